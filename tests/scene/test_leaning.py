"""Sides of objects that lean all alike tell of a wrong focal length, and of how wrong it is."""

import re

import pytest
import torch

from torchgrasp.cloud import look_at
from torchgrasp.geometry.frames import apply, inverse
from torchgrasp.geometry.plane import Plane
from torchgrasp.scene.leaning import tell_leaning

POSE = look_at(0.0, 40.0, 0.8)
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def draw(n, seed):
    return torch.rand(n, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def can(x, y, taper=0.0, seed=0):
    """The seen half of a can, whose radius shrinks upward by `taper` times the height."""
    share = draw(800, seed)
    turn = (share[:, 0] - 0.5) * torch.pi
    z = 0.12 * share[:, 1]
    radius = 0.035 - taper * z
    return torch.stack([x + radius * turn.cos(), y + radius * turn.sin(), z], -1)


def ball(x, y, seed=0):
    """The seen side of a ball on the table."""
    share = draw(1600, seed)
    z = 2 * share[:, 0] - 1
    turn = 2 * torch.pi * share[:, 1]
    flat = (1 - z * z).sqrt()
    normals = torch.stack([flat * turn.cos(), flat * turn.sin(), z], -1)
    place = torch.tensor([x, y, 0.04], dtype=torch.float64)
    points = place + 0.04 * normals
    seen = ((POSE[:3, 3] - points) * normals).sum(-1) > 0
    return points[seen]


def told(things, factor):
    """The note on objects on z = 0, seen with focal lengths that are `factor` times the true ones."""
    labels = torch.cat([torch.full((len(x),), k + 1) for k, x in enumerate(things)])
    stretch = torch.tensor([1 / factor, 1 / factor, 1.0], dtype=torch.float64)
    camera = inverse(POSE)
    points = apply(camera, torch.cat(things)) * stretch
    normal = (camera[:3, :3] @ UP) / stretch
    normal = normal / normal.norm()
    foot = apply(camera, torch.zeros(1, 3, dtype=torch.float64))[0] * stretch
    table = Plane(normal, float(normal @ foot))
    return tell_leaning(points, labels, torch.eye(4, dtype=torch.float64), table)


@pytest.mark.parametrize("factor", [0.6, 0.75, 1.35, 1.6])
def test_a_wrong_focal_length_is_told_with_its_ratio(factor):
    (note,) = told([can(0.0, -0.15), can(0.05, 0.12, seed=1), ball(0.0, 0.0)], factor)
    found = re.search(r"as if the focal lengths were ([\d.]+) times the true ones", note)
    assert found is not None and float(found[1]) == pytest.approx(factor, rel=0.1)
    assert ("lean towards" in note) == (factor > 1)


def test_right_views_balls_and_one_tapered_thing_are_no_wrong_focal_length():
    upright = [can(0.0, -0.15), can(0.05, 0.12, seed=1)]
    assert told(upright, 1.0) == told(upright, 1.1) == ()
    assert told([ball(0.0, -0.15), ball(0.05, 0.12)], 1.5) == ()
    assert told([can(0.0, -0.15, taper=0.25), can(0.05, 0.12)], 1.0) == ()
    assert told([can(0.0, -0.15, taper=0.25)], 1.0) == ()
