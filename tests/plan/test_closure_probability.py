"""The probability of closure against surfaces drawn anew."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from torchgrasp.errors import BadArgument
from torchgrasp.linalg import unit
from torchgrasp.plan.closure_probability import closure_probability
from torchgrasp.plan.surface_samples import FOOTPRINT, NODES, finer_grid, first_contact, sample_surfaces
from torchgrasp.plan.wrench import closed_exact
from torchgrasp.shape.condition import condition
from torchgrasp.shape.gp import Normalisation, ShapeGP
from torchgrasp.shape.joint_posterior import distance_covariance
from torchgrasp.shape.observations import Observations
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Contacts, PointCloud

RADIUS = 0.04


def ball(seen_from: float, std_factor: float, noise: float = 0.02) -> ShapeGP:
    """A ball of which the part above `seen_from` (in radii) was seen."""
    generator = torch.Generator().manual_seed(0)
    n = unit(torch.randn(120, 3, generator=generator, dtype=torch.float64))
    n = n[n[:, 2] > seen_from]
    x = torch.cat(
        [n, torch.zeros(1, 3, dtype=torch.float64), 1.2 * unit(torch.randn(40, 3, generator=generator)).double()]
    )
    distance = torch.cat([torch.zeros(len(n)), torch.tensor([-1.0]), torch.full((40,), 0.2)]).double()
    oriented = torch.arange(len(x)) < len(n)
    sigma = torch.full_like(distance, noise)
    observations = Observations(x, distance, torch.cat([n, torch.zeros_like(x[len(n) :])]), oriented, sigma, sigma)
    return condition(
        observations,
        Normalisation(torch.zeros(3, dtype=torch.float64), RADIUS),
        PointCloud(RADIUS * n, n),
        std_factor=std_factor,
    )


def contacts_on(shape: ShapeGP, generator: torch.Generator, count: int) -> Contacts:
    """Random triples on the mean surface whose normals are the mean's, closed there at friction 0.8."""
    x = unit(torch.randn(20 * count, 3, 3, generator=generator, dtype=torch.float64))
    for _ in range(8):
        distance, slope = (t.unflatten(0, (len(x), 3)) for t in shape.mean_and_gradient(x.flatten(0, 1)))
        x = x - (distance / (slope * slope).sum(-1))[..., None] * slope
    normals = unit(shape.mean_and_gradient(x.flatten(0, 1))[1]).unflatten(0, (len(x), 3))
    good = closed_exact(x, normals, 0.8) & (torch.linalg.vector_norm(x - x.roll(1, 1), dim=-1).amin(-1) > 0.3)
    x, normals = x[good][:count], normals[good][:count]
    return Contacts(shape.metres(x), normals)


@pytest.fixture(scope="module")
def doubtful() -> ShapeGP:
    return ball(-0.2, std_factor=0.4)


def test_a_sure_shape_is_sure_to_be_closed():
    shape = ball(-2.0, std_factor=0.1)
    angle = torch.tensor([0.1, 2.2, 4.3], dtype=torch.float64)
    corners = torch.stack([angle.cos(), angle.sin(), torch.zeros(3, dtype=torch.float64)], -1)[None]
    none = torch.zeros(1, 3)
    contacts = Contacts(RADIUS * corners, corners)
    found = closure_probability(shape, contacts)
    assert float(found.probability) > 0.999
    assert 0.0 < float(found.standard_error) < 1e-3
    for friction in (0.0, 1e-3):
        none = closure_probability(shape, contacts, ContactSpec(friction=friction))
        assert float(none.probability) < 0.02


def test_the_probability_is_a_share_with_a_bounded_error(doubtful, generator):
    contacts = contacts_on(doubtful, generator, 100)
    for friction in (0.5, 1.0):
        found = closure_probability(doubtful, contacts, ContactSpec(friction=friction), n=1000)
        assert float(found.standard_error.max()) <= 0.5 / 1000**0.5
        assert bool(((found.probability >= 0) & (found.probability <= 1)).all())
    assert 0.5 < float(found.probability.mean()) < 0.99


def test_surfaces_drawn_anew_are_closed_as_often(doubtful, generator, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "scripts"))
    from benchmarks.proof.closure_reference import redrawn_closure

    contacts = contacts_on(doubtful, generator, 6)
    found = closure_probability(doubtful, contacts, ContactSpec(friction=0.6), n=600)
    again = redrawn_closure(doubtful, contacts, 0.6, 600, seed=1)
    assert bool(((again - found.probability).abs() <= 3 * 2**0.5 * found.standard_error).all())
    assert float(found.probability.min()) < 0.95


def test_rows_do_not_depend_on_each_other_and_a_seed_fixes_every_bit(doubtful, generator):
    contacts = contacts_on(doubtful, generator, 20)
    every, again, other = (closure_probability(doubtful, contacts, n=300, seed=seed) for seed in (3, 3, 4))
    assert torch.equal(every.probability, again.probability)
    assert not torch.equal(every.probability, other.probability)
    some = closure_probability(doubtful, contacts[[4, 11]], n=300, seed=3)
    torch.testing.assert_close(some.probability, every.probability[[4, 11]], rtol=0, atol=1 / 300)
    assert len(closure_probability(doubtful, contacts[:0])) == 0


