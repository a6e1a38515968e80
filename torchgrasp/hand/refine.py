"""Move hand postures onto their contacts without touching anything else: batched Levenberg-Marquardt.

The learned posture (Eqs. 23-24) leaves millimetres to centimetres between fingertips and contacts. Here the hand's
pose and joints are solved together, every guess a row of one batch, with analytic Jacobians. The residuals are

* a round fingertip's centre one radius off the contact along its normal, so that the tip may roll; a tip that is not
  round brings its contact point itself to the contact,
* the contact direction inside a cone about the pad's axis,
* hinges on the clearance of the links' spheres from the object's field and from the table, and of the links' capsules
  from each other. Boxes (the palm's) are left to `check`.

Joint limits hold at every step by projection. The paper's COBYLA minimises the tip distances alone, one grasp at a
time; here collision is part of the problem, because that is where planned contacts are lost.
"""

import dataclasses
import math
from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.frames import apply, rigid, rotate, rotation_from_vector
from torchgrasp.hand.collide import DistanceField, segment_closest
from torchgrasp.hand.hand import Hand
from torchgrasp.values import Contacts

MILLIMETRE = 1e-3
CLEARANCE = 4 * MILLIMETRE
"""Clearance [m] that the links are asked to keep of the object and the table; `check` accepts any above zero."""
SELF_CLEARANCE = 1 * MILLIMETRE
"""Clearance [m] that the links are asked to keep of each other."""
ROUND_PAD, FLAT_PAD = math.radians(60), math.radians(40)
"""Half angles [rad] of the cone about the pad's axis in which a round and a flat fingertip may touch."""
PAD_WEIGHT = 20.0
"""Residual of a contact direction, per unit of cosine outside the pad's cone, against 1 per millimetre elsewhere."""
WORST = 10
"""How many of the least clearances of each kind enter one step; the others are larger."""
ITERATIONS = 40
OPENING, OPENING_SIGMAS = 0.012, 3.0
"""How far the pre-grasp's tips are from their contacts: metres, and standard deviations of the surface there."""
LARGEST_STEP = 0.3
"""Largest step [m, rad] of any variable in one iteration."""


@dataclasses.dataclass(frozen=True)
class Posture(Value):
    """Where the hand is: `joints` (g, h) [rad] and `obj_from_hand` (g, 4, 4)."""

    joints: Float[Tensor, "g h"]
    obj_from_hand: Float[Tensor, "g 4 4"]


@dataclasses.dataclass(frozen=True)
class Surroundings(Value):
    """What the links must not touch: the object's `field` and the height [m] of the `table`, None without one."""

    field: DistanceField
    table: float | None


@dataclasses.dataclass(frozen=True)
class Screws(Value):
    """The hand's links and joint axes in the object's frame, at one posture: all that its Jacobians need."""

    hand: Hand
    obj_from_link: Float[Tensor, "g l 4 4"]
    axes: Float[Tensor, "g j 3"]
    origins: Float[Tensor, "g j 3"]
    origin: Float[Tensor, "g 3"]

    @classmethod
    def at(cls, posture: Posture, hand: Hand) -> "Screws":
        """Evaluate the forward kinematics once."""
        links = hand.link_poses(posture.joints)
        axes, origins = hand.screws(links)
        pose = posture.obj_from_hand
        return cls(hand, pose[:, None] @ links, rotate(pose, axes), apply(pose, origins), pose[:, :3, 3])

    def points(self, links: Int[Tensor, "k"], local: Float[Tensor, "k 3"]) -> Float[Tensor, "g k 3"]:
        """Return points that are fixed in links, in the object's frame."""
        pose = self.obj_from_link[:, links]
        return (pose[..., :3, :3] @ local.to(pose)[:, :, None])[..., 0] + pose[..., :3, 3]

    def turning(self, moment: Float[Tensor, "g k 3"], links: Int[Tensor, "g k"]) -> Float[Tensor, "g k h"]:
        """Return axis . moment for every joint that moves the link: the joints' part of a Jacobian row."""
        rows = torch.einsum("gkx,gjx->gkj", moment, self.axes) * (1 - self.hand.prismatic.to(moment))
        return (rows * self.hand.moves[links].to(rows)) @ self.hand.coupling.to(rows)

    def pushing(
        self, points: Float[Tensor, "g k 3"], directions: Float[Tensor, "g k 3"], links: Int[Tensor, "g k"]
    ) -> Float[Tensor, "g k d"]:
        """Return the derivative of `directions . points` (points move with links) by pose and joints."""
        torque = torch.linalg.cross(points, directions)
        about = torch.linalg.cross(self.origins, self.axes)  # a . ((p - o) x n) = a . (p x n) + (o x a) . n
        rows = torch.einsum("gkx,gjx->gkj", torque, self.axes) + torch.einsum("gkx,gjx->gkj", directions, about)
        slide = self.hand.prismatic.to(points)
        rows = rows * (1 - slide) + torch.einsum("gkx,gjx->gkj", directions, self.axes) * slide
        joints = (rows * self.hand.moves[links].to(rows)) @ self.hand.coupling.to(rows)
        arm = points - self.origin[:, None]
        return torch.cat([directions, torch.linalg.cross(arm, directions), joints], -1)


