"""From guesses of the learned model to grasps that a hand can take: refine, open, check, rank.

Most guesses are hopeless and one look tells: the batch is refined in rounds, and after each only the rows with the
least residual go on, a few for each contact triple so that the survivors stay diverse.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.errors import Status
from torchgrasp.hand.check import check
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.rank import score
from torchgrasp.hand.refine import Posture, Surroundings, badness, open_hand, refine
from torchgrasp.values import Certificate, Contacts, GraspGuess, Grasps

ROUNDS = ((1200, 4, 0), (500, 3, 12), (240, 2, 30))
"""Rows that enter each round, how many of them for one contact triple, and the iterations spent before it."""


def best_rows(badness: Float[Tensor, "g"], group: Int[Tensor, "g"], most: int, each: int) -> Int[Tensor, "k"]:
    """Return the rows of least badness, at most `each` of one group and `most` in all, best first.

    >>> best_rows(torch.tensor([3.0, 1.0, 2.0, 0.0]), torch.tensor([0, 1, 1, 1]), 3, 2)
    tensor([3, 1, 0])
    """
    order = torch.argsort(badness, stable=True)
    # Rank within the group: stable sorting by group keeps the order by badness inside each.
    by_group = torch.argsort(group[order], stable=True)
    sorted_group = group[order][by_group]
    starts = torch.searchsorted(sorted_group, sorted_group)
    rank = torch.empty_like(order)
    rank[by_group] = torch.arange(len(order), device=order.device) - starts
    return order[rank < each][:most]


def assign(contacts: Contacts, guess: GraspGuess) -> Contacts:
    """Return the contacts of each guess in the order of the fingers."""
    at = guess.row[:, None]
    return Contacts(
        contacts.points[at, guess.permutation],
        contacts.normals[at, guess.permutation],
        contacts.variance[at, guess.permutation],
        contacts.std_m[at, guess.permutation],
    )


def realise(
    guess: GraspGuess,
    hand: Hand,
    contacts: Contacts,
    certificate: Certificate,
    surroundings: Surroundings,
    center: Float[Tensor, "3"],
) -> Grasps:
    """Refine guesses into checked grasps, ranked, those with `Status.OK` first.

    Args:
        guess: rows of the query; `guess.row` points into `contacts`.
        hand: the hand.
        contacts: planned contacts with their `certificate`.
        certificate: one row for each of the contacts.
        surroundings: the estimated object and the table.
        center: estimated centre of the object [m]; grasps around it rank higher.

    Returns:
        The survivors of the last round, also those that failed the check, each with its Status.
    """
    for most, each, iterations in ROUNDS:
        posture = Posture(guess.joints, guess.obj_from_hand)
        taken = assign(contacts, guess)
        if iterations:
            posture = refine(posture, hand, taken, surroundings, iterations)
        kept = best_rows(badness(posture, hand, taken, surroundings), guess.row, most, each)
        guess = GraspGuess(
            posture.joints[kept],
            posture.obj_from_hand[kept],
            guess.row[kept],
            guess.permutation[kept],
            guess.reach[kept],
            guess.tip_error[kept],
        )
    posture, taken = Posture(guess.joints, guess.obj_from_hand), assign(contacts, guess)
    pregrasp = open_hand(posture, hand, taken, surroundings)
    found = check(posture, pregrasp, hand, taken, surroundings)
    ranking = score(taken, found, center)
    grasps = Grasps(
        joints=posture.joints,
        pregrasp=pregrasp,
        obj_from_hand=posture.obj_from_hand,
        contacts=taken,
        permutation=guess.permutation,
        tip_error=found.tip_error,
        clearance=found.clearance,
        normal_angle=found.normal_angle,
        certificate=certificate[guess.row],
        score=ranking,
        status=found.status,
    )
    order = torch.argsort(-ranking, stable=True)
    order = order[torch.argsort((grasps.status[order] != Status.OK).long(), stable=True)]
    return grasps[order]
