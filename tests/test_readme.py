"""What README, guides and examples show runs; commands exist and take their flags."""

import base64
import contextlib
import functools
import io
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient
from PIL import Image

from tests.make import HALF, halved
from tests.pinch import QUICK
from torchgrasp import TrialSpec
from torchgrasp.app.cli.hands import HandTrial
from torchgrasp.evaluation import PROTOCOLS
from torchgrasp.hand.collision_shapes import collision_pairs

pytestmark = pytest.mark.usefixtures("kept_plans")
ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
APART = "agents.md"  # its client is in an environment beside; app/test_agents.py runs it there
GUIDES = [path.read_text() for path in sorted((ROOT / "docs").glob("*.md")) if path.name != APART]


def fenced(language, text=README):
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def with_little_work(code, most=8):
    """Return code whose plans have few starts, with few steps of descent, one trial of a view, and
    few ticks of a controller.
    """
    code = re.sub(r"starts=(\d+)", lambda found: f"starts={min(int(found[1]), most)}", code)
    code = re.sub(r"1 / [12]00\b", "1 / 50", code)
    code = code.replace("range(300)", "range(10)").replace("grasps=2,", "grasps=1,")
    code = code.replace("for shift in (0.0, 0.02):", "for shift in (0.0,):")
    code = code.replace("task=GraspTask(mass=mass))", f"task=GraspTask(mass=mass), starts={most})")
    return code


@pytest.fixture
def short_trials(monkeypatch):
    """Trials have few ticks, and hold the object for a short time: those without parameters, of
    `torchgrasp grasp --close`, and of the protocols by name.
    """
    quick = functools.partial(TrialSpec, hold_time=QUICK.hold_time, control_rate=QUICK.control_rate)
    for place in ("evaluation.lift", "app.cli.grasp"):
        monkeypatch.setattr(f"torchgrasp.{place}.TrialSpec", quick)
    for name, protocol in PROTOCOLS.items():
        rate = min(protocol.trial.control_rate, QUICK.control_rate)
        less = protocol.with_trial(hold_time=QUICK.hold_time, control_rate=rate)
        monkeypatch.setitem(PROTOCOLS, name, less)


@pytest.mark.parametrize(
    "code", [code for text in (README, *GUIDES) for code in fenced("python", text)]
)
def test_python_of_the_readme_and_the_guides_runs(code, tmp_path, monkeypatch, short_trials):
    monkeypatch.chdir(tmp_path)
    exec(compile(with_little_work(code), "README.md", "exec"), {})


@pytest.mark.slow
@pytest.mark.sim
def test_the_guide_to_hands_runs_as_it_stands(
    tmp_path, monkeypatch, capsys, few_postures, short_trials
):
    """A draft, its check, a mend by hand, a held object, a file for the robot; with fewer starts."""
    from torchgrasp.app import cli

    def of_python(found):
        """Return what Python prints for the code of a command in a line of the shell."""
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            exec(found[1], {})
        return out.getvalue().strip()

    def in_shell(line):
        line = re.sub(r"\$\(python -c '(.*?)'\)", of_python, line)
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", line], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout.strip()

    pytest.importorskip("sapien")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    monkeypatch.setattr("torchgrasp.app.cli.hands.TRIAL", HandTrial(starts=4, postures=1000))
    monkeypatch.setattr("torchgrasp.app.cli.hands.draw_hand", lambda *hand: b"")
    few = functools.partial(collision_pairs, n=2000)
    monkeypatch.setattr("torchgrasp.app.author.draft.collision_pairs", few)
    monkeypatch.setattr("torchgrasp.app.report.page.draw_pictures", lambda run: {})
    guide = "".join(fenced("bash", (ROOT / "docs" / "hands.md").read_text())).replace(
        "--starts 200", "--starts 8"
    )
    for line in guide.splitlines():
        if line.startswith("torchgrasp "):
            assert cli.main(shlex.split(os.path.expandvars(line))[1:]) == 0, (
                line,
                capsys.readouterr(),
            )
        elif assigned := re.fullmatch(r"(\w+)=(.*)", line):
            monkeypatch.setenv(assigned[1], in_shell(f"echo {assigned[2]}"))
        else:
            in_shell(line)
    said = capsys.readouterr().out
    assert said.count("the hand can grasp") == 2 and "The leap hand held the cylinder" in said
    assert "wrong:" not in said and "warning:" not in said
    grasps = json.loads((tmp_path / "grasps.json").read_text())["grasps"]
    assert grasps and {contact["finger"] for contact in grasps[0]["contacts"]} == {
        "index",
        "ring",
        "thumb",
    }


def test_the_guide_to_a_real_camera_runs_as_it_stands(tmp_path, monkeypatch, capsys):
    """The commands take the frame that the page renders, in a quarter of the pixels; planning itself
    is replaced.
    """
    from torchgrasp import read_scene
    from torchgrasp.app import cli
    from torchgrasp.app.cli.grasp import Grasp
    from torchgrasp.cloud import camera

    def render_less(*given, **options):
        depth, labels = render_whole(*given, **options)
        return halved(depth), halved(labels)

    render_whole = camera.render_depth
    monkeypatch.setattr(camera, "render_depth", render_less)
    monkeypatch.setattr(camera, "INTRINSICS", HALF)

    guide = (ROOT / "docs" / "real_camera.md").read_text()
    found = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        Grasp, "_grasp_scene", lambda self, path, *_: found.append(read_scene(path)) or 0
    )
    exec(compile(fenced("python", guide)[0], "real_camera.md", "exec"), {})
    for line in "".join(fenced("bash", guide)).splitlines():
        assert cli.main(shlex.split(line)[1:]) == 0, (line, capsys.readouterr())
    assert [len(scene.things) for scene in found] == [3, 3, 3] and found[-1].target is not None
    assert {path.stem for path in tmp_path.glob("*.png")} == {
        "scene",
        "masked",
        "quiet",
        "up",
        "known",
    }


