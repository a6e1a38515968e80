"""Postures in which a hand presses on a surface from above, with the tips of one or two fingers.

All other links are farther from the surface than the pressing tips. So the hand can be set down on
a low object without touching its table, and slide the object along.
"""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.base import Batch, flatnonzero
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.rules import Seed
from torchgrasp.geometry.frames import inverse, rigid
from torchgrasp.geometry.linalg import (
    across,
    eye_like,
    fibonacci_sphere,
    matvec,
    norm,
    perpendicular,
    unit,
)
from torchgrasp.hand.hand import Hand
from torchgrasp.posture_model.sample import sample_configurations


@dataclasses.dataclass(frozen=True)
class PressNumbers:
    """Parameters of the search for pressing postures."""

    postures: int = 1000
    """Number of random postures of the hand that are tried."""
    directions: int = 400
    """Number of directions, over the whole sphere, in which each posture is tried as pressing."""
    level: float = 0.003
    """Greatest difference [m] of the heights of two pressing tips. The hand is then turned to level
    them.
    """
    gap: float = 0.006
    """Least distance [m] by which all else of the hand is higher than the pressing tips."""
    cosine: float = 0.5
    """Least cosine between a pad's axis and the direction of pressing: 60 degrees."""
    apart: float = 0.02
    """Least distance [m] of two pressing tips, so that they resist a turn of the object."""
    weakest: float = 5.0
    """Least normal force [N] of a pressing finger: a quarter of a kilogram slides with it."""
    strongest: float = 60.0
    """Greatest normal force [N] of a pressing finger. A stretched finger does not give way, and is
    hard to control.
    """
    compliance: float = 1e-5
    """Compliance [m/N] of gears and links, which every fingertip has in all directions."""
    kept: int = 200
    """Number of postures that are kept."""
    chunk: int = 50
    """Number of postures whose links are projected at a time, to bound the memory."""


PRESS = PressNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class PressPostures(Batch):
    """Pressing postures of a hand: first those with two pressing tips, then those with one. Each
    kind is sorted by falling gap.

    The gap is the distance by which all other links are higher than the pressing tips.

    p counts postures, h actuated joints, f fingertips and s collision spheres. Each posture has a
    frame with the origin at the mean of the pressing tips' lowest points. Its z axis points up,
    against the direction of pressing.

    Attributes:
        joints: actuated joints (p, h) [rad or m].
        press_from_hand: pose (p, 4, 4) [m] of the hand's root link in the posture's frame.
        presses: mask (p, f) of the fingers that press.
        feet: lowest points (p, f, 3) [m] of the fingertips in the posture's frame.
        strength: greatest normal force (p,) [N] of the weakest pressing finger, by the torques of
            its joints.
        stiffness: matrix (p, f, 3, 3) [N/m] of each fingertip in the posture's frame. It gives the
            force with which the drives of the joints resist a displacement of the tip.
        spheres: centres (p, s, 3) [m] of the hand's collision spheres in the posture's frame.
    """

    joints: Float[Tensor, "p h"]
    press_from_hand: Float[Tensor, "p 4 4"]
    presses: Bool[Tensor, "p f"]
    feet: Float[Tensor, "p f 3"]
    strength: Float[Tensor, "p"]
    stiffness: Float[Tensor, "p f 3 3"]
    spheres: Float[Tensor, "p s 3"]

    @property
    def apart(self) -> Float[Tensor, "p"]:
        """Distance [m] of the two pressing tips' lowest points; infinite for one tip."""
        return _apart(self.feet, self.presses[:, None])[:, 0]


@checked
def press_postures(hand: Hand, seed: Seed = 0) -> PressPostures:
    """Return the pressing postures of a hand, found among random postures drawn from `seed`.

    In such a posture the tips of one or two fingers are lowest: all else is higher by 6 mm
    (`PRESS.gap`). Each pressing finger can press with 5 to 60 N, and faces down within 60 degrees.
    At most 200 (`PRESS.kept`) postures are returned, in float64 on the CPU; there may be none. The
    result is cached in `hand.derived`.

    Raises `BadArgument` if almost all random postures of the hand collide with themselves.

    >>> from torchgrasp import load_hand
    >>> found = press_postures(load_hand("allegro"))
    >>> bool(found.presses.any(1).all()), bool((found.strength > 1.0).any())
    (True, True)
    """
    key = (PressPostures, seed)
    if key not in hand.derived:
        hand.derived[key] = _search(hand.to("cpu", torch.float64), seed)
    return hand.derived[key]


