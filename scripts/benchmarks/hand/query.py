"""From the codes of real postures back to postures, end to end: query, refine, check; COBYLA beside it.

A held-out posture is drawn like those that the model has learned from, with another seed; the contact points and
directions of its pads are the contacts. A code is solved when every fingertip is found within 1 mm of its contact and
no link in another; the share that touches inside the pads' cones as well is printed beside it.
"""

import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.common import Options, Row, bench
from torchgrasp import Contacts, load_hand, load_mixture
from torchgrasp.errors import Status
from torchgrasp.hand.hand import Hand
from torchgrasp.ik import attempts
from torchgrasp.ik.attempts import assign
from torchgrasp.ik.candidates import TIP_TOLERANCE
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.configuration import Configuration, SpatialJacobian
from torchgrasp.ik.ranking import rank_in_group
from torchgrasp.ik.seeds import PostureLibrary, query_mixture
from torchgrasp.ik.solve import IKSolution, solve_ik
from torchgrasp.posture_model.mixture import GraspMixture
from torchgrasp.posture_model.sample import sample_configurations

SEED = 977
"""Of the held-out postures."""
BARS = {"allegro": 0.99, "barrett": 0.97}
"""Least share of codes that are solved."""
MEDIAN, RATIO = 0.05, 50.0
"""Most median of the worst tip's error [mm]; least ratio of COBYLA's time to ours."""

Result = TypeVar("Result")


@bench("hand/codes")
def codes(o: Options) -> list[Row]:
    """Solve held-out codes of both hands, and some of them with COBYLA from the likeliest seed.

    Args:
        codes: of each hand.
        peers: how many of them COBYLA gets.
    """
    return [row for name in o.hands for row in _bench_hand(name, o.times(10_000), o.times(100))]


def _bench_hand(name: str, codes: int, peers: int) -> list[Row]:
    """Return the rows of one hand."""
    hand, mixture = load_hand(name), load_mixture(name)
    contacts = touched(hand, sample_configurations(hand, codes, SEED).joints)
    library, drawn = timed(lambda: PostureLibrary.of(hand))
    solve_ik(hand, contacts[:100], mixture, library=library)  # the first call sets up
    solution, seconds = timed(lambda: solve_ik(hand, contacts, mixture, library=library))
    by_library, library_seconds = timed(lambda: solve_ik(hand, contacts, library=library))
    without = f"without the model, from {len(library.joints)} random postures (drawn once in {drawn:.1f} s)"
    return [
        _solved_row(name, "query + refine", solution, seconds / codes, BARS[name]),
        _solved_row(name, without, by_library, library_seconds / codes, None),
        _cobyla_row(hand, mixture, contacts[:peers], solution[:peers], seconds / codes),
    ]


def touched(hand: Hand, joints: Float[Tensor, "n h"]) -> Contacts:
    """Return the contacts that postures touch with the middle of their pads, in the hand's frame."""
    points, normals = hand.fingertips(joints)
    return Contacts(points, -normals)


def timed(action: Callable[[], Result]) -> tuple[Result, float]:
    """Return what an action returns and the time of the processor that it took [s]."""
    began = time.process_time()
    return action(), time.process_time() - began


def _solved_row(hand: str, what: str, solution: IKSolution, seconds: float, bar: float | None) -> Row:
    """Return the row of the share of solved codes and of their errors."""
    touching, clear = solution.tip_error.amax(1) <= TIP_TOLERANCE, solution.clearance >= 0
    solved, ok = touching & clear, solution.status == Status.OK
    error = 1e3 * solution.tip_error.amax(1).nan_to_num(torch.inf)
    share, median = float(solved.double().mean()), float(error.median())
    right = float(ok.double().mean())
    learned = float((ok & (solution.attempts <= 4)).double().mean())
    by_model = f", {learned:.2%} by the learned model's starts alone" if bar else ""
    wanted = "none"
    if bar is not None:
        wanted = f">= {bar:.0%} with all tips within 1 mm and free of self-collision, median <= {MEDIAN} mm"
    numbers = {"share": share, "median_mm": median, "ms": 1e3 * seconds, "right": right, "codes": len(solution)}
    return Row(
        f"{len(solution)} held-out codes, {hand}, {what}",
        wanted,
        f"{share:.2%}, median {median:.1e} mm, 99 % {float(error.quantile(0.99)):.1e} mm; inside the pads' cones too "
        f"{right:.2%}{by_model}; {1e3 * seconds:.2f} ms a code, {float(solution.attempts.double().mean()):.2f} starts",
        None if bar is None else share >= bar and median <= MEDIAN,
        numbers,
    )


def _cobyla_row(hand: Hand, mixture: GraspMixture, contacts: Contacts, ours: IKSolution, seconds: float) -> Row:
    """Return the row of COBYLA from the first seed alone, one try a code."""
    seeds, asked = timed(lambda: query_mixture(hand, contacts, mixture, n_seeds=2))
    seeds = seeds[rank_in_group(seeds.row) == 0]
    taken, start = assign(contacts, seeds), Configuration(seeds.joints, seeds.obj_from_hand)
    spent, evaluate = [0.0], attempts.CobylaRun.evaluate

    def counted(self: attempts.CobylaRun, x: np.ndarray) -> tuple[float, np.ndarray]:
        values, used = timed(lambda: evaluate(self, x))
        spent[0] += used
        return values

    attempts.CobylaRun.evaluate = counted
    try:
        refined, used = timed(lambda: attempts.refine_by_cobyla(hand, start, taken, CollisionWorld()))
    finally:
        attempts.CobylaRun.evaluate = evaluate
    points = SpatialJacobian.at(hand, refined).points(hand.tips.index, hand.tips.contact)
    error = 1e3 * torch.linalg.vector_norm(points - taken.points, dim=-1).amax(1)
    clear = hand.self_clearance(refined.joints) >= 0
    share = float(((error <= 1e3 * TIP_TOLERANCE) & clear).double().mean())
    mine = 1e3 * ours.tip_error.amax(1).nan_to_num(torch.inf)
    each, scipy = (asked + used) / len(contacts), (used - spent[0]) / len(contacts)
    medians = [float(x.median()) for x in (mine, error)]
    worse = [float(x.quantile(0.9)) for x in (mine, error)]
    ratio = each / seconds
    return Row(
        f"COBYLA (SciPy) from the first seed, {len(contacts)} of these codes, {hand.name}",
        f">= {RATIO:g}x slower, at equal or larger error (median and 90 %)",
        f"{ratio:.0f}x ({1e3 * each:.0f} ms a code, {1e3 * scipy:.0f} ms of them SciPy's own: {scipy / seconds:.0f}x); "
        f"error median {medians[1]:.1e} mm (ours {medians[0]:.1e}), 90 % {worse[1]:.1e} mm (ours {worse[0]:.1e}); "
        f"solved {share:.1%}",
        ratio >= RATIO and medians[0] <= medians[1] and worse[0] <= worse[1],
        {"ratio": ratio, "scipy_ratio": scipy / seconds, "ms": 1e3 * each, "error": medians[1], "share": share},
    )
