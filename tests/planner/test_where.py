"""Grasps whose contacts keep to regions: in every frame, in scenes, and explained where there are
none.
"""

import dataclasses

import pytest
import torch
import trimesh

from tests.make import load_hand, random_motion, see
from torchgrasp import (
    ContactSpec,
    Region,
    Status,
    explain_empty,
    fit_shape,
    load_object,
    plan_grasps,
    plan_scene,
)
from torchgrasp.foundation.errors import BadArgument, NoEffect
from torchgrasp.geometry.frames import apply, inverse
from torchgrasp.geometry.plane import Plane, move
from torchgrasp.planner.request import Request

HAND = load_hand("barrett")
VIEW = load_object("jug").view


def test_all_contacts_are_inside_keep_and_outside_avoid_in_the_frame_of_the_caller():
    frame = random_motion(5)
    upper = Region.rim(VIEW, 0.0, 0.6)
    middle = VIEW.points.double().mean(0)

    def keep(points):
        return upper(apply(inverse(frame), points))

    def avoid(points):
        return (apply(inverse(frame), points) - middle).norm(dim=-1) - 0.035

    spec = ContactSpec(table=Plane.horizontal(0.0).moved(frame))
    grasps = plan_grasps(move(VIEW, frame), HAND, spec, 10, keep=keep, avoid=avoid)
    good = grasps.contacts.points[grasps.status == Status.OK].reshape(-1, 3)
    assert len(good) > 0
    assert float(keep(good).max()) < 0 < float(avoid(good).min())


def test_without_a_grasp_in_the_region_the_region_is_what_is_changed():
    nowhere = Region(lambda points: points[:, 2] + 1.0)
    told = explain_empty(VIEW, HAND, ContactSpec(table=0.0), 20, keep=nowhere)
    assert told.funnel.reason is Status.OUTSIDE
    assert told.best is not None and told.best.words == "without keep"


def test_the_marked_object_of_a_scene_is_held_where_it_is_marked():
    scene = see((0.0, 0.0, 0.06, 0.12), (0.0, -0.2, 0.06, 0.14)).select(1)
    mask = scene.pixel_labels == 1
    rows = torch.nonzero(mask.any(1))[:, 0]
    mask[int(rows.double().mean()) :] = False  # its lower half in the picture
    keep = Region.mask(scene, mask)
    grasps = plan_grasps(scene, HAND, starts=8, keep=keep)
    good = grasps.contacts.points[grasps.status == Status.OK]
    assert len(good) > 0 and bool((keep(good) < 0).all())
    plan = plan_scene(scene, HAND, starts=4, avoid=Region(lambda points: -points[:, 0].abs() - 1.0))
    assert plan.best is None and Status.OUTSIDE.sentence in plan.things[0].reason


def test_what_is_no_distance_is_told_by_the_name_of_its_argument():
    for name, wrong in (
        ("keep", lambda x: x),
        ("avoid", lambda x: 3.0),
        ("keep", Region(lambda x: x[:, 0] / 0)),
        ("keep", lambda x: x[:, 2] > 0.1),
        ("avoid", lambda x: x[:, 2].long()),
    ):
        with pytest.raises(BadArgument, match=f"^{name}: .*one finite number each"):
            plan_grasps(VIEW, HAND, starts=4, **{name: wrong})


def test_a_region_is_of_one_cloud():
    for name in ("keep", "avoid"):
        with pytest.raises(BadArgument, match=name):
            plan_grasps([VIEW, VIEW], HAND, **{name: Region.rim(VIEW, 0.0)})
    with pytest.raises(BadArgument, match=r"spec: .*region"):
        plan_grasps([VIEW, VIEW], HAND, ContactSpec(region=Region.rim(VIEW, 0.0)))


FAR = ([0.5, 0.5, 0.0], [0.55, 0.55, 0.1])


def corners(low, high):
    return Region.box(torch.tensor(low), torch.tensor(high))


def test_a_box_or_mesh_in_another_frame_is_refused_or_told():
    tin = trimesh.creation.cylinder(0.03, 0.1)
    tin.apply_translation([0.5, 0.5, 0.05])
    scene = see((0.0, 0.0, 0.06, 0.12), (0.0, -0.2, 0.06, 0.14)).select(1)
    for region in (corners(*FAR), Region.mesh(tin), corners([100.0] * 3, [200.0] * 3)):
        for seen in (VIEW, scene):
            with pytest.raises(BadArgument, match=r"keep: .*in the frame of the cloud.* mm off"):
                plan_grasps(seen, HAND, starts=4, keep=region)
            with pytest.warns(NoEffect, match="avoid changes nothing: one that is .* mm off"):
                Request(seen, HAND, avoid=region)


def test_a_box_to_keep_to_that_holds_everything_is_told():
    # one in millimetres, of the lower half of the jug
    for seen in (VIEW, dataclasses.replace(VIEW, viewpoint=None, frustum=None)):
        with pytest.warns(NoEffect, match="keep changes nothing: it holds all"):
            Request(seen, HAND, keep=corners([-90.0, -90.0, -5.0], [90.0, 90.0, 75.0]))
        low = [*(seen.points.amin(0) - 0.01).tolist()[:2], 0.075]
        Request(seen, HAND, keep=corners(low, [0.1, 0.1, 0.3]))


def test_a_region_on_the_seen_or_the_hidden_side_is_at_the_object():
    mesh = load_object("jug").mesh
    low, high = (torch.tensor(x) for x in mesh.bounds)
    middle = (low + high) / 2
    # halves of the body on both sides of its middle, on each axis
    for axis in range(3):
        first = high.clone()
        first[axis] = middle[axis]
        second = low.clone()
        second[axis] = middle[axis]
        for region in (Region.box(low, first), Region.box(second, high), Region.mesh(mesh)):
            assert Request(VIEW, HAND, keep=region, avoid=region).keep is region


def test_a_shape_of_another_frame_is_refused():
    shape = fit_shape(VIEW)
    away = torch.eye(4, dtype=torch.float64)
    away[0, 3] = 0.1
    with pytest.raises(BadArgument, match=r"shape: .*in the frame of its cloud.* mm off"):
        plan_grasps(move(VIEW, away), HAND, starts=4, shape=shape)