def _search(hand: Hand, seed: int) -> PressPostures:
    """Return the pressing postures; each random posture gives at most one, in its best direction."""
    joints = sample_configurations(hand, PRESS.postures, seed).joints
    centres = hand.tip_centres(joints)
    radius = hand.tips.radius
    _, pads = hand.fingertips(joints)
    around = hand.collision_spheres
    links = hand.sphere_centres(joints)[:, ~around.touching]
    directions = fibonacci_sphere(PRESS.directions).to(centres)
    # how far everything reaches in each direction: (s, d, f) and (s, d)
    reach = directions @ centres.mT + radius
    links = torch.cat(
        [
            (directions @ some.mT + around.radius[~around.touching]).amax(2)
            for some in links.split(PRESS.chunk)
        ]
    )
    facing = directions @ pads.mT > PRESS.cosine
    presses = facing & (reach > reach.amax(2, keepdim=True) - PRESS.level)
    presses &= presses.sum(2, keepdim=True) <= 2
    gap = _gap(reach, links, presses)
    apart = _apart(centres, presses)
    good = presses.any(2) & (gap > PRESS.gap) & (apart > PRESS.apart)
    # two tips resist a turn, so they come before one; then the wider gap
    value = torch.where(good, gap + presses.sum(2), -math.inf)
    best, at = value.max(1)
    row = flatnonzero(best > -math.inf)
    row = row[torch.argsort(best[row], descending=True, stable=True)]
    at = at[row]
    joints = joints[row]
    presses = presses[row, at]
    down = _levelled(centres[row], radius, directions[at], presses)
    row = flatnonzero(_gap_along(hand, joints, down, presses) > PRESS.gap)
    return _built(hand, joints[row], down[row], presses[row])


def _levelled(
    centres: Float[Tensor, "p f 3"],
    radius: Float[Tensor, "f"],
    down: Float[Tensor, "p 3"],
    presses: Bool[Tensor, "p f"],
) -> Float[Tensor, "p 3"]:
    """Return the directions of pressing, turned so that two pressing tips touch a plane at once."""
    two = presses.sum(1) == 2
    index = presses.to(torch.int64).topk(2, 1).indices  # one tip: any second one, not used
    first, second = centres.gather(1, index[..., None].expand(-1, -1, 3)).unbind(1)
    side = first - second
    length = norm(side, keepdim=True)
    side = side / length
    # the component along the side by which the smaller tip reaches as far as the larger one
    share = (radius[index[:, 1]] - radius[index[:, 0]])[:, None] / length
    rest = unit(perpendicular(down, side))
    levelled = share * side + torch.sqrt(1 - share**2) * rest
    return torch.where(two[:, None], levelled, down)


def _gap_along(
    hand: Hand,
    joints: Float[Tensor, "p h"],
    down: Float[Tensor, "p 3"],
    presses: Bool[Tensor, "p f"],
) -> Float[Tensor, "p"]:
    """Return the `_gap` [m] of each posture in its direction of pressing."""
    around = hand.collision_spheres
    reach = matvec(hand.tip_centres(joints), down) + hand.tips.radius.to(down)
    links = matvec(hand.sphere_centres(joints), down) + around.radius
    # links that end in a pressing tip touch with it
    own = around.touching & presses[:, around.finger.clamp_min(0)]
    return _gap(reach, torch.where(own, -math.inf, links).amax(1), presses)


