"""`torchgrasp grasp` on a scene: the thing that was asked for, or the easiest."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

from torchgrasp.app.cli.common import holding, naming
from torchgrasp.app.cli.progress import Progress
from torchgrasp.app.cli.results import write_results
from torchgrasp.app.report.page import GRASP_COLUMNS, grasp_rows
from torchgrasp.app.report.run import Run, verdict
from torchgrasp.errors import Status
from torchgrasp.files import format_columns, format_line
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.hand_toml import Fingers
from torchgrasp.hand.load import hand_of
from torchgrasp.planner.explain import explain_empty
from torchgrasp.planner.grasps import plan_grasps
from torchgrasp.planner.problem import take_target
from torchgrasp.planner.scene import ThingPlan, plan_scene
from torchgrasp.scene.scene import read_scene
from torchgrasp.shape.surface import extract_surface
from torchgrasp.specs import ContactSpec

ENOUGH = 0.9
"""Predicted success from which on a thing is easy enough: the others are not tried."""


class Wanted(NamedTuple):
    """What is planned for in a scene; see `plan_scene`."""

    hand: Hand
    spec: ContactSpec
    starts: int
    seed: int
    fingers: Fingers | None


def grasp_scene(
    path: Path, wanted: Wanted, choice: int | tuple[float, float] | None, out: Path, no_report: bool = False
) -> int:
    """Plan grasps of a thing of a scene, and write them with a report.

    Args:
        path: of the scene.
        wanted: what is planned for.
        choice: label of the thing, or column and row of a pixel on it; None: the easiest thing.
        out: folder to write.
        no_report: write the grasps alone.
    """
    hand, spec, starts, seed, fingers = wanted
    names = {name: f"CLOUD: {name}" for name in ("depth", "intrinsics", "mask", "labels", "camera_pose", "table")}
    with naming(path="CLOUD", points="CLOUD", target="--label", point="--point", **names):
        scene = read_scene(path)
        scene = scene if choice is None else scene.select(choice)
    explanation = None
    progress = Progress(
        "scene", *["fingers"] * (fingers == "auto"), "shape", "plan", "certify", "query", "refine", "report"
    )
    with progress.bar, holding("--out", out):
        progress.end("scene", f"{len(scene.things)} things, labels {', '.join(map(str, scene.things))}")
        for sentence in scene.advice:
            print(f"advice  {sentence}")
        if scene.target is None:
            plan = plan_scene(scene, hand, spec, starts, seed, fingers=fingers, enough=ENOUGH)
            print_things(plan.things)
            progress.end("things", f"{sum(thing.grasps is not None for thing in plan.things)} with a grasp")
            if plan.best is None or plan.best.grasps is None or plan.best.shape is None:
                print(f"The {hand.name} hand has no executable grasp of any thing of the scene.")
                print("With --label or --point, what would help most is tried for one of them.")
                return 1
            scene = dataclasses.replace(scene, target=plan.best.label)
            grasps, shape = plan.best.grasps, plan.best.shape
        else:
            grasps = plan_grasps(scene, hand, spec, starts, seed, fingers=fingers, observer=progress.end)
            shape = progress.values["shape"]
            if not bool((grasps.status == Status.OK).any()):
                explanation = explain_empty(scene, hand, spec, starts, seed, fingers=fingers, observer=progress.end)
        spec, hand = dataclasses.replace(spec, table=scene.table), hand_of(grasps, hand)
        cloud, name = take_target(scene, seed), f"thing with label {scene.target}"
        run = Run(
            name, path, cloud, hand, spec, extract_surface(shape), grasps, tuple(progress.stages),
            progress.values.get("plan"), scene=scene, explanation=explanation,
        )  # fmt: skip
        with naming(path="--out"):
            progress.end("report", write_results(out, run, no_report))
    if len(run.executable):
        print(f"\n{format_columns([GRASP_COLUMNS, *grasp_rows(run.executable, 5)])}\n")
    print(verdict(run))
    return 0 if len(run.executable) else 1


def print_things(things: tuple[ThingPlan, ...]) -> None:
    """Print a line for each thing: its label, the predicted success of its best grasp, or why there is none."""
    for thing in things:
        text = thing.reason or f"{0 if thing.grasps is None else len(thing.grasps)} executable grasps"
        print(format_line((f"thing {thing.label}", f"{thing.success:.0%}", text), (-10, 5, -1)), flush=True)
