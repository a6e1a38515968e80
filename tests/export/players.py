"""Environments in which other simulators play exported folders; `scripts/beside` makes them."""

import json
import os
import subprocess
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).parents[2]

PLAYERS = {
    "MuJoCo 3": ("mujoco", ".venv"),
    "MuJoCo 4": ("mujoco", ".beside/mujoco4"),
    "ManiSkill": ("maniskill", ".beside/maniskill"),
    "Newton": ("newton", ".beside/newton"),
}
"""Format and environment of each simulator that plays."""

LEAST_SAME = 0.95
"""Share of equal verdicts with our own trial of the same motion: the project's own bar."""

RUNNER = """
import json, runpy, sys
for folder, numbers in json.loads(sys.argv[1]):
    sys.argv[1:], sys.path[0] = numbers, folder
    runpy.run_path(f"{folder}/play.py", run_name="__main__")
    sys.modules.pop("environment", None)  # of ManiSkill's folder
"""
"""Runs the scripts of several folders in one process, which loads the simulator once."""


def play_all(environment: str, folders: Iterable[Path]) -> list[bool]:
    """Play the first grasp of each folder with its own script in an environment, below the
    project's root, and return which are held.
    """
    tasks = [(str(folder), ["0"]) for folder in folders]
    python = ROOT / environment / "bin" / "python"
    kept = {name: text for name, text in os.environ.items() if name != "PYTHONPATH"}
    call = [str(python), "-W", "ignore", "-c", RUNNER, json.dumps(tasks)]
    done = subprocess.run(call, capture_output=True, text=True, check=False, env=kept)
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('{"grasp"')]
    assert len(lines) == len(tasks)
    return [line["held"] for line in lines]
