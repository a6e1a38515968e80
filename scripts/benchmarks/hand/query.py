"""From the codes of real postures back to postures, end to end: query, refine, check; COBYLA beside it.

A held-out posture is drawn like those that the model has learned from, with another seed; the contact points and
directions of its pads are the contacts. A code is solved when every fingertip is found within 1 mm of its contact and
no link in another; the share that touches inside the pads' cones as well is printed beside it.
"""

import time
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.common import Row
from torchgrasp import Contacts, load_hand, load_mixture
from torchgrasp.errors import Status
from torchgrasp.hand import cobyla
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.checks import TIP_TOLERANCE
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.configuration import Configuration, SpatialJacobian
from torchgrasp.ik.contact_first import assign, rank_in_group
from torchgrasp.ik.posture_library import PostureLibrary
from torchgrasp.ik.query import query_mixture
from torchgrasp.ik.solve import LEARNED, MODES, IKSolution, solve_ik
from torchgrasp.posture_model.mixture import GraspMixture
from torchgrasp.posture_model.sample import sample_configurations

SEED = 977
"""Of the held-out postures."""
BARS = {"allegro": 0.99, "barrett": 0.97}
"""Least share of codes that are solved."""
MEDIAN, RATIO = 0.05, 50.0
"""Most median of the worst tip's error [mm]; least ratio of COBYLA's time to ours."""

Result = TypeVar("Result")


def bench_codes(codes: int, peers: int) -> list[Row]:
    """Solve held-out codes of both hands, and some of them with COBYLA from the likeliest guess.

    Args:
        codes: of each hand.
        peers: how many of them COBYLA gets.
    """
    return [row for name in BARS for row in _bench_hand(name, codes, peers)]


def _bench_hand(name: str, codes: int, peers: int) -> list[Row]:
    """Return the rows of one hand."""
    hand, mixture = load_hand(name), load_mixture(name)
    contacts = touched(hand, sample_configurations(hand, codes, SEED).joints)
    postures, drawn = timed(lambda: PostureLibrary.of(hand))
    solve_ik(contacts[:100], hand, mixture, postures=postures)  # the first call sets up
    found, learned = timed(lambda: solve_ik(contacts, hand, mixture, postures=postures))
    own, alone = timed(lambda: solve_ik(contacts, hand, postures=postures))
    without = f"without the model, from 5000 own postures (drawn once in {drawn:.1f} s)"
    return [
        _solved_row(name, "query + refine", found, learned / codes, BARS[name]),
        _solved_row(name, without, own, alone / codes, None),
        _cobyla_row(hand, mixture, contacts[:peers], found[:peers], learned / codes),
    ]


def touched(hand: Hand, joints: Float[Tensor, "n h"]) -> Contacts:
    """Return the contacts that postures touch with the middle of their pads, in the hand's frame."""
    points, normals = hand.fingertips(joints)
    return Contacts(points, -normals)


def timed(action: Callable[[], Result]) -> tuple[Result, float]:
    """Return what an action returns and the time of the processor that it took [s]."""
    began = time.process_time()
    return action(), time.process_time() - began


def _solved_row(hand: str, what: str, found: IKSolution, seconds: float, bar: float | None) -> Row:
    """Return the row of the share of solved codes and of their errors."""
    near, free = found.tip_error.amax(1) <= TIP_TOLERANCE, found.clearance >= 0
    solved, first = near & free, (found.status == Status.OK) & (found.attempts <= LEARNED)
    error = 1e3 * found.tip_error.amax(1).nan_to_num(torch.inf)
    share, median = float(solved.double().mean()), float(error.median())
    right = float((found.status == Status.OK).double().mean())
    by_model = f", {float(first.double().mean()):.2%} by the learned model's starts alone" if bar else ""
    wanted = "none"
    if bar is not None:
        wanted = f">= {bar:.0%} with all tips within 1 mm and free of self-collision, median <= {MEDIAN} mm"
    numbers = {"share": share, "median_mm": median, "ms": 1e3 * seconds, "right": right, "codes": len(found)}
    return Row(
        f"{len(found)} held-out codes, {hand}, {what}",
        wanted,
        f"{share:.2%}, median {median:.1e} mm, 99 % {float(error.quantile(0.99)):.1e} mm; inside the pads' cones too "
        f"{right:.2%}{by_model}; {1e3 * seconds:.2f} ms a code, {float(found.attempts.double().mean()):.2f} starts",
        None if bar is None else share >= bar and median <= MEDIAN,
        numbers,
    )


def _cobyla_row(hand: Hand, mixture: GraspMixture, contacts: Contacts, ours: IKSolution, seconds: float) -> Row:
    """Return the row of COBYLA from the first guess alone, one try a code."""
    guess, asked = timed(lambda: query_mixture(contacts, hand, mixture, n_seeds=MODES))
    guess = guess[rank_in_group(torch.zeros_like(guess.energy), guess.row) == 0]
    taken, start = assign(contacts, guess), Configuration(guess.joints, guess.obj_from_hand)
    spent, place = [0.0], cobyla.place

    def counted(*arguments: Any) -> tuple[Tensor, Tensor]:
        found, used = timed(lambda: place(*arguments))
        spent[0] += used
        return found

    cobyla.place = counted
    try:
        found, used = timed(lambda: cobyla.refine_by_cobyla(start, hand, taken, CollisionWorld()))
    finally:
        cobyla.place = place
    jacobians = SpatialJacobian.at(found, hand)
    points = jacobians.points(hand.tips.index, hand.tips.contact)
    error = 1e3 * torch.linalg.vector_norm(points - taken.points, dim=-1).amax(1)
    free = hand.self_clearance(found.joints) >= 0
    share = float(((error <= 1e3 * TIP_TOLERANCE) & free).double().mean())
    mine = 1e3 * ours.tip_error.amax(1).nan_to_num(torch.inf)
    each, scipy = (asked + used) / len(contacts), (used - spent[0]) / len(contacts)
    medians = [float(x.median()) for x in (mine, error)]
    worse = [float(x.quantile(0.9)) for x in (mine, error)]
    ratio = each / seconds
    return Row(
        f"COBYLA (SciPy) from the first guess, {len(contacts)} of these codes, {hand.name}",
        f">= {RATIO:g}x slower, at equal or larger error (median and 90 %)",
        f"{ratio:.0f}x ({1e3 * each:.0f} ms a code, {1e3 * scipy:.0f} ms of them SciPy's own: {scipy / seconds:.0f}x); "
        f"error median {medians[1]:.1e} mm (ours {medians[0]:.1e}), 90 % {worse[1]:.1e} mm (ours {worse[0]:.1e}); "
        f"solved {share:.1%}",
        ratio >= RATIO and medians[0] <= medians[1] and worse[0] <= worse[1],
        {"ratio": ratio, "scipy_ratio": scipy / seconds, "ms": 1e3 * each, "error": medians[1], "share": share},
    )
