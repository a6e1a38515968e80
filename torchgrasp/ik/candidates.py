"""The input of the grasp solvers, and the checks and scores that turn candidate configurations into
grasps.

b counts contact sets, g candidates or grasps, f fingertips.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.contacts.feasibility import first_violation
from torchgrasp.foundation.base import Batch, Value, flatnonzero
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.foundation.rules import ANY, Length, Rows, is_known, show
from torchgrasp.geometry.frames import rotate
from torchgrasp.geometry.linalg import dot, norm, unit
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.clearance import MILLIMETRE, CollisionWorld, link_clearance
from torchgrasp.ik.configuration import Configuration, SpatialJacobian
from torchgrasp.ik.motion import find_approach, motion_clearance, opened_pose
from torchgrasp.ik.refine import open_hand, tip_targets
from torchgrasp.values.planning import Certificate, Contacts, Grasps, IKSeeds

Reachable = Callable[[Tensor], Tensor]
"""A user's function of hand poses (k, 4, 4) [m] in the object's frame. It returns a mask (k,) of
those that an arm reaches.
"""
FARTHEST_CENTER = 2.0  # distance [m] of an object's centre from its contacts: no hand spans more
# the paper's largest distance [m] of a tip from its contact: about a tip's radius
PAPER_TOLERANCE = 10 * MILLIMETRE
TIP_TOLERANCE = 1 * MILLIMETRE
TIP_PENETRATION = 2 * MILLIMETRE
"""Largest distance [m] of a tip from its contact, and largest depth [m] of a tip below the
estimated surface.
"""


@dataclasses.dataclass(frozen=True)
class CheckNumbers:
    """Parameters of the checks of a candidate grasp and of its geometric score."""

    angle: float = math.radians(2)
    """Greatest angle [rad] by which a contact direction may lie outside the pad's cone."""
    limits: float = 1e-9
    """Distance [rad] by which rounding may move a joint past its limits."""
    least_cosine: float = 1e-3
    """Least cosine between a force and the inward normal for which friction is computed."""
    offset: float = 0.02
    """Offset [m] of the contacts from the object's centre that lowers the score by 1. A needed
    friction of 1 does so, too.
    """
    pad_angle: float = 0.8
    """Angle [rad] of a contact direction from the pad's axis that lowers the score by 1."""


CHECKS = CheckNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class GraspProblem(Value):
    """The input of a grasp solver such as `solve_joint`: a hand, b contact sets and their
    surroundings.

    Args:
        hand: the hand.
        contacts: the b contact sets [m], in the object's frame, with the standard deviation `std_m`
            of the surface. Where the surface is less certain, the pre-grasp opens farther.
        certificate: the certificate of force closure of each contact set, from `certify`.
        world: the surroundings of the hand, with one object for all contact sets, or one for each.
        center: the object's centre (3,) [m] in the object's frame, or one for each contact set (b,
            3). Grasps whose contacts have a centroid near it get a higher score.
        reachable: function of hand poses (k, 4, 4) [m] in the object's frame. It returns a mask
            (k,) of the poses that an arm reaches. None means that every pose is reachable.
        descends: whether the opened hand may start above the pose of the grasp. It does so if its
            opened fingers would be in the table (`opened_pose`). It then goes down while it closes.

    Raises `BadArgument` if the contacts lack `std_m`. On the CPU it is also raised for a `center`
    more than 2 m (`FARTHEST_CENTER`) from the contacts' centroid.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> hand, grasp = load_hand("barrett"), load_shipped_grasp("jug", "barrett")
    >>> high = lambda poses: poses[:, 2, 3] > 0.1  # or ask your arm
    >>> given = (hand, grasp.contacts, grasp.certificate, CollisionWorld(), torch.zeros(3))
    >>> GraspProblem(*given, high).reachable is high
    True
    """

    hand: Hand
    contacts: Annotated[Contacts, Rows("b")]
    certificate: Annotated[Certificate, Rows("b")]
    world: CollisionWorld
    center: Float[Tensor, "*c 3"]
    reachable: Reachable | None = None
    descends: bool = False

    def __post_init__(self) -> None:
        self.contacts.require_std()
        points = self.contacts.points
        center = self.center.to(points)
        # elsewhere a plan would wait for the device
        if points.device.type != "cpu" or not (is_known(points) and is_known(center)):
            return
        away = norm(points.mean(-2) - center).nan_to_num(0.0)
        if len(away) and float(away.max()) > FARTHEST_CENTER:
            found = f"a centre {float(away.max()):.4g} m from the contacts"
            allowed = f"one within {FARTHEST_CENTER:g} m, in metres and in the object's frame"
            raise BadArgument("center", found, allowed)

    @checked
    def rows(self, index: Int[Tensor, "k"]) -> "GraspProblem":
        """Return the problem of some of the contact sets: those with the indices `index` (k,), in
        this order.

        Raises `IndexError` for an index beyond the last set.
        """
        return dataclasses.replace(
            self,
            contacts=self.contacts[index],
            certificate=self.certificate[index],
            world=self.world.rows(index),
            center=self.center if self.center.ndim == 1 else self.center[index],
        )

    @checked
    def drop_unreachable(self, seeds: IKSeeds) -> IKSeeds:
        """Return the initial guesses in `seeds` whose hand poses an arm reaches (`reachable`).

        All are returned if `reachable` is None. Raises `BadArgument` if `reachable` does not return
        a mask of booleans, one for each pose.
        """
        if self.reachable is None:
            return seeds
        return seeds[ask_reachable(self.reachable, seeds.obj_from_hand)]


