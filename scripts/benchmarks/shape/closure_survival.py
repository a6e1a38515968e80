"""How many contacts that are closed on the estimated surface are closed on the true one: what shape errors cost."""

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks.ground_truth import nearest_on_mesh, sample_mesh
from benchmarks.shape.accuracy import RESOLUTION, SURE_VARIANCE
from torchgrasp.geometry.linalg import unit
from torchgrasp.plan.closure import closed_exact
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import extract_surface

if TYPE_CHECKING:
    import trimesh

SAMPLES = 4000
"""Points of the estimated surface of which triples are drawn."""
TRIPLES = 60000
"""Random triples that are tried, at most."""
LEAST_HEIGHT = 0.010
"""Least height [m] of a contact over the object's lowest point."""
SIDES = (0.015, 0.110)
"""Least and greatest distance [m] between two contacts."""
FLAT_RADIUS, FLAT_ANGLE = 0.008, math.radians(25.0)
"""A contact is flat when the normals of the surface within 8 mm of it agree to 25 degrees."""
LEAST_CLOSED = 10
"""Fewer closed triples than this tell nothing, and give NaN."""


def closure_survival(shape: ShapeGP, mesh: "trimesh.Trimesh", seed: int = 0) -> dict[str, float]:
    """Return the share of triples closed on the estimated surface that are closed on the true one.

    Random triples of the zero level with variance < 0.03, 10 mm above the ground and 15 to 110 mm apart, that have
    frictional form closure with the estimated normals: "sure_" at friction 0.6; "flat_" at 0.4 and on flat surface
    alone. Each contact is moved to the nearest point of the true mesh on the finger's side, with its normal, and
    judged at friction 0.6 and 0.8: "sure_0.6", "sure_0.8", "flat_0.6", "flat_0.8"; "sure_yield" and "flat_yield" are
    the shares of the triples that were closed on the estimate.

    Args:
        shape: the posterior [m].
        mesh: the true surface in its frame [m], resting on the ground.
        seed: of the samples.
    """
    generator = np.random.default_rng(seed)
    points, _ = sample_mesh(extract_surface(shape, RESOLUTION).mesh(), SAMPLES, generator)
    points = points[shape.contains(points)]
    jet = shape.jet(shape.normalise(points))
    normals = unit(jet.gradient)
    flat = _flat(points, normals)
    use = (jet.variance < SURE_VARIANCE) & (points[:, 2] > float(mesh.bounds[0, 2]) + LEAST_HEIGHT)
    true_points, true_normals = nearest_on_mesh(mesh, points, normals)

    shares: dict[str, float] = {}
    for name, rows, friction in (("sure", use, 0.6), ("flat", use & flat, 0.4)):
        triples = _triples(points, torch.nonzero(rows)[:, 0], generator)
        closed = closed_exact(points[triples], normals[triples], friction)
        closed_triples = triples[closed]
        for judged in (0.6, 0.8):
            still_closed = closed_exact(true_points[closed_triples], true_normals[closed_triples], judged)
            enough = len(closed_triples) >= LEAST_CLOSED
            shares[f"{name}_{judged}"] = float(still_closed.double().mean()) if enough else math.nan
        shares[f"{name}_yield"] = len(closed_triples) / len(triples) if len(triples) else 0.0
    return shares


def _triples(points: Float[Tensor, "n 3"], rows: Tensor, generator: np.random.Generator) -> Tensor:
    """Return random triples of rows whose points are neither too close nor too far apart."""
    if len(rows) < 3:
        return torch.zeros(0, 3, dtype=torch.long)
    triples = rows[torch.from_numpy(generator.integers(len(rows), size=(TRIPLES, 3)))]
    corners = points[triples]
    side = torch.linalg.vector_norm(corners - corners.roll(1, 1), dim=-1)
    return triples[(side.amin(-1) > SIDES[0]) & (side.amax(-1) < SIDES[1])]


def _flat(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
    """Tell at which samples of the surface the normals nearby agree."""
    near = torch.cdist(points, points) < FLAT_RADIUS
    agree = normals @ normals.T > math.cos(FLAT_ANGLE)
    return ~(near & ~agree).any(-1)
