"""Inverse kinematics of three contacts: the joints and the pose with which a hand touches them, and nothing of itself.

Starts come from the learned model first (Eqs. 21-24) and, for what those leave, from the hand's own postures nearest to
the contacts. Each is refined, by Levenberg-Marquardt with the links' clearances among the residuals or by the paper's
COBYLA, and measured again; a row that no start solves returns the best try with its Status.
"""

import dataclasses
from collections.abc import Callable
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.base import Batch, check_tensor, join, pick
from torchgrasp.errors import BadArgument, Status
from torchgrasp.frames import degenerate
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.checks import measure
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.cobyla import refine_by_cobyla
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.contact_first import assign, rank_in_group
from torchgrasp.ik.posture_library import PostureLibrary, nearest_postures
from torchgrasp.ik.query import query_mixture
from torchgrasp.ik.refine import refine, settle_tips
from torchgrasp.posture_model.mixture import GraspMixture
from torchgrasp.values import Contacts, IKSeeds

Method = Literal["levenberg_marquardt", "cobyla"]

MODES = 2
"""Guesses of the learned model for each assignment: the conditional mean (Eq. 23) and the likeliest component's."""
LEARNED, OWN = 4, 8
"""How many starts of the learned model, and of the hand's own postures, are tried of a row before it is given up."""
EXACT = 1e-6
"""Sum of squared residuals [mm2] at which a row is done: 0.5 um at a fingertip."""
NEAR = 5e-5
"""Error of the fingertips [m] above which a solved row is tried on: another posture may have none."""
CHUNK = 512
"""Rows refined at a time: their temporaries stay in the cache."""


@dataclasses.dataclass(frozen=True)
class IKSolution(Batch):
    """A posture for each row of contacts; finger i touches contact `permutation[:, i]`.

    `tip_error` [m] and `normal_angle` [rad] are those of each fingertip, `clearance` [m] is the least of the links from
    each other and from the surroundings; `attempts` counts the starts that were refined, those of the learned model first.
    A row without a start holds NaN, and its `status` tells why.
    """

    joints: Float[Tensor, "b h"]
    obj_from_hand: Float[Tensor, "b 4 4"]
    permutation: Int[Tensor, "b 3"]
    tip_error: Float[Tensor, "b 3"]
    normal_angle: Float[Tensor, "b 3"]
    clearance: Float[Tensor, "b"]
    attempts: Int[Tensor, "b"]
    status: Int[Tensor, "b"]


def solve_ik(
    contacts: Contacts,
    hand: Hand,
    mixture: GraspMixture | None = None,
    world: CollisionWorld | None = None,
    method: Method = "levenberg_marquardt",
    postures: PostureLibrary | None = None,
) -> IKSolution:
    """Return postures whose three fingertips touch the contacts, in whichever assignment, free of self-collision.

    Args:
        contacts: b triples; `std_m` and `variance` are not used.
        hand: the hand.
        mixture: its learned model; None: only the hand's own postures are starts.
        surroundings: what the links must not touch; by default nothing but each other.
        method: "cobyla" is the paper's (Sec. 6.3), which moves the joints alone and sees the tips alone.
        postures: the hand's own; by default they are drawn when they are needed, which takes about a second.

    Returns:
        One row for each of the contacts, `Status.OK` where every tip is within 1 mm of its contact and inside its
        pad's cone, and every link is clear.

    Raises:
        BadArgument: contacts that are no finite triples, a mixture of another hand, an unknown method.

    >>> from torchgrasp.hand.load import load_hand
    >>> points = 0.05 * torch.eye(3)[None].double()
    >>> found = solve_ik(Contacts(points, 20 * points), load_hand("allegro"))
    >>> bool(found.tip_error.max() < 1e-3)
    True
    """
    check_tensor("contacts.points", contacts.points, (None, 3, 3))
    check_tensor("contacts.normals", contacts.normals, (len(contacts), 3, 3))
    if method not in get_args(Method):
        raise BadArgument("method", repr(method), f"one of {get_args(Method)}")
    around = CollisionWorld() if world is None else world
    move = refine_by_cobyla if method == "cobyla" else _refine

    def learned(some: Contacts) -> IKSeeds:
        assert mixture is not None
        return query_mixture(some, hand, mixture, n_seeds=MODES)

    def own(some: Contacts) -> IKSeeds:
        return nearest_postures(some, PostureLibrary.of(hand) if postures is None else postures, around, OWN)

    found = _nowhere(contacts, hand)
    sources = [(own, OWN)] if mixture is None else [(learned, LEARNED), (own, OWN)]
    for source, attempts in sources:
        waiting = torch.nonzero(~_done(found) & (found.status != Status.DEGENERATE))[:, 0]
        if not len(waiting):
            break
        found = _improve(found, waiting, source(contacts[waiting]), contacts, hand, around, move, attempts)
    return found


