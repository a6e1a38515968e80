"""The bend of the surface against a sphere's closed form."""

import dataclasses
import math

import torch

from torchgrasp.linalg import unit
from torchgrasp.plan.normal_variation import RING_RADIUS, normal_variation
from torchgrasp.plan.problem import triple_jet


def test_bend_of_a_sphere_is_the_angle_under_which_the_ring_is_seen_from_its_centre(ellipsoid, generator):
    sphere = dataclasses.replace(ellipsoid, axes=(0.5, 0.5, 0.5))
    points = 0.5 * unit(torch.randn(5, 3, 3, generator=generator, dtype=torch.float64))
    found = normal_variation(sphere, points, triple_jet(sphere, points).normals)
    expected = math.atan(RING_RADIUS / (0.5 * sphere.scale))
    torch.testing.assert_close(found, torch.full_like(found, expected))
