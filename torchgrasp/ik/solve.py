"""Inverse kinematics of given contacts: joints and pose of a hand that touches nothing else.

Seeds (initial guesses) of the learned model are tried first (Eqs. 21-24), then the nearest random
postures.
"""

import dataclasses
from functools import partial
from typing import Annotated, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Batch, flatnonzero, join, pick, rank_in_group, settle
from torchgrasp.foundation.checks import check_tensor, checked
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.rules import ANY
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.geometry.frames import degenerate
from torchgrasp.geometry.linalg import check_unit_vectors
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.attempts import Attempts, assign
from torchgrasp.ik.candidates import measure_errors
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.cobyla import refine_by_cobyla
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.refine import refine
from torchgrasp.ik.seeds import PostureLibrary, nearest_postures, query_mixture
from torchgrasp.posture_model.mixture import GraspMixture
from torchgrasp.values.planning import Contacts, IKSeeds

Method = Literal["levenberg_marquardt", "cobyla"]


@dataclasses.dataclass(frozen=True)
class SolveNumbers:
    """Parameters of the inverse kinematics of given contacts."""

    solved: float = 1e-6
    """Sum of squared residuals [mm2] at which the refinement of an initial guess ends."""
    exact: float = 5e-5
    """Largest tip error [m] of a solution that ends the search."""
    library_seeds: int = 8
    """Number of initial guesses for a contact set that are taken from the library of postures."""
    learned_seeds: int = 2
    """Number of initial guesses from the learned model for each reachable assignment of contacts to
    fingers. They are the mean of its prediction, and that of one of its Gaussians.
    """
    learned_tries: int = 4
    """Number of these guesses, over all assignments of a contact set, that are refined."""
    part: int = 512
    """Number of initial guesses refined at a time: their temporaries stay in the cache."""


SOLVING = SolveNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class IKSolution(Batch):
    """The hand configurations that `solve_ik` found, one for each of b contact sets.

    h counts actuated joints, and f fingertips. A contact set without an initial guess has NaN, and
    the `permutation` 0 to f - 1.

    Attributes:
        joints: actuated joints (b, h) [rad or m].
        obj_from_hand: pose (b, 4, 4) [m] of the hand's root link in the frame of the contacts.
        permutation: indices (b, f): in set k finger i touches contact `permutation[k, i]`.
        tip_error: distance (b, f) [m] of each fingertip from its contact.
        normal_angle: angle (b, f) [rad] between the contact's inward normal and the axis of the
            finger's pad. The pad is the part that touches objects.
        clearance: least clearance (b,) [m] of the links from object, table, each other, and
            obstacles that they must not touch. It is negative where they overlap.
        attempts: number (b,) of initial guesses that were refined.
        status: `Status` code (b,): `OK`, or the first check that fails, such as `TIP_ERROR`.
            Without an initial guess it is `DEGENERATE` for contacts on a line, else `OUT_OF_REACH`.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> found = solve_ik(load_hand("barrett"), load_shipped_grasp("jug", "barrett").contacts)
    >>> found.joints.shape, Status(int(found.status)).name
    (torch.Size([1, 4]), 'OK')
    """

    joints: Annotated[Float[Tensor, "b h"], ANY]
    obj_from_hand: Annotated[Float[Tensor, "b 4 4"], ANY]
    permutation: Int[Tensor, "b f"]
    tip_error: Annotated[Float[Tensor, "b f"], ANY]
    normal_angle: Annotated[Float[Tensor, "b f"], ANY]
    clearance: Annotated[Float[Tensor, "b"], ANY]
    attempts: Int[Tensor, "b"]
    status: Int[Tensor, "b"]


