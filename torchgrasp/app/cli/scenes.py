"""`torchgrasp evaluate --scenes`: grasps among neighbours, in simulation."""

import dataclasses
from pathlib import Path
from typing import Any

from torchgrasp.app.cli.common import naming
from torchgrasp.columns import format_columns, format_line
from torchgrasp.evaluation.intervals import format_share
from torchgrasp.evaluation.scenes import ClutterSpec, SceneScore, evaluate_scenes, scene_record, summarise_scenes
from torchgrasp.files import format_json, hold_folder, write_file
from torchgrasp.hand.hand import Hand

SHARES = {
    "lifted": "target lifted at the first try",
    "planned": "scenes with a grasp",
    "moved": "tries that moved a neighbour by more than 20 mm",
    "toppled": "tries that toppled a neighbour",
    "early": "tries that hit a neighbour or the table before the target",
    "cleared": "objects taken",
    "tables_cleared": "tables cleared",
}
"""The shares of a campaign in clutter, in words."""


def evaluate_clutter(objects: Path | None, hand: Hand, out: Path, scenes: int, spec: ClutterSpec, workers: int) -> int:
    """Run a campaign in clutter; print a line for each scene, then shares; write evaluate.json."""
    scores: list[SceneScore] = []
    with naming(folder="--out", path="--out"), hold_folder(out):
        with naming(objects="--objects", workers="--workers", scenes="--scenes"):
            for score in evaluate_scenes(objects, hand, scenes, spec, workers=workers):
                print_scene(score)
                scores.append(score)
        summary = summarise_scenes(scores)
        print_clutter(summary, spec.clear)
        asked = {"hand": hand.name, "hand_sha256": hand.source.sha256, "scenes": scenes, **dataclasses.asdict(spec)}
        asked["fingers"] = spec.fingers or hand.source.option
        asked["objects"] = "the library's own" if objects is None else str(objects)
        content = {"asked": asked, "summary": summary, "scenes": [scene_record(score) for score in scores]}
        write_file(out / "evaluate.json", format_json(content))
    return 0


def print_scene(score: SceneScore) -> None:
    """Print the line of a scene."""
    tries = ", ".join(f"{one.name} {one.status.name.lower()}" for one in score.tries)
    moved = max((1e3 * one.moved for one in score.tries), default=0.0)
    text = tries or score.reason or score.failure.sentence
    taken = f"{sum(one.lifted for one in score.tries)}/{len(score.names)}"
    print(format_line((score.index, taken, f"{moved:.0f} mm", text), (5, 7, 8, -1)), flush=True)


def print_clutter(summary: dict[str, Any], clear: bool) -> None:
    """Print shares, failures, and cost."""
    names = {key: text for key, text in SHARES.items() if clear or "cleared" not in key}
    rows = [(text, format_share(summary[key], "scenes")) for key, text in names.items()]
    if clear and summary["tries_per_object"] is not None:
        rows.append(("tries for each object taken", f"{summary['tries_per_object']:.2f}"))
    failed = ", ".join(f"{n} {name.lower()}" for name, n in summary["failures"].items())
    rows += [("failed", failed)] if failed else []
    print(f"\n{format_columns(rows, left={0, 1})}")
    print(f"CPU time {summary['plan_cpu_s']:.1f} s to plan on a scene, {summary['trial_cpu_s']:.1f} s for a try")
