"""Fit the model of predicted success, and show its calibration.

Grasps of all ranks are planned on noisy views of authored bodies and pulled: closed in open loop and under uncertainty,
at two frictions, with and without an error of the pose. The model is fitted to all trials. Each body is judged by a fit
without it. No scanned object is ever seen, so that the ranking of any may be reported.
"""

from pathlib import Path

import torch
from benchmarks.close.success import TESTS, brier, draw_reliability, fit, judge, leave_one_out, read_trials

from torchgrasp.files import format_json, write_file
from torchgrasp.ik.ranking import FEATURES, MODEL
from train.bodies import author_folder


def success(
    hands: tuple[str, ...] = ("allegro",),
    grasps: int = 5,
    workers: int = 1,
    folder: Path = Path("out/success"),
    model: Path = MODEL,
) -> None:
    """Run the missing trials, fit the model of predicted success, judge it and write it.

    Args:
        hands: names of hands.
        grasps: grasps of each body, spread over all ranks.
        workers: processes.
        folder: where bodies, grasps, trials and the reliability diagram go; trials found there are not run again.
        model: file of the model.
    """
    torch.set_num_threads(1)
    author_folder(folder / "authored")
    trials = read_trials(folder / "authored", hands, grasps, workers, folder)
    unseen, base = leave_one_out(trials)
    print(*judge(unseen, base, trials), sep="\n")
    draw_reliability(folder / "reliability.png", unseen, trials)
    weights, bias = fit(trials)
    bodies, passed = len(set(trials.object)), trials.passed.mean()
    fitted_on = f"{len(trials.passed)} trials of {bodies} authored bodies with {', '.join(hands)}, {passed:.0%} passed"
    content = {
        "weights": dict(zip(FEATURES, weights, strict=True)),
        "bias": bias,
        "fitted_on": fitted_on,
        "trial": "torchgrasp.evaluation.pull with 7 N: " + "; ".join(f"{name}, {closing}" for name, closing in TESTS),
        "brier_on_bodies_not_fitted_on": round(brier(unseen, trials.passed), 4),
        "brier_of_the_base_rates": round(brier(base, trials.passed), 4),
    }
    print(write_file(model, format_json(content) + "\n"))
