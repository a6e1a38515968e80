"""Commands as processes of their own: killed at random moments, or left by a worker that dies or
never answers.

20 kills of each command at its real work run with `--hypothesis-profile=long`.
"""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.campaign.cheap import contents
from tests.hostile.faults.commands import POSE
from tests.make import start_process
from torchgrasp.data.shipped import DATA

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")

REAL = """
import time
time.perf_counter = time.process_time = lambda: 0.0  # pages tell how long the work took
import torchgrasp.posture_model.dataset, torchgrasp.posture_model.sample
torchgrasp.posture_model.dataset.CHUNK_POSTURES = torchgrasp.posture_model.sample.CHUNK_POSTURES = 300

if __name__ == "__main__":
    from torchgrasp.app import cli
    cli.run_and_exit()
"""
"""The command line, whose clocks stand still and whose chunks are small; workers import it, too."""

STUB = """
import dataclasses, os, signal, time
from torchgrasp.foundation.errors import Status
from torchgrasp.evaluation import sweep as campaign
from torchgrasp.evaluation.summary import ProtocolResult

def plan(view, shelf, friction, spec):
    return dataclasses.replace(view.score, executable=2)

def attempt(view, shelf, protocol, spec, row, draw):
    if (view.view, row) == ("left", 0):
        mark = view.objects / f"{os.getpid()}.new"
        mark.write_text(str(os.getpid()))
        mark.rename(mark.with_suffix(".worker"))
        if len(list(view.objects.glob("*.worker"))) == 1:
            time.sleep(3600)
    if (view.view, row) == ("left", 1):
        os.kill(os.getpid(), signal.SIGKILL)
    while (view.view, row) == ("right", 1):
        pass
    return ProtocolResult(row, draw, True, Status.OK)

campaign._plan, campaign._try, campaign.TRIAL_LIMIT = plan, attempt, 0.5

if __name__ == "__main__":
    from torchgrasp.app import cli
    from torchgrasp.app.cli import evaluate
    evaluate.import_simulator = lambda name: None
    cli.run_and_exit()
"""
"""`evaluate` without planning and simulation; here is what its workers do.

The worker of the first grasp of "left" waits to be killed. The second grasp of "left" kills its
worker. The second grasp of "right" works for ever.
"""


def objects(folder: Path, *views: str, workers: str = "2") -> list[str]:
    """Make a folder of one object; return the words that evaluate it."""
    (folder / "cup").mkdir(parents=True)
    shutil.copy(DATA / "cylinder" / "mesh.ply", folder / "cup" / "mesh.ply")
    for view in views:
        shutil.copy(DATA / "cylinder" / "view.ply", folder / "cup" / f"{view}_noisy.ply")
    entry = {"views": {view: {"T_object_camera": POSE} for view in views}}
    (folder / "manifest.json").write_text(json.dumps({"objects": {"cup": entry}}))
    return [
        "evaluate",
        "--objects",
        str(folder),
        "--hand",
        "barrett",
        "--workers",
        workers,
        "--out",
    ]


def words(name: str, folder: Path) -> list[str]:
    """Return the words of a command but for its output."""
    if name == "evaluate":
        return [
            *objects(folder / "objects", "left", "right")[:-1],
            "--grasps",
            "2",
            "--starts",
            "5",
            "--out",
        ]
    if name == "campaign":
        place = objects(folder / "objects", "front", "left", "right")[2]
        sizes = ["--grasps", "1", "--starts", "5", "--jobs-in-shard", "2", "--workers", "2"]
        return [
            "campaign",
            place,
            "--hand",
            "barrett",
            "--protocol",
            "dexgraspbench",
            *sizes,
            "--out",
        ]
    return {
        "grasp": [
            "grasp",
            str(DATA / "cylinder" / "view.ply"),
            "--hand",
            "barrett",
            "--starts",
            "8",
            "--out",
        ],
        "sample": ["hand", "sample", "--hand", "barrett", "--n", "1500", "--workers", "2", "--out"],
        "train": [
            "hand",
            "train",
            "barrett",
            "--n",
            "2000",
            "--held-out",
            "100",
            "--components",
            "3",
            "--out",
        ],
    }[name]


