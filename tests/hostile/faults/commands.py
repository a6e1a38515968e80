"""The commands that write, on little work: what is slow in them is done once, before any fault, and
repeated.
"""

import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.campaign.cheap import records
from torchgrasp import load_grasps, load_hand, load_object, plan_grasps
from torchgrasp.app.cli import evaluate as evaluate_command
from torchgrasp.app.cli import grasp as grasp_command
from torchgrasp.app.cli import hands as hand_commands
from torchgrasp.app.cli import results
from torchgrasp.app.report import page
from torchgrasp.data.shards import JobRow, Shard, pack_shard
from torchgrasp.data.shipped import DATA
from torchgrasp.evaluation import sweep as campaign
from torchgrasp.evaluation.protocols import Protocol
from torchgrasp.evaluation.summary import ProtocolResult, ViewScore
from torchgrasp.evaluation.views import EvaluationSpec, ObjectView
from torchgrasp.foundation.errors import Status
from torchgrasp.shape.surface import extract_surface
from torchgrasp.values.specs import ContactSpec

POSE = [[1.0, 0.0, 0.0, 0.4], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]]

Command = Callable[[Path], list[str]]
"""The words of a command that writes below a folder."""


def sample(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Command:
    """Three chunks of postures."""
    monkeypatch.setattr("torchgrasp.posture_model.sample.CHUNK_POSTURES", 40)
    monkeypatch.setattr("torchgrasp.posture_model.dataset.CHUNK_POSTURES", 40)
    return lambda out: [
        "hand",
        "sample",
        "--hand",
        "barrett",
        "--n",
        "100",
        "--out",
        str(out / "samples"),
    ]


def train(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Command:
    """A mixture of one Gaussian, with a checkpoint after every step."""
    monkeypatch.setattr(hand_commands, "check_hand", load_hand)
    words = ["hand", "train", "barrett", "--n", "100", "--held-out", "20", "--components", "1"]
    return lambda out: [
        *words,
        *("--checkpoint", str(out / "step.safetensors")),
        *("--out", str(out / "model.safetensors")),
    ]


@functools.cache
def planned() -> tuple[Any, list[tuple[Any, ...]]]:
    """Grasps of the shipped cylinder, and what an observer of the planning was told."""
    told: list[tuple[Any, ...]] = []
    hand = load_hand("barrett")
    view = load_object("cylinder").view
    grasps = plan_grasps(view, hand, ContactSpec(table=0.0), 8, observer=lambda *x: told.append(x))
    return grasps, told


def grasp(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Command:
    """Grasps and a report without pictures."""
    grasps, told = planned()

    def repeat(*_: Any, observer: Callable[..., object], **__: Any) -> Any:
        for one in told:
            observer(*one)
        return grasps

    monkeypatch.setattr(grasp_command, "plan_grasps", repeat)
    surface = extract_surface(
        next(value for stage, _, value in told if stage == "shape"), resolution=16
    )
    monkeypatch.setattr(results, "extract_surface", lambda shape: surface)
    monkeypatch.setattr(page, "draw_pictures", lambda run: {})
    view = str(DATA / "cylinder" / "view.ply")
    return lambda out: [
        "grasp",
        view,
        "--hand",
        "barrett",
        "--starts",
        "8",
        "--out",
        str(out / "grasps"),
    ]


def evaluate(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Command:
    """A campaign on two views, whose trials read the grasps that were kept; nothing is simulated."""
    grasps = planned()[0]
    views = {name: {"T_object_camera": POSE} for name in ("left", "right")}
    (folder / "manifest.json").write_text(json.dumps({"objects": {"cup": {"views": views}}}))

    def plan(view: Any, shelf: Path, friction: float, spec: EvaluationSpec) -> ViewScore:
        grasps.save(view.file(shelf))
        return dataclasses.replace(view.score, executable=len(grasps))

    def try_grasp(
        view: Any, shelf: Path, protocol: Any, spec: EvaluationSpec, row: int, draw: int
    ) -> ProtocolResult:
        score = float(load_grasps(view.file(shelf))[row].score[0])
        return ProtocolResult(row, draw, True, Status.OK, 0.0, 0.0, score, 0.0, 0.0)

    monkeypatch.setattr(evaluate_command, "import_simulator", lambda name: None)
    monkeypatch.setattr(campaign, "_plan", plan)
    monkeypatch.setattr(campaign, "_try", try_grasp)
    words = [
        "evaluate",
        "--objects",
        str(folder),
        "--hand",
        "barrett",
        "--grasps",
        "2",
        "--workers",
        "0",
    ]
    return lambda out: [*words, "--out", str(out / "evaluation")]


def gather(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Command:
    """A campaign of two shards, one job of which is refused; nothing is planned or simulated."""
    views = {name: {"T_object_camera": POSE} for name in ("left", "right")}
    objects = {"cup": {"views": views}, "jug": {"views": {"front": views["left"]}}, "loose": 5}
    (folder / "manifest.json").write_text(json.dumps({"objects": objects}))

    def work(
        view: ObjectView,
        protocol: Protocol,
        spec: EvaluationSpec,
        meta: dict[str, str],
        *plan: object,
    ) -> bytes:
        found = records(torch.Generator().manual_seed(len(view.view)), 4, 2, protocol.noise.draws)
        row = JobRow(
            view.object, view.view, executable=2, points=4, grasps=2, passed=int(found.passed.sum())
        )
        return pack_shard(Shard((row,), found), meta)

    monkeypatch.setattr("torchgrasp.campaign.campaign.run_job", work)
    monkeypatch.setattr(evaluate_command, "import_simulator", lambda name: None)
    words = ["campaign", str(folder), "--hand", "barrett", "--jobs-in-shard", "2", "--workers", "0"]
    return lambda out: [
        *words,
        "--out",
        str(out / "campaign"),
        "--parquet",
        str(out / "campaign" / "parquet"),
    ]


COMMANDS = {
    "sample": sample,
    "train": train,
    "grasp": grasp,
    "evaluate": evaluate,
    "campaign": gather,
}
