"""Numbers far from the usual: places, sizes, friction, edges, threads. Equal where it is promised, else a status."""

import itertools
import warnings

import numpy as np
import pytest
import torch
import trimesh
from scipy.optimize import linprog

from torchgrasp import ContactSpec, Plane, PointCloud, certify, fit_shape, load_object, plan_contacts
from torchgrasp.cloud import look_at, partial_view
from torchgrasp.errors import CloudWarning, Status
from torchgrasp.values import Contacts


@pytest.mark.promise("I6")
@pytest.mark.parametrize("metres", [10.0, 1000.0])
def test_contacts_far_from_the_origin_are_those_near_it(metres):
    view, shift = load_object("cylinder").view, metres * torch.tensor([0.6, -0.8, 0.3], dtype=torch.float64)
    far = PointCloud(view.points + shift, None, view.viewpoint + shift)
    shapes, plans = [], []
    for cloud, table in ((view, 0.0), (far, float(shift[2]))):
        shapes.append(fit_shape(cloud, table=Plane.horizontal(table)))
        plans.append(plan_contacts(shapes[-1], ContactSpec(table=table), starts=30, seed=0))
    here, there = plans
    assert torch.equal(here.status, there.status) and int((here.status == Status.OK).sum()) > 5
    torch.testing.assert_close(there.contacts.points - shift, here.contacts.points, rtol=0, atol=1e-8)
    near = shapes[0].predict(there.contacts.points - shift)  # a normal turns by 32 rad a metre on the way between both
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
    """Whatever is called closed is so by an independent programme; every other row says what it lacks."""
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
            points, normals = row.contacts.points[0].numpy(), row.contacts.normals[0].numpy()
            assert np.isfinite(points).all() and margin(points, normals, spec.planned_friction, 64) > -1e-9
    if name == "cube of 1 cm":
        assert not bool((plan.status == Status.OK).any())  # three fingertips have no room


def margin(points: np.ndarray, normals: np.ndarray, friction: float, edges: int) -> float:
    """Return the largest s of Eq. (13) by SciPy, from points and outward normals alone."""
    columns, centre = [], points.mean(0)
    radius = np.linalg.norm(points - centre, axis=1).max()
    for point, normal in zip(points, normals, strict=True):
        inward = -normal / np.linalg.norm(normal)
        one = np.cross(inward, np.eye(3)[np.abs(inward).argmin()])
        one /= np.linalg.norm(one)
        two = np.cross(inward, one)
        for angle in 2 * np.pi * np.arange(edges) / edges:
            force = inward + friction * (np.cos(angle) * one + np.sin(angle) * two)
            columns.append(np.concatenate([force, np.cross(point - centre, force) / radius]))
    wrenches, n = np.array(columns).T, len(columns)
    equal = np.vstack([np.hstack([wrenches, wrenches.sum(1, keepdims=True)]), np.append(np.ones(n), n)])
    found = linprog(
        np.append(np.zeros(n), -1.0), A_eq=equal, b_eq=[0] * 6 + [1], bounds=[(0, None)] * n + [(None, None)]
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
    for friction, edges in itertools.product((0.05, 0.3, 0.8, 2.0), (3, 4, 8, 24)):
        found = certify(contacts, ContactSpec(friction=friction, friction_margin=1.0, edges=edges))
        closed[friction, edges] = found.closed
        low, high = (
            [margin(p, n, f, 96) > 1e-9 for p, n in zip(contacts.points.numpy(), normals.numpy(), strict=True)]
            for f in (friction * np.cos(np.pi / edges), friction / np.cos(np.pi / 96))
        )
        for verdict, least, most in zip(found.closed.tolist(), low, high, strict=True):
            assert least <= verdict <= most  # the cone of so many edges lies between two round ones
    for (friction, edges), found in closed.items():
        assert bool((found <= closed[2.0, edges]).all()) and bool((closed[0.05, edges] <= found).all())
        if edges in (4, 8):
            assert bool((found <= closed[friction, 24]).all())
    assert 0 < int(closed[0.3, 8].sum()) < int(closed[2.0, 24].sum())
