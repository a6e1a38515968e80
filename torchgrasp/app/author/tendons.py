"""Joints that motors, tendons and equalities move together: which lead, and how the others follow.

The equalities are `A q = b`, and the motors set `T q`, with the positions q of all joints. Where
both leave some motion free, the joints are under-actuated: one motor pulls several by a tendon.
Then a quasi-static rule gives the posture in free space. Of all postures that the motors allow, the
joints take that of least energy of their springs. Without springs they move as their dampers let
them, and without dampers by equal weights.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from torchgrasp.hand.urdf import Mimic


@dataclasses.dataclass(frozen=True)
class TendonNumbers:
    """Numbers of the linear algebra of coupled joints."""

    # singular value, as a share of the largest one, below which it counts as zero
    rank: float = 1e-9
    leads: float = 0.1  # least motion of a leading joint, as a share of the largest joint's motion
    digits: int = 12  # number of decimals to which ratios and offsets are rounded
    zero: float = 1e-9  # absolute value of a ratio below which it counts as zero
    agree: float = 1e-6  # largest error [rad or m] of equalities that agree with each other


TENDONS = TendonNumbers()


class Joints(NamedTuple):
    """The n joints of a mechanism: names, and springs and dampers by which they give way.

    A sliding joint has units with [N] and [m] in place of [N m] and [rad]. `stiffness` [N m/rad] is
    that of each joint's spring, and `damping` [N m s/rad] that of its damper. `spring` [rad] is the
    position at which the spring is relaxed. `rest` [rad] is that in the model's initial posture.
    """

    names: tuple[str, ...]
    stiffness: Float[np.ndarray, "n"]
    damping: Float[np.ndarray, "n"]
    spring: Float[np.ndarray, "n"]
    rest: Float[np.ndarray, "n"]


class Mechanism(NamedTuple):
    """How the joints of a hand move: every joint leads, follows or stands still.

    `followers` holds, by name, how each following joint depends on leading ones. `still` holds, by
    name, the positions [rad or m] of joints that nothing moves. All other joints lead: motors set
    their positions. `told` has sentences for the user on under-actuated and on still joints.
    """

    followers: dict[str, Mimic]
    still: dict[str, float]
    told: tuple[str, ...]


class Contradiction(Exception):
    """Raised for equalities between joint positions that no posture obeys; `joints` names the
    joints.
    """

    def __init__(self, joints: tuple[str, ...]) -> None:
        super().__init__(", ".join(joints))
        self.joints = joints


def couple_joints(
    joints: Joints,
    equal: Float[np.ndarray, "m n"],
    values: Float[np.ndarray, "m"],
    pulls: Float[np.ndarray, "k n"],
) -> Mechanism:
    """Return which of n joints lead, how the others follow, and which stand still.

    The positions q (n,) [rad or m] of the joints obey m equalities, `equal @ q = values`. Each of k
    motors sets one weighted sum of the positions, an entry of `pulls @ q`. Joints with a motor of
    their own are the first choice to lead. If several joints share a motor, their springs or
    dampers decide how they move. Raises `Contradiction` for equalities that no posture obeys.
    """
    followers = dict[str, Mimic]()
    still = dict[str, float]()
    told = list[str]()
    alone = (pulls != 0).sum(1) == 1
    direct = (pulls[alone] != 0).any(0)  # (n,)
    for part in _parts(np.concatenate([equal, pulls]) != 0):
        rows = (equal[:, part] != 0).any(1)
        few = Joints(
            tuple(joints.names[k] for k in part),
            *(np.asarray(column)[part] for column in joints[1:]),
        )
        pulled = pulls[(pulls[:, part] != 0).any(1)][:, part]
        motion, offset, sentence = _free_motion(few, equal[rows][:, part], values[rows], pulled)
        leads = _leaders(motion, direct[part].tolist())
        # all joints by the leaders: q = ratio q_leads + shift
        ratio = motion @ np.linalg.inv(motion[leads])
        shift = offset - ratio @ offset[leads]
        ratio = np.where(np.abs(ratio) < TENDONS.zero, 0.0, ratio.round(TENDONS.digits))
        names = [few.names[k] for k in leads]
        for k, name in enumerate(few.names):
            terms = [(leader, float(x)) for leader, x in zip(names, ratio[k], strict=True) if x]
            at = round(float(shift[k]), TENDONS.digits) + 0.0
            if k in leads:
                continue
            if terms:
                followers[name] = Mimic(*terms[0], at, tuple(terms[1:]))
            else:
                still[name] = at
        told += [sentence] if sentence else []
    if still:
        places = ", ".join(f"{name} at {at:.4g}" for name, at in still.items())
        told.append(f"joints that no motor moves are fixed: {places}")
    return Mechanism(followers, still, tuple(told))


def _parts(touched: np.ndarray) -> list[list[int]]:
    """Return the groups of joints that rows of `touched` (rows, n) tie together, in their order."""
    group = list(range(touched.shape[1]))
    for row in touched:
        tied = np.flatnonzero(row).tolist()
        least = min((group[k] for k in tied), default=0)
        old = {group[k] for k in tied}
        group = [least if g in old else g for g in group]
    return [[k for k, g in enumerate(group) if g == one] for one in dict.fromkeys(group)]


def _free_motion(
    joints: Joints, equal: np.ndarray, values: np.ndarray, pulls: np.ndarray
) -> tuple[np.ndarray, np.ndarray, str]:
    """Return the motion (n, h) of joints by h motors and their offset (n,): `q = motion y + offset`.

    The sentence says by which rule joints share a motor; it is "" if the motors set all.
    """
    start = np.linalg.lstsq(equal, values, rcond=None)[0] if len(equal) else joints.rest * 0
    if len(equal) and np.abs(equal @ start - values).max() > TENDONS.agree:
        raise Contradiction(joints.names)
    _, free = _split(equal)  # (n, p)
    reached, left = _split(pulls @ free)
    motion = free @ reached
    slack = free @ left  # motions that no motor sets (n, s)
    if not slack.shape[1]:
        return motion, start, ""
    loose = np.abs(slack).max(1) > TENDONS.zero
    weights = np.ones(len(loose))
    at = joints.rest
    rule = "equal weights"
    if (joints.stiffness[loose] > 0).all():
        weights = joints.stiffness
        at = joints.spring
        rule = "their springs"
    elif (joints.damping[loose] > 0).all():
        weights = joints.damping
        rule = "their dampers"
    weighted = slack.T * weights
    give = np.linalg.solve(weighted @ slack, weighted)  # (s, n)
    motion = motion - slack @ (give @ motion)
    offset = start - slack @ (give @ (start - at))
    if not motion.shape[1]:
        return motion, offset, ""
    names = ", ".join(name for name, x in zip(joints.names, loose, strict=True) if x)
    count = f"{motion.shape[1]} motor" + ("s" if motion.shape[1] > 1 else "")
    told = f"under-actuated: {count} for {names}, which in free space move by {rule}"
    return motion, offset, told


def _split(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return orthonormal bases of a matrix's row space, and of the vectors that it maps to zero, as
    columns.
    """
    n = matrix.shape[1]
    if not matrix.size:
        return np.zeros((n, 0)), np.eye(n)
    _, sizes, rows = np.linalg.svd(matrix)
    rank = int((sizes > TENDONS.rank * max(sizes.max(), TENDONS.zero)).sum())
    return rows[:rank].T, rows[rank:].T


def _leaders(motion: np.ndarray, direct: Sequence[bool]) -> list[int]:
    """Return the indices of joints whose positions tell those of all, given their motion (n, h).

    Joints that are `direct`, with a motor of their own, come first.
    """
    order = sorted(range(len(motion)), key=lambda k: not direct[k])
    largest = float(np.linalg.norm(motion, axis=1).max(initial=0.0))
    chosen = list[int]()
    left = motion.copy()
    for least in (TENDONS.leads, TENDONS.rank):
        for k in order:
            size = float(np.linalg.norm(left[k]))
            if len(chosen) == motion.shape[1] or k in chosen or size <= least * largest:
                continue
            chosen.append(k)
            way = left[k] / size
            left = left - np.outer(left @ way, way)
    return sorted(chosen)
