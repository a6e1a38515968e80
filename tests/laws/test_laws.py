"""Laws over whole stages: rigid motions, units, order, seeds; and numbers far from the usual."""

import functools
import itertools
import warnings

import numpy as np
import pytest
import torch
import trimesh
from scipy.optimize import linprog

from tests.apart import run_apart
from tests.make import ball_contacts, load_hand
from torchgrasp import (
    ContactSpec,
    Plane,
    PointCloud,
    certify,
    encode,
    fit_shape,
    load_grasps,
    load_object,
    plan_contacts,
    plan_grasps,
)
from torchgrasp.cloud import look_at, partial_view
from torchgrasp.foundation.errors import CloudWarning, Status
from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.shape.estimate import Normalisation, Observations
from torchgrasp.shape.fit import condition
from torchgrasp.values.planning import Contacts


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
        x @ turn.T,
        observations.distance,
        observations.normal @ turn.T,
        *list(vars(observations).values())[3:],
    )
    origin = torch.zeros(3, dtype=torch.float64)
    here = condition(observations, Normalisation(origin, 0.1), seen_cylinder)
    there = condition(turned, Normalisation(motion[:3, 3], 0.1), seen_cylinder)
    queries = 0.01 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    a = here.predict(queries)
    b = there.predict(apply(motion, queries))
    torch.testing.assert_close(a.distance, b.distance, rtol=0, atol=1e-8)
    torch.testing.assert_close(a.normal @ turn.T, b.normal, rtol=0, atol=1e-8)
    torch.testing.assert_close(a.variance, b.variance, rtol=0, atol=1e-8)


@pytest.mark.promise("I6")
@pytest.mark.parametrize("name", ["jug", "rabbit"])
def test_a_shifted_cloud_gives_a_shifted_shape(name):
    """Ties on a raster are broken by order, not by the rounding of shifted coordinates."""
    view = load_object(name).view
    shift = torch.tensor([3.0, -2.0, 5.0], dtype=torch.float64)
    queries = view.points[::50]
    a = fit_shape(view, table=0.0).predict(queries)
    b = fit_shape(PointCloud(view.points + shift, None, view.viewpoint + shift), table=5.0).predict(
        queries + shift
    )
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
    a = encode(contacts).q
    b = encode(swapped).q
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
import torch
from torchgrasp import load_hand, load_object, plan_grasps
for threads, path in enumerate({!r}, 1):
    torch.set_num_threads(threads)
    plan_grasps(load_object("cylinder").view, load_hand("barrett"), starts=20, seed=3).save(path)
