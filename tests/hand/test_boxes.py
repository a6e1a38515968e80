"""Distances of boxes against linear programmes, coal, trimesh and finite differences."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.optimize import linprog

from tests.make import near, real
from torchgrasp.geometry.frames import rotation_from_vector
from torchgrasp.hand.self_collision import BoxPairs, box_distance


def separation(*pairs: torch.Tensor) -> torch.Tensor:
    return BoxPairs(*pairs).along_axes().amax(0)


def boxes(n: int, generator: torch.Generator) -> tuple[torch.Tensor, ...]:
    """Draw pairs of boxes of which about half overlap; in a third of them axes are parallel."""
    turns = torch.randn(2, n, 3, generator=generator, dtype=torch.float64)
    turns[1, : n // 6] = turns[0, : n // 6]
    turns[:, n // 6 : n // 3, :2] = 0
    a, b = rotation_from_vector(turns).permute(0, 2, 3, 1)
    half = 0.2 + torch.rand(2, 3, n, generator=generator, dtype=torch.float64)
    gap = 1.2 * torch.randn(3, n, generator=generator, dtype=torch.float64)
    return a, b, gap, half[0], half[1]


def test_two_boxes_overlap_exactly_where_a_linear_programme_finds_a_common_point(generator):
    found = separation(*boxes(60, generator=generator))
    generator.manual_seed(generator.initial_seed())
    a, b, gap, half_a, half_b = (x.numpy() for x in boxes(60, generator))
    assert 10 < int((found < 0).sum()) < 50
    for k in range(60):
        rows = np.concatenate([a[..., k].T, -a[..., k].T, b[..., k].T, -b[..., k].T])
        shift = b[..., k].T @ gap[:, k]
        limits = np.concatenate(
            [half_a[:, k], half_a[:, k], half_b[:, k] + shift, half_b[:, k] - shift]
        )
        common = linprog(np.zeros(3), rows, limits, bounds=(None, None)).status == 0
        assert common == (found[k] < 0)


def test_separation_of_boxes_is_coals_depth_and_at_most_its_distance(generator):
    coal = pytest.importorskip("coal")
    found = separation(*boxes(400, generator))
    generator.manual_seed(generator.initial_seed())
    a, b, gap, half_a, half_b = (x.numpy() for x in boxes(400, generator))
    truth = np.zeros(400)
    for k in range(400):
        shapes = [coal.Box(*(2 * half[:, k])) for half in (half_a, half_b)]
        places = coal.Transform3s(a[..., k], np.zeros(3)), coal.Transform3s(b[..., k], gap[:, k])
        request = coal.DistanceRequest()
        request.enable_signed_distance = True
        truth[k] = coal.distance(
            shapes[0], places[0], shapes[1], places[1], request, coal.DistanceResult()
        )
    met = truth < 0
    np.testing.assert_allclose(found.numpy()[met], truth[met], atol=1e-6)
    assert (found.numpy()[~met] <= truth[~met] + 1e-6).all()
    assert (found.numpy()[~met] >= truth[~met] / 3**0.5 - 1e-6).all()


def test_separation_of_boxes_closed_forms_gradient_and_dtype(generator):
    eye = torch.eye(3, dtype=torch.float64)[..., None]
    unit = torch.ones(3, 1, dtype=torch.float64)
    quarter = rotation_from_vector(real([0.0, 0.0, torch.pi / 4]))[..., None]
    tilted = rotation_from_vector(real([torch.pi / 4, 0.0, 0.0]))[..., None]
    for a, b, gap, expected in [
        (eye, eye, (3.0, 0.5, 0.0), 1.0),  # face to face
        (eye, eye, (0.5, 0.0, 1.0), -1.0),  # within one another
        (eye, quarter, (4.0, 0.0, 0.0), 3 - 2**0.5),  # face to edge
        (quarter, tilted, (2.0, 0.0, 0.0), 1 - 2**0.5),  # an edge in a face
        (
            quarter,
            rotation_from_vector(torch.tensor([0.0, torch.pi / 4, 0]).double())[..., None],
            (4.0, 0.0, 0.0),
            4 - 2 * 2**0.5,
        ),  # crossing edges
    ]:
        found = separation(a, b, real(gap)[:, None], unit, unit)
        assert float(found) == pytest.approx(expected, abs=1e-12)
    given = [x[..., 10:] for x in boxes(30, generator)]  # where axes are parallel it has kinks
    assert torch.autograd.gradcheck(separation, [x.requires_grad_() for x in given])
    with torch.no_grad():
        single = separation(*(x.float() for x in given))
        near(single.double(), separation(*given), 1e-5)


def test_box_distance_is_that_of_trimesh(generator):
    half = real([0.5, 1.0, 1.5])
    points = 2 * torch.randn(300, 3, generator=generator, dtype=torch.float64)
    box = trimesh.creation.box(extents=2 * half.numpy())
    truth = -trimesh.proximity.signed_distance(box, points.numpy())
    found = box_distance(points, half.expand_as(points))
    near(found, torch.tensor(truth), 1e-9)
    points.requires_grad_()
    assert torch.autograd.gradcheck(lambda p: box_distance(p, half.expand_as(p)), (points[:50],))
