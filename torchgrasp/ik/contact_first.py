"""From guesses of the learned model to grasps that a hand can take: refine, open, check, approach, rank.

Most guesses are hopeless and no look tells which, but the best of a triple's guesses often holds. So every triple's
best guesses are refined first, and more of them only for triples that have no grasp yet.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import join, map_tensors
from torchgrasp.errors import Status
from torchgrasp.frames import rotate
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.approach import find_approach
from torchgrasp.ik.checks import check, measure
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.ranking import score
from torchgrasp.ik.refine import open_hand, refine, refinement_cost
from torchgrasp.values import Certificate, Contacts, Grasps, IKSeeds

ROUNDS = (2, 4)
"""How many guesses of each triple that has no grasp yet are refined in each round."""
CHUNK = 256
"""Guesses judged at a time: their temporaries stay in the cache."""


def rank_in_group(refinement_cost: Float[Tensor, "g"], group: Int[Tensor, "g"]) -> Int[Tensor, "g"]:
    """Return how many rows of its own group are better than each row; equal ones keep their order.

    >>> rank_in_group(torch.tensor([1.0, 3.0, 2.0, 0.0]), torch.tensor([0, 1, 1, 1]))
    tensor([0, 2, 1, 0])
    """
    order = torch.argsort(refinement_cost, stable=True)
    order = order[torch.argsort(group[order], stable=True)]
    grouped = group[order].contiguous()
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order), device=order.device) - torch.searchsorted(grouped, grouped)
    return rank


def assign(contacts: Contacts, seeds: IKSeeds) -> Contacts:
    """Return the contacts of each guess in the order of the fingers."""
    at = seeds.row[:, None]
    return map_tensors(lambda x: x[at, seeds.permutation], contacts)


def rank_seeds(seeds: IKSeeds, hand: Hand, contacts: Contacts, world: CollisionWorld) -> Int[Tensor, "g"]:
    """Return the place of each guess among those of its triple, by the residuals that refinement starts from."""
    parts = [
        refinement_cost(Configuration(part.joints, part.obj_from_hand), hand, assign(contacts, part), world)
        for part in (seeds[rows] for rows in torch.arange(len(seeds), device=seeds.row.device).split(CHUNK))
    ]
    return rank_in_group(torch.cat(parts), seeds.row) if parts else seeds.row


def check_grasps(
    posture: Configuration,
    contacts: Contacts,
    certificate: Certificate,
    planned: Int[Tensor, "g"],
    permutation: Int[Tensor, "g 3"],
    hand: Hand,
    world: CollisionWorld,
    center: Float[Tensor, "3"],
) -> Grasps:
    """Return checked grasps of postures, with pre-grasps where all else is right, and the straight ways to these.

    Args:
        posture: g postures.
        contacts: contact i is the one of finger i.
        certificate: of the contacts.
        planned: status of the contacts themselves.
        permutation: which contact of its triple each finger has.
        hand: the hand.
        surroundings: the estimated object and the table.
        center: estimated centre of the object [m]; grasps around it rank higher.
    """
    planned = torch.where((planned == Status.OK) & ~certificate.closed, int(Status.NOT_CLOSED), planned)
    pregrasp = posture.joints.clone()
    sound = (planned == Status.OK) & (measure(posture, hand, contacts, world).status == Status.OK)
    pregrasp[sound] = open_hand(posture[sound], hand, contacts[sound], world)
    found = check(posture, pregrasp, hand, contacts, world)
    status, way = found.status.clone(), rotate(posture.obj_from_hand, hand.approach.to(center)[None])[:, 0]
    fine = status == Status.OK
    way[fine], free = find_approach(Configuration(pregrasp, posture.obj_from_hand)[fine], hand, world)
    status[fine] = torch.where(free >= 0, status[fine], int(Status.NO_APPROACH))
    return Grasps(
        joints=posture.joints,
        pregrasp=pregrasp,
        approach=way,
        obj_from_hand=posture.obj_from_hand,
        contacts=contacts,
        permutation=permutation,
        tip_error=found.tip_error,
        clearance=found.clearance,
        normal_angle=found.normal_angle,
        certificate=certificate,
        score=score(contacts, found, center),
        status=torch.where(planned == Status.OK, status, planned),
    )


Refinement = Callable[[IKSeeds], Grasps]


def refine_in_rounds(
    seeds: IKSeeds, rank: Int[Tensor, "g"], triples: int, rounds: list[tuple[int, Refinement]]
) -> Grasps:
    """Try guesses in rounds, each on the triples without a grasp so far, and return one grasp a triple, best first.

    A round is how many more guesses of each triple are tried, and the attempt; an attempt of another kind than the
    one before starts again from the first guess. Of a triple without a grasp the failure of best score is returned, if
    there is one of certified contacts, of these.
    """
    waiting = torch.ones(triples, dtype=torch.bool, device=rank.device)
    tried: list[Grasps] = []
    rows: list[Tensor] = []
    first, before = 0, None
    for count, attempt in rounds:
        first = first if attempt is before else 0
        chosen = seeds[(rank >= first) & (rank < first + count) & waiting[seeds.row]]
        first, before = first + count, attempt
        if len(chosen) or not tried:
            tried.append(attempt(chosen))
            rows.append(chosen.row)
            waiting[chosen.row[tried[-1].status == Status.OK]] = False
    grasps, row = join(tried), torch.cat(rows)
    bad = (grasps.status != Status.OK).to(grasps.score)
    # The best of each triple: a success, else a failure of certified contacts, else any.
    penalty = bad + (grasps.status < Status.OUT_OF_REACH).to(bad) * bad
    best = rank_in_group(_lexical(penalty, -grasps.score), row) == 0
    grasps = grasps[best]
    return grasps[_lexical((grasps.status != Status.OK).to(bad), -grasps.score).argsort()]


def _lexical(first: Float[Tensor, "g"], second: Float[Tensor, "g"]) -> Float[Tensor, "g"]:
    """Return the place of each row in the order by `first`, then `second`, ties in their own order."""
    order = torch.argsort(second, stable=True)
    order = order[torch.argsort(first[order], stable=True)]
    place = torch.empty_like(second)
    place[order] = torch.arange(len(order)).to(second)
    return place


def refinement_on_contacts(
    hand: Hand,
    contacts: Contacts,
    certificate: Certificate,
    world: CollisionWorld,
    center: Float[Tensor, "3"],
) -> Refinement:
    """Return the attempt that moves the hand onto the contacts as they are.

    Raises:
        BadArgument: contacts without `std_m`, by which the pre-grasp opens.
    """
    contacts.require_std()  # before any work

    def attempt(seeds: IKSeeds) -> Grasps:
        taken = assign(contacts, seeds)
        posture = refine(Configuration(seeds.joints, seeds.obj_from_hand), hand, taken, world)
        planned = torch.full_like(seeds.row, Status.OK)
        return check_grasps(posture, taken, certificate[seeds.row], planned, seeds.permutation, hand, world, center)

    return attempt


def solve_contact_first(
    seeds: IKSeeds,
    hand: Hand,
    contacts: Contacts,
    certificate: Certificate,
    world: CollisionWorld,
    center: Float[Tensor, "3"],
) -> Grasps:
    """Refine guesses into checked grasps, one for each triple that has guesses, those with `Status.OK` first.

    Args:
        guess: rows of the query; `seeds.row` points into `contacts`.
        hand: the hand.
        contacts: planned contacts with their `certificate`.
        certificate: one row for each of the contacts.
        surroundings: the estimated object and the table.
        center: estimated centre of the object [m]; grasps around it rank higher.

    Returns:
        Ranked grasps; of a triple that gave none, one failure with its Status.
    """
    attempt = refinement_on_contacts(hand, contacts, certificate, world, center)
    rank = rank_seeds(seeds, hand, contacts, world)
    return refine_in_rounds(seeds, rank, len(contacts), [(count, attempt) for count in ROUNDS])
