"""What the set-up decides about torch and extras, run against a stand-in for Python and pip:
nothing is downloaded.
"""

import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

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
    elif "-e" in arguments:
        print((here / "said.txt").read_text())
        sys.exit(int(answers["breaks"]))
elif not {{"import sapien", "import compileall"}} & {{x.split(",")[0] for x in arguments}}:
    os.execv({python!r}, [{python!r}, *arguments])
"""


ALL = "sim,mujoco,fast,cluster,data,dev,docs"
SAID = """Collecting beartype>=0.19 (from torchgrasp==0.1.0)
  Downloading beartype-0.23.1-py3-none-any.whl.metadata (37 kB)
  Downloading beartype-0.23.1-py3-none-any.whl (1.6 MB)
Processing /opt/numpy-2.4.6-cp311-cp311-manylinux_2_28_x86_64.whl (from torchgrasp==0.1.0)
  Using cached svg_path-7.1-py2.py3-none-any.whl (18 kB)
WARNING: something of no use
Installing collected packages: beartype, numpy, svg.path
"""
"""Of pip, when it installs the project."""


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
    (fake / "said.txt").write_text(SAID)
    tools = fake / "tools"
    tools.mkdir()
    (tools / "nvidia-smi").touch(0o755)

    def run(extras=ALL, installed=False, configured=None, index=None, gpu=False, **environment):
        breaks = environment.pop("breaks", False)
        (tools / "nvidia-smi").write_text(f"#!/bin/sh\nexit {0 if gpu else 9}\n")
        answers = {"installed": installed, "configured": configured, "index": index}
        answers["breaks"] = breaks
        (fake / "answers.json").write_text(json.dumps(answers))
        (fake / "calls.txt").unlink(missing_ok=True)
        clean = {k: v for k, v in os.environ.items() if not k.startswith(("TORCHGRASP_", "PIP_"))}
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", f"source scripts/_setup {extras}"],
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
        return done, [c for c in calls if " -c constraints.txt" in c and "--report" not in c]

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
        "--index-url" not in installs[1]
        and "-e .[cluster,data,dev,docs,fast,mujoco,sim]" in installs[1]
    )
    done, installs = set_up()  # a second run does nothing
    assert done.returncode == 0 and installs == [] and done.stdout == ""


def test_setup_names_a_missing_torch(set_up):
    done, installs = set_up()
    assert done.returncode == 1 and installs == [] and "pip finds no torch==" in done.stderr


@pytest.fixture
def cpu(tmp_path):
    """What pip would say of a CPU build."""
    (tmp_path / "torch.whl").touch()
    return report(tmp_path / "torch.whl")


def test_setup_tells_each_package_and_keeps_the_words_of_a_failure(set_up, cpu):
    done, _ = set_up("sim", configured=cpu)
    told = done.stdout.splitlines()
    assert told[-4:] == [
        "set-up: 1 of about 75: beartype 0.23.1 (1.6 MB)",
        "set-up: 2 of about 75: numpy 2.4.6",
        "set-up: 3 of about 75: svg_path 7.1 (18 kB)",
        "set-up: unpacking 3 packages",
    ]
    assert any("0.5 GB to download" in line for line in told) and done.stderr == ""
    done, _ = set_up("sim,dev", installed=True, breaks=True)
    assert done.returncode == 1 and "something of no use" in done.stderr
    assert done.stderr.splitlines()[-1] == "set-up: pip could not install torchgrasp."


def test_extras_add_up_and_a_smaller_set_changes_nothing(set_up, cpu, tmp_path):
    stamp = tmp_path / "project" / ".venv" / "torchgrasp-stamp"

    def installed(extras):
        done, installs = set_up(extras, configured=cpu)
        assert done.returncode == 0, done.stderr
        return [call.split("-e ")[1].split()[0] for call in installs if "-e " in call]

    assert installed("sim") == [".[sim]"] and installed("sim") == []
    assert installed("docs") == [".[docs,sim]"]  # none is forgotten when versions change
    assert installed("sim") == [] and installed("docs") == []
    assert installed(ALL) == [".[cluster,data,dev,docs,fast,mujoco,sim]"]
    assert installed("sim") == []
    with (tmp_path / "project" / "constraints.txt").open("a") as constraints:
        constraints.write("new==1\n")
    assert installed("sim") == [".[cluster,data,dev,docs,fast,mujoco,sim]"]
    stamp.write_text(stamp.read_text().splitlines()[0])  # of a set-up that wrote no extras
    assert installed("sim") == [".[sim]"]


def test_the_demo_installs_about_75_packages_and_none_of_development():
    """The installed packages say what they need."""
    needed = set[str]()
    waiting = [("torchgrasp", ("", "sim"))]
    while waiting:
        name, extras = waiting.pop()
        needed.add(name)
        try:
            lines = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:  # of another platform
            continue
        for need in map(Requirement, lines):
            of_use = (
                any(need.marker.evaluate({"extra": x}) for x in extras) if need.marker else True
            )
            known = canonicalize_name(need.name)
            if of_use and known not in needed:
                waiting.append((known, ("", *need.extras)))
    cuda = {name for name in needed if name.startswith(("nvidia", "cuda", "triton"))}
    assert 60 <= len(needed - cuda) <= 90
    assert not needed & {"pytest", "ruff", "mkdocs", "dask", "pyarrow", "playwright", "ipykernel"}
    demo = (ROOT / "scripts" / "demo").read_text()
    assert '_setup" sim "$@"' in demo and demo.endswith('echo "demo: open out/demo/report.html"\n')
