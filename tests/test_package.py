"""What importing torchgrasp does and leaves alone, and what its source never contains."""

import ast
import datetime
import importlib
import inspect
import os
import pkgutil
import re
import subprocess
import sys
import typing
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.version import Version

import torchgrasp
from tests.make import run_python

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "torchgrasp").rglob("*.py"))
PACKAGES = [
    found.name for found in pkgutil.walk_packages(torchgrasp.__path__, "torchgrasp.") if found.ispkg
]


SIMULATORS = {"sapien", "mujoco", "coacd", "pebble"}
DRAWERS = {"pyvista", "vtk", "vtkmodules", "matplotlib", "PIL"}
SLOW = {
    "scipy",
    "trimesh",
    "yourdfpy",
    "pytorch_kinematics",
    "networkx",
    "lxml",
    "skimage",
    "sklearn",
    "embreex",
}
OF_URDF = SLOW - {"skimage", "sklearn"} | {"PIL"}
"""What yourdfpy and the used modules of pytorch-kinematics import."""


IMPORTS = """
import contextlib, logging, os, random, sys, warnings
import numpy as np, torch

def state():
    return (torch.get_default_dtype(), torch.get_num_threads(), torch.is_grad_enabled(), torch.get_default_device(),
            torch.are_deterministic_algorithms_enabled(), torch.get_float32_matmul_precision(), torch.get_rng_state(),
            np.random.get_state()[1], random.getstate(), np.geterr(), dict(os.environ), logging.root.handlers[:],
            logging.root.level, os.getcwd())

def apart(act, *given):
    if child := os.fork():
        assert os.waitpid(child, 0)[1] == 0
        return
    act(*given)
    os._exit(0)

def ask_for_help():
    from torchgrasp.app import cli
    with contextlib.suppress(SystemExit):
        cli.main(["--help"])
    print("help:", *sys.modules)

def load_hands():
    hand = [torchgrasp.load_hand(name) for name in ("allegro", "shadow", "barrett")][-1]
    print("hand:", *sys.modules)
    for words in ("*", "build_chain_from_mjcf"):
        apart(import_kinematics, hand, words)

def import_kinematics(hand, words):
    names = {}
    exec(f"from pytorch_kinematics import {words}", names)
    import pytorch_kinematics as kinematics
    assert isinstance(hand.chain, kinematics.Chain) and kinematics.PseudoInverseIK
    print("kinematics:", names["build_chain_from_mjcf"].__module__, type(kinematics).__name__)

before = state()
import torchgrasp
for a, b in zip(before, state(), strict=True):
    same = a == b
    assert same if isinstance(same, bool) else bool(same.all()), (a, b)
print("import:", *sys.modules)
print("files:", *os.listdir())
apart(ask_for_help)
apart(load_hands)
"""
"""Tells what is imported after each step, each in a copy of the process that has imported the library."""


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """What `IMPORTS` tells in an empty folder, by the words before the colons."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("empty"))
        done = run_python("-u", "-c", IMPORTS)
    assert done.returncode == 0, done.stderr
    told = dict[str, list[str]]()
    for line in done.stdout.splitlines():
        name, colon, said = line.partition(":")
        if colon:
            told.setdefault(name, []).append(said)
    return told


def assert_light(modules: str, needed: frozenset[str] = frozenset()) -> None:
    """What is heavy is imported by the function that needs it."""
    loaded = {name.split(".")[0] for name in modules.split()}
    assert "torchgrasp" in loaded
    assert not loaded & (SIMULATORS | DRAWERS | SLOW) - needed


@pytest.mark.promise("F9")
def test_help_brings_in_nothing_that_simulates_draws_or_is_slow_to_import(
    imported: dict[str, list[str]],
):
    """Nor does it bring in the tools of agents."""
    (modules,) = imported["help"]
    assert_light(modules)
    assert "torchgrasp.app.cli" in modules.split() and ".agent_" not in modules


@pytest.mark.promise("F9")
def test_a_hand_brings_in_little_and_leaves_the_whole_pytorch_kinematics_to_its_caller(
    imported: dict[str, list[str]],
):
    """Each way of importing is tried after the hands are loaded."""
    (modules,) = imported["hand"]
    assert_light(modules, frozenset(OF_URDF))
    assert imported["kinematics"] == [" pytorch_kinematics.mjcf module"] * 2


@pytest.mark.promise("F9")
def test_import_is_light_changes_no_global_state_and_writes_no_file(
    imported: dict[str, list[str]],
):
    (modules,) = imported["import"]
    assert imported["files"] == [""]
    assert_light(modules)


@pytest.mark.promise("H4")
@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_source_has_no_neural_network_pickle_or_global_random_state(path):
    text = path.read_text()
    forbidden = {
        "torch.nn": r"\btorch\.nn\b(?!_)|\bfrom torch import nn\b",
        "pickle": r"\bimport pickle\b|\bfrom pickle\b|\btorch\.load\(|allow_pickle=True",
        "global random state": r"\btorch\.manual_seed\(|\bnp\.random\.(seed|rand|randn|normal|uniform|choice)\(",
        "postponed annotations": r"^from __future__ import annotations",
    }
    found = [name for name, pattern in forbidden.items() if re.search(pattern, text, re.MULTILINE)]
    assert found == []


def public_names():
    packages = [torchgrasp, *map(importlib.import_module, PACKAGES)]
    return {
        f"{p.__name__}.{name}": getattr(p, name)
        for p in packages
        for name in getattr(p, "__all__", ())
    }


def types_of(annotation):
    """The classes of the package that an annotation names, in unions and containers too."""
    if isinstance(annotation, type) and annotation.__module__.startswith("torchgrasp"):
        yield annotation
    for inner in typing.get_args(annotation):
        yield from types_of(inner)


def hints(function):
    """The annotations of a function's parameters; types of simulators and meshes are left out."""
    try:
        found = typing.get_type_hints(function)
    except NameError:  # a type that is imported for type checkers alone, such as trimesh.Trimesh
        found = {
            k: x
            for k, x in getattr(function, "__annotations__", {}).items()
            if not isinstance(x, str)
        }
    return [hint for name, hint in found.items() if name != "return"]


