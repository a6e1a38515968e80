"""Learning the posture model of a new hand: a step of EM beside scikit-learn's, a whole hand, and
its likelihood.

A whole hand is what `torchgrasp hand train` does: draw postures, choose the number of Gaussians by
the BIC, fit from five starts. Times are the processor's, so bars of two cores are twice those of
the wall.
"""

from typing import Any

import torch
from sklearn.mixture import GaussianMixture

from benchmarks.common import Options, Row, bench, least_seconds, timed
from torchgrasp import fit_mixture, load_hand, load_mixture
from torchgrasp.posture_model.em import DataRows, expectation, maximisation, start_components
from torchgrasp.posture_model.sample import sample_configurations
from torchgrasp.posture_model.score import growing_bic

COMPONENTS = 36
DIMENSIONS = 18
"""Of the step: the paper's number for a hand, and the joints of the Allegro hand with the code."""
TRAINED = 200_000
APART = 40_000
HELD_OUT = 20_000
STARTS = 5
"""Of a whole hand, as `torchgrasp hand train` has them: postures of the fit, the BIC and the
evaluation; starts.
"""
MOST_SECONDS = 360.0
"""Most processor time of a whole hand [s]: three minutes on two cores."""
MOST_LOST = 0.01
"""Largest loss of the mean log-likelihood of a held-out posture [nats]."""


@bench("hand/em")
def em(o: Options) -> list[Row]:
    """Time a step of EM and a whole hand; compare held-out likelihoods with the shipped models and
    full-batch EM.
    """
    return [_step(o), *(row for name in o.hands for row in _whole_hand(name, o))]


def _step(o: Options) -> Row:
    """Time one step of both libraries from the same components on the same rows."""
    n = o.times(400_000)
    x = torch.randn(
        n, DIMENSIONS, generator=torch.Generator().manual_seed(o.seed), dtype=torch.float64
    )
    start = start_components(DataRows(x), COMPONENTS, o.seed, 1e-6)
    first = start.components
    theirs: Any = GaussianMixture(COMPONENTS, reg_covar=1e-6)
    theirs.weights_ = first.weights.numpy()
    theirs.means_ = first.means.numpy()
    theirs.precisions_cholesky_ = torch.linalg.cholesky(torch.linalg.inv(first.covariances)).numpy()

    def ours() -> None:
        maximisation(expectation(DataRows(x), first)[0], n, 1e-6, start.reseeded)

    rows = x.numpy()
    density = abs(theirs._e_step(rows)[0] - float(expectation(DataRows(x), first)[1] / n))
    mine = least_seconds(ours, 3)
    peer = least_seconds(lambda: theirs._m_step(rows, theirs._e_step(rows)[1]), 2, limit=60.0)
    what = (
        f"EM step, {n:,} rows of {DIMENSIONS} numbers, {COMPONENTS} Gaussians, {o.threads} threads"
    )
    told = f"{peer / mine:.1f}x: {mine:.2f} s against {peer:.2f} s; log-likelihoods differ by {density:.0e}"
    return Row(
        what,
        ">= 12x faster than scikit-learn",
        told,
        peer / mine >= 12,
        {"ours": mine, "peer": peer},
    )


def _whole_hand(name: str, o: Options) -> list[Row]:
    """Learn the model of a hand as the command does, and once more by full-batch EM."""
    hand = load_hand(name)
    shipped = load_mixture(name)
    n = o.times(TRAINED)
    samples, drawn = timed(lambda: sample_configurations(hand, n + HELD_OUT, o.seed, 1, "grasping"))
    apart, more = timed(lambda: sample_configurations(hand, APART, o.seed + 1, 1, "grasping"))
    curve, chosen = timed(lambda: growing_bic(apart, 64))
    m = int(curve.components[curve.bic.argmin()])
    new, fitted = timed(lambda: fit_mixture(samples[:n], m, o.seed, starts=STARTS, subset=300 * m))
    full, slow = timed(lambda: fit_mixture(samples[:n], m, o.seed, starts=STARTS))
    held_out = samples[n:].rows()
    ours, batch, before = (float(x.log_prob(held_out).mean()) for x in (new, full, shipped))
    spent = drawn + more + chosen + fitted
    told = f"{spent:.0f} s: {drawn + more:.0f} s of postures, {chosen:.0f} s of BIC, {fitted:.0f} s of fit"
    what = f"{name}: a whole hand, {n:,} postures, {STARTS} starts of {m} Gaussians, the least BIC of 1 to 64 on {APART:,}"
    seconds = {
        "postures": drawn + more,
        "bic": chosen,
        "fit": fitted,
        "full": slow,
        "components": m,
    }
    bar = f"<= {MOST_SECONDS:.0f} s of processor time, three minutes on two cores"
    rows = [Row(what, bar, told, spent <= MOST_SECONDS, seconds)]
    for what, other in (
        (f"the shipped model's, of {len(shipped.weights)} Gaussians", before),
        (f"full-batch EM's, of {STARTS} starts in {slow:.0f} s instead of {fitted:.0f} s", batch),
    ):
        told = f"{ours - other:+.4f} nats: {ours:.4f} beside {other:.4f}"
        bar = f">= -{MOST_LOST} nats"
        title = f"{name}: log-likelihood of {HELD_OUT:,} held-out postures, beside {what}"
        rows.append(
            Row(title, bar, told, ours - other >= -MOST_LOST, {"ours": ours, "other": other})
        )
    return rows
