"""The posterior on the fingers' lines against that of distance and normal, and where fingers stop."""

import itertools

import numpy as np
import torch

from tests.make import HALF_BALL_RADIUS as RADIUS
from tests.make import contacts_on, near
from torchgrasp.contacts.closure_probability import (
    FOOTPRINT,
    NODES,
    first_contact,
    grid,
    line_posterior,
)
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.posterior import combined_covariance


def test_a_finger_stops_where_the_drawn_distance_turns_negative_nearest_to_its_contact(
    doubtful, generator
):
    lines = line_posterior(doubtful, contacts_on(doubtful, generator, 5))
    drawn = 2 * torch.randn(5, 60, 60, generator=generator, dtype=torch.float64) @ lines.root
    points, normals = first_contact(lines, drawn)
    value = drawn.unflatten(-1, (3, len(NODES), 4))
    t = grid().flip(0).numpy()
    nodes = np.array(NODES[::-1])
    met = 0
    for b, n, i in itertools.product(range(5), range(60), range(3)):
        deviation = np.interp(t, nodes, value[b, n, i, :, 0].flip(0).numpy())
        slope = (lines.slope[b, i] + value[b, n, i, :, 1:]).flip(0).numpy()
        close = np.linspace(-12, 12, 6001)
        distance = np.interp(close, t, lines.distance[b, i].flip(0).numpy() + deviation)
        stops = close[1:][(distance[:-1] <= 0) & (distance[1:] > 0)]
        if not len(stops):
            assert not bool(torch.isfinite(points[b, n, i]).any())
            continue
        expected = lines.points[b, i] + lines.deviation[b, i] * stops[:, None] * lines.normals[b, i]
        gap = torch.linalg.vector_norm(expected - points[b, n, i], dim=-1)
        assert float(gap.min()) < 0.006 * float(lines.deviation[b, i])
        stop = stops[gap.argmin()]
        assert abs(stop) <= np.abs(stops).min() + 3.0  # nearest, but for the width of a step
        met += 1
        there = np.array([np.interp(stop, nodes, slope[:, k]) for k in range(3)])
        near(normals[b, n, i], unit(torch.from_numpy(there)), 3e-2)
    assert 600 < met < 900  # some meet nothing, at twice the real deviations


def test_the_posterior_on_the_lines_is_that_of_distance_and_normal(doubtful, generator):
    lines = line_posterior(doubtful, contacts_on(doubtful, generator, 3))
    deviation = (lines.root @ lines.root).unflatten(-1, (3, 5, 4)).unflatten(1, (3, 5, 4))
    edge = doubtful.domain_radius - FOOTPRINT / RADIUS
    held = 0
    for b, i, k in itertools.product(range(3), range(3), range(5)):
        step = int((grid() == NODES[k]).nonzero())
        at = lines.points[b, i] + lines.deviation[b, i] * grid()[step] * lines.normals[b, i]
        mean, covariance = doubtful.estimate(at[None])
        near(lines.distance[b, i, step], mean[0, 0], 1e-10)
        near(lines.slope[b, i, k], mean[0, 1:], 1e-10)
        if float(torch.linalg.vector_norm(at)) <= edge:
            variance = doubtful.std_factor**2 * covariance[0, 0, 0]
            torch.testing.assert_close(
                deviation[b, i, k, 0, i, k, 0], variance, rtol=1e-6, atol=1e-12
            )
            held += 1
    assert 20 < held < 45  # outside the domain deviations are those at its edge


def distance_covariance(posterior, x):
    """The covariance of the distances in each set of points (b, k, 3)."""
    return combined_covariance(posterior, x[:, :, None], x.new_ones(1, 1, 1, 1))


def test_covariances_of_distances_and_their_sums_are_those_of_the_joint_posterior(
    doubtful, generator
):
    x = unit(torch.randn(3, 2, 4, 3, generator=generator, dtype=torch.float64))
    weights = torch.randn(3, 2, 2, 4, generator=generator, dtype=torch.float64)
    whole = torch.stack([torch.block_diag(*blocks) for blocks in weights])
    expected = whole @ distance_covariance(doubtful, x.flatten(1, 2)) @ whole.mT
    near(combined_covariance(doubtful, x, weights), expected, 1e-9)
    x = unit(torch.randn(4, 5, 3, generator=generator, dtype=torch.float64))
    found = distance_covariance(doubtful, x)
    for i in range(4):
        joint = doubtful.joint(doubtful.metres(x[i])).covariance
        near(found[i], joint[::4, ::4], 1e-10)