def ask_reachable(reachable: Reachable, obj_from_hand: Float[Tensor, "k 4 4"]) -> Bool[Tensor, "k"]:
    """Return a mask of the k hand poses `obj_from_hand` [m] that the user's function `reachable`
    accepts.

    Raises `BadArgument` if it does not return k booleans.
    """
    if not len(obj_from_hand):
        return obj_from_hand.new_zeros(0, dtype=torch.bool)
    answer = reachable(obj_from_hand)
    if (
        not isinstance(answer, Tensor)
        or answer.dtype != torch.bool
        or answer.shape != obj_from_hand.shape[:1]
    ):
        raise BadArgument(
            "reachable",
            f"an answer of {show(answer)}",
            f"a tensor of {len(obj_from_hand)} booleans",
        )
    return answer.to(obj_from_hand.device)


@checked
@dataclasses.dataclass(frozen=True)
class GraspCandidates(Batch):
    """Hand configurations to check, g in number, each with the contacts that its f fingers touch.

    Contacts and poses are in the object's frame [m].
    """

    # poses of the hand and positions of its actuated joints
    configuration: Annotated[Configuration, Rows("g")]
    contacts: Annotated[Contacts, Rows("g")]  # contact sets, each in the order of the fingers
    # certificates of the contact sets' force closure
    certificate: Annotated[Certificate, Rows("g")]
    # indices: finger i of grasp k touches contact `permutation[k, i]` of the planned contact set
    permutation: Int[Tensor, "g f"]
    status: Int[Tensor, "g"]  # `Status` code that contact planning gave each contact set


@checked
@dataclasses.dataclass(frozen=True)
class GraspErrors(Batch):
    """The errors and clearances of g grasps with f fingertips, by which grasps are accepted."""

    # distance [m] of each fingertip from its contact
    tip_error: Annotated[Float[Tensor, "g f"], ANY]
    # angle [rad] between the contact's inward normal and the axis of the finger's pad
    normal_angle: Annotated[Float[Tensor, "g f"], ANY]
    # least clearance [m] of the links from object, table, each other, and obstacles that they must
    # not touch; negative if they overlap
    clearance: Annotated[Float[Tensor, "g"], ANY]
    # `Status` code of the first check of tips, joint limits and collisions that fails, else `OK`
    status: Int[Tensor, "g"]


