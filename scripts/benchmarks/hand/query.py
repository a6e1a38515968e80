"""From the codes of real postures back to postures, end to end: query, refine, check.

A held-out posture is drawn like those that the model has learned from, with another seed; the
contact points and directions of its pads are the contacts. A code is solved when every fingertip is
found within 1 mm of its contact and no link in another; the share that touches inside the pads'
cones as well is printed beside it.
"""

import torch

from benchmarks.common import Options, Row, bench, timed
from torchgrasp import Contacts, load_hand, load_mixture
from torchgrasp.foundation.errors import Status
from torchgrasp.ik.candidates import TIP_TOLERANCE
from torchgrasp.ik.seeds import PostureLibrary
from torchgrasp.ik.solve import IKSolution, solve_ik
from torchgrasp.posture_model.sample import sample_configurations

HELD_OUT_SEED = 977
"""Of the held-out postures: not the seed of a shipped model."""
LEAST_SOLVED = {"allegro": 0.99, "barrett": 0.97}
"""Least share of codes that are solved."""
MOST_ERROR = 0.05
"""Most median of the worst tip's error [mm]."""


@bench("hand/codes")
def codes(o: Options) -> list[Row]:
    """Solve held-out codes of each hand, with the learned model and from random postures alone."""
    rows = []
    for name in o.hands:
        hand = load_hand(name)
        mixture = load_mixture(name)
        points, normals = hand.fingertips(
            sample_configurations(hand, o.times(10_000), HELD_OUT_SEED).joints
        )
        contacts = Contacts(points, -normals)
        library, drawn = timed(lambda: PostureLibrary.of(hand))  # noqa: B023
        solve_ik(hand, contacts[:100], mixture, library=library)  # the first call sets up
        for what, model in (
            ("query + refine", mixture),
            (f"random postures (drawn once in {drawn:.1f} s)", None),
        ):
            solution, seconds = timed(lambda: solve_ik(hand, contacts, model, library=library))  # noqa: B023
            bar = None if model is None else LEAST_SOLVED.get(name, 0.97)
            rows.append(_solved_row(f"{name}, {what}", solution, seconds / len(contacts), bar))
    return rows


def _solved_row(what: str, solution: IKSolution, seconds: float, bar: float | None) -> Row:
    """Return the row of the share of solved codes and of their errors."""
    solved = (solution.tip_error.amax(1) <= TIP_TOLERANCE) & (solution.clearance >= 0)
    ok = solution.status == Status.OK
    error = 1e3 * solution.tip_error.amax(1).nan_to_num(torch.inf)
    share, right, learned, starts = (
        float(x.double().mean())
        for x in (solved, ok, ok & (solution.attempts <= 4), solution.attempts)
    )
    median = float(error.median())
    most = float(error.quantile(0.99))
    measured = f"{share:.2%}, median {median:.1e} mm, 99 % {most:.1e} mm; inside the pads' cones too {right:.2%}"
    measured += f", {learned:.2%} by the learned model's starts alone" if bar else ""
    return Row(
        f"{len(solution)} held-out codes, {what}",
        f">= {bar:.0%} with all tips within 1 mm and no self-collision, median <= {MOST_ERROR} mm"
        if bar
        else "-",
        f"{measured}; {1e3 * seconds:.2f} ms a code, {starts:.2f} starts",
        None if bar is None else share >= bar and median <= MOST_ERROR,
        {
            "share": share,
            "median_mm": median,
            "ms": 1e3 * seconds,
            "right": right,
            "codes": len(solution),
        },
    )
