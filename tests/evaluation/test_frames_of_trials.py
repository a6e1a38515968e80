"""A trial that is moved as a whole is the same trial, and results come back in its frame."""

import dataclasses
import math

import pytest
import torch
import trimesh

from tests.make import random_motion, real
from tests.pinch import QUICK, cylinder, pinch
from torchgrasp import Plane, close_hand
from torchgrasp.evaluation import GraspTrial, Truth
from torchgrasp.evaluation.trial import TrialDriver, true_table
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply, inverse, rigid, rotate, rotation_from_vector
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


def trial(b_from_a, simulator, table, **options):
    """The lift of a cylinder beside a box on a table, all moved."""
    pytest.importorskip(simulator)
    hand, grasp = pinch("allegro")
    box = trimesh.creation.box([0.04, 0.05, 0.06])
    box.apply_translation([-0.02, 0.10, 0.03])
    mesh, box = (body.copy().apply_transform(b_from_a.numpy()) for body in (cylinder(), box))
    spec = dataclasses.replace(QUICK, simulator=simulator, **options)
    rest = {"error": ERROR, "parts": [mesh], "neighbours": [Neighbour(box, [box])]}
    table = table.moved(b_from_a)
    return close_hand(moved(grasp, b_from_a), hand, mesh, spec, table=table, told=table, **rest)


LEVEL = Plane.horizontal(0.0)
ENDING = LEVEL.ending(real([0.01, 0.0, 0.0]), real([1.0, -0.3, 0.0]))


@pytest.mark.parametrize(
    ("simulator", "seed", "table"), [("sapien", 0, ENDING), ("mujoco", 1, LEVEL)]
)
def test_a_moved_trial_is_the_same_trial(simulator, seed, table):
    """Either simulator gets the same scene to the last bit."""
    b_from_a = random_motion(seed)
    still = trial(torch.eye(4, dtype=torch.float64), simulator, table)
    result = trial(b_from_a, simulator, table)
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


@pytest.mark.parametrize("seed", range(3))
def test_edges_of_tables_reach_the_simulator_and_the_controller(seed):
    """The edge is that of the true table, or of the plan where no true table is given."""
    b_from_a = random_motion(seed)
    hand, grasp = pinch("barrett")
    there = moved(grasp, b_from_a)
    planned = dataclasses.replace(there, meta={"table": ENDING.moved(b_from_a).describe()})
    body = cylinder().apply_transform(b_from_a.numpy())
    level = LEVEL.moved(b_from_a)
    truth = Truth(body, [body], table=ENDING.moved(b_from_a))
    driver = TrialDriver(GraspTrial(hand, there, truth, told=ENDING.moved(b_from_a)), QUICK)
    points = real([[x, y, 0.0] for x in (-0.3, 0.0, 0.02, 0.4) for y in (-0.2, 0.1)])
    x, y, offset = driver.scene_spec.edge
    in_world = apply(inverse(driver.obj_from_world), apply(b_from_a, points))
    beyond = in_world[:, :2] @ real([x, y]) - offset
    torch.testing.assert_close(beyond, ENDING.edge.height(points), atol=1e-6, rtol=0)
    assert math.hypot(x, y) == pytest.approx(1.0, abs=1e-12)
    in_hand = apply(inverse(there.obj_from_hand[0]), apply(b_from_a, points))
    known = driver.reference.table
    torch.testing.assert_close(
        known.clearance(in_hand), ENDING.clearance(points), atol=1e-6, rtol=0
    )
    # a plan of a table with an edge, on a true table without one
    without = TrialDriver(GraspTrial(hand, planned, Truth(body, [body], table=level)), QUICK)
    assert without.scene_spec.edge is None and without.reference.table.edge is not None


def test_a_true_table_under_the_object_ends_where_the_table_of_the_plan_ends():
    hand, grasp = pinch("barrett")
    tilt = rigid(rotation_from_vector(real([0.02, -0.03, 0.0])), real([0.0, 0.0, 0.004]))
    body = cylinder()
    for table in (ENDING, ENDING.moved(tilt)):
        planned = dataclasses.replace(grasp, meta={"table": table.describe()})
        truth = Truth(body, [body])
        spec = TrialDriver(GraspTrial(hand, planned, truth), QUICK).scene_spec
        level = true_table(planned, truth)
        x, y, offset = spec.edge
        assert float(level.normal[2]) == 1.0 and level.offset == spec.table_height == 0.0
        assert level.edge.normal.tolist() == pytest.approx([x, y, 0.0], abs=1e-8)
        assert level.edge.offset == pytest.approx(offset, abs=1e-8)
        # the edges agree near the object
        near = real([[0.01, 0.0, 0.0]])
        near = near if table is ENDING else apply(tilt, near)
        assert abs(float(level.edge.height(near))) < 3e-4
    steep = Plane(real([1.0, 0.0, 0.0]), -0.2, Plane(real([0.0, 0.0, 1.0]), 0.1))
    planned = dataclasses.replace(grasp, meta={"table": steep.describe()})
    with pytest.raises(BadArgument, match="table: expected the true table, a Plane, got None"):
        TrialDriver(GraspTrial(hand, planned, Truth(body, [body])), QUICK)
