#!/usr/bin/env python3
"""Hashes of what the library computes, to show that a change of the code leaves every bit as it
was.

    .venv/bin/python scripts/golden.py --save before.json      # at the old commit
    .venv/bin/python scripts/golden.py --against before.json   # after the change

The exit code is 1 where a hash differs.

Hashes depend on the processor and on the versions of the packages. Compare files of one machine
only.
"""

import argparse
import concurrent.futures
import contextlib
import hashlib
import io
import json
import multiprocessing
import re
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

OBJECTS = ("cylinder", "jug", "rabbit", "spray")
HANDS = ("allegro", "barrett")
Mode = Literal["joint", "contact_first", "paper"]
MODES: tuple[Mode, ...] = ("joint", "contact_first", "paper")
VIEWS = tuple((name, k) for name in OBJECTS for k in range(6))
"""View 0 is the shipped one; the others look from azimuths of 60 degrees apart."""
STARTS = {"joint": 80, "contact_first": 30, "paper": 10}
"""Starts of the planner. The paper's refinement is slow."""
GRASP_FIELDS = (
    *("joints", "pregrasp", "approach", "obj_from_hand", "permutation", "tip_error", "clearance"),
    *("normal_angle", "score", "status"),
)
CLOSINGS: dict[str, dict[str, Any]] = {
    "uncertainty": {},
    "grip": {"holding": "grip"},
    "impedance": {"holding": "impedance"},
    "mujoco": {"simulator": "mujoco"},
    "torque": {"sensor": "torque"},
    "binary": {"sensor": "binary"},
    "paper": {"closing": "paper"},
    "paper position": {"closing": "paper_position"},
    "open loop": {"closing": "open_loop"},
    "displaced": {"shift": 0.01},
    "guarded": {"shift": 0.02, "seen": True},
    "guarded, grip": {"shift": 0.02, "seen": True, "holding": "grip"},
}
"""Ways to close, each tried with two hands on two objects."""
COMMANDS = (
    "objects",
    "--help",
    "cloud check {data}/jug/view.ply",
    "cloud thin {data}/jug/view.ply --voxel 0.005 --out {out}/thin.ply",
    "grasp {data}/scene.npz --hand barrett --out {out}/scene --starts 60 --no-report",
    "hand check barrett --out {out}/hand.png",
    "grasp {data}/jug/view.ply --hand barrett --out {out}/jug --starts 60 --no-report",
    "shape surface {data}/jug/view.ply --out {out}/jug.ply",
)