def test_a_finger_stops_where_the_drawn_distance_turns_negative_nearest_to_its_contact(doubtful, generator):
    lines = sample_surfaces(doubtful, contacts_on(doubtful, generator, 5))
    drawn = 2 * torch.randn(5, 200, 60, generator=generator, dtype=torch.float64) @ lines.root
    points, normals = first_contact(lines, drawn)
    value = drawn.unflatten(-1, (3, len(NODES), 4))
    at, rungs = finer_grid().flip(0).numpy(), np.array(NODES[::-1])
    met = 0
    for b, n, i in itertools.product(range(5), range(200), range(3)):
        deviation = np.interp(at, rungs, value[b, n, i, :, 0].flip(0).numpy())
        slope = (lines.slope[b, i] + value[b, n, i, :, 1:]).flip(0).numpy()
        close = np.linspace(-12, 12, 6001)
        distance = np.interp(close, at, lines.distance[b, i].flip(0).numpy() + deviation)
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
        there = np.array([np.interp(stop, rungs, slope[:, k]) for k in range(3)])
        torch.testing.assert_close(normals[b, n, i], unit(torch.from_numpy(there)), rtol=0, atol=3e-2)
    assert 2000 < met < 3000  # some meet nothing, at twice the real deviations


def test_the_posterior_on_the_lines_is_that_of_distance_and_normal(doubtful, generator):
    lines = sample_surfaces(doubtful, contacts_on(doubtful, generator, 3))
    deviation = (lines.root @ lines.root).unflatten(-1, (3, 5, 4)).unflatten(1, (3, 5, 4))
    edge = doubtful.domain_radius - FOOTPRINT / RADIUS
    held = 0
    for b, i, k in itertools.product(range(3), range(3), range(5)):
        step = int((finer_grid() == NODES[k]).nonzero())
        at = lines.points[b, i] + lines.steps[b, i, step] * lines.normals[b, i]
        mean, covariance = doubtful.estimate(at[None])
        torch.testing.assert_close(lines.distance[b, i, step], mean[0, 0], rtol=0, atol=1e-10)
        torch.testing.assert_close(lines.slope[b, i, k], mean[0, 1:], rtol=0, atol=1e-10)
        if float(torch.linalg.vector_norm(at)) <= edge:
            variance = doubtful.std_factor**2 * covariance[0, 0, 0]
            torch.testing.assert_close(deviation[b, i, k, 0, i, k, 0], variance, rtol=1e-6, atol=1e-12)
            held += 1
    assert 20 < held < 45  # outside the domain deviations are those at its edge


def test_covariances_of_distances_are_those_of_the_joint_posterior(doubtful, generator):
    x = unit(torch.randn(4, 5, 3, generator=generator, dtype=torch.float64))
    found = distance_covariance(doubtful, x)
    for i in range(4):
        joint = doubtful.joint(doubtful.metres(x[i])).covariance
        torch.testing.assert_close(found[i], joint[::4, ::4], rtol=0, atol=1e-10)


def internal_forces(points: Tensor, g: Tensor) -> Tensor:
    """The forces of tensions g along the edges 12, 23, 31."""
    push = g[..., None] * unit(points.roll(-1, -2) - points)
    return push - push.roll(1, -2)


def test_a_triple_is_closed_if_and_only_if_internal_forces_lie_inside_its_cones(generator):
    points = torch.randn(200, 3, 3, generator=generator, dtype=torch.float64)
    noise = torch.randn(200, 3, 3, generator=generator, dtype=torch.float64)
    normals = unit(unit(points - points.mean(1, keepdim=True)) + 0.3 * noise)
    grid = torch.tensor(list(itertools.product(range(-8, 9), repeat=3)), dtype=torch.float64)
    force = unit(internal_forces(points[:, None], grid[grid.abs().sum(1) > 0]))
    cosine = -(force * normals[:, None]).sum(-1)
    exists = (cosine > torch.tensor(0.6, dtype=torch.float64).atan().cos()).all(-1).any(-1)
    closed = closed_exact(points, normals, 0.6)
    assert bool((closed | ~exists).all())
    assert int((closed & ~exists).sum()) < 0.05 * int(closed.sum())  # the grid is coarse
    assert 50 < int(closed.sum()) < 180


def test_bad_arguments_name_what_was_found(doubtful, generator):
    contacts = contacts_on(doubtful, generator, 2)
    far = Contacts(contacts.points * 100, contacts.normals)
    long = Contacts(contacts.points, 1.1 * contacts.normals)
    for action, match in (
        (lambda: closure_probability(doubtful, contacts, n=0), "integer from 1"),
        (lambda: closure_probability(doubtful, contacts, seed=-1), "integer from 0"),
        (lambda: closure_probability(doubtful, far), "domain"),
        (lambda: closure_probability(doubtful, long), "unit vectors"),
    ):
        with pytest.raises(BadArgument, match=match):
            action()
