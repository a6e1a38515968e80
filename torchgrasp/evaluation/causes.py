"""Why an object was not held: the cause of a failed trial, from the trial's record and the true
object.
"""

import dataclasses
import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.evaluation.criterion import SLIP_ANGLE, SLIP_DISTANCE
from torchgrasp.evaluation.several_tries import LiftTry
from torchgrasp.evaluation.trial import GraspTrial
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.geometry.frames import apply, inverse, real, rotation_angle
from torchgrasp.geometry.linalg import norm
from torchgrasp.geometry.mesh import read_mesh
from torchgrasp.values.closing import ClosureResult
from torchgrasp.values.specs import TrialSpec

CAUSES: dict[str, list[str]] = json.loads(Path(__file__).with_suffix(".json").read_text("utf-8"))
"""Causes by name, each with the unit of its size and a sentence. The first that applies to a trial
is the trial's cause.
"""
SHAPE_OFF = 10.0  # least distance [mm] of a planned contact from the true surface that is a cause
RAISED = 1e-3  # greatest height [m] by which a raised hand is below the height of the lift


@checked
def find_cause(tries: Sequence[LiftTry], trial: GraspTrial, spec: TrialSpec) -> tuple[str, float]:
    """Return (cause, size): why the object was not held in the last try of a trial.

    The cause is a key of the dict `CAUSES`, such as "toppled" or "too weak". `CAUSES` also holds
    the unit of the size, and a sentence that explains the cause. The result is ("", NaN) if the
    object was held, or the simulation did not stay finite. `tries` are the trial's lifts, as
    `lift_grasps` returns them. `trial` and `spec` are the input of the trial.
    """
    truth = trial.truth
    *before, (row, lift) = tries
    if lift.held or lift.status is Status.UNSTABLE:
        return "", math.nan
    if lift.status is Status.START_OVERLAP:
        return "start overlap", 1e3 * lift.start_overlap
    # Each record begins with the object where the try before left it.
    for _, result in reversed(before):
        lift = dataclasses.replace(lift, object_pose=lift.object_pose @ result.object_pose[-1])
        truth = dataclasses.replace(truth, slide=None)
    trial = dataclasses.replace(trial, grasp=trial.grasp[row], truth=truth)
    return next((cause, size) for cause, size, least in _sizes(lift, trial, spec) if size > least)


def _sizes(
    lift: ClosureResult, trial: GraspTrial, spec: TrialSpec
) -> Iterator[tuple[str, float, float]]:
    """Yield every cause of a lift, its size, and the size above which it applies; NaN if it cannot
    apply.
    """
    mesh = read_mesh(trial.truth.mesh)
    truth = trial.truth
    up = real([0.0, 0.0, 1.0])
    if truth.table is not None:
        up = truth.table.normal.double()
    centre = torch.tensor(mesh.center_mass.tolist(), dtype=torch.float64)
    pressed = tick_of(lift, 2)
    poses = lift.object_pose[[0, tick_of(lift, 1), pressed]]
    start, closed, lifted = apply(poses, centre.expand(3, 1, 3))[:, 0]
    start = start if truth.slide is None else start + truth.slide.to(start)
    upright = lift.object_pose[[0, pressed], :3, :3] @ up
    tilt = torch.atan2(torch.linalg.cross(*upright).norm(), upright[0] @ upright[1])
    yield "toppled", math.degrees(tilt), math.degrees(SLIP_ANGLE)
    yield "pushed away", 1e3 * float((closed - start).norm()), 1e3 * SLIP_DISTANCE
    yield "ejected", 1e3 * float((lifted - closed).norm()), 1e3 * SLIP_DISTANCE
    points = trial.grasp.contacts.points[0].double().numpy()
    off = 1e3 * trimesh.proximity.closest_point(mesh, points)[1]
    yield "shape off", float(off.max()), SHAPE_OFF
    missing = [finger for finger in range(len(off)) if finger not in lift.contact_order]
    yield "never met", float(off[missing].max()) if missing else math.nan, -1.0
    weak = lift.status in (Status.TOO_WEAK, Status.TOO_HEAVY)
    yield "too weak", float(lift.forces[pressed].max()) if weak else math.nan, -1.0
    slid, turned = (motion[pressed:] for motion in moved_in_hand(lift, centre))
    lost = (slid >= SLIP_DISTANCE) | (turned >= SLIP_ANGLE)
    first = int(lost.int().argmax())
    heights = (lift.hand_pose[pressed:, :3, 3] - lift.hand_pose[pressed, :3, 3]) @ up
    risen = int((heights >= spec.lift_height - RAISED).int().argmax()) or -1
    yield "dropped when pushed", math.nan if lost[risen] else math.hypot(*spec.push), 0.0
    rotates = bool(lost[first]) and bool(slid[first] < SLIP_DISTANCE)
    yield "turned", math.degrees(turned.max()) if rotates else math.nan, 0.0
    yield "slid", 1e3 * float(slid.max()), -1.0


def tick_of(lift: ClosureResult, phase: int) -> int:
    """Return the index of the control tick in the record `lift` at which a phase of the lift ended.

    A tick is a period of the controller. The `phase` is 0 (approach), 1 (closing) or 2 (pressing).
    A phase that did not end, with NaN in `ClosureResult.phases`, gives the last tick.
    """
    end = lift.phases[phase]
    return int((lift.time - end).abs().argmin()) if end.isfinite() else len(lift.time) - 1


def moved_in_hand(
    lift: ClosureResult, centre: Float[Tensor, "3"]
) -> tuple[Float[Tensor, " t"], Float[Tensor, " t"]]:
    """Return how far the object has moved [m] and turned [rad] in the hand since the pressing
    ended.

    Both are (t,), for the t control ticks of the record `lift`, and relative to the hand's root
    link. Earlier ticks are compared with the end of the pressing, too. `centre` (3,) [m] is the
    point of the true mesh whose motion counts. It is in the frame of the planned cloud.
    """
    hand_from_object = inverse(lift.hand_pose.double()) @ lift.object_pose.double()
    start = hand_from_object[tick_of(lift, 2)]
    centres = apply(hand_from_object, centre.double().expand(len(hand_from_object), 1, 3))[:, 0]
    turn = rotation_angle(start[:3, :3].T @ hand_from_object[:, :3, :3])
    return norm(centres - apply(start, centre.double()[None])), turn