@checked
def measure_errors(
    hand: Hand,
    configuration: Configuration,
    contacts: Contacts,
    world: CollisionWorld,
    rolling: bool = True,
    tolerance: Length = TIP_TOLERANCE,
) -> GraspErrors:
    """Return the errors, clearances and status of g grasps; finger i touches contact i.

    The `status` is `OK` if tips, joint limits and collisions pass their checks. Links may touch, at
    a clearance of 0, but not overlap. With `rolling`, round fingertips may roll on their contacts
    within the cones of their pads. Without `rolling`, as in the paper, each pad must touch with its
    own contact point, in any direction. `tolerance` [m] is the largest allowed distance of a tip
    from its contact. NaN is out of tolerance. Configurations, contacts [m] and `world` are in the
    object's frame.
    """
    spatial = SpatialJacobian.at(hand, configuration)
    touching = hand.tips.contact
    target = contacts.points
    if rolling:
        touching = hand.tips.center
        target = tip_targets(hand, contacts)
    error = norm(spatial.points(hand.tips.index, touching) - target)
    pads = spatial.pads.permute(2, 1, 0)
    angle = torch.acos((-dot(pads, contacts.normals)).clamp(-1.0, 1.0))  # from the inward normal
    links, depth, table = link_clearance(spatial, world, tips_touch=True)
    between = hand.self_clearance(configuration.joints)
    lower = hand.lower.to(error) - CHECKS.limits
    upper = hand.upper.to(error) + CHECKS.limits
    cone = hand.tips.cone.to(error) + CHECKS.angle
    conditions = {
        Status.TIP_ERROR: (error <= tolerance).all(1),
        Status.NORMAL_ANGLE: (angle <= cone).all(1) | (not rolling),
        Status.JOINT_LIMITS: (
            (configuration.joints >= lower) & (configuration.joints <= upper)
        ).all(1),
        Status.SELF_COLLISION: between >= 0,
        Status.OBJECT_COLLISION: (links >= 0) & (depth >= -TIP_PENETRATION),
        Status.TABLE_COLLISION: table >= 0,
    }
    clearances = [links, table, between]
    if world.obstacles is not None and world.guarded:
        distance, _ = world.obstacles.field.query(spatial.sphere_centres)
        clearances.append((distance - hand.collision_spheres.radius.to(distance)).amin(1))
        conditions[Status.NEIGHBOUR_COLLISION] = clearances[-1] >= 0
    return GraspErrors(error, angle, torch.stack(clearances).amin(0), first_violation(conditions))


def is_clear(hand: Hand, configuration: Configuration, world: CollisionWorld) -> Bool[Tensor, "g"]:
    """Return a mask (g,) of the configurations in which no link overlaps the object, the table or
    another link. Links include the fingertips.

    `world` holds the object and the table, in the frame of the configurations; its obstacles do not
    count.
    """
    links, _, table = link_clearance(
        SpatialJacobian.at(hand, configuration), world, tips_touch=False
    )
    return (links >= 0) & (table >= 0) & (hand.self_clearance(configuration.joints) >= 0)


