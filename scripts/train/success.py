"""Fit the model of predicted success, and show its calibration.

Grasps of all ranks are planned on noisy views of authored bodies, pulled and lifted: closed in open loop and under
uncertainty, at three frictions, with and without an error of the pose. One model is fitted to all trials, with a bias
for each hand and one for errors of the pose. Each kind of body is judged by a fit without it. No scanned object is
seen. The shipped weight of the load's force comes from lifts of scanned objects instead: see the model's file.
"""

import json
from pathlib import Path

import torch
from benchmarks.close.success import TESTS, describe, draw_reliability, fit, judge, leave_one_out, read_trials

from torchgrasp.files import format_json, write_file
from torchgrasp.ik.ranking import FEATURES, MODEL
from train.bodies import author_folder


def success(
    hands: tuple[str, ...] = ("allegro", "barrett"),
    grasps: int = 5,
    workers: int | None = 1,
    folder: Path = Path("out/success"),
    model: Path = MODEL,
) -> None:
    """Run the missing trials, fit the model of predicted success, judge it and write it.

    Args:
        hands: names of hands.
        grasps: grasps of each body, spread over all ranks.
        workers: processes; None: nothing is run, the trials that are there are fitted anew, as after a change of the
            shape.
        folder: where bodies, grasps, trials and the reliability diagram go; trials found there are not run again.
        model: file of the model.
    """
    torch.set_num_threads(1)
    author_folder(folder / "authored")
    trials = read_trials(folder / "authored", hands, grasps, workers, folder)
    unseen = leave_one_out(trials)
    print(*judge(unseen, trials), sep="\n")
    draw_reliability(folder / "reliability.png", unseen, trials)
    fitted, said = fit(trials), describe(unseen, trials)
    bodies, passed = len(set(trials.object)), trials.passed.mean()
    content = {
        "weights": dict(zip(FEATURES, fitted.weights.tolist(), strict=True)),
        "bias": fitted.bias,
        "pose_error": fitted.pose_error,
        **{key: json.loads(model.read_text("utf-8"))[key] for key in ("range", "range_from")},  # not fitted here
        "fitted_on": f"{len(trials.passed)} trials of {bodies} authored bodies, {passed:.0%} passed",
        "trial": "torchgrasp.evaluation.pull: " + "; ".join(", ".join(test) for test in TESTS),
        "on_kinds_of_bodies_left_out": {name: round(said[name], 4) for name in ("brier", "skill", "auc", "error")},
    }
    print(write_file(model, format_json(content) + "\n"))
