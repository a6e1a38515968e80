"""Joints of other programs' files: their order, signs and couplings, held against our own hand.

A file has values for all joints of its hand; we grasp with the actuated ones. Values that would be
lost or change their sign are refused, or named in a `GraspFileWarning`.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.files.write import Refuse
from torchgrasp.foundation.base import Batch, flatnonzero
from torchgrasp.foundation.errors import BadArgument, GraspFileWarning
from torchgrasp.foundation.told import warn_user
from torchgrasp.geometry.linalg import matvec, norm
from torchgrasp.geometry.optim import LeastSquares, Residuals, levenberg_marquardt
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.kinematics import map_points


@dataclasses.dataclass(frozen=True)
class PostureNumbers:
    """Bounds by which a posture in another program's file counts as one of our hand. Also the
    parameters of the search that moves its fingertips to given points (`reach_tips`).
    """

    same_tip: float = 1e-4  # greatest distance [m] of a fingertip from that of the file
    same_joint: float = 1e-3  # greatest difference [rad or m] of a joint that moves no fingertip
    backward: float = 0.05  # bend of a joint [rad] below which it is no sign of a reversed axis
    short: float = 0.5  # greatest backward part of a joint's range, as a share of the forward part
    reached: float = 1e-6  # sum of squared errors of the fingertips [mm^2] that ends a search
    rounding: float = 1e-6  # distance [rad or m] by which a joint may exceed its limits
    steps: int = 60  # greatest number of steps in which fingers take up the motion of a wrist
    stalled: float = 1e-4  # relative decrease of the squared errors below which a search ends


POSTURE = PostureNumbers()


class Column(NamedTuple):
    """How one joint of another program's file becomes a joint of our hand.

    Its value in our hand is `factor` times the value in the file, plus `offset`.

    Attributes:
        joint: name of the joint in the hand's URDF.
        factor: factor on the value in the file.
        offset: number [rad, or m for a sliding joint] that is then added.
        turned: whether the factor is known, so that the sign of the joint is not checked.
    """

    joint: str
    factor: float = 1.0
    offset: float = 0.0
    turned: bool = False


def read_order(hand: Hand, order: Sequence[str]) -> tuple[Column, ...]:
    """Return how each number of a posture in another program's file becomes a joint of the `hand`.

    `order` has a word for each number of the posture: JOINT, JOINT:FACTOR or JOINT:FACTOR:OFFSET.
    JOINT is the joint's name in the hand's URDF. The joint is FACTOR times the number, by default 1,
    plus OFFSET, by default 0. OFFSET is in [rad], or [m] for a sliding joint. A word that does not
    start with a joint of the hand names a number that is not read.

    Raises `BadArgument` for an actuated joint that is missing, or a name twice. Raises it also for
    a FACTOR of 0, and for a FACTOR or OFFSET that is no finite number.
    """
    columns = list[Column]()
    for word in order:
        # the longest joint that starts the word: names may hold colons
        starts = [x for x in hand.tree.joint_names if word == x or word.startswith(f"{x}:")]
        joint = max(starts, key=len, default=word)
        given = word != joint
        numbers = _numbers(word[len(joint) + 1 :])
        if given and (not 1 <= len(numbers) <= 2 or numbers[0] == 0):
            raise BadArgument("order", repr(word), "JOINT, JOINT:FACTOR or JOINT:FACTOR:OFFSET")
        columns.append(Column(joint, *numbers, turned=given))
    names = [column.joint for column in columns]
    missing = [name for name in hand.joint_names if name not in names]
    if missing or len(set(names)) != len(names):
        found = "a name twice"
        if missing:
            found = f"{len(names)} names without {', '.join(missing[:4])}"
        raise BadArgument("order", found, f"each of {', '.join(hand.joint_names)} once")
    return tuple(columns)


def _numbers(words: str) -> list[float]:
    """Return the numbers between colons; none if one is not finite, or no number."""
    try:
        numbers = [float(x) for x in words.split(":")]
    except ValueError:
        return []
    return numbers if all(math.isfinite(x) for x in numbers) else []


def read_columns(
    hand: Hand, columns: Sequence[Column], table: np.ndarray, refuse: Refuse
) -> dict[str, np.ndarray]:
    """Return the values (g,) [rad or m] of the hand's joints in g grasps of another program's file,
    by joint name.

    `table` (g, n) has the numbers of the file: a row for each grasp, a column for each of the n
    `columns` (`read_order`). A `GraspFileWarning` names columns that are not read although they are
    not 0. It also names joints that in every grasp are on the far shorter side of their range about
    0. Their sign may be reversed.

    Raises an error for joints beyond their limits that fit with the other sign. `refuse` makes it
    from two texts: what was found, and what is allowed.
    """
    unread = list[str]()
    turned = dict[str, str]()  # what was found, by JOINT:-1
    backward = list[str]()
    values = dict[str, np.ndarray]()
    limits = zip(hand.lower.tolist(), hand.upper.tolist(), strict=True)
    ranges = dict(zip(hand.joint_names, limits, strict=True))
    for place, column in enumerate(columns):
        found = column.factor * table[:, place] + column.offset
        if column.joint not in hand.tree.joint_names:
            unread += [column.joint] * bool(found.any())
            continue
        values[column.joint] = found
        if column.turned or column.joint not in ranges or not len(found):
            continue
        low, high = ranges[column.joint]
        if not _within(-found, low, high):
            continue
        span = f"{column.joint} from {found.min():.3g} to {found.max():.3g}"
        if not _within(found, low, high):
            turned[f"{column.joint}:-1"] = f"{span} outside [{low:.3g}, {high:.3g}]"
        elif _is_backward(found, low, high):
            backward.append(span)
    if turned:
        allowed = f"the signs of our URDF, as with {' '.join(turned)} in --joints"
        raise refuse(", ".join(turned.values()), allowed)
    if unread:
        warn_user(
            GraspFileWarning,
            f"{', '.join(unread)}: no joint of the {hand.name} hand, so its values are not read",
        )
    if backward:
        warn_user(
            GraspFileWarning,
            f"{', '.join(backward)}: bent backward in every grasp. In --joints, JOINT:-1 turns the "
            "sign; JOINT:1 keeps it",
        )
    return values


def _within(values: np.ndarray, low: float, high: float) -> bool:
    """Return whether all values are in [low, high], up to rounding."""
    inside = (values >= low - POSTURE.rounding) & (values <= high + POSTURE.rounding)
    return bool(inside.all())


def _is_backward(values: np.ndarray, low: float, high: float) -> bool:
    """Return whether all values [rad] are on the far shorter side of a range about 0."""
    forward = values if high >= -low else -values
    short, long = sorted((-low, high))
    if short <= 0 or short > POSTURE.short * long:
        return False
    return bool((forward <= 0).all() and forward.min() < -POSTURE.backward)


def read_posture(
    hand: Hand, values: dict[str, np.ndarray], what: str, refuse: Refuse
) -> Float[Tensor, "g h"]:
    """Return the positions (g, h) [rad or m] of the hand's h actuated joints in g grasps, on the
    CPU. `values` holds the file's values (g,) [rad or m] of the hand's joints, by name.

    The file may have values of coupled joints, too. All values together must put each fingertip
    where the actuated joints alone put it, to 0.1 mm. Else an error is raised, which names the
    joint. `refuse` makes it from two texts: what was found, and what is allowed.

    A `GraspFileWarning` names joints of fingers that do not grasp, whose values are not kept.
    `what` is the posture's name in these texts, such as "grasp".
    """
    joints = torch.tensor(np.stack([values[name] for name in hand.joint_names], axis=1))
    own = hand.expand_joints(joints)
    theirs = own.clone()
    for place, name in enumerate(hand.tree.joint_names):
        if name in values:
            theirs[:, place] = torch.tensor(values[name])
    if not len(joints):
        return joints
    off = norm(_tips(hand, theirs) - _tips(hand, own)).amax(-1)  # (g,)
    apart = (theirs - own).abs()  # (g, j)
    moving = hand.tree.moves[hand.tips.index].bool().any(0)  # (j,)
    row = int(off.argmax())
    if float(off[row]) > POSTURE.same_tip:
        joint = int(torch.where(moving, apart[row], -1.0).argmax())
        found = (
            f"{what} {row} with {hand.tree.joint_names[joint]} at {float(theirs[row, joint]):.3g}, "
            f"{float(own[row, joint]):.3g} {_reason(hand, joint)}: a fingertip "
            f"{1000 * float(off[row]):.1f} mm off"
        )
        raise refuse(found, "joints that follow as in the hand; any other name skips a joint")
    idle = (apart.amax(0) > POSTURE.same_joint) & ~moving
    names = [x for x, one in zip(hand.tree.joint_names, idle.tolist(), strict=True) if one]
    if names:
        warn_user(
            GraspFileWarning,
            f"{what}: {', '.join(names)} move no grasping finger, so the file's values are not "
            "kept; --fingers chooses others",
        )
    return joints


def _reason(hand: Hand, joint: int) -> str:
    """Return why a joint that is not actuated has its value."""
    leaders = flatnonzero(hand.actuated.coupling[joint] != 0).tolist()
    if not leaders:
        return "where the hand parks it"
    return f"by its coupling to {', '.join(hand.joint_names[k] for k in leaders)}"


def _tips(hand: Hand, values: Float[Tensor, "g j"]) -> Float[Tensor, "g f 3"]:
    """Return the contact points [m] of the pads in the palm's frame, given all movable joints."""
    _, carriers = hand.tips.frames(values.T.contiguous())
    return map_points(carriers, hand.tips.in_carriers[0]).permute(2, 1, 0)


