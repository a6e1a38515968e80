"""Errors of a shape on the true surface that its camera did not see, and coverage of its std_m."""

from typing import TYPE_CHECKING

import numpy as np
import torch

from benchmarks.ground_truth import nearest_on_mesh, sample_hidden
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import extract_surface
from torchgrasp.values.planning import PointCloud

if TYPE_CHECKING:
    import trimesh

RESOLUTION = 56
"""Cells of the grid of the estimated surface along the domain's diameter."""
SAMPLES = 3000
"""Points on the true surface."""


def measure_shape(
    shape: ShapeGP, mesh: "trimesh.Trimesh", cloud: PointCloud, seed: int = 0
) -> dict[str, float]:
    """Return errors of a shape on the hidden true surface, without the face on the table.

    * "median", "p90": distance [mm] of the true surface from the estimated one.
    * "within_1", "within_2", "within_3": share of the true surface within k std_m. Surface outside
      the domain is missed.

    All is NaN where nothing is hidden.

    Args:
        shape: the posterior [m].
        mesh: the true surface in the frame of the cloud [m].
        cloud: what the camera saw, before cleaning.
        seed: of the samples.
    """
    points = sample_hidden(mesh, cloud, SAMPLES, np.random.default_rng(seed))
    if not len(points):
        return dict.fromkeys(("median", "p90", "within_1", "within_2", "within_3"), float("nan"))
    feet, _ = nearest_on_mesh(extract_surface(shape, RESOLUTION).mesh(), points)
    error = 1e3 * torch.linalg.vector_norm(feet - points, dim=-1)
    inside = shape.contains(points)
    estimate = shape.predict(points[inside])
    ratio = torch.full_like(error, torch.inf)
    # Distance and std_m in metres are both divided by the slope there, which cancels.
    ratio[inside] = estimate.distance.abs() / (shape.std_factor * estimate.variance.sqrt())
    shares = {f"within_{k}": float((ratio <= k).double().mean()) for k in (1, 2, 3)}
    return {"median": float(error.quantile(0.5)), "p90": float(error.quantile(0.9))} | shares