def digest(*parts: Any) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of tensors, arrays, text and None."""
    sha = hashlib.sha256()
    for part in parts:
        if part is None:
            sha.update(b"None")
        elif isinstance(part, str):
            sha.update(part.encode())
        else:
            array = np.ascontiguousarray(part)
            sha.update(f"{array.dtype}{array.shape}".encode())
            sha.update(array.tobytes())
    return sha.hexdigest()[:16]


def hash_grasps(grasps: Any) -> str:
    """Return the hash of all numbers of grasps: joints, poses, contacts, certificates, statuses."""
    contacts = grasps.contacts
    certificate = grasps.certificate
    return digest(
        *(getattr(grasps, name) for name in GRASP_FIELDS),
        *(contacts.points, contacts.normals, contacts.variance, contacts.std_m),
        *(certificate.margin, certificate.closed, certificate.witness),
    )


def see(name: str, k: int) -> Any:
    """Return view k of the shipped object `name`, a cloud [m].

    View 0 is the shipped one; the others are rendered from 60 k degrees.
    """
    import trimesh

    from torchgrasp import cloud_from_depth, load_object
    from torchgrasp.cloud.camera import INTRINSICS, look_at, render_depth

    shipped = load_object(name)
    if k == 0:
        return shipped.view
    pose = look_at(60.0 * k, 35.0, target=shipped.mesh)
    mesh = trimesh.Trimesh(shipped.mesh.vertices, shipped.mesh.faces)
    depth, labels = render_depth([mesh], pose, seed=k)
    return cloud_from_depth(depth, INTRINSICS, mask=labels == 1, camera_pose=pose)


def plan(name: str, k: int, hand: str, mode: Mode) -> str:
    """Plan grasps of a hand on view k of a shipped object, and return their hash."""
    from torchgrasp import ContactSpec, load_hand, plan_grasps

    spec = (ContactSpec.paper if mode == "paper" else ContactSpec)(table=0.0)
    grasps = plan_grasps(see(name, k), load_hand(hand), spec, STARTS[mode], 0, mode=mode)
    return hash_grasps(grasps)


def close(name: str, hand: str, how: str) -> str:
    """Close a hand on a shipped object and lift it 20 mm; return the hash of what was measured.

    `how` is a key of `CLOSINGS`, such as "impedance".
    """
    from torchgrasp import SensorModel, TrialSpec, close_hand, fit_shape, load_hand, load_object
    from torchgrasp.data.shipped import load_shipped_grasp
    from torchgrasp.shape.surface import surface_field

    options = dict(CLOSINGS[how])
    error = torch.eye(4, dtype=torch.float64)
    error[0, 3] = options.pop("shift", 0.0)
    if "sensor" in options:
        options["sensor"] = SensorModel(options["sensor"])
    thing = load_object(name)
    surface = None
    if options.pop("seen", False):
        surface = surface_field(fit_shape(thing.view, table=0.0))
    spec = TrialSpec(lift_height=0.02, hold_time=0.1, **options)
    grasp = load_shipped_grasp(name, hand)
    model = load_hand(hand)
    found = close_hand(
        grasp, model, thing.mesh, spec, error=error, parts=thing.parts, surface=surface
    )
    moved = (found.object_pose, found.hand_pose, found.joints)
    return digest(found.status.name, found.time, found.forces, *moved)


def lift(k: int) -> str:
    """Return as text whether the grasp of case k of the golden set held, and whether it should."""
    from torchgrasp.evaluation.golden import run_golden

    result = list(run_golden("sapien"))[k]
    return f"{result.case.object} {result.case.hand} held={result.held} right={result.right}"


def export(name: str, hand: str) -> str:
    """Return the hash of a shipped grasp, exported to the formats of other programs."""
    from torchgrasp import load_hand
    from torchgrasp.data.shipped import load_shipped_grasp
    from torchgrasp.export import format_graspgen, format_grasps, format_keyframes

    grasps = load_shipped_grasp(name, hand)
    model = load_hand(hand)
    texts = (format_grasps(model, grasps), format_keyframes(model, grasps))
    return digest(*texts, format_graspgen(grasps, "object.obj"))


def run_command(words: str) -> str:
    """Run a command of torchgrasp, and return the hash of its exit code and of what it prints.

    Paths and times in the output are replaced. In `words`, {data} and {out} stand for folders.
    """
    from torchgrasp.app.cli import main
    from torchgrasp.data.shipped import DATA
    from torchgrasp.hand import hands_folder

    stdout = io.StringIO()
    with tempfile.TemporaryDirectory() as out, contextlib.redirect_stdout(stdout):
        code: object
        try:
            code = main(words.format(data=DATA, out=out).split())
        except SystemExit as end:
            code = end.code
        text = stdout.getvalue()
    for folder, name in ((DATA, "DATA"), (hands_folder(), "HANDS"), (out, "OUT")):
        text = text.replace(str(folder), name)
    # times are padded to a width
    return digest(re.sub(r" *[0-9.]+ (s|min)\b", " TIME", text), str(code))


JOBS: dict[str, tuple[Callable[..., str], list[tuple[Any, ...]]]] = {
    "plan": (plan, [(*view, hand, mode) for view in VIEWS for hand in HANDS for mode in MODES]),
    "close": (
        close,
        [(name, hand, how) for how in CLOSINGS for name in OBJECTS[:2] for hand in HANDS],
    ),
    "lift": (lift, [(k,) for k in range(8)]),
    "export": (export, [(name, hand) for name in OBJECTS[:2] for hand in HANDS]),
    "command": (run_command, [(words,) for words in COMMANDS]),
}
"""The parts, and the arguments of each of their hashes."""


def compute(job: tuple[str, tuple[Any, ...]]) -> tuple[str, str]:
    """Return (name, hash) of a job, which is a part of `JOBS` and its arguments.

    A failure has its error in place of the hash.
    """
    torch.set_num_threads(1)
    part, arguments = job
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            value = JOBS[part][0](*arguments)
    except Exception as error:
        value = f"{type(error).__name__}: {error}"
    return f"{part}: {', '.join(map(str, arguments))}", value


def compute_all(parts: Iterable[str], every: int, workers: int) -> dict[str, str]:
    """Return the hashes of some parts of `JOBS` by name, computed in `workers` processes.

    With `every` = 3, only each third hash of a part is computed.
    """
    jobs = [(part, arguments) for part in parts for arguments in JOBS[part][1][::every]]
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(workers, mp_context=context) as pool:
        return dict(pool.map(compute, jobs))


def main() -> int:
    """Compute hashes, save them to a file or compare them with one; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    add_option = parser.add_argument
    add_option("--save", type=Path, help="file that the hashes are written to")
    add_option("--against", type=Path, help="file of hashes to compare with")
    add_option("--only", nargs="+", choices=JOBS, default=list(JOBS), help="parts; by default all")
    add_option("--every", type=int, default=1, help="3 computes each third hash of a part")
    add_option("--workers", type=int, default=2, help="processes")
    given = parser.parse_args()
    found = compute_all(given.only, given.every, given.workers)
    for name in sorted(name for name, value in found.items() if "Error" in value or ":" in value):
        print(f"failed   {name}: {found[name]}")
    if given.save:
        given.save.write_text(json.dumps(found, indent=1, sort_keys=True))
    if given.against is None:
        return 0
    before = json.loads(given.against.read_text())
    changed = [name for name in found if before.get(name) != found[name]]
    for name in changed:
        print(f"changed  {name}: {before.get(name)} -> {found[name]}")
    print(f"{len(found) - len(changed)} of {len(found)} hashes are equal")
    return 1 if changed else 0


if __name__ == "__main__":
    sys.exit(main())
