"""Refinement of hand configurations onto contacts and away from collisions, by batched
Levenberg-Marquardt.

The centre of a round fingertip is one radius away from its contact, so that the tip may roll.
Fingertips of other shapes touch with a fixed point. The contact direction, the inward normal, stays
inside a cone about the pad's axis. Here g counts configurations, and f fingertips. Contacts are in
the order of the fingers.
"""

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.geometry.linalg import dot, eye_like
from torchgrasp.geometry.optim import SOLVED, LeastSquares, Residuals, levenberg_marquardt
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.clearance import (
    CLEARANCE,
    MILLIMETRE,
    CollisionWorld,
    away,
    clearance_rows,
    is_world_fused,
    level,
)
from torchgrasp.ik.configuration import Configuration, ResidualRows, SpatialJacobian, differentiate
from torchgrasp.values.planning import Contacts

# weights of a millimetre at a tip, and of a cosine outside the pad's cone
TIP_WEIGHT = 2.0
PAD_WEIGHT = 80.0
HAND_STEP = 0.6  # largest step of a pose or a joint [m or rad]
ITERATIONS = 30  # most steps of one refinement


@dataclasses.dataclass(frozen=True)
class OpeningNumbers:
    """Parameters of the optimisation that opens a hand from its grasp to its pre-grasp."""

    gap: float = 0.012
    """Distance [m] that each tip moves off its contact if the surface there is exactly known."""
    deviations: float = 3.0
    """Number of standard deviations of the surface at the contact that are added to `gap`."""
    solved: float = 1.0
    """Sum of squared residuals [mm2] below which the optimisation ends. Residuals of tips are twice
    their errors, so an error of half a millimetre at one tip gives this sum.
    """
    steps: int = 12
    """Greatest number of steps of the optimisation."""


OPENING = OpeningNumbers()


def tip_targets(hand: Hand, contacts: Contacts) -> Float[Tensor, "g f 3"]:
    """Return the positions [m] of the fingertip centres when the tips touch.

    They are one tip radius from the contacts, along the outward normals. Finger i touches contact
    i. Contacts and results are in the object's frame.
    """
    return contacts.points + hand.tips.radius.to(contacts.normals)[:, None] * contacts.normals


def tip_rows(
    spatial: SpatialJacobian, target: Float[Tensor, "g f 3"], normals: Float[Tensor, "g f 3"]
) -> ResidualRows:
    """Return 4 f residuals of fingertips: position errors, then errors of contact directions.

    A position error has three components [mm], times 2 (`TIP_WEIGHT`). A contact direction has one
    residual, times 80 (`PAD_WEIGHT`). It is the cosine of the pad's cone less the cosine of the
    direction's angle from the pad's axis. Inside the cone it is 0. `target` [m] holds the wanted
    centres of the tips. `normals` are the outward unit normals at their contacts, both in the
    object's frame.
    """
    tips = spatial.hand.tips
    motion = spatial.hand.motion
    g = len(target)
    centres = spatial.tips.permute(2, 1, 0)
    pads = spatial.pads.permute(2, 1, 0)
    # the contact direction is the inward normal
    outside = tips.cone.cos().to(pads) + dot(pads, normals)
    weight = PAD_WEIGHT * (outside > 0).to(pads)
    axes = eye_like(3, pads).expand(g, len(tips), 3, 3) * (TIP_WEIGHT / MILLIMETRE)
    pulls = torch.cat(
        [axes, torch.linalg.cross(centres[:, :, None].expand_as(axes), axes)], -1
    ).flatten(1, 2)
    turns = torch.linalg.cross(pads, normals) * weight[..., None]
    residual = torch.cat(
        [(TIP_WEIGHT / MILLIMETRE) * (centres - target).flatten(1), weight * outside], 1
    )
    wrench = torch.cat([pulls, torch.cat([torch.zeros_like(turns), turns], -1)], 1)
    moves = motion.moves[torch.cat([tips.index.repeat_interleave(3), tips.index])].to(pads)
    return ResidualRows(residual, wrench, moves.expand(g, -1, -1))


