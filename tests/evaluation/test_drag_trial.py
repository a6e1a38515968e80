"""Simulated drags of a box to the edge of its table, and lifts there, in both simulators."""

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch

from tests.dragged import BOX, DISTANCE, FRICTION, MASS, OUTWARD, TABLE_FRICTION, dragged, ending
from tests.make import near, random_motion, real, same_bits
from torchgrasp import Status
from torchgrasp.evaluation import drag_trial
from torchgrasp.evaluation.drag_trial import drag_object, lift_from_edge
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply, inverse, rigid
from torchgrasp.geometry.plane import move
from torchgrasp.values.closing import SensorModel
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.specs import TrialSpec

pytestmark = pytest.mark.sim

SPEC = TrialSpec(mass=MASS, friction=FRICTION, table_friction=TABLE_FRICTION, hold_time=0.1)
SIMULATORS = ["sapien", "mujoco"]
CENTRE = torch.from_numpy(np.array(BOX.center_mass))
"""The true centre of mass (3,) [m] of the box."""


@functools.cache
def trial(name, simulator, motion=None, displacement=None, seed=0, **changes):
    """The drag of the box with a hand; `displacement` [m] is the length of another drag."""
    pytest.importorskip(simulator)
    hand, plan = dragged(name)
    drag = plan.drag
    if displacement is not None:
        drag = dataclasses.replace(drag, displacement=displacement * OUTWARD)
    mesh = BOX
    if motion is not None:
        pose = random_motion(motion)
        mesh = BOX.copy().apply_transform(pose.numpy())
        drag = dataclasses.replace(
            drag,
            obj_from_hand=pose @ drag.obj_from_hand,
            feet=apply(pose, drag.feet),
            displacement=pose[:3, :3] @ drag.displacement,
            table=drag.table.moved(pose),
        )
    spec = dataclasses.replace(SPEC, simulator=simulator, **changes)
    return drag_object(drag, hand, mesh, spec, seed, parts=[mesh])


@pytest.mark.parametrize(("name", "simulator"), [("allegro", "sapien"), ("barrett", "mujoco")])
def test_the_box_goes_where_the_plan_wants_it(name, simulator):
    result = trial(name, simulator)
    drag = dragged(name).plan.drag
    assert result.status is Status.OK
    off = apply(result.motion, CENTRE[None])[0] - CENTRE - drag.displacement
    assert result.missed == pytest.approx(float(off.norm()), abs=1e-6)
    assert result.missed < 0.01
    turn = result.motion[:3, :3]
    near(turn @ turn.mT, torch.eye(3).double(), 1e-6)
    assert math.degrees(math.acos(min((float(turn.trace()) - 1) / 2, 1.0))) < 3
    assert float(result.forces.max()) < 2.5 * drag.force
    pressed = result.forces[result.forces > 0.5 * drag.force]
    assert float(pressed.mean()) == pytest.approx(drag.force, rel=0.2)
    assert float(result.forces[:50].max()) == float(result.forces[-10:].max()) == 0.0


def test_a_box_is_dragged_to_the_edge_and_lifted_there():
    pytest.importorskip("sapien")
    hand, plan = dragged("allegro")
    lift = lift_from_edge(plan, hand, BOX, SPEC, parts=[BOX])
    assert lift.held and len(lift.tries) == 1
    assert lift.drag is not None
    # the drag is that of `drag_object`, to the last bit
    again = trial("allegro", "sapien")
    assert same_bits(lift.drag, again) and lift.drag.missed == again.missed
    assert float(lift.tries[0].result.object_pose[-1][2, 3]) > 0.05


def test_a_plan_without_an_executable_grasp_is_refused():
    hand, plan = dragged("barrett")
    bad = plan.grasps[plan.grasps.status != Status.OK]
    with pytest.raises(BadArgument, match="no executable grasp"):
        lift_from_edge(dataclasses.replace(plan, grasps=bad), hand, BOX, SPEC)


def test_slippery_fingertips_leave_the_box_behind():
    result = trial("barrett", "mujoco", friction=0.05, table_friction=0.05)
    assert result.missed > 0.05
    gone = float((apply(result.motion, CENTRE[None])[0] - CENTRE).norm())
    assert gone < 0.05
    assert result.status is Status.NO_CONTACT


def test_a_box_that_is_left_behind_is_not_lifted():
    pytest.importorskip("mujoco")
    hand, plan = dragged("barrett")
    spec = dataclasses.replace(SPEC, simulator="mujoco", friction=0.05, table_friction=0.05)
    lift = lift_from_edge(plan, hand, BOX, spec, parts=[BOX])
    assert lift.tries == () and not lift.held
    assert same_bits(lift.drag, trial("barrett", "mujoco", friction=0.05, table_friction=0.05))
    # the drag ends where it was told to, but the grasps are elsewhere
    away = rigid(torch.eye(3).double(), 0.2 * OUTWARD)
    elsewhere = dataclasses.replace(plan, grasps=move(plan.grasps, away))
    spec = dataclasses.replace(SPEC, simulator="mujoco")
    lift = lift_from_edge(elsewhere, hand, BOX, spec, parts=[BOX])
    assert lift.drag is not None and lift.drag.status is Status.OK
    assert lift.tries == () and not lift.held


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_a_box_whose_centre_is_brought_beyond_the_edge_falls(simulator):
    result = trial("barrett", simulator, displacement=DISTANCE + 0.02)
    assert result.status is Status.DROPPED
    kept = trial("barrett", simulator)
    assert float(kept.motion[2, 2]) > math.cos(math.radians(1))


