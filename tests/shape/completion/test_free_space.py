"""Free space around a cylinder, of which the camera's cone and the table are known in closed form."""

import math

import pytest
import torch

from torchgrasp import PointCloud, fit_shape
from torchgrasp.shape.completion.silhouette import silhouettes
from torchgrasp.shape.estimate import Normalisation
from torchgrasp.shape.extra_observations import free_space, free_space_violations

CENTER = torch.tensor([0.0, 0.0, 0.06], dtype=torch.float64)


def test_free_space_is_free_and_its_least_distance_is_a_lower_bound(seen_cylinder: PointCloud):
    assert seen_cylinder.viewpoint is not None
    outline = silhouettes(seen_cylinder)
    x, least = free_space(outline, Normalisation(CENTER, 0.07), table=0.0)
    points = 0.07 * x + CENTER
    least = 0.07 * least
    assert len(x) > 100 and torch.linalg.vector_norm(x, dim=-1).max() < 1.15
    beside = torch.linalg.vector_norm(points[:, :2], dim=-1) - 0.03
    apart = torch.stack([beside, -points[:, 2], points[:, 2] - 0.12]).amax(0)
    # The outline is known to about a spacing of the cloud's points.
    assert (apart - least).min() > -0.003
    assert (points[:, 2] < 0).any() and (points[:, 2] > 0).any()
    above, _ = free_space(outline, Normalisation(CENTER, 0.07))
    assert len(above) < len(x)


def test_a_shape_that_respects_free_space_does_not_violate_it_and_a_blown_up_one_does(
    seen_cylinder: PointCloud,
):
    assert seen_cylinder.viewpoint is not None
    shape = fit_shape(seen_cylinder, table=0.0)
    x = shape.normalise(_ring(0.045))
    near = torch.full((len(x),), 0.005 / shape.scale, dtype=torch.float64)
    assert len(free_space_violations(shape, x, near)) == 0
    rows = free_space_violations(shape, x, 8 * near)  # 40 mm away from a surface that is 15 mm away
    assert 0 < len(rows) <= 16 and len(rows.unique()) == len(rows)


def _ring(radius: float) -> torch.Tensor:
    angle = torch.arange(40, dtype=torch.float64) * 2 * math.pi / 40
    return torch.stack(
        [radius * angle.cos(), radius * angle.sin(), torch.full_like(angle, 0.06)], -1
    )


@pytest.mark.filterwarnings("ignore::torchgrasp.foundation.errors.Flat")
def test_a_slab_seen_face_on_stays_within_its_outline(generator: torch.Generator):
    """Nothing is seen of its sides; without free space the far side swells beyond the outline."""
    p = (
        torch.rand(1000, 3, generator=generator, dtype=torch.float64)
        * torch.tensor([0.0, 0.05, 0.17]).double()
    )
    camera = torch.tensor([0.6, 0.025, 0.2], dtype=torch.float64)
    shape = fit_shape(
        PointCloud(p + torch.tensor([0.04, 0.0, 0.0]).double(), None, camera), table=0.0
    )
    depth = torch.linspace(-0.03, 0.03, 7, dtype=torch.float64)
    height = torch.linspace(0.03, 0.14, 7, dtype=torch.float64)
    x, z = torch.cartesian_prod(depth, height).T
    for y in (-0.015, 0.065):  # 15 mm beside the slab
        beside = torch.stack([x, torch.full_like(x, y), z], -1)
        assert (shape.predict(beside).distance > 0).all()
