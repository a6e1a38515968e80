"""Every script says what it does."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"
PYTHON = sorted(path for path in SCRIPTS.glob("*.py") if path.read_text().startswith("#!"))
SHELL = sorted(path for path in SCRIPTS.iterdir() if path.is_file() and path.suffix == "" and path.name[0] != "_")


@pytest.mark.parametrize("path", PYTHON, ids=lambda path: path.stem)
def test_a_python_script_has_help(path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(path), "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(path), run_name="__main__")
    assert not end.value.code and len(capsys.readouterr().out.splitlines()) > 5


@pytest.mark.parametrize("path", SHELL, ids=lambda path: path.name)
def test_a_shell_script_has_help_and_sets_nothing_up_for_it(path, tmp_path):
    done = subprocess.run([path, "--help"], cwd=tmp_path, env={"PATH": "/usr/bin:/bin"}, capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == ""
    assert path.read_text().splitlines()[1] == f"# {done.stdout.strip()}"


def test_files_that_scripts_name_exist():
    root = Path(__file__).parents[2]
    for path in (*(root / "scripts").rglob("*.py"), *SHELL):
        named = re.findall(r"\btorchgrasp/[\w/]+(?:\.\w+)?", path.read_text())
        assert [name for name in named if not (root / name).exists()] == [], path


def test_scripts_are_found():
    names = {path.stem for path in (*PYTHON, *SHELL)}
    assert names >= {"bench", "demo", "docs", "package", "reproduce", "survey", "test", "train"}
