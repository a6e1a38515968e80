"""What grasp solvers are given, and how candidates become checked grasps."""

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Batch, Value
from torchgrasp.errors import Status
from torchgrasp.frames import rotate
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.approach import find_approach
from torchgrasp.ik.checks import is_clear, measure_errors
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.ranking import score
from torchgrasp.ik.refine import open_hand
from torchgrasp.values import Certificate, Contacts, Grasps


@dataclasses.dataclass(frozen=True)
class GraspProblem(Value):
    """A hand, certified contacts and the world; grasps around `center`, the object's centre [m], rank higher.

    Raises:
        BadArgument: contacts without `std_m`, by which the pre-grasp opens.
    """

    hand: Hand
    contacts: Contacts
    certificate: Certificate
    world: CollisionWorld
    center: Float[Tensor, "3"]

    def __post_init__(self) -> None:
        """Check the contacts once, before any work."""
        self.contacts.require_std()


@dataclasses.dataclass(frozen=True)
class GraspCandidates(Batch):
    """Configurations with finger i on contact i, the triple's `permutation[:, i]`; `status` is that of the contacts."""

    configuration: Configuration
    contacts: Contacts
    certificate: Certificate
    permutation: Int[Tensor, "g 3"]
    status: Int[Tensor, "g"]


def check_candidates(problem: GraspProblem, candidates: GraspCandidates) -> Grasps:
    """Return checked grasps; those right so far get pre-grasp and approach."""
    hand, world = problem.hand, problem.world
    configuration, contacts, certificate = candidates.configuration, candidates.contacts, candidates.certificate
    unproven = (candidates.status == Status.OK) & ~certificate.closed
    planned = torch.where(unproven, int(Status.NOT_CLOSED), candidates.status)
    errors = measure_errors(hand, configuration, contacts, world)

    pregrasp, touching = configuration.joints.clone(), (planned == Status.OK) & (errors.status == Status.OK)
    pregrasp[touching] = open_hand(hand, configuration[touching], contacts[touching], world)
    opened = Configuration(pregrasp, configuration.obj_from_hand)
    blocked = (errors.status == Status.OK) & ~is_clear(hand, opened, world)
    status = torch.where(blocked, int(Status.PREGRASP), errors.status)

    approach = rotate(configuration.obj_from_hand, hand.approach.to(problem.center)[None])[:, 0]
    ready = status == Status.OK
    approach[ready], clearance = find_approach(hand, opened[ready], world)
    status[ready] = torch.where(clearance >= 0, int(Status.OK), int(Status.NO_APPROACH))
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
    )
