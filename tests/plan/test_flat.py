"""The bend of the surface against a sphere's closed form, and the guide's rows against finite differences."""

import dataclasses
import math

import torch

from torchgrasp.linalg import unit
from torchgrasp.plan.flat import RING_RADIUS, bend, bend_guide
from torchgrasp.plan.problem import carry, triple_jet
from torchgrasp.plan.wrench import tangents


def test_bend_of_a_sphere_is_the_angle_under_which_the_ring_is_seen_from_its_centre(ellipsoid, generator):
    sphere = dataclasses.replace(ellipsoid, axes=(0.5, 0.5, 0.5))
    points = 0.5 * unit(torch.randn(5, 3, 3, generator=generator, dtype=torch.float64))
    found = bend(sphere, points, triple_jet(sphere, points).normals)
    expected = math.atan(RING_RADIUS / (0.5 * sphere.scale))
    torch.testing.assert_close(found, torch.full_like(found, expected))


def test_guide_rows_are_chords_and_their_slopes_match_finite_differences(ellipsoid, generator):
    points = 0.8 * torch.randn(5, 3, 3, generator=generator, dtype=torch.float64)
    jet = triple_jet(ellipsoid, points)
    tangent = tangents(points, jet.normals)
    guide = bend_guide(ellipsoid, points, tangent, jet, flatness=0.4)
    move = torch.randn(5, 3, 3, generator=generator, dtype=torch.float64)
    h = 1e-5
    ends = []
    for sign in (-h, h):
        there = points + sign * move
        moved = triple_jet(ellipsoid, there)
        ends.append(bend_guide(ellipsoid, there, carry(tangent, moved.normals), moved, flatness=0.4).value)
    torch.testing.assert_close((guide.rows(points + move) - guide.value), (ends[1] - ends[0]) / (2 * h))
