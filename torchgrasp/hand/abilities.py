"""What a hand can do, as numbers. They are spans and forces of its fingertips, widths that it can
hold, and its free postures.

All numbers come from seeded random postures, which are uniform within the limits of the joints. A
posture is free if no pair of links of `[self_collision]` overlaps.
"""

import dataclasses
import itertools
import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Count, Fraction, Measured, Seed
from torchgrasp.geometry.linalg import dot, norm
from torchgrasp.hand.hand import Hand


@dataclasses.dataclass(frozen=True)
class AbilityNumbers:
    """Parameters by which the abilities of a hand are computed from its random postures."""

    sure: float = (
        0.1  # share of the free postures in which a fingertip is weaker than its sure force
    )
    # least distance [m] of two tips that is a divisor, so that coinciding tips have a direction
    least_apart: float = 1e-9
    digits: int = 6  # number of significant digits in files: random postures give no more


ABILITY = AbilityNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class FingerAbility:
    """What one fingertip can do; `hand_abilities` makes it.

    Attributes:
        name: name of the finger.
        tip_link: name of the link of its tip.
        joints: number of the actuated joints that move the tip.
        force: greatest normal force [N] of the tip, as the median over the free postures. NaN if in
            half of them no joint moves the contact point along its normal. The load is then carried
            by the links, not by the motors. It is also NaN if the effort of a joint that moves the
            contact point is unknown.
        sure_force: normal force [N] that the tip reaches in 90 % of the free postures. NaN if no
            joint moves the contact point along its normal in these postures, or if an effort is
            unknown, as for `force`.

    Both forces act at the contact point of the pad, the part that touches objects, along the pad's
    normal. No other finger presses, and each actuated joint exerts at most its effort, its greatest
    torque in the URDF. An effort that the URDF lacks, or that is 0, is unknown. A posture is free
    if no links of the hand overlap.
    """

    name: str
    tip_link: str
    joints: Count
    force: Measured
    sure_force: Measured


@checked
@dataclasses.dataclass(frozen=True)
class PairAbility:
    """What two fingertips can do together; `hand_abilities` makes it.

    Attributes:
        fingers: names of both fingers.
        least_span: least distance [m] between the contact points of the two pads, over the free
            postures.
        greatest_span: greatest distance [m] between these contact points.
        least_width: least thickness [m] of a plate that the two tips hold between them. NaN if they
            hold none in any free posture.
        greatest_width: greatest thickness [m] of such a plate. NaN as for `least_width`.
        opposed: share [0 to 1] of the free postures in which the tips hold a plate.

    A posture is free if no links of the hand overlap. Two tips hold a plate if they face each
    other: the line between the centres of their spheres lies in the cones of both pads.
    `Fingertips.cone` is the half angle of these cones. The plate is as thick as the gap between the
    tips on this line.
    """

    fingers: tuple[str, str]
    least_span: Measured
    greatest_span: Measured
    least_width: Measured
    greatest_width: Measured
    opposed: Fraction


@checked
@dataclasses.dataclass(frozen=True)
class HandAbilities:
    """What a hand can do with its grasping fingers; `hand_abilities` returns it.

    Attributes:
        hand: name of the hand.
        option: name of the option of hand.toml that lists the fingers; or the names of the fingers.
        joints: number of actuated joints.
        postures: number of random postures that were drawn.
        seed: seed of these postures.
        free: share [0 to 1] of the postures in which no links of the hand overlap.
        fingers: a `FingerAbility` for each grasping finger.
        pairs: a `PairAbility` for each pair of grasping fingers.
    """

    hand: str
    option: str
    joints: Count
    postures: Count
    seed: Seed
    free: Fraction
    fingers: tuple[FingerAbility, ...]
    pairs: tuple[PairAbility, ...]

    @property
    def least_width(self) -> float:
        """The least thickness [m] of a plate that two tips hold between them (`PairAbility`); NaN
        if no tips hold one.
        """
        return min(_known(pair.least_width for pair in self.pairs), default=math.nan)

    @property
    def greatest_width(self) -> float:
        """The greatest thickness [m] of a plate that two tips hold between them (`PairAbility`);
        NaN if no tips hold one.
        """
        return max(_known(pair.greatest_width for pair in self.pairs), default=math.nan)

    @checked
    def content(self) -> dict[str, Any]:
        """Return the abilities as a dict for JSON.

        It holds all fields, with a dict for each finger and each pair of fingers. A span or a width
        is a list [least, greatest]. A key ends with the unit of its number, as in "force_n" [N] and
        "span_m" [m], or with "_share". Numbers have six significant digits. NaN becomes None.
        """
        fingers = [
            {
                "name": finger.name,
                "tip_link": finger.tip_link,
                "joints": finger.joints,
                "force_n": _rounded(finger.force),
                "sure_force_n": _rounded(finger.sure_force),
            }
            for finger in self.fingers
        ]
        pairs = [
            {
                "fingers": list(pair.fingers),
                "span_m": [_rounded(pair.least_span), _rounded(pair.greatest_span)],
                "width_m": [_rounded(pair.least_width), _rounded(pair.greatest_width)],
                "opposed_share": _rounded(pair.opposed),
            }
            for pair in self.pairs
        ]
        return {
            "hand": self.hand,
            "option": self.option,
            "joints": self.joints,
            "postures": self.postures,
            "seed": self.seed,
            "free_share": _rounded(self.free),
            "width_m": [_rounded(self.least_width), _rounded(self.greatest_width)],
            "fingers": fingers,
            "pairs": pairs,
        }