@checked
def check_candidates(
    problem: GraspProblem,
    candidates: GraspCandidates,
    rolling: bool = True,
    tolerance: Length = TIP_TOLERANCE,
) -> Grasps:
    """Return a grasp for each candidate, with pre-grasp, approach and the `Status` of the first
    check that it fails.

    Contacts are checked first, then fingertips, joint limits and collisions. Pre-grasp, approach
    and the reach of an arm follow. With `rolling`, round fingertips may roll on their contacts
    within the cones of their pads. Without, each pad must touch with its own contact point.
    `tolerance` [m] is the largest allowed distance of a tip from its contact. `problem` holds the
    hand and its surroundings, one row for each candidate.
    """
    hand = problem.hand
    world = problem.world
    configuration = candidates.configuration
    contacts = candidates.contacts
    certificate = candidates.certificate
    unproven = (candidates.status == Status.OK) & ~certificate.closed
    planned = torch.where(unproven, int(Status.NOT_CLOSED), candidates.status)
    errors = measure_errors(hand, configuration, contacts, world, rolling, tolerance)

    # the hand is opened only where the grasp itself is good
    pregrasp = configuration.joints.clone()
    touching = flatnonzero((planned == Status.OK) & (errors.status == Status.OK))
    pregrasp[touching] = open_hand(
        hand, configuration[touching], contacts[touching], world.rows(touching)
    )
    opened = Configuration(pregrasp, configuration.obj_from_hand)
    if problem.descends:
        raised = opened_pose(hand, pregrasp, opened.obj_from_hand, world.plane)
        opened = dataclasses.replace(opened, obj_from_hand=raised)
    blocked = (errors.status == Status.OK) & ~is_clear(hand, opened, world)
    status = torch.where(blocked, int(Status.PREGRASP), errors.status)

    # a straight way leads to the opened hand
    approach = rotate(configuration.obj_from_hand, hand.approach.to(problem.center)[None])[:, 0]
    ready = flatnonzero(status == Status.OK)
    approach[ready], clearance = find_approach(hand, opened[ready], world.rows(ready))
    status[ready] = torch.where(clearance >= 0, int(Status.OK), int(Status.NO_APPROACH))
    if world.obstacles is not None:
        _keep_clear(problem, configuration, opened, approach, status)
    # an arm is asked for the poses that are left
    if problem.reachable is not None:
        ready = flatnonzero((status == Status.OK) & (planned == Status.OK))
        refused = ~ask_reachable(problem.reachable, configuration.obj_from_hand[ready])
        status[ready[refused]] = int(Status.UNREACHABLE)
    return Grasps(
        joints=configuration.joints,
        pregrasp=pregrasp,
        approach=approach,
        obj_from_hand=configuration.obj_from_hand,
        contacts=contacts,
        permutation=candidates.permutation,
        tip_error=errors.tip_error,
        clearance=errors.clearance,
        normal_angle=errors.normal_angle,
        certificate=certificate,
        score=score(contacts, errors.normal_angle, problem.center),
        status=torch.where(planned == Status.OK, status, planned),
        known=torch.ones_like(blocked),
        interval=torch.zeros_like(errors.clearance)[:, None].repeat(1, 2),
    )


def _keep_clear(
    problem: GraspProblem,
    configuration: Configuration,
    opened: Configuration,
    approach: Tensor,
    status: Tensor,
) -> None:
    """Change in place the `status` of grasps that collide with hard obstacles; soft ones change
    only the `approach`.
    """
    hand = problem.hand
    world = problem.world
    crowded = flatnonzero(status == Status.NO_APPROACH)
    direction, clearance = find_approach(hand, opened[crowded], world.alone)
    pushed = crowded[clearance >= 0]
    if world.guarded:
        status[pushed] = int(Status.NEIGHBOUR_COLLISION)
        ready = flatnonzero(status == Status.OK)
        room = motion_clearance(hand, configuration[ready], opened[ready], world)
        status[ready[room < 0]] = int(Status.NEIGHBOUR_COLLISION)
    else:
        status[pushed] = int(Status.OK)
        approach[pushed] = direction[clearance >= 0]


def centred_friction(contacts: Contacts) -> Float[Tensor, "g"]:
    """Return the friction coefficient (g,) that each contact set needs if all forces point to its
    centroid.

    It is the largest ratio of a tangential to a normal force of the set, at most about 1000.
    """
    inward = unit(contacts.points.mean(1, keepdim=True) - contacts.points)
    cosine = -dot(inward, contacts.normals)
    sine = norm(torch.linalg.cross(inward, contacts.normals))
    return (sine / cosine.clamp_min(CHECKS.least_cosine)).amax(1)


def score(
    contacts: Contacts, normal_angle: Float[Tensor, "g f"], center: Float[Tensor, "*g 3"]
) -> Float[Tensor, "g"]:
    """Return the geometric score of each grasp, at most 0 and without unit; a higher score is
    better.

    It is -(d / 20 mm + mu + a / 0.8 rad) (`CHECKS.offset`, `CHECKS.pad_angle`). Here d is the
    distance of the contacts' centroid from `center` [m], and a the largest `normal_angle` [rad] of
    a fingertip. The number mu is the friction coefficient that forces towards the centroid need
    (`centred_friction`).
    """
    offset = norm(contacts.points.mean(1) - center)
    away = offset / CHECKS.offset
    turned = normal_angle.amax(1) / CHECKS.pad_angle
    return -(away + centred_friction(contacts) + turned)
