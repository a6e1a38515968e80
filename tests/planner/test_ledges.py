"""Grasps of a plate that lies half over the edge of its table: fingers reach under it."""

import dataclasses

import pytest
import torch
import trimesh

from tests.make import load_hand, random_motion, real, same_bits
from torchgrasp import ContactSpec, load_scene, plan_grasps
from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.foundation.base import named_tensors
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.fused import VARIABLE
from torchgrasp.geometry.frames import apply, inverse
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.plane import Plane, move

PLATE = trimesh.creation.box(
    (0.12, 0.08, 0.015), trimesh.transformations.translation_matrix([0.0, 0.0, 0.0075])
)
VIEW = partial_view(PLATE, look_at(60.0, 35.0, target=PLATE), seed=1).to(torch.float64)
LEVEL = Plane.horizontal(0.0)
OUTWARD = real([1.0, 0.2, 0.0])
ENDING = LEVEL.ending(real([0.01, 0.0, 0.0]), OUTWARD)
HANDS = ["allegro", "barrett"]


@pytest.fixture(scope="module", params=HANDS)
def over(request):
    """A hand and its grasps of the plate over the edge."""
    hand = load_hand(request.param)
    return hand, plan_grasps(VIEW, hand, ContactSpec(table=ENDING), starts=32)


def inside(points):
    """Whether points (n, 3) [m] are in the table: below z = 0, and behind a line through
    x = 0.01 m.
    """
    ahead = (points - real([0.01, 0.0, 0.0])) @ unit(OUTWARD)
    return (points[:, 2] < 0) & (ahead < 0)


def ball(centres, radius):
    """Points in and on balls: (s k, 3)."""
    inner = torch.randn(400, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    inner = unit(inner) * torch.linspace(0.1, 1.0, 400, dtype=torch.float64)[:, None]
    return (centres[:, None] + radius[:, None, None] * inner).reshape(-1, 3)


def test_no_sphere_of_an_executable_grasp_is_in_the_table_and_fingers_reach_below_it(over):
    hand, grasps = over
    good = grasps.executable
    assert len(good)
    assert good.table is not None and good.table.describe() == ENDING.describe()
    shrunk = hand.collision_spheres.radius.double() - 1e-4  # the clearances are of single precision
    low = 0
    for grasp in (good[k] for k in range(len(good))):
        joints = grasp.joints.double()
        centres = apply(grasp.obj_from_hand.double(), hand.sphere_centres(joints))[0]
        assert not bool(inside(ball(centres, shrunk)).any())
        low += int((centres[:, 2] < 0).any())
    assert low


def test_round_fingertips_at_the_contacts_are_not_in_the_table(over):
    hand, grasps = over
    good = grasps.executable
    contacts = good.contacts
    radius = hand.tips.radius.double().expand(len(good), -1) - 1e-4
    centres = contacts.points.double() + radius[..., None] * contacts.normals.double()
    assert not bool(inside(ball(centres.reshape(-1, 3), radius.reshape(-1))).any())
    under = contacts.normals[..., 2] < -0.5
    assert bool(under.any())  # some contact is on the underside


def test_grasps_over_an_edge_do_not_depend_on_the_frame():
    hand = load_hand("barrett")
    grasps = plan_grasps(VIEW, hand, ContactSpec(table=ENDING), starts=12)
    motion = random_motion(3)
    spec = ContactSpec(table=ENDING.moved(motion))
    there = plan_grasps(move(VIEW, motion), hand, spec, starts=12)
    back = named_tensors(move(there, inverse(motion)))
    for name, x in named_tensors(grasps).items():
        torch.testing.assert_close(back[name], x, rtol=0, atol=1e-9, msg=name)


def test_an_edge_far_away_changes_no_grasp(monkeypatch):
    monkeypatch.setenv(VARIABLE, "0")  # compiled loops plan without an edge alone, and round
    hand = load_hand("allegro")
    far = LEVEL.ending(10.0 * OUTWARD, OUTWARD)
    plain, other = (
        plan_grasps(VIEW, hand, ContactSpec(table=table), starts=12) for table in (LEVEL, far)
    )
    assert plain.status.tolist() == other.status.tolist()
    assert same_bits(plain, dataclasses.replace(other, meta=plain.meta))


def test_an_edge_of_the_specification_takes_the_place_of_a_scenes_table():
    scene = load_scene().select(1)
    assert scene.table is not None
    middle = scene.points[scene.rows_of()].double().mean(0)
    ending = scene.table.ending(middle, real([0.0, 1.0, 0.0]))
    hand = load_hand("barrett")
    grasps = plan_grasps(scene, hand, ContactSpec(table=ending), starts=8)
    assert grasps.table is not None and grasps.table.describe() == ending.describe()
    good = grasps.executable
    assert len(good)
    centres = apply(good.obj_from_hand.double(), hand.sphere_centres(good.joints.double()))
    room = ending.clearance(centres) - hand.collision_spheres.radius.double()
    assert float(room.min()) > -1e-4


def test_many_clouds_and_scenes_from_images_refuse_an_edge():
    with pytest.raises(BadArgument, match=r"spec: expected .*got a table with an edge"):
        plan_grasps([VIEW, VIEW], load_hand("barrett"), ContactSpec(table=ENDING))
    scene = load_scene()
    image = scene.image
    with pytest.raises(BadArgument, match=r"table: expected .*got a table with an edge"):
        type(scene).from_depth(image.depth, image.intrinsics, table=ENDING)