def _refine(posture: Configuration, hand: Hand, contacts: Contacts, world: CollisionWorld) -> Configuration:
    """Refine until the tips are exact; where a margin of clearance has kept them off, it is given up if all is well."""
    refined = refine(posture, hand, contacts, world, EXACT)
    settled = settle_tips(refined, hand, contacts, EXACT)
    good = measure(settled, hand, contacts, world).status == Status.OK
    return pick(good, settled, refined)


def _improve(
    found: IKSolution,
    rows: Int[Tensor, "w"],
    seeds: IKSeeds,
    contacts: Contacts,
    hand: Hand,
    world: CollisionWorld,
    move: Callable[[Configuration, Hand, Contacts, CollisionWorld], Configuration],
    attempts: int,
) -> IKSolution:
    """Try the guesses of rows one after the other until one solves the row exactly, keeping the best.

    `seeds.row` points into `rows`.
    """
    seeds = dataclasses.replace(seeds, row=rows[seeds.row])
    rank = rank_in_group(torch.zeros_like(seeds.energy), seeds.row)
    for k in range(attempts):
        chosen = seeds[(rank == k) & ~_done(found)[seeds.row]]
        if not len(chosen):
            break
        tried = join([_try(part, contacts, hand, world, move) for part in _chunks(chosen)])
        found.attempts[chosen.row] += 1
        before = found[chosen.row]
        tried = dataclasses.replace(tried, attempts=before.attempts)
        gain = (tried.status == Status.OK).long() - (before.status == Status.OK).long()
        nearer = ~(before.tip_error.amax(1) <= tried.tip_error.amax(1))
        better = (gain > 0) | ((gain == 0) & nearer)
        found = _put(found, chosen.row[better], tried[better])
    return found


def _done(found: IKSolution) -> Bool[Tensor, "b"]:
    """Tell which rows are solved, and exactly."""
    return (found.status == Status.OK) & (found.tip_error.amax(1) <= NEAR)


def _try(
    seeds: IKSeeds,
    contacts: Contacts,
    hand: Hand,
    world: CollisionWorld,
    move: Callable[[Configuration, Hand, Contacts, CollisionWorld], Configuration],
) -> IKSolution:
    """Refine guesses and measure what came of it."""
    taken = assign(contacts, seeds)
    posture = move(Configuration(seeds.joints, seeds.obj_from_hand), hand, taken, world)
    seen = measure(posture, hand, taken, world)
    return IKSolution(
        posture.joints, posture.obj_from_hand, seeds.permutation, seen.tip_error, seen.normal_angle, seen.clearance,
        torch.ones_like(seen.status), seen.status,
    )  # fmt: skip


def _chunks(seeds: IKSeeds) -> list[IKSeeds]:
    """Cut a batch into parts that stay in the cache."""
    return [seeds[k : k + CHUNK] for k in range(0, len(seeds), CHUNK)]


def _put(found: IKSolution, rows: Int[Tensor, "r"], better: IKSolution) -> IKSolution:
    """Return the batch with some of its rows replaced."""
    fields = (f.name for f in dataclasses.fields(found))
    return IKSolution(**{name: getattr(found, name).index_copy(0, rows, getattr(better, name)) for name in fields})


def _nowhere(contacts: Contacts, hand: Hand) -> IKSolution:
    """Return rows without a posture: out of reach, or degenerate."""
    b, nan = len(contacts), torch.full((), torch.nan).to(contacts.points)
    order = torch.arange(3, device=nan.device).expand(b, 3)
    status = torch.where(degenerate(contacts.points), int(Status.DEGENERATE), int(Status.OUT_OF_REACH))
    return IKSolution(
        nan.expand(b, hand.dof), nan.expand(b, 4, 4), order, nan.expand(b, 3), nan.expand(b, 3), nan.expand(b),
        torch.zeros_like(status), status,
    )  # fmt: skip