def moved(posture: Posture, step: Float[Tensor, "g d"], hand: Hand) -> Posture:
    """Return the posture after a step (translation [m], rotation vector, joints [rad]), projected on the limits."""
    pose = posture.obj_from_hand
    turned = rotation_from_vector(step[:, 3:6]) @ pose[:, :3, :3]
    joints = (posture.joints + step[:, 6:]).clamp(hand.lower.to(pose), hand.upper.to(pose))
    return Posture(joints, rigid(turned, pose[:, :3, 3] + step[:, :3]))


Rows = tuple[Float[Tensor, "g m"], Float[Tensor, "g m d"]]


def tip_rows(screws: Screws, contacts: Contacts, gap: Float[Tensor, "g 3"]) -> Rows:
    """Return residuals [mm] of the three tips, `gap` metres off their contacts, and of their contact directions."""
    hand = screws.hand
    g = len(contacts)
    links = hand.tip_index.expand(g, 3)
    radius = hand.tip_radius.to(contacts.points)
    target = contacts.points + (radius + gap)[..., None] * contacts.normals
    tips = screws.points(hand.tip_index, hand.center)
    basis = torch.eye(3).to(tips).repeat(3, 1).expand(g, 9, 3)
    three = torch.arange(3).repeat_interleave(3)
    jacobian = screws.pushing(tips[:, three], basis, links[:, three])
    residual = (tips - target).reshape(g, 9)

    pads = (screws.obj_from_link[:, hand.tip_index, :3, :3] @ hand.normal.to(tips)[:, :, None])[..., 0]
    cone = torch.where(radius > 0, math.cos(ROUND_PAD), math.cos(FLAT_PAD))
    outside = cone + (pads * contacts.normals).sum(-1)  # the contact direction is the inward normal
    moment = torch.linalg.cross(pads, contacts.normals)
    tilt = torch.cat([torch.zeros_like(moment), moment, screws.turning(moment, links)], -1)
    active = (outside > 0).to(tips)
    return (
        torch.cat([residual / MILLIMETRE, PAD_WEIGHT * outside * active], 1),
        torch.cat([jacobian / MILLIMETRE, PAD_WEIGHT * tilt * active[..., None]], 1),
    )


def hinge(clearance: Float[Tensor, "g k"], jacobian: Float[Tensor, "g k d"], margin: float) -> Rows:
    """Return max(0, margin - clearance) [mm] and its derivative."""
    active = (clearance < margin).to(clearance)
    return active * (margin - clearance) / MILLIMETRE, -active[..., None] * jacobian / MILLIMETRE


def least(clearance: Float[Tensor, "g s"]) -> tuple[Float[Tensor, "g k"], Int[Tensor, "g k"]]:
    """Return the `WORST` least clearances of each row and where they are."""
    values, index = clearance.topk(min(WORST, clearance.shape[1]), dim=1, largest=False)
    return values, index


def clearance_rows(screws: Screws, surroundings: Surroundings, tips_touch: bool) -> Rows:
    """Return hinges on the least clearances from the object, from the table and between the links."""
    hand, cover = screws.hand, screws.hand.collision_spheres
    centres = screws.points(cover.link_index, cover.center)
    radius = cover.radius.to(centres)
    g = len(centres)
    residuals, jacobians = [], []

    def add(rows: Rows) -> None:
        residuals.append(rows[0])
        jacobians.append(rows[1])

    distance, gradient = surroundings.field.query(centres)
    free = distance - radius
    if tips_touch:
        free = torch.where(cover.touching, math.inf, free)
    at = torch.arange(g, device=free.device)[:, None]
    worst, index = least(free)
    worst = torch.where(torch.isinf(worst), 1.0, worst)
    add(hinge(worst, screws.pushing(centres[at, index], gradient[at, index], cover.link_index[index]), CLEARANCE))

    if surroundings.table is not None:
        worst, index = least(centres[..., 2] - radius - surroundings.table)
        up = torch.tensor([0.0, 0.0, 1.0]).to(centres).expand(*index.shape, 3)
        add(hinge(worst, screws.pushing(centres[at, index], up, cover.link_index[index]), CLEARANCE))

    capsules = hand.self_collision
    first, second = capsules.capsule_pairs.unbind(1)
    start = screws.points(capsules.capsule_link, capsules.start)
    end = screws.points(capsules.capsule_link, capsules.end)
    here, there = segment_closest(start[:, first], end[:, first], start[:, second], end[:, second])
    thick = capsules.radius.to(centres)
    length = torch.linalg.vector_norm(here - there, dim=-1)
    worst, index = least(length - thick[first] - thick[second])
    here, there = here[at, index], there[at, index]
    # Axes that cross have no direction; such a pair keeps a zero row and leaves it to the others to part them.
    direction = (here - there) / length[at, index][..., None].clamp_min(1e-9)
    row = screws.pushing(here, direction, capsules.capsule_link[first[index]])
    row = row - screws.pushing(there, direction, capsules.capsule_link[second[index]])
    add(hinge(worst, row, SELF_CLEARANCE))
    return torch.cat(residuals, 1), torch.cat(jacobians, 1)


