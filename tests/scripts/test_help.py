"""Every script says what it does; scripts/package.py: what it refuses, without a build."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

import package
import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / "scripts"
PYTHON = sorted(path for path in SCRIPTS.glob("*.py") if path.read_text().startswith("#!"))
SHELL = sorted(
    path
    for path in SCRIPTS.iterdir()
    if path.is_file() and path.suffix == "" and path.name[0] != "_"
)


@pytest.mark.parametrize("path", PYTHON, ids=lambda path: path.stem)
def test_a_python_script_has_help(path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(path), "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(path), run_name="__main__")
    assert not end.value.code and len(capsys.readouterr().out.splitlines()) > 5


@pytest.mark.parametrize("path", SHELL, ids=lambda path: path.name)
def test_a_shell_script_has_help_and_sets_nothing_up_for_it(path, tmp_path):
    done = subprocess.run(
        [path, "--help"],
        cwd=tmp_path,
        env={"PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and done.stderr == ""
    assert path.read_text().splitlines()[1] == f"# {done.stdout.strip()}"


def test_files_that_scripts_name_exist():
    for path in (*(ROOT / "scripts").rglob("*.py"), *SHELL):
        named = re.findall(r"\btorchgrasp/[\w/]+(?:\.\w+)?", path.read_text())
        assert [name for name in named if not (ROOT / name).exists()] == [], path


def test_scripts_are_found():
    names = {path.stem for path in (*PYTHON, *SHELL)}
    assert names >= {
        "bench",
        "beside",
        "demo",
        "docs",
        "package",
        "reproduce",
        "survey",
        "test",
        "train",
    }


def test_the_long_description_leads_nowhere_inside_the_project():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    hook = project["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]
    (fragment,) = hook["fragments"]
    readme = shown = (ROOT / fragment["path"]).read_text()
    for change in hook["substitutions"]:
        shown = re.sub(change["pattern"], change["replacement"], shown)
    targets = re.findall(r"\]\(([^)]*)\)", shown)
    assert all(target.startswith("https://") for target in targets)
    assert [x for x in readme.splitlines() if x.startswith("#")] == [
        x for x in shown.splitlines() if x.startswith("#")
    ]


def test_run_hides_the_surrounding_package_and_ends_with_the_last_words(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "/nowhere")
    assert (
        package.run(
            sys.executable, "-c", "import os; print('PYTHONPATH' in os.environ)", cwd=tmp_path
        )
        == "False\n"
    )
    assert (
        package.run(sys.executable, "-c", "import sys; sys.exit(1)", cwd=tmp_path, codes=(1,)) == ""
    )
    with pytest.raises(SystemExit, match=r"ended with 3:\nthe reason"):
        package.run(
            sys.executable, "-c", "import sys; print('the reason'); sys.exit(3)", cwd=tmp_path
        )


def test_one_interpreter_of_each_version_is_found(tmp_path, monkeypatch):
    for version in ("3.9.1", "3.10.2", "3.12.9", "3.12.1"):
        python = tmp_path / "versions" / version / "bin" / "python"
        python.parent.mkdir(parents=True)
        python.symlink_to(sys.executable)
    monkeypatch.setenv("PYENV_ROOT", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))
    names = [path.split("/")[-3] for path in package.find_pythons()]
    assert names == ["3.10.2", "3.12.9"]


def test_files_are_counted_and_links_are_not_followed(tmp_path):
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "file").write_bytes(bytes(5000))
    before = package.size_of(tmp_path)
    (tmp_path / "link").symlink_to(tmp_path / "deep" / "file")
    assert 5000 <= before and package.size_of(tmp_path) - before < 1000
