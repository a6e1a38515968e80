"""Fit the model of predicted success, and show its calibration.

Grasps of all ranks are planned on noisy views and pulled: closed in open loop and under uncertainty, at two frictions,
with and without an error of the pose. The model is fitted to all trials. Each object is judged by a fit without it.
"""

from pathlib import Path

import torch
from benchmarks.close.success import TESTS, brier, draw_reliability, fit, judge, leave_one_out, read_trials

from torchgrasp.files import format_json, write_file
from torchgrasp.ik.ranking import FEATURES, MODEL


def success(
    objects: tuple[Path, ...] = (),
    hands: tuple[str, ...] = ("allegro",),
    grasps: int = 12,
    workers: int = 1,
    folder: Path = Path("out/success"),
    model: Path = MODEL,
) -> None:
    """Run the missing trials, fit the model of predicted success, judge it and write it.

    Args:
        objects: folders of objects, beside the library's own and simple bodies.
        hands: names of hands.
        grasps: grasps of each view, spread over all ranks.
        workers: processes.
        folder: where grasps, trials and the reliability diagram go; trials found there are not run again.
        model: file of the model.
    """
    torch.set_num_threads(1)
    trials = read_trials(objects, hands, grasps, workers, folder)
    unseen, base = leave_one_out(trials)
    print(*judge(unseen, base, trials), sep="\n")
    draw_reliability(folder / "reliability.png", unseen, trials)
    weights, bias = fit(trials)
    bodies, share = len(set(trials.object)), trials.passed.mean()
    content = {
        "weights": dict(zip(FEATURES, weights, strict=True)),
        "bias": bias,
        "fitted_on": f"{len(trials.passed)} trials of {bodies} objects with {', '.join(hands)}, {share:.0%} passed",
        "trial": "torchgrasp.evaluation.pull with 7 N: " + "; ".join(f"{name}, {closing}" for name, closing in TESTS),
        "brier_on_objects_not_fitted_on": round(brier(unseen, trials.passed), 4),
        "brier_of_the_base_rates": round(brier(base, trials.passed), 4),
    }
    print(write_file(model, format_json(content) + "\n"))