def _gap(
    reach: Float[Tensor, "*b f"], links: Float[Tensor, "*b"], presses: Bool[Tensor, "*b f"]
) -> Float[Tensor, "*b"]:
    """Return by how much [m] all else of a hand is higher than its pressing tips.

    `reach` and `links` [m] are how far each tip and the other links reach down.
    """
    lowest = torch.where(presses, reach, math.inf).amin(-1)
    others = torch.where(presses, -math.inf, reach).amax(-1)
    return lowest - torch.maximum(links, others)


def _apart(centres: Float[Tensor, "s f 3"], presses: Bool[Tensor, "s d f"]) -> Float[Tensor, "s d"]:
    """Return the least distance [m] of two pressing tips; infinite for one tip."""
    gaps = torch.cdist(centres, centres)  # (s, f, f)
    both = presses[..., :, None] & presses[..., None, :]
    both &= ~torch.eye(centres.shape[1], dtype=torch.bool, device=centres.device)
    return torch.where(both, gaps[:, None], math.inf).flatten(2).amin(2)


def _built(
    hand: Hand,
    joints: Float[Tensor, "p h"],
    down: Float[Tensor, "p 3"],
    presses: Bool[Tensor, "p f"],
) -> PressPostures:
    """Return the postures that press in the directions `down` of the hand's frame, in their order.

    Those that are too weak or too stiff are left out.
    """
    feet = hand.tip_centres(joints) + hand.tips.radius.to(down)[:, None] * down[:, None]
    strength = _strength(hand, joints, feet, down, presses)
    fit = (strength >= PRESS.weakest) & (strength <= PRESS.strongest)
    fit = flatnonzero(fit)[: PRESS.kept]
    joints, down, presses, feet, strength = (
        x[fit] for x in (joints, down, presses, feet, strength)
    )
    share = presses.to(feet) / presses.sum(1, keepdim=True)
    origin = (share[..., None] * feet).sum(1)
    first, second = across(down)
    press_from_hand = inverse(rigid(torch.stack([second, first, -down], -1), origin))
    turn = press_from_hand[:, :3, :3]
    shift = press_from_hand[:, None, :3, 3]
    spheres = hand.sphere_centres(joints)
    return PressPostures(
        joints,
        press_from_hand,
        presses,
        feet @ turn.mT + shift,
        strength,
        _stiffness(hand, joints, feet, turn),
        spheres @ turn.mT + shift,
    )


def _stiffness(
    hand: Hand,
    joints: Float[Tensor, "p h"],
    feet: Float[Tensor, "p f 3"],
    turn: Float[Tensor, "p 3 3"],
) -> Float[Tensor, "p f 3 3"]:
    """Return the stiffness [N/m] of each fingertip, turned into the posture's frame.

    It is the inverse of a compliance: J K^-1 J^T plus that of gears and links. J is the Jacobian,
    and K the stiffness of the actuated joints, without those coupled to them. `feet` [m] are the
    tips' lowest points in the hand's frame.
    """
    jacobian = turn[:, None] @ hand.jacobian(joints, feet)  # (p, f, 3, h)
    kp = jacobian.new_tensor([hand.actuators[name].kp for name in hand.joint_names])
    compliance = (jacobian / kp) @ jacobian.mT
    return torch.linalg.inv(compliance + PRESS.compliance * eye_like(3, jacobian))


def _strength(
    hand: Hand,
    joints: Float[Tensor, "p h"],
    feet: Float[Tensor, "p f 3"],
    down: Float[Tensor, "p 3"],
    presses: Bool[Tensor, "p f"],
) -> Float[Tensor, "p"]:
    """Return the greatest normal force [N] of the weakest pressing finger of each posture.

    A force F along `down` at a tip with the Jacobian J needs the torques J^T F (statics).
    """
    jacobian = hand.jacobian(joints, feet)  # (p, f, 3, h)
    torque = (down[:, None, None] @ jacobian)[:, :, 0].abs()  # (p, f, h) for 1 N
    effort = torque.new_tensor([hand.actuators[name].effort for name in hand.joint_names])
    most = (effort / torque.clamp_min(torch.finfo(torque.dtype).tiny)).amin(2)
    return torch.where(presses, most, math.inf).amin(1)