def badness(posture: Posture, hand: Hand, contacts: Contacts, surroundings: Surroundings) -> Float[Tensor, "g"]:
    """Return the sum of squared residuals of each row: what `refine` lowers."""
    screws = Screws.at(posture, hand)
    tips, _ = tip_rows(screws, contacts, torch.zeros_like(contacts.std_m))
    links, _ = clearance_rows(screws, surroundings, tips_touch=True)
    return (tips**2).sum(1) + (links**2).sum(1)


def minimise(
    posture: Posture,
    evaluate: Callable[[Posture], Rows],
    hand: Hand,
    iterations: int,
) -> Posture:
    """Solve every row by Levenberg-Marquardt with its own damping; a step that does not lower the sum is undone.

    A Jacobian of h columns leaves the hand's pose as it is; one of 6 + h moves it too.
    """
    residual, jacobian = evaluate(posture)
    damping = torch.full_like(residual[:, 0], 1e-2)
    for _ in range(iterations):
        normal = jacobian.transpose(1, 2) @ jacobian
        diagonal = normal.diagonal(dim1=1, dim2=2)
        # Relative damping alone would leave a joint that moves nothing undamped.
        damped = normal + torch.diag_embed(damping[:, None] * diagonal + 1e-3)
        factor, info = torch.linalg.cholesky_ex(damped)
        step = -torch.cholesky_solve(jacobian.transpose(1, 2) @ residual[..., None], factor)[..., 0]
        step = torch.where((info == 0)[:, None], step, 0.0)  # one row without a factor waits for more damping
        step = step * (LARGEST_STEP / step.abs().amax(1, keepdim=True).clamp_min(LARGEST_STEP))
        still = step.new_zeros(len(step), 6 + posture.joints.shape[1] - step.shape[1])
        trial = moved(posture, torch.cat([still, step], 1), hand)
        trial_residual, trial_jacobian = evaluate(trial)
        better = (trial_residual**2).sum(1) < (residual**2).sum(1)
        keep = better[:, None]
        posture = Posture(
            torch.where(keep, trial.joints, posture.joints),
            torch.where(keep[..., None], trial.obj_from_hand, posture.obj_from_hand),
        )
        residual = torch.where(keep, trial_residual, residual)
        jacobian = torch.where(keep[..., None], trial_jacobian, jacobian)
        damping = torch.where(better, damping / 3, damping * 4).clamp(1e-6, 1e6)
    return posture


def refine(
    posture: Posture, hand: Hand, contacts: Contacts, surroundings: Surroundings, iterations: int = ITERATIONS
) -> Posture:
    """Return postures whose fingertips are on their contacts and whose links are clear, as far as each row allows.

    Args:
        posture: starting pose and joints, g rows.
        hand: whose fingers, in grasp order, take the contacts in theirs.
        contacts: g rows; finger i takes contact i.
        surroundings: the estimated object and the table.
        iterations: of the solver.

    Returns:
        As many rows; whether each succeeded is for `check` to say.
    """

    def evaluate(at: Posture) -> Rows:
        screws = Screws.at(at, hand)
        tips = tip_rows(screws, contacts, torch.zeros_like(contacts.std_m))
        links = clearance_rows(screws, surroundings, tips_touch=True)
        return torch.cat([tips[0], links[0]], 1), torch.cat([tips[1], links[1]], 1)

    return minimise(posture, evaluate, hand, iterations)


def open_hand(posture: Posture, hand: Hand, contacts: Contacts, surroundings: Surroundings) -> Float[Tensor, "g h"]:
    """Return the joints of the pre-grasp: at the same pose, the tips off their contacts and everything clear.

    Each tip opens by `OPENING` and three standard deviations of the surface at its contact, so that it starts outside
    the object even where that is larger than it was thought to be. Opening along the normals alone drives links into
    the object; here clearance is part of the problem.
    """
    gap = OPENING + OPENING_SIGMAS * contacts.std_m

    def evaluate(at: Posture) -> Rows:
        screws = Screws.at(at, hand)
        tips, links = tip_rows(screws, contacts, gap), clearance_rows(screws, surroundings, tips_touch=False)
        return torch.cat([tips[0], links[0]], 1), torch.cat([tips[1], links[1]], 1)[..., 6:]

    return minimise(posture, evaluate, hand, ITERATIONS).joints
