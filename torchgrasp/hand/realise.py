"""From guesses of the learned model to grasps that a hand can take: refine, open, check, approach, rank.

Most guesses are hopeless and no look tells which, but the best of a triple's guesses often holds. So every triple's
best guesses are refined first, and more of them only for triples that have no grasp yet.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import join
from torchgrasp.errors import Status
from torchgrasp.frames import rotate
from torchgrasp.hand.approach import find_approach
from torchgrasp.hand.check import check, measure
from torchgrasp.hand.clear import Surroundings
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.motion import Posture
from torchgrasp.hand.rank import score
from torchgrasp.hand.refine import badness, open_hand, refine
from torchgrasp.values import Certificate, Contacts, GraspGuess, Grasps

ROUNDS = (2, 4)
"""How many guesses of each triple that has no grasp yet are refined in each round."""
CHUNK = 256
"""Guesses judged at a time: their temporaries stay in the cache."""


def rank_in_group(badness: Float[Tensor, "g"], group: Int[Tensor, "g"]) -> Int[Tensor, "g"]:
    """Return how many rows of its own group are better than each row; equal ones keep their order.

    >>> rank_in_group(torch.tensor([1.0, 3.0, 2.0, 0.0]), torch.tensor([0, 1, 1, 1]))
    tensor([0, 2, 1, 0])
    """
    order = torch.argsort(badness, stable=True)
    order = order[torch.argsort(group[order], stable=True)]
    grouped = group[order].contiguous()
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order), device=order.device) - torch.searchsorted(grouped, grouped)
    return rank


def assign(contacts: Contacts, guess: GraspGuess) -> Contacts:
    """Return the contacts of each guess in the order of the fingers."""
    at = guess.row[:, None]
    return Contacts(
        contacts.points[at, guess.permutation],
        contacts.normals[at, guess.permutation],
        contacts.variance[at, guess.permutation],
        contacts.std_m[at, guess.permutation],
    )


def rank_guesses(guess: GraspGuess, hand: Hand, contacts: Contacts, surroundings: Surroundings) -> Int[Tensor, "g"]:
    """Return the place of each guess among those of its triple, by the residuals that refinement starts from."""
    parts = [
        badness(Posture(part.joints, part.obj_from_hand), hand, assign(contacts, part), surroundings)
        for part in (guess[rows] for rows in torch.arange(len(guess), device=guess.row.device).split(CHUNK))
    ]
    return rank_in_group(torch.cat(parts), guess.row) if parts else guess.row


def judge(
    posture: Posture,
    contacts: Contacts,
    certificate: Certificate,
    planned: Int[Tensor, "g"],
    permutation: Int[Tensor, "g 3"],
    hand: Hand,
    surroundings: Surroundings,
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
    sound = (planned == Status.OK) & (measure(posture, hand, contacts, surroundings).status == Status.OK)
    pregrasp[sound] = open_hand(posture[sound], hand, contacts[sound], surroundings)
    found = check(posture, pregrasp, hand, contacts, surroundings)
    status, way = found.status.clone(), rotate(posture.obj_from_hand, hand.approach.to(center)[None])[:, 0]
    fine = status == Status.OK
    way[fine], free = find_approach(Posture(pregrasp, posture.obj_from_hand)[fine], hand, surroundings)
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


Attempt = Callable[[GraspGuess], Grasps]


def try_guesses(guess: GraspGuess, rank: Int[Tensor, "g"], triples: int, rounds: list[tuple[int, Attempt]]) -> Grasps:
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
        chosen = guess[(rank >= first) & (rank < first + count) & waiting[guess.row]]
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


def on_contacts(
    hand: Hand,
    contacts: Contacts,
    certificate: Certificate,
    surroundings: Surroundings,
    center: Float[Tensor, "3"],
) -> Attempt:
    """Return the attempt that moves the hand onto the contacts as they are."""

    def attempt(guess: GraspGuess) -> Grasps:
        taken = assign(contacts, guess)
        posture = refine(Posture(guess.joints, guess.obj_from_hand), hand, taken, surroundings)
        planned = torch.full_like(guess.row, Status.OK)
        return judge(posture, taken, certificate[guess.row], planned, guess.permutation, hand, surroundings, center)

    return attempt


def realise(
    guess: GraspGuess,
    hand: Hand,
    contacts: Contacts,
    certificate: Certificate,
    surroundings: Surroundings,
    center: Float[Tensor, "3"],
) -> Grasps:
    """Refine guesses into checked grasps, one for each triple that has guesses, those with `Status.OK` first.

    Args:
        guess: rows of the query; `guess.row` points into `contacts`.
        hand: the hand.
        contacts: planned contacts with their `certificate`.
        certificate: one row for each of the contacts.
        surroundings: the estimated object and the table.
        center: estimated centre of the object [m]; grasps around it rank higher.

    Returns:
        Ranked grasps; of a triple that gave none, one failure with its Status.
    """
    attempt = on_contacts(hand, contacts, certificate, surroundings, center)
    rank = rank_guesses(guess, hand, contacts, surroundings)
    return try_guesses(guess, rank, len(contacts), [(count, attempt) for count in ROUNDS])