@dataclasses.dataclass(frozen=True)
class _Fingers(Batch):
    """Actuated joints [rad] of g hands whose wrists are fixed."""

    joints: Float[Tensor, "g h"]


def reach_tips(
    hand: Hand, joints: Float[Tensor, "g h"], tips: Float[Tensor, "g f 3"]
) -> tuple[Float[Tensor, "g h"], Float[Tensor, "g"]]:
    """Return joint positions (g, h) [rad or m] that bring fingertips to given points, then the
    distance (g,) [m] that is left.

    `tips` (g, f, 3) [m] are the points for the contact points of f fingertips in g grasps. They are
    in the frame of the hand's root link. Each grasp's distance is the greatest one of its
    fingertips. The h actuated joints stay within their limits. The search starts at the argument
    `joints` (g, h) [rad or m].
    """

    def errors(state: _Fingers, rows: Int[Tensor, "a"]) -> Residuals:
        found = state.joints
        error = 1000.0 * (hand.fingertips(found)[0] - tips[rows]).flatten(1)  # (a, 3 f) [mm]
        jacobian = 1000.0 * hand.jacobian(found).flatten(1, 2)  # (a, 3 f, h)
        slope = matvec(jacobian.mT, error)
        # joints that press on a limit stay there
        held = ((found <= hand.lower) & (slope > 0)) | ((found >= hand.upper) & (slope < 0))
        return error, torch.where(held[:, None], 0.0, jacobian)

    def move(state: _Fingers, step: Float[Tensor, "a h"]) -> _Fingers:
        return _Fingers((state.joints + step).clamp(hand.lower, hand.upper))

    problem = LeastSquares(errors, move, solved=POSTURE.reached, stalled=POSTURE.stalled)
    joints = levenberg_marquardt(problem, _Fingers(joints), POSTURE.steps)[0].joints
    return joints, norm(tips - hand.fingertips(joints)[0]).amax(-1)
