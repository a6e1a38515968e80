"""The number of Gaussians: criterion and cross-validation beside Fig. 6 (b, d), with a picture."""

from pathlib import Path

import matplotlib.pyplot as plt
import torch
from tqdm import tqdm

from benchmarks.common import Row
from benchmarks.hand.mixture import COMPONENTS, draw
from benchmarks.hand.model_selection import BicCurve, CrossValidation, bic_curve, cross_validate

SWEEP = tuple(range(5, 61, 5))
"""Numbers of Gaussians; the paper's figure shows 5 to 60."""
FIT = {"tolerance": 1e-3, "iterations": 100}
"""Of every fit: as `fit_mixture`, but with a third of the steps, since there are hundreds of fits."""


def bench_bic(n: int, folds: int, out: Path) -> list[Row]:
    """Sweep the criterion on n postures and cross-validate on a quarter as many others; draw both.

    Args:
        n: postures of the sweep.
        folds: of the cross-validation.
        out: the picture.
    """
    rows, curves = [], {}
    for name, paper in COMPONENTS.items():
        samples = draw(name, n + n // 4)
        numbers = sorted({10, 20, 30, paper, 50, 60})
        with tqdm(total=len(SWEEP) + len(numbers) * folds, desc=name, disable=None, leave=False) as bar:
            curve = bic_curve(samples[:n], SWEEP, observer=lambda m, mixture: bar.update() and None, **FIT)
            crossed = cross_validate(samples[n:], numbers, folds, observer=lambda m, fold: bar.update() and None, **FIT)
        print(name, curve, crossed, sep="\n")
        curves[name] = curve, crossed
        rows.append(_row(name, paper, n, curve, crossed))
    draw_selection(curves, out)
    return rows


def _row(name: str, paper: int, n: int, curve: BicCurve, crossed: CrossValidation) -> Row:
    """Return where the criterion, the likelihood and the error are least."""
    least = int(curve.components[curve.bic.argmin()])
    likeliest = int(crossed.components[crossed.log_likelihood.mean(1).argmax()])
    truest = int(crossed.components[crossed.error.mean(1).argmin()])
    at = crossed.components.tolist().index(paper)
    falling = bool((curve.bic.diff() < 0).all())
    return Row(
        f"{name}: number of Gaussians, {n} postures; {crossed.error.shape[1]}-fold cross-validation on {n // 4} others",
        f"the paper takes {paper}",
        f"BIC {'falls all the way to' if falling else 'is least at'} {least}; held-out likelihood is largest at "
        f"{likeliest}, the error is least at {truest}: {float(crossed.error.mean(1).min()):.4f} rad against "
        f"{float(crossed.error[at].mean()):.4f} at {paper}",
        None,
        {
            "components": curve.components.tolist(),
            "bic": curve.bic.tolist(),
            "cross_components": crossed.components.tolist(),
            "cross_log_likelihood": crossed.log_likelihood.tolist(),
            "cross_error": crossed.error.tolist(),
        },
    )


def draw_selection(curves: dict[str, tuple[BicCurve, CrossValidation]], out: Path) -> None:
    """Draw a row for each hand: the criterion, the held-out log-likelihood, the held-out error."""
    figure, axes = plt.subplots(len(curves), 3, figsize=(12, 3.2 * len(curves)), squeeze=False, layout="constrained")
    for (name, (curve, crossed)), row in zip(curves.items(), axes, strict=True):
        row[0].plot(curve.components, curve.bic / 1e6, "o-", ms=3)
        row[0].set_ylabel("BIC [10^6]")
        for axis, values, label in (
            (row[1], crossed.log_likelihood, "held-out log-likelihood [nats]"),
            (row[2], crossed.error, "held-out mean absolute error [rad]"),
        ):
            error = values.std(1) / torch.tensor(values.shape[1]).sqrt()
            axis.errorbar(crossed.components, values.mean(1), error, fmt="o-", ms=3, capsize=2)
            axis.set_ylabel(label)
        for axis in row:
            axis.axvline(COMPONENTS[name], color="grey", lw=0.8, ls="--", label=f"paper: {COMPONENTS[name]}")
            axis.set_xlabel("Gaussians")
            axis.set_title(name)
            axis.grid(alpha=0.3)
        row[0].legend()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=110)
    plt.close(figure)
