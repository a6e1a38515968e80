"""The motion of an arm and its hand through a grasp: straight approach, closing, pressing, lift."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.arm.arm import Arm
from torchgrasp.arm.reach import track, way_of
from torchgrasp.control.finger_forces import check_all_executable
from torchgrasp.control.protocol import POSE_TIME
from torchgrasp.export.postures import named_postures
from torchgrasp.foundation.base import Value, flatnonzero
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Force, Positive
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.motion import COARSE_STEPS
from torchgrasp.values.planning import Grasps

HELD = 1e-3  # largest difference [m, 1] between the poses of the grasps and of the arm's hand


@checked
@dataclasses.dataclass(frozen=True)
class ArmMotion(Value):
    """The motions of an arm and its hand through g grasps, at t common times; `plan_motion` makes
    it.

    Attributes:
        joint_names: names of the j joints: first the arm's, then all movable joints of the hand.
        times: times (t,) [s] from the start, beginning at 0.
        positions: target positions (g, t, j) [rad, or m for sliding joints] of these joints.
        phases: index into `times` of each named moment. At "above", the start, the opened hand is
            0.1 m away from its pre-grasp pose. At "pregrasp" it has reached that pose. At "grasp"
            the fingers are on the contacts. At "squeeze" the joint targets lie beyond them, so that
            the fingers press. At "lift" the hand has lifted the object by 0.1 m.
    """

    joint_names: tuple[str, ...]
    times: Float[Tensor, "t"]
    positions: Float[Tensor, "g t j"]
    phases: dict[str, int]


@checked
def plan_motion(
    arm: Arm, hand: Hand, grasps: Grasps, force: Force = 4.0, kp: Positive | None = None
) -> ArmMotion:
    """Return the motions of arm and hand through executable grasps, which passed all checks and
    were planned with the arm.

    The opened hand moves straight over the last 0.1 m to its pre-grasp, closes and presses. Then it
    is lifted by 0.1 m along the normal of the plan's table, or along z without a table. Approach
    and lift take a second each. How the arm gets to the start of the approach is not planned.

    Args:
        arm: the arm, with the `obj_from_base` for which the grasps were planned.
        hand: the hand on the arm.
        grasps: executable grasps of `plan_grasps(..., arm=arm)`.
        force: normal force [N] of the strongest finger at the "squeeze", the targets with which the
            fingers press.
        kp: stiffness [N m/rad] of the robot's position control; None means the hand's own.

    Raises `BadArgument` for grasps that were planned without this arm, or with another pose of its
    base. It is also raised for grasps that failed a check, for joints of another hand, and for an
    approach that the arm cannot follow.

    >>> grasps = plan_grasps(cloud, hand, spec, arm=arm)  # doctest: +SKIP
    >>> motion = plan_motion(arm, hand, grasps[:1])  # doctest: +SKIP
    >>> motion.phases  # doctest: +SKIP
    {'above': 0, 'pregrasp': 8, 'grasp': 9, 'squeeze': 10, 'lift': 18}
    """
    check_all_executable(grasps)
    arm = arm.to("cpu", torch.float64)
    grasps = grasps.to("cpu", torch.float64)
    if grasps.arm is None or not _holds(arm, grasps.arm, grasps.obj_from_hand):
        found = "a grasp without a posture of this arm"
        raise BadArgument("grasps", found, "executable grasps of plan_grasps(arm=)")
    near = COARSE_STEPS
    poses = way_of(hand.to("cpu", torch.float64), grasps, CollisionWorld(table=grasps.table))
    tips = arm.tip_poses(poses.flatten(0, 1))
    tips = tips.unflatten(2, poses.shape[:2])
    way, steady = track(arm, grasps.arm.T.contiguous(), tips)  # (g, 2 near + 1, n)
    if not steady.all():
        lost = flatnonzero(~steady).tolist()
        found = f"the approach or the lift of grasps {lost}, which the arm cannot follow"
        raise BadArgument("grasps", found, "executable grasps of plan_grasps(arm=), unchanged")
    postures = named_postures(hand, grasps, force, kp)[1]
    opened, closed, pressed = (
        torch.stack(list(joints.values()), -1)[:, None] for joints in postures.values()
    )
    fingers = torch.cat(
        [opened.expand(-1, near + 1, -1), closed, pressed.expand(-1, near + 1, -1)], 1
    )
    arms = torch.cat([way[:, : near + 2], way[:, near + 1 :]], 1)
    # 0.1 m in a second; while the fingers close and press, the arm rests
    moves = [1.0 / near] * near
    steps = [0.0, *moves, POSE_TIME, POSE_TIME, *moves]
    return ArmMotion(
        (*arm.joint_names, *postures["grasp"]),
        torch.tensor(steps, dtype=torch.float64).cumsum(0),
        torch.cat([arms, fingers], 2),
        {
            "above": 0,
            "pregrasp": near,
            "grasp": near + 1,
            "squeeze": near + 2,
            "lift": 2 * near + 2,
        },
    )


def _holds(arm: Arm, joints: Float[Tensor, "g n"], obj_from_hand: Float[Tensor, "g 4 4"]) -> bool:
    """Return whether `joints` [rad] are those of this arm, with which it holds the hand at the
    given poses.
    """
    fits = joints.shape[1] == len(arm.lower)
    return fits and torch.allclose(arm.hand_poses(joints), obj_from_hand, rtol=0.0, atol=HELD)
