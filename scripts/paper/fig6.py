"""Fig. 6 (b, d): the number of Gaussians by the Bayesian information criterion and by
cross-validation.
"""

import json
from pathlib import Path

import torch
from matplotlib.figure import Figure
from tqdm import tqdm

from paper.selection import CrossValidation, bic_curve, cross_validate
from torchgrasp import load_hand
from torchgrasp.files import write_file
from torchgrasp.posture_model.sample import sample_configurations
from torchgrasp.posture_model.score import BicCurve

PUBLISHED = {"allegro": 41, "barrett": 36}
"""The paper's numbers of Gaussians."""
SWEEP = tuple(range(5, 61, 5))
"""Numbers of Gaussians; the paper's figure shows 5 to 60."""
FIT = {"tolerance": 1e-3, "iterations": 100}
"""Of every fit: as `fit_mixture`, but with a third of the steps, since there are hundreds of fits.
"""


def fig6(out: Path, n: int = 40_000, apart: int = 20_000, folds: int = 10, seed: int = 1) -> None:
    """Draw Fig. 6 (b, d): the criterion on n postures and cross-validation on others, for both
    hands.

    The shipped models have the number of least criterion in this range.

    Args:
        out: folder of fig6.png and fig6.json.
        n: postures of the criterion.
        apart: other postures, of the cross-validation.
        folds: of the cross-validation.
        seed: of both draws.
    """
    curves = {}
    for name in PUBLISHED:
        hand = load_hand(name)
        samples = sample_configurations(hand, n, seed, sampling="grasping")
        others = sample_configurations(hand, apart, seed + 1, sampling="grasping")
        with tqdm(total=len(SWEEP) * (folds + 1), desc=name, disable=None, leave=False) as bar:
            curve = bic_curve(samples, SWEEP, tick=bar.update, **FIT)
            crossed = cross_validate(others, SWEEP, folds, tick=bar.update, **FIT)
        print(name, curve, crossed, f"the paper: {PUBLISHED[name]}", sep="\n")
        curves[name] = curve, crossed
    draw_selection(curves, out / "fig6.png")
    numbers = {
        name: {
            "components": list(SWEEP),
            "bic": curve.bic.tolist(),
            "log_likelihood": crossed.log_likelihood.tolist(),
            "error": crossed.error.tolist(),
            "paper": PUBLISHED[name],
        }
        for name, (curve, crossed) in curves.items()
    }
    write_file(out / "fig6.json", json.dumps(numbers, indent=1))


def draw_selection(curves: dict[str, tuple[BicCurve, CrossValidation]], out: Path) -> None:
    """Draw a row for each hand, and write the picture to `out`.

    It has the information criterion, the held-out log-likelihood and the held-out error over the
    number of Gaussians. `curves` has both by the hand's name.
    """
    figure = Figure(figsize=(12, 3.2 * len(curves)), layout="constrained")
    axes = figure.subplots(len(curves), 3, squeeze=False)
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
        paper = PUBLISHED[name]
        least = int(curve.components[curve.bic.argmin()])
        for axis in row:
            axis.axvline(paper, color="grey", lw=0.8, ls="--", label=f"paper: {paper}")
            axis.axvline(least, color="#d62728", lw=0.8, label="least BIC")
            axis.set_xlabel("Gaussians")
            axis.set_title(name)
            axis.grid(alpha=0.3)
        row[0].legend()
    write_file(out, lambda file: figure.savefig(file, format="png", dpi=110))
    print(out)