def test_what_public_functions_take_is_public():
    names = public_names()
    public = {id(value) for value in names.values()}
    apart = {"ForcePreference"}  # what the loaded model of the paper's baseline satisfies
    hidden = set()
    for name, thing in names.items():
        parts = [thing] if inspect.isfunction(thing) else []
        if isinstance(thing, type):
            parts = [
                m
                for key, m in vars(thing).items()
                if not key.startswith("_") and inspect.isfunction(m)
            ]
        for kind in (kind for part in parts for hint in hints(part) for kind in types_of(hint)):
            if (
                id(kind) not in public
                and not kind.__name__.startswith("_")
                and kind.__name__ not in apart
            ):
                hidden.add(f"{kind.__module__}.{kind.__qualname__} in {name}")
    assert hidden == set()


def test_every_subpackage_names_its_public_things():
    packages = [importlib.import_module(name) for name in PACKAGES]
    silent = [package for package in packages if not getattr(package, "__all__", None)]
    said = {package.__name__: " ".join((package.__doc__ or "").split()) for package in silent}
    assert [name for name, words in said.items() if "Not public." not in words] == []


def test_every_public_function_has_an_example_that_calls_it():
    """The doctests of the suite run all examples that stand in docstrings."""
    silent = []
    for name, function in public_names().items():
        lines = "\n".join(re.findall(r"^ *(?:>>>|\.\.\.) .*", function.__doc__ or "", re.MULTILINE))
        if inspect.isfunction(function) and not re.search(rf"\b{function.__name__}\b", lines):
            silent.append(name)
    assert silent == []


PROMISES, NOT_PROMISED = (ROOT / "docs" / "promises.md").read_text().split("## Not promised")
PROMISED = set(re.findall(r"^\| ([A-Z]\d+) \| ", PROMISES, re.MULTILINE))


def marked() -> set[str]:
    found = set[str]()
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        for test in ast.parse(path.read_text()).body:
            for mark in test.decorator_list if isinstance(test, ast.FunctionDef) else ():
                if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.promise":
                    found.update(map(ast.literal_eval, mark.args))
    return found


def test_every_promise_has_a_test_and_every_mark_a_promise():
    assert marked() == PROMISED


