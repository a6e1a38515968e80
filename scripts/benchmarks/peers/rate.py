"""Our planner beside others: CPU seconds for each grasp that passes the same checks, and how many
hold in the same trial.

Each planner is a process of one thread on one core, started by an adapter in `adapters/` with the
Python that `--peers NAME=PYTHON` names. The checks are those of `judge`. The trial is protocol
"dexgraspbench" in MuJoCo: the hand closes on the floating object without feedback, and 1 N pulls at
0.1 kg in six directions. Nothing of another planner is in this repository.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh

from benchmarks.common import ROOT, Options, Row, bench
from benchmarks.ground_truth import read_views
from benchmarks.peers.judge import judge, read_answer
from torchgrasp import PointCloud, load_object
from torchgrasp.evaluation.protocols import PROTOCOLS, seed_of
from torchgrasp.evaluation.pull import run_protocol
from torchgrasp.evaluation.trial import GraspTrial, Truth
from torchgrasp.evaluation.views import choose_rows
from torchgrasp.files import write_file
from torchgrasp.foundation.errors import GraspError
from torchgrasp.sim.convex_parts import convex_parts

ADAPTERS = Path(__file__).parent / "adapters"
PROTOCOL = PROTOCOLS["dexgraspbench"].with_trial(simulator="mujoco")
SECONDS = 60
"""CPU seconds of a search on each object, times --scale, for planners that search until stopped."""
PATIENCE = 600.0
"""Seconds [s] after which a planner is stopped, beyond ten times those of its search."""
SHIPPED = ("cylinder", "jug")
"""The library's own objects that are measured, beside those of --objects."""


class Peer(NamedTuple):
    """A planner: its adapter, what it is, and how to install it (empty: nothing to install)."""

    adapter: str
    what: str
    install: str = ""


PEERS = {
    "torchgrasp": Peer("run_torchgrasp.py", "torchgrasp, one noisy view"),
    "torchgrasp-whole": Peer("run_torchgrasp_whole.py", "torchgrasp, whole surface"),
    "min-weight": Peer("run_min_weight.py", "min-weight baseline (ours, after FRoGGeR's paper)"),
    "gpis": Peer("run_gpis.py", "GPIS baseline (ours, after SpringGrasp's paper)"),
    "frogger": Peer(
        "run_frogger.py",
        "FRoGGeR",
        "clone github.com/alberthli/frogger, pip install -e it in an environment of its own; "
        "the `frogger` of the package index is another program",
    ),
    "vnb-grasp": Peer(
        "run_vnb_grasp.py",
        "vnb-grasp, quick experiment",
        "clone github.com/coenwerem/vnb-grasp, pip install -e it in an environment of its own",
    ),
    "springgrasp": Peer(
        "",
        "SpringGrasp",
        "clone github.com/Stanford-TML/SpringGrasp_release; it writes no joint angles in the "
        "released form and has no licence, so give an adapter of your own",
    ),
}
"""Planners by the names that --peers takes."""


class Thing(NamedTuple):
    """An object: its true mesh [m], convex parts, and one noisy view [m]."""

    name: str
    mesh: trimesh.Trimesh
    parts: Sequence[trimesh.Trimesh]
    view: PointCloud


class Found(NamedTuple):
    """What a planner did on one object.

    `counts` are the numbers of grasps by status, `held` and `tried` those of the trials. `failure`
    says why there is no answer.
    """

    object: str
    seconds: float = 0.0
    starts: int = 0
    passed: int = 0
    counts: dict[str, int] = {}  # noqa: RUF012
    held: int = 0
    tried: int = 0
    about: str = ""
    told: str = ""
    failure: str = ""


@bench("peers/rate")
def rate(o: Options) -> list[Row]:
    """Run each planner on each object, judge its grasps, and try some of those that pass."""
    commands = read_commands(o.peers)
    things = list_things(o)
    rows = list[Row]()
    for name, peer in PEERS.items():
        if name not in commands:
            rows.append(missing_row(peer))
            continue
        python, adapter = commands[name]
        found = list[Found]()
        for thing in things:
            found.append(run_peer(python, adapter, thing, o))
            print(name, found[-1], flush=True)
            if found[-1].told or found[-1].failure:
                break  # it does not depend on the object, or would fail again
        rows.append(row_of(peer.what, found))
    return rows


def read_commands(given: Sequence[str]) -> dict[str, tuple[str, Path]]:
    """Return Python and adapter by name of planner: those that need nothing, and those given as
    NAME=PYTHON or NAME=PYTHON:ADAPTER.
    """
    own = [name for name, peer in PEERS.items() if not peer.install]
    found = {name: (sys.executable, ADAPTERS / PEERS[name].adapter) for name in own}
    for text in given:
        name, _, command = text.partition("=")
        python, _, adapter = command.partition(":")
        if name not in PEERS or not python:
            raise SystemExit(
                f"peers: {text!r} is not NAME=PYTHON with NAME one of {', '.join(PEERS)}"
            )
        script = Path(adapter) if adapter else ADAPTERS / PEERS[name].adapter
        for path in (Path(python), script):
            if not path.is_file():
                raise SystemExit(f"peers: {text!r} names {path}, which is no file")
        found[name] = python, script
    return found


