"""Laws that hold over whole stages: rigid motions, units, the order of points, seeds, global state."""

import subprocess
import sys

import pytest
import torch

from tests.make import ball_contacts
from torchgrasp import ContactSpec, PointCloud, certify, encode, fit_shape, load_grasps, load_object, plan_contacts
from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.shape.fit import condition
from torchgrasp.shape.values import Normalisation, Observations
from torchgrasp.values import Contacts


def transformed(contacts: Contacts, motion: torch.Tensor, scale: float = 1.0) -> Contacts:
    points = scale * apply(motion, contacts.points)
    return Contacts(points, rotate(motion, contacts.normals))


@pytest.mark.promise("N5")
def test_the_posterior_moves_with_its_observations(seen_cylinder, motion, generator):
    x = seen_cylinder.points[:60] / 0.1
    n = len(x)
    observations = Observations(
        x,
        torch.zeros(n, dtype=torch.float64),
        seen_cylinder.normals[:60],
        torch.ones(n, dtype=torch.bool),
        torch.full((n,), 0.01, dtype=torch.float64),
        torch.full((n,), 0.05, dtype=torch.float64),
    )
    turn = motion[:3, :3]
    turned = Observations(
        x @ turn.T, observations.distance, observations.normal @ turn.T, *list(vars(observations).values())[3:]
    )
    origin = torch.zeros(3, dtype=torch.float64)
    here = condition(observations, Normalisation(origin, 0.1), seen_cylinder)
    there = condition(turned, Normalisation(motion[:3, 3], 0.1), seen_cylinder)
    queries = 0.01 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    a, b = here.predict(queries), there.predict(apply(motion, queries))
    torch.testing.assert_close(a.distance, b.distance, rtol=0, atol=1e-8)
    torch.testing.assert_close(a.normal @ turn.T, b.normal, rtol=0, atol=1e-8)
    torch.testing.assert_close(a.variance, b.variance, rtol=0, atol=1e-8)


@pytest.mark.promise("I6")
@pytest.mark.parametrize("name", ["cylinder", "jug", "rabbit", "spray"])
def test_a_shifted_cloud_gives_a_shifted_shape(name):
    """Ties on a raster are broken by order, not by the rounding of shifted coordinates."""
    view = load_object(name).view
    shift = torch.tensor([3.0, -2.0, 5.0], dtype=torch.float64)
    queries = view.points[::50]
    a = fit_shape(view, table=0.0).predict(queries)
    b = fit_shape(PointCloud(view.points + shift, None, view.viewpoint + shift), table=5.0).predict(queries + shift)
    torch.testing.assert_close(a.distance, b.distance, rtol=0, atol=1e-7)
    torch.testing.assert_close(a.variance, b.variance, rtol=0, atol=1e-7)


@pytest.mark.promise("I5", "N5")
def test_certificates_and_codes_ignore_frames_and_units(generator, motion):
    contacts = ball_contacts(40, generator)
    spec = ContactSpec(friction=0.8, friction_margin=1.0)
    here = certify(contacts, spec)
    assert 0 < int(here.closed.sum()) < 40
    for there in (transformed(contacts, motion), transformed(contacts, motion, scale=1000.0)):
        found = certify(there, spec)
        assert torch.equal(found.closed, here.closed)
        torch.testing.assert_close(found.margin, here.margin, rtol=0, atol=1e-9)
    torch.testing.assert_close(encode(transformed(contacts, motion)).q, encode(contacts).q)


@pytest.mark.promise("N7")
def test_the_code_of_a_permuted_triple_is_the_permuted_set(generator):
    contacts = ball_contacts(10, generator)
    swapped = Contacts(contacts.points.flip(1), contacts.normals.flip(1))
    a, b = encode(contacts).q, encode(swapped).q
    permutations = encode(contacts).permutation.tolist()
    index = [permutations.index([2 - i, 2 - j, 2 - k]) for i, j, k in permutations]
    torch.testing.assert_close(a, b[:, index])


@pytest.mark.promise("N10")
def test_the_same_seed_gives_the_same_plan(seen_cylinder):
    shape = fit_shape(seen_cylinder)
    spec = ContactSpec(friction=0.8)
    first, second = (plan_contacts(shape, spec, starts=60, seed=7) for _ in range(2))
    other = plan_contacts(shape, spec, starts=60, seed=8)
    assert torch.equal(first.contacts.points, second.contacts.points)
    assert torch.equal(first.status, second.status)
    assert not torch.equal(first.contacts.points, other.contacts.points)


GRASP = """
import sys, torch
torch.set_num_threads(int(sys.argv[1]))
from torchgrasp import load_hand, load_object, plan_grasps
plan_grasps(load_object("cylinder").view, load_hand("barrett"), starts=20, seed=3).save(sys.argv[2])
"""


@pytest.mark.promise("N10")
@pytest.mark.slow
def test_the_same_seed_gives_the_same_grasps_in_other_processes_and_with_two_threads_but_for_rounding(tmp_path):
    paths = [tmp_path / "one", tmp_path / "again", tmp_path / "two"]
    for path, threads in zip(paths, "112", strict=True):
        subprocess.run([sys.executable, "-c", GRASP, threads, str(path)], check=True, timeout=300)
    assert paths[0].read_bytes() == paths[1].read_bytes()
    one, two = load_grasps(paths[0]), load_grasps(paths[2])
    assert len(one) > 0 and torch.equal(one.status, two.status)
    torch.testing.assert_close(one.joints, two.joints, rtol=0, atol=1e-6)
    torch.testing.assert_close(one.obj_from_hand, two.obj_from_hand, rtol=0, atol=1e-6)