"""


@pytest.mark.promise("N10")
@pytest.mark.slow
def test_the_same_seed_gives_the_same_grasps_in_another_process_and_with_two_threads_but_for_rounding(
    tmp_path,
):
    paths = [tmp_path / "one", tmp_path / "two", tmp_path / "here"]
    run_apart(GRASP.format([str(path) for path in paths[:2]]))
    plan_grasps(load_object("cylinder").view, load_hand("barrett"), starts=20, seed=3).save(
        paths[2]
    )
    assert paths[0].read_bytes() == paths[2].read_bytes()
    one = load_grasps(paths[0])
    two = load_grasps(paths[1])
    assert len(one) > 0 and torch.equal(one.status, two.status)
    torch.testing.assert_close(one.joints, two.joints, rtol=0, atol=1e-6)
    torch.testing.assert_close(one.obj_from_hand, two.obj_from_hand, rtol=0, atol=1e-6)


@pytest.mark.promise("I6")
@pytest.mark.parametrize("metres", [1000.0])
def test_contacts_far_from_the_origin_are_those_near_it(metres):
    view = load_object("cylinder").view
    shift = metres * torch.tensor([0.6, -0.8, 0.3], dtype=torch.float64)
    far = PointCloud(view.points + shift, None, view.viewpoint + shift)
    shapes = []
    plans = []
    for cloud, table in ((view, 0.0), (far, float(shift[2]))):
        shapes.append(fit_shape(cloud, table=Plane.horizontal(table)))
        plans.append(plan_contacts(shapes[-1], ContactSpec(table=table), starts=30, seed=0))
    here, there = plans
    assert torch.equal(here.status, there.status) and int((here.status == Status.OK).sum()) > 5
    torch.testing.assert_close(
        there.contacts.points - shift, here.contacts.points, rtol=0, atol=1e-8
    )
    near = shapes[0].predict(
        there.contacts.points - shift
    )  # a normal turns by 32 rad a metre on the way between both
    torch.testing.assert_close(there.contacts.normals, near.normal, rtol=0, atol=1e-10)


SIZES = {  # half sides [m]
    "cube of 1 cm": (0.005, 0.005, 0.005),
    "cube of 30 cm": (0.15, 0.15, 0.15),
    "lying plate of 2 mm": (0.1, 0.1, 0.001),
    "standing plate of 2 mm": (0.001, 0.1, 0.1),
    "lying rod of 6 mm": (0.15, 0.003, 0.003),
    "standing rod of 6 mm": (0.003, 0.003, 0.15),
}


@pytest.mark.promise("N1")
@pytest.mark.parametrize("name", SIZES)
def test_what_is_tiny_huge_thin_or_long_has_closed_contacts_or_a_status(name):
    """Whatever is called closed is so by an independent programme; every other row says what it
    lacks.
    """
    half = np.array(SIZES[name])
    box = trimesh.creation.box(2 * half)
    box.apply_translation([0, 0, half[2]])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CloudWarning)  # some fill the image
        shape = fit_shape(partial_view(box, look_at(40.0, 35.0, target=box), n=1500), table=0.0)
        spec = ContactSpec(table=0.0)
        plan = plan_contacts(shape, spec, starts=30, seed=0)
    assert len(plan) == 30 and set(plan.status.tolist()) <= set(map(int, Status))
    for row in plan:
        if int(row.status) == Status.OK:
            points = row.contacts.points[0].numpy()
            normals = row.contacts.normals[0].numpy()
            assert (
                np.isfinite(points).all()
                and margin(points, normals, spec.planned_friction, 64) > -1e-9
            )
    if name == "cube of 1 cm":
        assert not bool((plan.status == Status.OK).any())  # three fingertips have no room


def margin(points: np.ndarray, normals: np.ndarray, friction: float, edges: int) -> float:
    """Return the largest s of Eq. (13) by SciPy, from points and outward normals alone."""
    columns = []
    centre = points.mean(0)
    radius = np.linalg.norm(points - centre, axis=1).max()
    for point, normal in zip(points, normals, strict=True):
        inward = -normal / np.linalg.norm(normal)
        one = np.cross(inward, np.eye(3)[np.abs(inward).argmin()])
        one /= np.linalg.norm(one)
        two = np.cross(inward, one)
        angles = 2 * np.pi * np.arange(edges)[:, None] / edges
        forces = inward + friction * (np.cos(angles) * one + np.sin(angles) * two)
        columns.append(np.concatenate([forces, np.cross(point - centre, forces) / radius], 1))
    wrenches = np.concatenate(columns).T
    n = wrenches.shape[1]
    equal = np.vstack(
        [np.hstack([wrenches, wrenches.sum(1, keepdims=True)]), np.append(np.ones(n), n)]
    )
    found = linprog(
        np.append(np.zeros(n), -1.0),
        A_eq=equal,
        b_eq=[0] * 6 + [1],
        bounds=[(0, None)] * n + [(None, None)],
    )
    return -found.fun if found.status == 0 else -np.inf


@pytest.mark.promise("I10")
def test_friction_and_edges_decide_as_an_independent_programme_does_and_more_never_opens():
    generator = torch.Generator().manual_seed(3)
    normals = torch.randn(12, 3, 3, generator=generator, dtype=torch.float64)
    normals[:, :, 2] *= 0.2  # about a plane, where many are closed
    normals = normals / normals.norm(dim=-1, keepdim=True)
    contacts = Contacts(0.04 * normals, normals)
    closed = {}

    @functools.cache
    def verdicts(friction: float) -> list[bool]:
        """Whether the independent programme calls each contact set closed, with a cone of 48 edges."""
        return [
            margin(p, n, friction, 48) > 1e-9
            for p, n in zip(contacts.points.numpy(), normals.numpy(), strict=True)
        ]

    for friction, edges in itertools.product((0.05, 0.3, 0.8, 2.0), (3, 4, 8, 24)):
        found = certify(contacts, ContactSpec(friction=friction, friction_margin=1.0, edges=edges))
        closed[friction, edges] = found.closed
        low = verdicts(friction * np.cos(np.pi / edges))
        high = verdicts(friction / np.cos(np.pi / 48))
        for verdict, least, most in zip(found.closed.tolist(), low, high, strict=True):
            assert least <= verdict <= most  # the cone of so many edges lies between two round ones
    for (friction, edges), found in closed.items():
        assert bool((found <= closed[2.0, edges]).all()) and bool(
            (closed[0.05, edges] <= found).all()
        )
        if edges in (4, 8):
            assert bool((found <= closed[friction, 24]).all())
    assert 0 < int(closed[0.3, 8].sum()) < int(closed[2.0, 24].sum())
