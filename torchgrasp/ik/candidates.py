"""What grasp solvers are given, and how candidates become checked grasps."""

import dataclasses
from collections.abc import Callable
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.base import Batch, Value
from torchgrasp.checks import Length, Rows, checked
from torchgrasp.errors import BadArgument, Status
from torchgrasp.geometry.frames import rotate
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.checks import TIP_TOLERANCE, is_clear, measure_errors
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.motion import find_approach, motion_clearance
from torchgrasp.ik.ranking import score
from torchgrasp.ik.refine import open_hand
from torchgrasp.values import Certificate, Contacts, Grasps, IKSeeds

Reachable = Callable[[Tensor], Tensor]
"""Tells which poses obj_from_hand (k, 4, 4) an arm reaches, as booleans (k,)."""


@checked
@dataclasses.dataclass(frozen=True)
class GraspProblem(Value):
    """A hand, certified contacts and the world; grasps around `center`, the object's centre [m], rank higher.

    Poses that `reachable` refuses are no grasps; None: every pose is reached.

    Raises:
        BadArgument: contacts without `std_m`, by which the pre-grasp opens.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.ik import PostureLibrary
    >>> from torchgrasp.ik import nearest_postures
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> hand, grasp = load_hand("barrett"), load_shipped_grasp("jug", "barrett")
    >>> middle = grasp.contacts.points[0].mean(0)
    >>> high = lambda poses: poses[:, 2, 3] > 0.1  # or ask your arm: which palms does it bring there?
    >>> problem = GraspProblem(hand, grasp.contacts, grasp.certificate, CollisionWorld(), middle, high)
    >>> seeds = nearest_postures(PostureLibrary.of(hand, 200), grasp.contacts, problem.world)
    >>> bool((problem.drop_unreachable(seeds).obj_from_hand[:, 2, 3] > 0.1).all())
    True
    """

    hand: Hand
    contacts: Annotated[Contacts, Rows("b")]
    certificate: Annotated[Certificate, Rows("b")]
    world: CollisionWorld
    center: Float[Tensor, "3"]
    reachable: Reachable | None = None

    def __post_init__(self) -> None:
        """Check the contacts once, before any work."""
        self.contacts.require_std()

    @checked
    def drop_unreachable(self, seeds: IKSeeds) -> IKSeeds:
        """Return the seeds whose poses are reached."""
        return seeds if self.reachable is None else seeds[ask_reachable(self.reachable, seeds.obj_from_hand)]


def ask_reachable(reachable: Reachable, obj_from_hand: Float[Tensor, "k 4 4"]) -> Bool[Tensor, "k"]:
    """Return which poses a user's callable reaches.

    Raises:
        BadArgument: an answer of another kind than one boolean for each pose.
    """
    if not len(obj_from_hand):
        return torch.zeros(0, dtype=torch.bool, device=obj_from_hand.device)
    answer = reachable(obj_from_hand)
    if not isinstance(answer, Tensor) or answer.dtype != torch.bool or answer.shape != obj_from_hand.shape[:1]:
        found = (
            f"{answer.dtype} of shape {tuple(answer.shape)}" if isinstance(answer, Tensor) else type(answer).__name__
        )
        raise BadArgument("reachable", f"an answer of {found}", f"a tensor of {len(obj_from_hand)} booleans")
    return answer.to(obj_from_hand.device)


@checked
@dataclasses.dataclass(frozen=True)
class GraspCandidates(Batch):
    """Configurations with finger i on contact i, a row's `permutation[:, i]`; `status` is that of the contacts.

    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> grasp = load_shipped_grasp("jug", "barrett")
    >>> placed = Configuration(grasp.joints, grasp.obj_from_hand)
    >>> len(GraspCandidates(placed, grasp.contacts, grasp.certificate, grasp.permutation, grasp.status))
    1
    """

    configuration: Annotated[Configuration, Rows("g")]
    contacts: Annotated[Contacts, Rows("g")]
    certificate: Annotated[Certificate, Rows("g")]
    permutation: Int[Tensor, "g f"]
    status: Int[Tensor, "g"]


@checked
def check_candidates(
    problem: GraspProblem, candidates: GraspCandidates, rolling: bool = True, tolerance: Length = TIP_TOLERANCE
) -> Grasps:
    """Return checked grasps (`measure_errors`); those right so far get pre-grasp and approach.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> hand, grasp = load_hand("barrett"), load_shipped_grasp("jug", "barrett")
    >>> middle = grasp.contacts.points[0].mean(0)
    >>> problem = GraspProblem(hand, grasp.contacts, grasp.certificate, CollisionWorld(), middle)
    >>> placed, order = Configuration(grasp.joints, grasp.obj_from_hand), torch.tensor([[0, 1, 2]])
    >>> tried = GraspCandidates(placed, grasp.contacts, grasp.certificate, order, grasp.status)
    >>> check_candidates(problem, tried).status
    tensor([0])
    """
    hand, world = problem.hand, problem.world
    configuration, contacts, certificate = candidates.configuration, candidates.contacts, candidates.certificate
    unproven = (candidates.status == Status.OK) & ~certificate.closed
    planned = torch.where(unproven, int(Status.NOT_CLOSED), candidates.status)
    errors = measure_errors(hand, configuration, contacts, world, rolling, tolerance)

    pregrasp, touching = configuration.joints.clone(), (planned == Status.OK) & (errors.status == Status.OK)
    pregrasp[touching] = open_hand(hand, configuration[touching], contacts[touching], world)
    opened = Configuration(pregrasp, configuration.obj_from_hand)
    blocked = (errors.status == Status.OK) & ~is_clear(hand, opened, world)
    status = torch.where(blocked, int(Status.PREGRASP), errors.status)

    approach = rotate(configuration.obj_from_hand, hand.approach.to(problem.center)[None])[:, 0]
    ready = status == Status.OK
    approach[ready], clearance = find_approach(hand, opened[ready], world)
    status[ready] = torch.where(clearance >= 0, int(Status.OK), int(Status.NO_APPROACH))
    if world.obstacles is not None:
        _keep_clear(problem, configuration, opened, approach, status)
    if problem.reachable is not None:
        ready = torch.nonzero((status == Status.OK) & (planned == Status.OK))[:, 0]
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
    )


def _keep_clear(
    problem: GraspProblem, configuration: Configuration, opened: Configuration, approach: Tensor, status: Tensor
) -> None:
    """Name what obstacles prevent, in place; obstacles that may be touched only turn the approach where they can."""
    hand, world = problem.hand, problem.world
    crowded = torch.nonzero(status == Status.NO_APPROACH)[:, 0]
    direction, clearance = find_approach(hand, opened[crowded], world.alone)
    pushed = crowded[clearance >= 0]
    if world.guarded:
        status[pushed] = int(Status.NEIGHBOUR_COLLISION)
        ready = torch.nonzero(status == Status.OK)[:, 0]
        room = motion_clearance(hand, configuration[ready], opened.joints[ready], world)
        status[ready[room < 0]] = int(Status.NEIGHBOUR_COLLISION)
    else:
        status[pushed], approach[pushed] = int(Status.OK), direction[clearance >= 0]
