"""What the set-up decides about torch, run against a stand-in for Python and pip: nothing is
downloaded.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
INDEX = "https://download.example.org/whl/cpu"

STAND_IN = """#!{python}
# Plays python3 and .venv/bin/python: makes the environment, answers pip from answers.json, runs any
# other code.
import json, os, pathlib, shutil, sys
arguments, here = sys.argv[1:], pathlib.Path({folder!r})
if arguments[:2] == ["-m", "venv"]:
    pathlib.Path(".venv/bin").mkdir(parents=True)
    shutil.copy(here / "python", ".venv/bin/python")
elif arguments[:2] == ["-m", "pip"]:
    with open(here / "calls.txt", "a") as calls:
        print(*arguments[2:], file=calls)
    answers = json.loads((here / "answers.json").read_text())
    if arguments[2] == "show":
        sys.exit(0 if answers["installed"] else 1)
    if "--report" in arguments:
        report = answers["index" if "--index-url" in arguments else "configured"]
        if report is None:
            sys.exit(1)
        print(json.dumps(report))
elif "import sapien" not in arguments[-1]:
    os.execv({python!r}, [{python!r}, *arguments])
"""


def report(wheel: Path, *needs: str) -> dict:
    """What pip would say of a torch with these requirements."""
    metadata = {"name": "torch", "requires_dist": ["filelock", 'numpy; extra == "np"', *needs]}
    metadata["project_url"] = [
        "Repository, https://example.org/code",
        "Homepage, https://example.org",
    ]
    return {"install": [{"download_info": {"url": wheel.as_uri()}, "metadata": metadata}]}


@pytest.fixture
def set_up(tmp_path):
    """Return a function that runs scripts/_setup in a copy of the project; it returns the run and
    pip's calls.
    """
    project = tmp_path / "project"
    fake = tmp_path / "fake"
    (project / "scripts").mkdir(parents=True)
    fake.mkdir()
    for name in ("pyproject.toml", "constraints.txt", "scripts/_setup"):
        shutil.copy(ROOT / name, project / name)
    (fake / "python").write_text(STAND_IN.format(python=sys.executable, folder=str(fake)))
    (fake / "python").chmod(0o755)
    tools = fake / "tools"
    tools.mkdir()
    (tools / "nvidia-smi").touch(0o755)

    def run(installed=False, configured=None, index=None, gpu=False, **environment):
        (tools / "nvidia-smi").write_text(f"#!/bin/sh\nexit {0 if gpu else 9}\n")
        answers = {"installed": installed, "configured": configured, "index": index}
        (fake / "answers.json").write_text(json.dumps(answers))
        (fake / "calls.txt").unlink(missing_ok=True)
        clean = {k: v for k, v in os.environ.items() if not k.startswith(("TORCHGRASP_", "PIP_"))}
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", "source scripts/_setup"],
            cwd=project,
            env={
                **clean,
                "PYTHON": str(fake / "python"),
                "PATH": f"{tools}:{clean['PATH']}",
                **environment,
            },
            capture_output=True,
            text=True,
            check=False,
        )
        calls = (
            (fake / "calls.txt").read_text().splitlines() if (fake / "calls.txt").exists() else []
        )
        return done, [c for c in calls if c.startswith("install") and "--report" not in c]

    return run


CPU = ()
CUDA = ("nvidia-cublas-cu12; platform_system == 'Linux'",)
CASES = {
    "the configured index has a CPU build": (CPU, {}, False, ""),
    "PyTorch's index has a CPU build": (CUDA, {"own": True}, True, "looking for a CPU build"),
    "a CPU build is asked for beside a GPU": (
        CUDA,
        {"own": True, "gpu": True, "TORCHGRASP_CUDA": "0"},
        True,
        "",
    ),
    "there is no CPU build": (CUDA, {}, False, "taking the CUDA build, 2.3 GB"),
    "there is a GPU": (CUDA, {"own": True, "gpu": True}, False, "taking the CUDA build, 2.3 GB"),
    "torch is installed": (CUDA, {"own": True, "installed": True}, False, ""),
    "a CUDA build is asked for": (CUDA, {"own": True, "TORCHGRASP_CUDA": "1"}, False, ""),
}
"""What the configured build of torch needs, the surroundings, whether PyTorch's index is used, and
what is told.
"""


@pytest.mark.parametrize(("needs", "around", "own_index", "told"), CASES.values(), ids=CASES)
def test_setup_chooses_a_build_of_torch(set_up, tmp_path, needs, around, own_index, told):
    wheel = tmp_path / "torch.whl"
    around = dict(around)
    wheel.touch()
    os.truncate(wheel, 2_300_000_000)  # a sparse file: it takes no space
    index = report(wheel) if around.pop("own", False) else None
    done, installs = set_up(configured=report(wheel, *needs), index=index, **around)
    assert (
        done.returncode == 0 and told in done.stdout and ("GB" in done.stdout) is ("GB" in told)
    ), done.stderr
    assert (f"--index-url {INDEX}" in installs[0]) is own_index and "torch==" in installs[0]
    assert (
        "--index-url" not in installs[1] and "-e .[sim,mujoco,cluster,data,dev,docs]" in installs[1]
    )
    done, installs = set_up()  # a second run does nothing
    assert done.returncode == 0 and installs == [] and done.stdout == ""


def test_setup_names_a_missing_torch(set_up):
    done, installs = set_up()
    assert done.returncode == 1 and installs == [] and "pip finds no torch==" in done.stderr