@checked
@single_threaded
def solve_ik(
    hand: Hand,
    contacts: Contacts,
    mixture: GraspMixture | None = None,
    world: CollisionWorld | None = None,
    method: Method = "levenberg_marquardt",
    library: PostureLibrary | None = None,
) -> IKSolution:
    """Return for each contact set the best hand configuration whose fingertips touch its contacts.

    Any finger may touch any contact. `Status.OK` means that no link collides, and every tip is
    within 1 mm of its contact. Joints are then within their limits. Every contact's inward normal
    is then in the cone of the finger's pad (`Fingertips.cone`), to 2 degrees. The pad is the part
    that touches objects.

    Args:
        hand: the hand.
        contacts: b contact sets [m], with one contact for each fingertip; `std_m` and `variance`
            are not used.
        mixture: the hand's learned posture model, which gives initial guesses. None means that all
            guesses come from `library`.
        world: object, table and obstacles that the links must not touch; None means that only
            self-collision counts.
        method: "levenberg_marquardt", or "cobyla", the paper's method (Sec. 6.3 of the paper).
            "cobyla" brings each tip's contact point to its contact and ignores the contact's
            normal.
        library: random postures of the hand, which give initial guesses; None means that they are
            drawn when they are needed.

    Hand, mixture, world and library are moved to the contacts' device.

    Raises:
        BadArgument: contacts that are not finite, or not one for each fingertip.
        BadArgument: normals that are not of length 1 (to 1e-3).
        BadArgument: a mixture of another hand, or an unknown method.
        BadArgument: a mixture or "cobyla" for a hand with more than three fingertips.

    >>> from torchgrasp.hand.load import load_hand
    >>> points = 0.05 * torch.eye(3)[None].double()
    >>> solution = solve_ik(load_hand("allegro"), Contacts(points, 20 * points))
    >>> bool(solution.tip_error.max() < 1e-3)
    True
    """
    check_tensor("contacts.points", contacts.points, (None, len(hand.tips), 3))
    check_tensor("contacts.normals", contacts.normals, (len(contacts), len(hand.tips), 3))
    check_unit_vectors("contacts.normals", contacts.normals)
    if method == "cobyla":
        hand.require_three("method", "'cobyla'")
    if mixture is not None:
        hand.require_three("mixture", "a learned model")
    device = contacts.points.device
    hand = settle(hand, device)
    world = settle(CollisionWorld() if world is None else world, device)
    library = None if library is None else settle(library, device)
    refine_seeds = partial(_refine_seeds, hand, contacts, world, method)

    def library_seeds(some: Contacts) -> IKSeeds:
        return nearest_postures(
            PostureLibrary.of(hand) if library is None else library,
            some,
            world,
            SOLVING.library_seeds,
        )

    def is_exact(solution: IKSolution) -> Bool[Tensor, "k"]:
        return (solution.status == Status.OK) & (solution.tip_error.amax(1) <= SOLVING.exact)

    attempts = Attempts(~degenerate(contacts.points), is_exact)
    attempts.add(_no_solution(hand, contacts), torch.arange(len(contacts), device=device))
    sources = [(library_seeds, SOLVING.library_seeds)]
    if mixture is not None:
        learned_seeds = partial(query_mixture, hand, mixture=mixture, n_seeds=SOLVING.learned_seeds)
        sources = [(learned_seeds, SOLVING.learned_tries), *sources]
    for source, count in sources:
        rows = flatnonzero(attempts.unsolved)
        if len(rows):
            seeds = source(contacts[rows])
            seeds = dataclasses.replace(seeds, row=rows[seeds.row])
            attempts.refine(seeds, rank_in_group(seeds.row), [1] * count, refine_seeds)
    solution, row = attempts.best(
        lambda tried: ((tried.status != Status.OK).int(), tried.tip_error.amax(1))
    )
    counts = torch.bincount(torch.cat(attempts.rows), minlength=len(contacts)) - 1
    return dataclasses.replace(solution[row.argsort()], attempts=counts)


def _refine_seeds(
    hand: Hand, contacts: Contacts, world: CollisionWorld, method: Method, seeds: IKSeeds
) -> IKSolution:
    """Return the measured configurations of seeds that were refined onto their contacts by the
    given `method`.
    """
    # the paper's method touches with fixed points of the pads
    rolling = method != "cobyla"
    refined = refine_exactly if rolling else refine_by_cobyla
    parts = []
    size = SOLVING.part
    for first in range(0, max(len(seeds), 1), size):
        part = seeds[first : first + size]
        taken = assign(contacts, part)
        configuration = refined(hand, Configuration(part.joints, part.obj_from_hand), taken, world)
        errors = measure_errors(hand, configuration, taken, world, rolling)
        placed = configuration.joints, configuration.obj_from_hand, part.permutation
        measured = errors.tip_error, errors.normal_angle, errors.clearance
        parts.append(IKSolution(*placed, *measured, torch.ones_like(errors.status), errors.status))
    return join(parts)


def refine_exactly(
    hand: Hand, start: Configuration, contacts: Contacts, world: CollisionWorld
) -> Configuration:
    """Return hand configurations moved from `start` onto their `contacts`, clear of the `world`.

    Finger i touches contact i; poses, contacts and `world` are in one frame. Each configuration is
    refined twice: first with a margin of clearance, then from there without regard to clearance.
    The second result is returned where it passes all checks (`measure_errors`), else the first.
    """
    refined = refine(hand, start, contacts, world, SOLVING.solved)
    settled = refine(hand, refined, contacts, None, SOLVING.solved)
    return pick(
        measure_errors(hand, settled, contacts, world).status == Status.OK, settled, refined
    )


def _no_solution(hand: Hand, contacts: Contacts) -> IKSolution:
    """Return the solution of contact sets without seeds: NaN, with status `OUT_OF_REACH` or
    `DEGENERATE`.
    """
    b = len(contacts)
    f = contacts.fingertips
    nan = contacts.points.new_full((), torch.nan)
    status = torch.where(
        degenerate(contacts.points), int(Status.DEGENERATE), int(Status.OUT_OF_REACH)
    )
    placed = (
        nan.expand(b, hand.dof),
        nan.expand(b, 4, 4),
        torch.arange(f, device=nan.device).expand(b, f),
    )
    return IKSolution(
        *placed, nan.expand(b, f), nan.expand(b, f), nan.expand(b), torch.zeros_like(status), status
    )