def start(script: str, folder: Path, given: list[str]) -> subprocess.Popen[str]:
    (folder / "script.py").write_text(script)
    own = {"OMP_NUM_THREADS": "1", "XDG_CACHE_HOME": str(folder / "cache")}
    command = [sys.executable, str(folder / "script.py"), *given]
    return start_process(command, stdout=subprocess.PIPE, env=os.environ | own)


def descendants(pid: int) -> list[int]:
    """Return the processes below one."""
    children: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            children.setdefault(int(stat.read_text().rpartition(")")[2].split()[1]), []).append(
                int(stat.parent.name)
            )
        except OSError:  # it has just ended
            continue
    found = [pid]
    for one in found:
        found += children.get(one, [])
    return found[1:]


def gone(processes: list[int]) -> bool:
    """Wait until none of them is left; one that stays ends the test by its time."""
    while any(Path(f"/proc/{one}").exists() for one in processes):
        time.sleep(0.05)
    return True


@pytest.mark.promise("F1")
@pytest.mark.parametrize(
    "name",
    [
        "sample",
        "grasp",
        "train",
        *(pytest.param(name, marks=pytest.mark.sim) for name in ("evaluate", "campaign")),
    ],
)
def test_a_process_killed_at_random_moments_is_continued_to_the_same_bytes(
    name: str, tmp_path: Path, request: pytest.FixtureRequest
):
    if request.config.getoption("--hypothesis-profile") != "long":
        pytest.skip("takes minutes")
    given = words(name, tmp_path)
    draw = random.Random(name)

    def command(out: Path) -> list[str]:
        model = name == "train"
        extra = ["--checkpoint", str(out / "step.safetensors")] if model else []
        return [*given, str(out / "model.safetensors" if model else out), *extra]

    began = time.monotonic()
    first = start(REAL, tmp_path, command(tmp_path / "whole"))
    said = first.communicate()
    assert first.returncode == 0, said
    lasts = time.monotonic() - began
    whole = contents(tmp_path / "whole")
    killed = attempts = 0
    while killed < 20:
        out = tmp_path / f"out{attempts}"
        for _ in range(5):  # it is continued, and killed again
            run = start(REAL, tmp_path, command(out))
            time.sleep(draw.uniform(0.2, 1.0) * lasts)
            below = descendants(run.pid)
            run.kill()
            run.communicate()
            killed += run.returncode == -signal.SIGKILL
            assert gone(below)
        run = start(REAL, tmp_path, command(out))
        said = run.communicate()
        assert run.returncode == 0, said
        assert contents(out) == whole
        attempts += 1
    print(f"{name}: {killed} kills, {lasts:.1f} s undisturbed")


@pytest.mark.promise("F4", "F5")
def test_a_worker_that_is_lost_costs_its_own_row_and_the_row_says_so(tmp_path: Path):
    pytest.importorskip("pebble")
    run = start(
        STUB,
        tmp_path,
        [*objects(tmp_path / "objects", "left", "right", workers="1"), str(tmp_path / "out")],
    )
    worker = None
    while worker is None and run.poll() is None:
        worker = next((tmp_path / "objects").glob("*.worker"), None)
        time.sleep(0.05)
    assert worker is not None
    os.kill(int(worker.read_text()), signal.SIGKILL)
    said = run.communicate()
    assert run.returncode == 0, said
    views = json.loads((tmp_path / "out" / "evaluate.json").read_text())["views"]
    found = {
        (view["view"], row["rank"]): row["status"] for view in views for row in view["attempts"]
    }
    # A death from outside is forgiven.
    assert found == {
        ("left", 0): "OK",
        ("left", 1): "WORKER_DIED",
        ("right", 0): "OK",
        ("right", 1): "TIMED_OUT",
    }


@pytest.mark.promise("F6")
def test_no_worker_outlives_an_evaluation_that_is_killed(tmp_path: Path):
    pytest.importorskip("pebble")
    run = start(
        STUB, tmp_path, [*objects(tmp_path / "objects", "left", "right"), str(tmp_path / "out")]
    )
    while run.poll() is None and not list((tmp_path / "objects").glob("*.worker")):
        time.sleep(0.05)
    below = descendants(run.pid)
    assert len(below) >= 2
    run.kill()
    run.communicate()
    assert run.returncode == -signal.SIGKILL and gone(below)
