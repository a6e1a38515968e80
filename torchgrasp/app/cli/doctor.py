"""The commands `torchgrasp doctor` and `torchgrasp selftest`: is the installation complete, and
does it work?
"""

import importlib.metadata
import importlib.util
import os
import platform
import re
import sys
import time
from typing import NamedTuple

import torch

from torchgrasp import __version__
from torchgrasp.app.cli.command import Command, ForPrograms, answer, arguments, make_bar
from torchgrasp.app.cli.inputs import import_simulator
from torchgrasp.files import format_columns
from torchgrasp.foundation.errors import BadArgument, MissingExtra
from torchgrasp.hand.load import list_hands
from torchgrasp.values.specs import Simulator

CORE = ("torch", "numpy", "scipy", "trimesh", "pytorch-kinematics", "yourdfpy", "safetensors")
"""Packages that every command needs."""
SIMULATORS: dict[Simulator, str] = {"sapien": "sim", "mujoco": "mujoco"}
"""Simulators, and the extra that installs each."""
NEEDED_BY = {
    "cluster": "`torchgrasp campaign --scheduler`",
    "data": "`torchgrasp campaign --parquet` and data sets for LeRobot",
    "dev": "the tests of the library",
    "docs": "the site of the library",
    "film": "MP4 files of `torchgrasp film`",
    "mcp": "`torchgrasp mcp`",
    "meshes": "hands with .dae meshes",
    "fast": "planning by compiled loops",
    "realsense": "`torchgrasp grasp --realsense`",
    "rerun": "`torchgrasp grasp --rerun`",
    "robots": "hands of robot_descriptions",
}
"""What needs an extra, where it is known; all other extras are listed without it."""


class Finding(NamedTuple):
    """One part of the installation and its state.

    Attributes:
        part: name of the part.
        found: its state in words.
        fix: command that repairs it; "" if nothing is missing.
    """

    part: str
    found: str
    fix: str = ""


@arguments()
class Doctor(ForPrograms):
    """List installed and missing packages, with the command that installs each.

    The exit code is 1 if a simulator or a package is missing, even though planning needs no
    simulator. Other extras, which single commands need, do not change the exit code.
    """

    def run(self) -> int:
        """Print the state of every part, and the fixes; return the exit code."""
        findings = find_parts()
        print(format_columns([(x.part, x.found) for x in findings], left={0, 1}))
        missing = [x for x in findings if x.fix]
        answer({"complete": not missing, "parts": [x._asdict() for x in findings]})
        for x in missing:
            print(f"\n{x.part}: {x.fix}")
        complete = "planning and simulation are complete; `torchgrasp selftest` tries them"
        print("" if missing else f"\n{complete}")
        return 1 if missing else 0


def find_parts() -> list[Finding]:
    """Return the state of every part of the installation: the library, Python, packages, processor,
    GPU, simulators and extras, which are groups of optional packages.
    """
    hands = ", ".join(list_hands())
    gpu = "none visible to torch; everything runs on the processor"  # no fault
    if torch.cuda.is_available():
        gpu = f"{torch.cuda.get_device_name()}, CUDA {torch.version.cuda}"
    return [
        Finding("torchgrasp", f"{__version__}, hands: {hands}"),
        Finding(
            "Python",
            f"{platform.python_version()} on {platform.system()} {platform.machine()}, "
            f"{sys.executable}",
        ),
        *(_package(name) for name in CORE),
        Finding("processor", f"{os.cpu_count()} cores; a command uses one, and --workers N uses N"),
        Finding("GPU", gpu),
        *(_simulator(name) for name in SIMULATORS),
        *(_package(name, "pip install 'torchgrasp[sim]'") for name in ("coacd", "pebble")),
        *find_extras(),
    ]


