"""What an installation is told of itself, whole or not, and the golden set."""

import importlib.metadata
import importlib.util
import re
import sys
from pathlib import Path

import pytest

from torchgrasp.app import cli
from torchgrasp.data.shipped import load_object, load_shipped_grasp
from torchgrasp.evaluation import golden

if sys.version_info < (3, 11):
    import tomli as tomllib
else:
    import tomllib


def without(monkeypatch, *names):
    """Hide packages from the import system."""
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name, *more: None if name in names else find(name, *more),
    )


def test_the_doctor_names_what_is_there(capsys):
    code = cli.main(["doctor"])
    told = capsys.readouterr().out
    for name in ("torch", "numpy", "scipy", "safetensors"):
        assert importlib.metadata.version(name) in told
    assert "allegro" in told and "GPU" in told and code in (0, 1)
    assert (code == 0) == ("missing" not in told and "cannot be loaded" not in told)


def test_what_one_command_needs_is_told_and_is_no_fault(monkeypatch, capsys):
    code = cli.main(["doctor"])
    version = importlib.metadata.version
    capsys.readouterr()

    def without_dask(name):
        if name == "dask":
            raise importlib.metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(importlib.metadata, "version", without_dask)
    assert cli.main(["doctor"]) == code
    assert (
        "for `torchgrasp campaign --scheduler`: pip install 'torchgrasp[cluster]'"
        in capsys.readouterr().out
    )


def test_every_extra_of_the_package_is_listed(monkeypatch, capsys):
    """The oracle is pyproject.toml; an extra without an entry in the library is listed, too."""
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    extras = project["project"]["optional-dependencies"]
    lines = [
        f"{need.split(';')[0]}; extra == '{x}'" for x, needs in extras.items() for need in needs
    ]
    lines += ["no-such-package>=2; extra == 'novel'", "torch>=2.6"]
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: lines)
    cli.main(["doctor"])
    told = capsys.readouterr().out
    assert re.search(r"extra novel +no no-such-package: pip install 'torchgrasp\[novel\]'", told)
    for extra in {*extras} - {"sim", "mujoco"}:
        assert f"\nextra {extra} " in told

    def unknown(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "requires", unknown)
    cli.main(["doctor"])
    assert "torchgrasp is not installed, but imported" in capsys.readouterr().out


def test_the_doctor_names_what_is_missing_and_what_installs_it(monkeypatch, capsys):
    without(monkeypatch, "sapien", "mujoco")
    assert cli.main(["doctor"]) == 1
    told = capsys.readouterr().out
    assert "pip install 'torchgrasp[sim]'" in told and "pip install 'torchgrasp[mujoco]'" in told
    assert "Traceback" not in told


def test_without_a_simulator_the_selftest_says_so_and_fails(monkeypatch, capsys):
    without(monkeypatch, "sapien", "mujoco")
    assert cli.main(["selftest"]) == 1
    told = capsys.readouterr().out
    assert told.count("pip install") == 2 and "sapien" in told and "mujoco" in told


def test_golden_grasps_fit_their_hands_and_objects():
    for case in golden.GOLDEN:
        grasp = load_shipped_grasp(case.object, case.hand).raise_for_status()
        assert len(grasp) == 1 and bool(grasp.certificate.closed.all())
        low, high = load_object(case.object).mesh.bounds
        points = grasp.contacts.points[0].numpy()
        assert (points > low - 0.01).all() and (points < high + 0.01).all()
    assert {case.held for case in golden.GOLDEN} == {True, False}


@pytest.mark.sim
def test_every_simulator_finds_the_known_verdicts(capsys, monkeypatch):
    """Of the golden set one held grasp, one that misses and one that is too heavy."""
    pytest.importorskip("sapien"), pytest.importorskip("mujoco")
    few = (golden.GOLDEN[0], golden.GOLDEN[5], golden.GOLDEN[-1])
    assert [case.held for case in few] == [True, False, False]
    monkeypatch.setattr(golden, "GOLDEN", few)
    assert cli.main(["selftest"]) == 0
    told = capsys.readouterr().out
    assert (
        told.count(f"{len(golden.GOLDEN)} of {len(golden.GOLDEN)} verdicts right") == 2
        and "(wrong)" not in told
    )


def test_the_selftest_fails_where_a_verdict_is_another(monkeypatch, capsys):
    wrong = [golden.GoldenResult(case, not case.held, 0.1) for case in golden.GOLDEN]
    monkeypatch.setattr(golden, "run_golden", lambda simulator: wrong)
    assert cli.main(["selftest"]) == 1
    told = capsys.readouterr().out
    assert "(wrong)" in told
    # no two rows are alike: what differs is said
    rows = [" ".join(line.split()) for line in told.splitlines() if " kg " in line]
    assert len(rows) == len(set(rows)) == len(golden.GOLDEN) and told.count("60 mm off") == 2