def missing_row(peer: Peer) -> Row:
    """Return the row of a planner that is not installed."""
    return Row(peer.what, "-", f"not installed: {peer.install}")


def list_things(o: Options) -> list[Thing]:
    """Return the shipped objects and the first view of each object in the folders."""
    things = list[Thing]()
    for name in SHIPPED:
        if not o.names or name in o.names:
            own = load_object(name)
            things.append(Thing(name, own.mesh, own.parts, own.view))
    for folder in o.objects:
        seen = set[str]()
        for name, _, view, mesh in read_views(folder, views=o.views):
            if name not in seen and (not o.names or name in o.names):
                seen.add(name)
                things.append(Thing(name, mesh, convex_parts(mesh), view))
    return things


def run_peer(python: str, adapter: Path, thing: Thing, o: Options) -> Found:
    """Return what a planner does on an object: its process, the verdict, and trials."""
    friction = PROTOCOL.trial.friction
    with tempfile.TemporaryDirectory() as folder:
        task = write_task(Path(folder), thing, friction, o)
        text, failure = call(python, adapter, task, PATIENCE + 10 * o.times(SECONDS))
        if failure:
            return Found(thing.name, failure=failure)
        answered = Path(folder) / "answer.json"
        write_file(answered, text)
        try:
            answer = read_answer(answered)
        except GraspError as error:
            return Found(thing.name, failure=" ".join(str(error).split()))
    if answer.told:
        return Found(thing.name, told=answer.told, about=answer.versions)
    good, counts = judge(answer, thing.mesh, friction)
    held = 0
    chosen = choose_rows(len(good), o.grasps, "spread")
    for rank in chosen:
        seed = seed_of(o.seed, thing.name, rank)
        trial = GraspTrial(answer.hand, good[rank], Truth(thing.mesh, thing.parts), seed)
        held += run_protocol(trial, PROTOCOL, rank).passed
    about = f"sees the {answer.sees}; {answer.settings}; {answer.versions}"
    return Found(
        thing.name, answer.seconds, answer.tried, len(good), counts, held, len(chosen), about
    )


def write_task(folder: Path, thing: Thing, friction: float, o: Options) -> Path:
    """Write the files of a task (see `adapters/messages.py`), and return the path of the task."""
    thing.mesh.export(folder / "mesh.ply")
    np.savetxt(folder / "view.txt", thing.view.points.numpy())
    camera = thing.view.viewpoint
    task: dict[str, Any] = {
        "mesh": str(folder / "mesh.ply"),
        "view": str(folder / "view.txt"),
        "camera": None if camera is None else camera.reshape(-1, 3)[0].tolist(),
        "friction": friction,
        "seconds": o.times(SECONDS),
        "starts": o.starts,
        "seed": o.seed,
    }
    write_file(folder / "task.json", json.dumps(task))
    return folder / "task.json"


def call(python: str, adapter: Path, task: Path, patience: float) -> tuple[str, str]:
    """Return the last line that an adapter prints, and else why there is none.

    The process has one thread, on one core where the system can bind it.
    """
    threads = ("OMP", "OPENBLAS", "MKL", "NUMEXPR", "NUMBA", "VECLIB_MAXIMUM")
    environment = os.environ | {f"{name}_NUM_THREADS": "1" for name in threads}
    environment.pop("PYTHONPATH", None)
    if python == sys.executable:
        environment["PYTHONPATH"] = str(ROOT)
    command = [python, str(adapter), str(task)]
    process = subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(process.pid, {max(os.sched_getaffinity(0))})
    try:
        out, errors = process.communicate(timeout=patience)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return "", f"stopped after {patience:.0f} s"
    lines = out.strip().splitlines()
    if process.returncode or not lines:
        last = (errors.strip().splitlines() or ["it printed nothing"])[-1]
        return "", f"failed: {last[:200]}"
    return lines[-1], ""


def row_of(what: str, found: Sequence[Found]) -> Row:
    """Return the row of a planner, over all objects."""
    numbers = {"objects": [x._asdict() for x in found]}
    for one in found:
        if one.told or one.failure:
            text = f"{one.told} ({one.about})" if one.told else one.failure
            return Row(what, "-", text, None, numbers)
    seconds = sum(x.seconds for x in found)
    passed = sum(x.passed for x in found)
    held = sum(x.held for x in found)
    tried = sum(x.tried for x in found)
    counts = Counter[str]()
    for one in found:
        counts.update(one.counts)
    answered = sum(counts.values())
    each = f"{seconds / passed:.3f} s for each that passes" if passed else "none passes"
    if answered:
        each += f", {seconds / answered:.3f} s for each that it returns"
    share = f"held {held} of {tried} tried" if tried else "none tried"
    each_held = f", {seconds * tried / passed / held:.3f} s for each that holds" if held else ""
    lost = ", ".join(f"{n} {name}" for name, n in counts.most_common() if name != "OK")
    by_object = ", ".join(f"{x.object} {x.passed} in {x.seconds:.0f} s" for x in found)
    text = (
        f"{each}; {share}{each_held}; {passed} of {answered} grasps pass"
        f"{f' ({lost})' if lost else ''}, of {sum(x.starts for x in found)} starts in "
        f"{seconds:.0f} s ({by_object}); {found[0].about}"
    )
    return Row(what, "-", text, None, numbers | {"seconds": seconds, "passed": passed})