def find_extras() -> list[Finding]:
    """Return the state of every extra, a group of optional packages, but those of the simulators.

    An incomplete extra has an empty `fix`, as only single commands need it. Then `found` says how
    to install it.
    """
    try:
        lines = importlib.metadata.requires("torchgrasp") or []
    except importlib.metadata.PackageNotFoundError:  # imported from a clone
        return [Finding("extras", "unknown: torchgrasp is not installed, but imported")]
    packages = dict[str, list[str]]()
    for line in lines:
        extra = re.search(r"extra\s*==\s*['\"]([^'\"]+)['\"]", line)
        name = re.match(r"[A-Za-z0-9._-]+", line)
        if extra is not None and name is not None and extra[1] not in SIMULATORS.values():
            packages.setdefault(extra[1], []).append(name[0])
    return [_extra(extra, sorted(set(names))) for extra, names in sorted(packages.items())]


def _extra(extra: str, names: list[str]) -> Finding:
    """Return which of an extra's packages, `names`, are installed, and what installs the others."""
    states = [_package(name) for name in names]
    absent = [state.part for state in states if state.fix]
    found = ", ".join(f"{state.part} {state.found}" for state in states if not state.fix)
    if absent:
        need = f", for {NEEDED_BY[extra]}" if extra in NEEDED_BY else ""
        fix = f"pip install 'torchgrasp[{extra}]'"
        found = f"no {', '.join(absent)}{need}: {fix}"
    return Finding(f"extra {extra}", found)


@arguments()
class Selftest(Command):
    """Lift shipped grasps in each installed simulator, and compare the verdicts with the known
    ones.

    The exit code is 0 if all verdicts are right. It is 1 if one is wrong or no simulator is
    installed.
    """

    def run(self) -> int:
        """Lift the shipped grasps in each simulator, compare the verdicts; return the exit code."""
        from torchgrasp.evaluation.golden import GOLDEN, GoldenResult, run_golden

        faults: dict[Simulator, str] = {name: _simulator(name).fix for name in SIMULATORS}
        for name, fix in faults.items():
            if fix:
                print(f"{name}: {fix}")
        found: dict[Simulator, list[GoldenResult]] = {
            name: [] for name in SIMULATORS if not faults[name]
        }
        if not found:
            return 1
        with make_bar(len(GOLDEN) * len(found), "lift") as bar:
            for name, results in found.items():
                begin = time.perf_counter()
                for result in run_golden(name):
                    results.append(result)
                    bar.update()
                right = sum(x.right for x in results)
                seconds = time.perf_counter() - begin
                bar.write(f"{name:8}{seconds:6.1f} s  {right} of {len(GOLDEN)} verdicts right")
        rows = [("object", "hand", "hand is", "expected", *found)]
        words = {True: "held", False: "lost"}
        for k, case in enumerate(GOLDEN):
            verdicts = [
                f"{words[x[k].held]}{'' if x[k].right else ' (wrong)'}" for x in found.values()
            ]
            rows.append(
                (
                    f"{case.object}, {case.mass:g} kg",
                    case.hand,
                    f"{1000 * case.shift:g} mm off" if case.shift else "as planned",
                    words[case.held],
                    *verdicts,
                )
            )
        print(f"\n{format_columns(rows, left=range(len(rows[0])))}")
        return 0 if all(x.right for results in found.values() for x in results) else 1


def _package(name: str, fix: str = "pip install torchgrasp") -> Finding:
    """Return the installed version of a package as a finding; if it is missing, the `fix`."""
    try:
        return Finding(name, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return Finding(name, "missing", fix)


def _simulator(name: Simulator) -> Finding:
    """Return the version of a simulator if it can be imported, otherwise the fix."""
    try:
        import_simulator(name)
    except (MissingExtra, BadArgument) as error:
        missing = isinstance(error, MissingExtra)
        return Finding(
            name,
            "missing" if missing else "cannot be loaded",
            str(error).partition(": ")[2] or str(error),
        )
    return Finding(name, importlib.metadata.version(name))