def test_every_id_is_promised_or_has_its_reason():
    most = {"I": 13, "H": 6, "F": 9, "L": 7, "N": 16}
    known = {f"{letter}{k}" for letter in most for k in range(1, most[letter] + 1)}
    reasons = re.findall(r"^\| ([A-Z])(\d+)(?: to [A-Z](\d+))? \|", NOT_PROMISED, re.MULTILINE)
    told = {
        f"{letter}{k}"
        for letter, first, last in reasons
        for k in range(int(first), int(last or first) + 1)
    }
    assert PROMISED | told == known and not PROMISED & told


def test_the_lowest_versions_are_those_of_the_bounds():
    """constraints-lowest.txt, with which scripts/lowest runs tests, follows pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    script = (ROOT / "scripts" / "lowest").read_text()
    extras = re.search(r'-e "\.\[([\w,]+)\]"', script)
    assert extras is not None
    bounds = list[str](project["dependencies"])
    for extra in extras[1].split(","):
        bounds += project["optional-dependencies"][extra]
    lines = (ROOT / "constraints-lowest.txt").read_text().splitlines()
    listed = [line for line in lines if not line.startswith("#")]
    assert lowest_of(listed, "==") == lowest_of(bounds, ">=")


def lowest_of(lines: list[str], operator: str) -> dict[str, tuple[Version, str]]:
    """Return version and condition of each package after an operator such as ">="."""
    found = dict[str, tuple[Version, str]]()
    for line in lines:
        requirement = Requirement(line)
        versions = [one.version for one in requirement.specifier if one.operator == operator]
        assert len(versions) == 1, line
        found[requirement.name] = Version(versions[0]), str(requirement.marker)
    return found


def test_the_citation_has_the_version_and_the_date_of_the_release():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert cited["cff-version"] == "1.2.0" and cited["version"] == torchgrasp.__version__
    released = datetime.date.fromisoformat(cited["date-released"])
    changes = (ROOT / "CHANGELOG.md").read_text()
    told = re.search(rf"^## \[{re.escape(cited['version'])}\] - (.*)$", changes, re.MULTILINE)
    assert told is not None and told[1] in ("unreleased", released.isoformat())


def test_the_wheel_installs_from_a_file_and_holds_models_hands_and_objects(tmp_path):
    """Built and installed offline, beside the packages of this environment."""
    builder = ROOT / ".beside" / "wheel" / "bin" / "python"
    if not builder.exists():
        pytest.skip("scripts/beside makes .beside/wheel")
    build = [builder, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path / "dist"]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    assert wheel.name == f"torchgrasp-{torchgrasp.__version__}-py3-none-any.whl"
    place = tmp_path / "place"
    pip = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--no-compile"]
    subprocess.run([*pip, "--quiet", "--target", place, wheel], check=True, cwd=tmp_path)
    ask = (
        "import torchgrasp; print(torchgrasp.__file__, torchgrasp.__version__,"
        " torchgrasp.load_hand('barrett').dof, len(torchgrasp.load_object('jug').view))"
    )
    around = os.environ | {"PYTHONPATH": str(place)}
    done = subprocess.run(
        [sys.executable, "-c", ask], cwd=tmp_path, env=around, capture_output=True, text=True
    )
    found = done.stdout.split()
    assert found == [str(place / "torchgrasp" / "__init__.py"), torchgrasp.__version__, "4", "1000"]
    command = place / "bin" / "torchgrasp"
    assert command.is_file() and "torchgrasp.app.cli" in command.read_text()


def test_reports_of_faults_ask_for_version_installation_and_cloud():
    forms = ROOT / ".github" / "ISSUE_TEMPLATE"
    asked = {}
    for path in sorted(forms.glob("*.yml")):
        form = yaml.safe_load(path.read_text())
        fields = [x for x in form["body"] if x["type"] != "markdown"]
        assert form["name"] and form["description"]
        assert len({x["id"] for x in fields}) == len(fields)
        asked[path.stem] = fields
    assert {"bug", "feature"} == set(asked)
    needed = {x["id"] for x in asked["bug"] if x.get("validations", {}).get("required")}
    assert needed == {"what", "version", "doctor"}
    said = str(asked["bug"])
    commands = {"--version", *importlib.import_module("torchgrasp.app.cli").COMMANDS}
    named = re.findall(r"`torchgrasp ([a-z-]+(?: check)?)", said)
    assert {"--version", "doctor", "cloud check", "hand check"} == set(named) <= commands
    assert (ROOT / ".github" / "pull_request_template.md").read_text().strip()