@pytest.mark.parametrize(
    "path", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.stem
)
def test_example_runs(path, capsys, short_trials):
    """Each plan has few starts; the script is compiled under its own name."""
    names = {"__name__": "__main__", "__file__": str(path)}
    exec(compile(with_little_work(path.read_text()), str(path), "exec"), names)
    assert capsys.readouterr().out


def test_every_example_is_short_and_numbered():
    assert 1 <= len(fenced("python")[0].strip().splitlines()) <= 8
    paths = sorted((ROOT / "examples").glob("*.py"))
    assert [path.name[:3] for path in paths] == [f"{k:02}_" for k in range(1, len(paths) + 1)]
    assert max(len(path.read_text().splitlines()) for path in paths) <= 80


@pytest.mark.parametrize(
    "line", [line for block in fenced("bash") for line in block.splitlines() if line.strip()]
)
def test_commands_of_the_readme_exist_and_take_their_flags(line, capsys):
    from torchgrasp.app.cli import COMMANDS, main

    groups = {name.split()[0] for name in COMMANDS if " " in name}
    words = shlex.split(line, comments=True)
    if words[0] == "torchgrasp":
        with pytest.raises(SystemExit) as end:
            main([*words[1 : 3 if words[1] in groups else 2], "--help"])
        assert end.value.code == 0
        said = capsys.readouterr().out
        assert [w for w in words if w.startswith("--") and w not in said] == []
    elif words[0].startswith("scripts/"):
        script = ROOT / words[0]
        assert script.is_file() and script.stat().st_mode & 0o111
    elif words[0] == "python":
        assert (ROOT / words[1]).is_file()
    else:
        assert words[0] in ("source", "pip")


@pytest.mark.sim
@pytest.mark.slow
def test_commands_of_the_readme_run_in_a_clone_as_typed(
    tmp_path, monkeypatch, capsys, few_postures, short_trials
):
    """In the order of the page, with less work; what a clone holds is linked."""
    from torchgrasp.app import cli

    pytest.importorskip("sapien")
    for name in ("torchgrasp", "hands", "examples"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    less = {
        "grasp": ["--starts", "12", "--no-report"],
        "evaluate": [
            *("--starts", "12", "--grasps", "1", "--views", "1", "--only", "can"),
            *("--workers", "0"),
        ],
    }
    lines = [line for line in "".join(fenced("bash")).splitlines() if line[:11] == "torchgrasp "]
    for line in lines:
        words = shlex.split(line, comments=True)[1:]
        assert cli.main([*words, *less.get(words[0], [])]) == 0, (line, capsys.readouterr())
    made = {path.name for path in (tmp_path / "out").iterdir()}
    assert len(lines) == 9 and made >= {"mine", "scene", "my_leap", "test", "grasps.json", "play"}


def test_inputs_that_commands_of_the_readme_take_are_in_a_clone():
    """What no earlier line of the page wrote must be a file, a folder or a shipped name."""
    from torchgrasp import list_objects

    for line in "".join(fenced("bash")).splitlines():
        words = shlex.split(line, comments=True)
        paths = [word for word in words if "/" in word and not word.startswith(("out", "scripts"))]
        assert [
            path for path in paths if words[0] == "torchgrasp" and not (ROOT / path).exists()
        ] == []
        if words[:2] == ["torchgrasp", "grasp"]:
            assert "/" in words[2] or words[2] in list_objects()


def test_every_file_the_readme_names_exists():
    links = re.findall(r"\]\(([^)#:]+)\)", README)
    assert [p for p in links if not (ROOT / p).exists()] == []
    assert "docs/overview.png" in links


NOTEBOOK = ROOT / "examples" / "tutorial.ipynb"
SHORT = f"__import__('torchgrasp').TrialSpec(hold_time={QUICK.hold_time}, control_rate={QUICK.control_rate})"


def outputs_of(notebook):
    """The kind of each output, and the sizes of its pictures [pixels], by cell."""
    found = []
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            png = data.get("image/png")
            if "text/html" in data:
                png = re.search(r'src="data:image/png;base64,([^"]*)"', data["text/html"])[1]
                assert "<script" not in data["text/html"]
            size = None
            if png is not None:
                size = Image.open(io.BytesIO(base64.b64decode(png))).size
            found.append((output["output_type"], sorted(data), size))
    return found


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")  # of the kernel's own
def test_the_notebook_runs_to_its_last_cell_and_is_stored_with_what_it_shows(monkeypatch):
    pytest.importorskip("sapien")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    stored = outputs_of(notebook)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = []
            cell.source = cell.source.replace("starts=150", "starts=24")
            cell.source = cell.source.replace("hand, jug.mesh,", f"hand, jug.mesh, {SHORT},")
    NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert not any(output["output_type"] == "error" for output in outputs)
    assert outputs[-1]["text"].startswith("True")
    shown = outputs_of(notebook)
    assert [x[:2] for x in shown] == [x[:2] for x in stored]
    assert sum(size is not None for *_, size in shown) == 3
    for (*_, here), (*_, there) in zip(shown, stored, strict=True):
        # fonts of other machines are a little wider
        assert here == there or np.abs(np.subtract(here, there)).max() < 40


def test_the_stored_notebook_is_small_and_ended_well():
    assert NOTEBOOK.stat().st_size < 400_000
    text = "".join(nbformat.read(NOTEBOOK, as_version=4).cells[-1].outputs[0].text)
    assert text.startswith("True ") and str(ROOT) not in NOTEBOOK.read_text()