def grasp_residuals(
    hand: Hand,
    configuration: Configuration,
    target: Float[Tensor, "g f 3"],
    normals: Float[Tensor, "g f 3"],
    world: CollisionWorld | None,
    tips_touch: bool,
) -> Residuals:
    """Return the weighted residuals (g, k) of each hand, then their Jacobian (g, k, 6 + h).

    First are errors of tip positions [mm], then of cosines of pad directions (no unit; `tip_rows`).
    With a `world`, residuals of clearances follow: by how much [mm] each is below the wanted one
    (`clearance_rows`). None leaves them out. The Jacobian is with respect to the hand's pose (6)
    and its h joints. `target` [m] holds the wanted tip centres, and `normals` the outward unit
    normals at the contacts, in the object's frame. With `tips_touch` the fingertips may touch the
    object and the table.
    """
    posture = configuration.joints, configuration.obj_from_hand
    if is_world_fused(world, *posture, target, normals):
        from torchgrasp.ik import fused_refine  # it imports numba

        given = target, normals, world, tips_touch, (TIP_WEIGHT, PAD_WEIGHT)
        return fused_refine.solve(hand, configuration, *given)[1:]
    spatial = SpatialJacobian.at(hand, configuration)
    links = [] if world is None else clearance_rows(spatial, world, tips_touch)
    return differentiate(spatial, [tip_rows(spatial, target, normals), *links])


def refine(
    hand: Hand,
    configuration: Configuration,
    contacts: Contacts,
    world: CollisionWorld | None,
    solved: float = SOLVED,
    steps: int = ITERATIONS,
) -> Configuration:
    """Return hand configurations moved so that finger i touches contact i and, with a `world`,
    links are clear.

    Contacts, poses and `world` are in one frame. The solver may not succeed, so check the result. A
    configuration is done when the sum of its squared `grasp_residuals` [mm2] is below `solved`, or
    after `steps` steps. A `world` of None leaves out all clearances, also those between links.
    """
    target = tip_targets(hand, contacts)
    normals = contacts.normals

    def evaluate(state: Configuration, rows: Int[Tensor, "a"]) -> Residuals:
        around = None if world is None else world.rows(rows)
        return grasp_residuals(hand, state, target[rows], normals[rows], around, tips_touch=True)

    problem = LeastSquares(evaluate, lambda x, step: x.integrate(hand, step), solved, HAND_STEP)
    if is_world_fused(world, configuration.joints, configuration.obj_from_hand, target):
        from torchgrasp.ik import fused_refine

        given = target, normals, world, True, (TIP_WEIGHT, PAD_WEIGHT)
        return fused_refine.solve(hand, configuration, *given, problem, steps)[0]
    return levenberg_marquardt(problem, configuration, steps)[0]


def open_hand(
    hand: Hand, grasp: Configuration, contacts: Contacts, world: CollisionWorld
) -> Float[Tensor, "g h"]:
    """Return the joints [rad or m] of the opened hand: each tip is moved off its contact along the
    normal.

    The tip moves by 12 mm, and by 3 standard deviations of the surface (`OPENING`). The links keep
    clear of the `world`, and the hand's pose stays that of the `grasp`. Raises `BadArgument` if the
    contacts lack the standard deviations `std_m`.
    """
    normals = contacts.normals
    gap = OPENING.gap + OPENING.deviations * contacts.require_std()
    target = tip_targets(hand, contacts) + gap[..., None] * normals
    if world.plane is not None:
        up = away(target, world.plane)
        height = level(target, world.plane)[..., None]
        lowest = (world.plane.offset + CLEARANCE + hand.tips.radius.to(target))[:, None]
        # Exact where the table is horizontal.
        target = target - height * up + torch.maximum(height, lowest) * up

    def evaluate(state: Configuration, rows: Int[Tensor, "a"]) -> Residuals:
        around = world.rows(rows)
        residual, jacobian = grasp_residuals(
            hand, state, target[rows], normals[rows], around, tips_touch=False
        )
        return residual, jacobian[..., 6:]

    def integrate(state: Configuration, step: Float[Tensor, "a h"]) -> Configuration:
        # The pose is fixed.
        return state.integrate(hand, torch.cat([step.new_zeros(len(step), 6), step], 1))

    problem = LeastSquares(evaluate, integrate, OPENING.solved, HAND_STEP)
    if is_world_fused(world, grasp.joints, grasp.obj_from_hand, target):
        from torchgrasp.ik import fused_refine

        given = target, normals, world, False, (TIP_WEIGHT, PAD_WEIGHT)
        solved = fused_refine.solve(hand, grasp, *given, problem, OPENING.steps, fixed=True)
        return solved[0].joints
    return levenberg_marquardt(problem, grasp, OPENING.steps)[0].joints