@checked
def hand_abilities(hand: Hand, postures: Count = 5000, seed: Seed = 0) -> HandAbilities:
    """Return numbers on what a hand can do with its grasping fingers, measured in random postures.

    They are the forces of its fingertips, the spans between them, and the widths that two of them
    can hold.

    Args:
        hand: the hand, with its grasping fingers. The result is cached in `hand.derived`.
        postures: number of random postures, uniform within the joint limits. More postures bring
            the least and greatest values nearer to the hand's true limits.
        seed: seed of the random postures.

    Raises `BadArgument` if links of the hand overlap in every drawn posture.

    >>> from torchgrasp import load_hand
    >>> able = hand_abilities(load_hand("barrett"), postures=500)
    >>> [finger.name for finger in able.fingers], len(able.pairs), able.greatest_width > 0.1
    (['f1', 'f2', 'f3'], 3, True)
    """
    key = "abilities", postures, seed
    if key not in hand.derived:
        hand.derived[key] = _measure(hand.to(device="cpu", dtype=torch.float64), postures, seed)
    return hand.derived[key]


def random_joints(hand: Hand, n: int, seed: int = 0) -> Float[Tensor, "n h"]:
    """Return n random postures (n, h) [rad or m] of the h actuated joints, uniform within their
    limits. `seed` is the random seed.
    """
    share = torch.rand(
        n,
        hand.dof,
        generator=torch.Generator().manual_seed(seed),
        dtype=torch.float64,
        device="cpu",
    )
    return hand.lower + (hand.upper - hand.lower) * share


def _measure(hand: Hand, postures: int, seed: int) -> HandAbilities:
    """Return the abilities of a hand on the CPU, from `postures` random postures."""
    joints = random_joints(hand, postures, seed)
    apart = hand.self_clearance(joints, below=0.0) > 0
    free = joints[apart]
    if not len(free):
        found = f"{hand.name}, whose links meet in all of {postures} random postures"
        raise BadArgument("hand", found, "a hand with a free posture, as check_hand demands")
    points, normals = hand.fingertips(free)  # (n, f, 3)
    centres = hand.tip_centres(free)  # (n, f, 3)
    jacobian = hand.jacobian(free)  # (n, f, 3, h)
    fingers = _fingers(hand, torch.einsum("nfih,nfi->nfh", jacobian, normals))
    pairs = []
    for one, two in itertools.combinations(range(len(hand.tips)), 2):
        span = norm(points[:, two] - points[:, one])
        width = _widths(hand, centres, normals, one, two)
        names = hand.finger_names[one], hand.finger_names[two]
        share = float(width.isfinite().double().mean())
        pairs.append(PairAbility(names, *_ends(span), *_ends(width), share))
    return HandAbilities(
        hand.name,
        hand.source.option,
        hand.dof,
        postures,
        seed,
        len(free) / postures,
        fingers,
        tuple(pairs),
    )


def _fingers(hand: Hand, levers: Float[Tensor, "n f h"]) -> tuple[FingerAbility, ...]:
    """Return the abilities of the fingers.

    `levers` [m, or no unit for a sliding joint] are for each contact and each actuated joint. They
    are the moves of the contact along its normal.
    """
    effort = levers.new_tensor([hand.actuators[name].effort for name in hand.joint_names])
    # The joint that reaches its effort first bounds the force. One without a lever does not, even
    # if its effort is unknown, which the URDF's reader stores as 0.
    effort = torch.where(effort > 0, effort, torch.nan)
    bounds = torch.where(levers == 0, math.inf, effort / levers.abs())
    force = bounds.amin(2)  # (n, f)
    moved = (hand.tree.moves[hand.tips.index] @ hand.actuated.coupling.abs()) > 0  # (f, h)
    found = []
    for k, name in enumerate(hand.finger_names):
        ranked = force[:, k].sort().values
        median = float(ranked[len(ranked) // 2])
        sure = float(ranked[int(ABILITY.sure * len(ranked))])
        unknown = bool(ranked.isnan().any())
        known = [math.nan if unknown or math.isinf(x) else x for x in (median, sure)]
        found.append(FingerAbility(name, hand.tips.links[k], int(moved[k].sum()), *known))
    return tuple(found)


def _widths(
    hand: Hand,
    centres: Float[Tensor, "n f 3"],
    normals: Float[Tensor, "n f 3"],
    one: int,
    two: int,
) -> Float[Tensor, "n"]:
    """Return the thickness [m] of the plate between two tips in each posture; NaN without one."""
    between = centres[:, two] - centres[:, one]
    apart = norm(between)
    way = between / apart.clamp_min(ABILITY.least_apart)[:, None]
    width = apart - hand.tip_radius[one] - hand.tip_radius[two]
    least = hand.tips.cone.cos()
    held = dot(normals[:, one], way) >= least[one]
    held &= dot(normals[:, two], -way) >= least[two]
    return torch.where(held & (width > 0), width, torch.nan)


def _ends(values: Float[Tensor, "n"]) -> tuple[float, float]:
    """Return the least and the greatest of the values that are known; NaN if none is."""
    known = values[values.isfinite()]
    if not len(known):
        return math.nan, math.nan
    return float(known.min()), float(known.max())


def _known(values: Any) -> list[float]:
    return [x for x in values if math.isfinite(x)]


def _rounded(value: float) -> float | None:
    """Return a number with few digits; None for NaN."""
    return float(f"{value:.{ABILITY.digits}g}") if math.isfinite(value) else None
