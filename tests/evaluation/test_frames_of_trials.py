"""A trial that is moved as a whole is the same trial, and results come back in its frame."""

import dataclasses

import pytest
import torch
import trimesh

from tests.make import random_motion, real
from tests.pinch import QUICK, cylinder, pinch
from torchgrasp import Plane, close_hand
from torchgrasp.geometry.frames import apply, inverse, rigid, rotate
from torchgrasp.sim import Neighbour

pytestmark = [pytest.mark.sim, pytest.mark.filterwarnings("ignore")]

ERROR = rigid(torch.eye(3, dtype=torch.float64), real([0.002, -0.001, 0.001]))


def moved(grasp, b_from_a):
    contacts = dataclasses.replace(
        grasp.contacts,
        points=apply(b_from_a, grasp.contacts.points),
        normals=rotate(b_from_a, grasp.contacts.normals),
    )
    approach = rotate(b_from_a, grasp.approach[:, None])[:, 0]
    return dataclasses.replace(
        grasp,
        contacts=contacts,
        approach=approach,
        obj_from_hand=b_from_a @ grasp.obj_from_hand,
        meta={},
    )


def trial(b_from_a, simulator, **options):
    """The lift of a cylinder beside a box, all moved."""
    pytest.importorskip(simulator)
    hand, grasp = pinch("allegro")
    box = trimesh.creation.box([0.04, 0.05, 0.06])
    box.apply_translation([-0.02, 0.10, 0.03])
    mesh, box = (body.copy().apply_transform(b_from_a.numpy()) for body in (cylinder(), box))
    spec = dataclasses.replace(QUICK, simulator=simulator, **options)
    rest = {"error": ERROR, "parts": [mesh], "neighbours": [Neighbour(box, [box])]}
    table = Plane.horizontal(0.0).moved(b_from_a)
    return close_hand(moved(grasp, b_from_a), hand, mesh, spec, table=table, told=table, **rest)


@pytest.mark.parametrize(("simulator", "seed"), [("sapien", 0), ("mujoco", 1)])
def test_a_moved_trial_is_the_same_trial(simulator, seed):
    b_from_a = random_motion(seed)
    still = trial(torch.eye(4, dtype=torch.float64), simulator)
    result = trial(b_from_a, simulator)
    assert still.held
    for name in ("time", "forces", "joints"):
        assert torch.equal(getattr(result, name), getattr(still, name))
    for name in ("status", "object_motion", "start_overlap"):
        assert getattr(result, name) == getattr(still, name)
    a_from_b = inverse(b_from_a)
    for found, known in (
        (a_from_b @ result.hand_pose, still.hand_pose),
        (a_from_b @ result.object_pose @ b_from_a, still.object_pose),
        (a_from_b @ result.disturbance.neighbour_pose @ b_from_a, still.disturbance.neighbour_pose),
    ):
        assert float((found - known).abs().max()) < 1e-9


def test_a_plane_that_is_level_changes_a_trial_little():
    """The same trial without a plane runs in the frame of the grasp."""
    hand, grasp = pinch("allegro")
    mesh = cylinder()
    plain, level = (
        close_hand(
            grasp, hand, mesh, dataclasses.replace(QUICK, noise=False), parts=[mesh], table=table
        )
        for table in (None, Plane.horizontal(0.0))
    )
    assert plain.held and level.held
    difference = (plain.object_pose - level.object_pose)[..., 3].abs()
    assert float(difference[:20].max()) < 1e-5  # until the first finger touches
    assert float(difference.max()) < 2e-3
    assert float((plain.hand_pose[0] - level.hand_pose[0]).abs().max()) < 1e-6