def test_a_trial_that_is_moved_as_a_whole_is_the_same_trial():
    """The simulator gets the same scene to the last bit."""
    still = trial("barrett", "mujoco")
    moved = trial("barrett", "mujoco", motion=4)
    assert torch.equal(moved.forces, still.forces)
    assert (moved.status, moved.missed) == (still.status, pytest.approx(still.missed, abs=1e-9))
    motion = random_motion(4)
    near(inverse(motion) @ moved.motion @ motion, still.motion, 1e-8)


def test_seeds_draw_the_noise_of_the_sensors():
    one, other = (trial("barrett", "mujoco", seed=seed) for seed in (0, 1))
    assert other.status is Status.OK and other.missed < 0.01
    assert not torch.equal(one.forces, other.forces)


def test_sensors_of_torques_serve_and_sensors_without_forces_are_refused():
    torque = trial("barrett", "mujoco", sensor=SensorModel("torque"))
    assert torque.status is Status.OK and torque.missed < 0.01
    hand, plan = dragged("barrett")
    pressing, idle = (
        [
            name
            for name, x in zip(hand.finger_names, plan.drag.presses.tolist(), strict=True)
            if x == on
        ]
        for on in (True, False)
    )
    for sensor in (SensorModel("binary"), SensorModel(dead=(pressing[0],))):
        with pytest.raises(BadArgument, match=r"spec\.sensor"):
            drag_object(plan.drag, hand, BOX, dataclasses.replace(SPEC, sensor=sensor))
    drag_trial._check_sensor(SensorModel(dead=tuple(idle)), plan.drag, hand)


def test_a_mesh_must_stand_on_the_table_and_a_plan_fit_the_hand():
    hand, plan = dragged("barrett")
    above = BOX.copy().apply_translation([0.0, 0.0, 0.05])
    with pytest.raises(BadArgument, match="mesh"):
        drag_object(plan.drag, hand, above, SPEC)
    with pytest.raises(BadArgument, match="plan"):
        drag_object(plan.drag, dragged("allegro").hand, BOX, SPEC, parts=[BOX])


class Opened(Exception):
    """The scene of a drag."""


def scene_of(monkeypatch, **changes):
    """The parameters of the scene in which a drag is simulated."""

    def stop(spec, simulator):
        raise Opened(spec)

    monkeypatch.setattr(drag_trial, "open_scene", stop)
    hand, plan = dragged("barrett")
    spec = dataclasses.replace(SPEC, **changes)
    with pytest.raises(Opened) as opened:
        drag_object(plan.drag, hand, BOX, spec, 3, parts=[BOX])
    return opened.value.args[0]


def test_the_scene_is_that_of_the_trial(monkeypatch):
    plan = dragged("barrett").plan
    spec = scene_of(monkeypatch, density=500.0, friction=Distribution.between(0.5, 0.9))
    assert spec.mass == pytest.approx(500.0 * BOX.volume)
    assert 0.5 < spec.friction < 0.9 and spec.friction != pytest.approx(0.7)
    assert spec.table_friction == TABLE_FRICTION and spec.height == 0.0
    # the edge is as far from the box's centre as in the plan, in the world's frame
    x, y, offset = spec.edge
    assert offset - spec.mesh.center_mass[:2] @ [x, y] == pytest.approx(DISTANCE, abs=1e-5)
    # the hand begins above its planned pose
    world_from_obj = spec.world_from_hand @ np.linalg.inv(plan.drag.obj_from_hand.numpy())
    near(torch.from_numpy(world_from_obj[2, :3]), real([0.0, 0.0, 1.0]), 1e-8)
    near(real(spec.start), real([0.0, 0.0, 0.05]), 1e-8)
    other = scene_of(monkeypatch, mass=Distribution.between(0.1, 0.4))
    assert 0.1 < other.mass < 0.4


def test_a_hand_in_the_box_and_an_object_that_flies_off_have_a_status():
    pytest.importorskip("mujoco")
    hand, plan = dragged("barrett")
    low = rigid(torch.eye(3).double(), real([0.0, 0.0, -0.055]))
    drag = dataclasses.replace(
        plan.drag,
        obj_from_hand=low @ plan.drag.obj_from_hand,
        feet=apply(low, plan.drag.feet),
    )
    spec = dataclasses.replace(SPEC, simulator="mujoco")
    result = drag_object(drag, hand, BOX, spec, parts=[BOX])
    assert result.status is Status.START_OVERLAP and not len(result.forces)
    near(result.motion, torch.eye(4).double(), 1e-12)
    assert result.missed == pytest.approx(float(drag.displacement.norm()))
    lost = drag_trial._Drag(plan.drag, hand, BOX, [BOX], ending(DISTANCE), spec, 0)
    start = lost.scene.object_pose()
    lost.scene.object_pose = lambda: np.full((4, 4), np.nan)
    result = lost._result(Status.OK, start, [1.0])
    assert result.status is Status.UNSTABLE and math.isnan(result.missed)
