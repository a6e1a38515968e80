"""Move hand postures onto their contacts without touching anything else: batched Levenberg-Marquardt.

The learned posture (Eqs. 23-24) leaves millimetres to centimetres between fingertips and contacts. Here the hand's
pose and joints are solved together, every guess a row of one batch, with analytic Jacobians. The residuals are

* a round fingertip's centre one radius off the contact along its normal, so that the tip may roll; a tip that is not
  round brings its contact point itself to the contact,
* the contact direction inside a cone about the pad's axis,
* hinges on the clearance of the links' spheres from the object's field and from the table, and of the links' shapes
  from each other. Boxes (the palm's) are left to `check`.

Joint limits hold at every step by projection. The paper's COBYLA minimises the tip distances alone, one grasp at a
time; here collision is part of the problem, because that is where planned contacts are lost.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.hand.hand import Hand
from torchgrasp.ik.clearance import CLEARANCE, MILLIMETRE, CollisionWorld, clearance_rows
from torchgrasp.ik.configuration import Configuration, SpatialJacobian, wrench_of
from torchgrasp.optim import SOLVED, Residuals, levenberg_marquardt
from torchgrasp.values import Contacts

ROUND_PAD, FLAT_PAD = math.radians(60), math.radians(40)
"""Half angles [rad] of the cone about the pad's axis in which a round and a flat fingertip may touch."""
TIP_WEIGHT, PAD_WEIGHT = 2.0, 80.0
"""Residual of a tip's millimetre and of a contact direction's unit of cosine outside the pad's cone, against 1 for a
millimetre of clearance: what must be met outweighs a margin that may be used up."""
ITERATIONS = 40
OPENING, OPENING_SIGMAS = 0.012, 3.0
"""How far the pre-grasp's tips are from their contacts: metres, and standard deviations of the surface there."""


def tip_targets(hand: Hand, contacts: Contacts) -> Float[Tensor, "g 3 3"]:
    """Return where the centres of tips (`Hand.tip_centres`) that touch their contacts are [m]."""
    return contacts.points + hand.tip_radius.to(contacts.normals)[:, None] * contacts.normals


def tip_rows(jacobians: SpatialJacobian, target: Float[Tensor, "g 3 3"], normals: Float[Tensor, "g 3 3"]) -> Residuals:
    """Return residuals [mm] of the tips' centres from their targets and of the pads' axes from the normals' cones."""
    hand = jacobians.hand
    radius = hand.tip_radius.to(normals)
    tips = jacobians.points(hand.tips.index, hand.tips.center)
    three = torch.arange(3, device=tips.device).repeat_interleave(3)
    axes = torch.eye(3).to(tips).repeat(3, 1).expand(len(tips), 9, 3)
    pads = jacobians.directions(hand.tips.index, hand.tips.normal)
    cone = torch.where(radius > 0, math.cos(ROUND_PAD), math.cos(FLAT_PAD))
    outside = cone + (pads * normals).sum(-1)  # the contact direction is the inward normal
    turning = torch.cat([torch.zeros_like(pads), torch.linalg.cross(pads, normals)], -1)
    wrenches = torch.cat([wrench_of(tips[:, three], axes), turning], 1)
    jacobian = jacobians.jacobian(wrenches, hand.tips.index[torch.cat([three, torch.arange(3).to(three)])])
    active = (outside > 0).to(tips)
    return (
        torch.cat([TIP_WEIGHT * (tips - target).flatten(1) / MILLIMETRE, PAD_WEIGHT * outside * active], 1),
        torch.cat([TIP_WEIGHT * jacobian[:, :9] / MILLIMETRE, PAD_WEIGHT * active[..., None] * jacobian[:, 9:]], 1),
    )


def grasp_rows(
    posture: Configuration,
    hand: Hand,
    target: Float[Tensor, "g 3 3"],
    normals: Float[Tensor, "g 3 3"],
    world: CollisionWorld,
    tips_touch: bool,
) -> Residuals:
    """Return the residuals of a hand: its tips from their targets, its pads, its clearances."""
    jacobians = SpatialJacobian.at(posture, hand)
    tips = tip_rows(jacobians, target, normals)
    links = clearance_rows(jacobians, world, tips_touch)
    return torch.cat([tips[0], links[0]], 1), torch.cat([tips[1], links[1]], 1)


def refinement_cost(
    posture: Configuration, hand: Hand, contacts: Contacts, world: CollisionWorld
) -> Float[Tensor, "g"]:
    """Return the sum of squared residuals of each row: what `refine` lowers."""
    rows = grasp_rows(posture, hand, tip_targets(hand, contacts), contacts.normals, world, tips_touch=True)
    return rows[0].square().sum(1)


def refine(
    posture: Configuration, hand: Hand, contacts: Contacts, world: CollisionWorld, solved: float = SOLVED
) -> Configuration:
    """Return postures whose fingertips are on their contacts and whose links are clear, as far as each row allows.

    Args:
        posture: starting pose and joints, g rows.
        hand: whose fingers, in grasp order, take the contacts in theirs.
        contacts: g rows; finger i takes contact i.
        surroundings: the estimated object and the table.
        solved: sum of squared residuals [mm2] at which a row is left alone.

    Returns:
        As many rows; whether each succeeded is for `check` to say.
    """
    target, normals = tip_targets(hand, contacts), contacts.normals

    def evaluate(state: Configuration, at: Int[Tensor, "a"]) -> Residuals:
        return grasp_rows(state, hand, target[at], normals[at], world, tips_touch=True)

    return levenberg_marquardt(posture, evaluate, lambda state, step: state.moved(step, hand), ITERATIONS, solved)


def settle_tips(posture: Configuration, hand: Hand, contacts: Contacts, solved: float) -> Configuration:
    """Return refined postures with their tips on their contacts, whatever clearance that costs: it is a last touch."""
    target, normals = tip_targets(hand, contacts), contacts.normals

    def evaluate(state: Configuration, at: Int[Tensor, "a"]) -> Residuals:
        return tip_rows(SpatialJacobian.at(state, hand), target[at], normals[at])

    return levenberg_marquardt(posture, evaluate, lambda state, step: state.moved(step, hand), ITERATIONS, solved)


def open_hand(posture: Configuration, hand: Hand, contacts: Contacts, world: CollisionWorld) -> Float[Tensor, "g h"]:
    """Return the joints of the pre-grasp: at the same pose, the tips off their contacts and everything clear.

    Each tip opens by `OPENING` and three standard deviations of the surface at its contact, so that it starts outside
    the object even where that is larger than it was thought to be, but not into the table. Opening along the normals
    alone drives links into the object; here clearance is part of the problem.
    """
    normals, gap = contacts.normals, OPENING + OPENING_SIGMAS * contacts.require_std()
    target = tip_targets(hand, contacts) + gap[..., None] * normals
    if world.table is not None:
        lowest = world.table + CLEARANCE + hand.tip_radius.to(target)
        target = torch.stack([*target.unbind(-1)[:2], torch.maximum(target[..., 2], lowest)], -1)

    def evaluate(state: Configuration, at: Int[Tensor, "a"]) -> Residuals:
        residual, jacobian = grasp_rows(state, hand, target[at], normals[at], world, tips_touch=False)
        return residual, jacobian[..., 6:]

    def move(state: Configuration, step: Float[Tensor, "a d"]) -> Configuration:
        return state.moved(torch.cat([step.new_zeros(len(step), 6), step], 1), hand)

    return levenberg_marquardt(posture, evaluate, move, ITERATIONS).joints
