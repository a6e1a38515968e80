"""The command line: what a bad input ends with, and that nothing is left behind."""

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from torchgrasp.app import cli
from torchgrasp.app.cli import grasps, inputs
from torchgrasp.app.cli.evaluate import print_score
from torchgrasp.app.cli.inputs import check_folder
from torchgrasp.data.shipped import DATA
from torchgrasp.errors import MissingExtra
from torchgrasp.evaluation.score import ViewScore

VIEW = str(DATA / "cylinder" / "view.ply")
MESH = str(DATA / "cylinder" / "mesh.ply")


@pytest.fixture
def refuse_work(monkeypatch):
    """Fail the test if the work begins."""

    def work(*args, **kwargs):
        raise AssertionError("the work began")

    monkeypatch.setattr(grasps, "plan_grasps", work)


def sphere(count, scale=0.04):
    points = np.random.default_rng(0).normal(size=(count, 3))
    return scale * points / np.linalg.norm(points, axis=1, keepdims=True)


def bad_inputs(folder):
    """Name each bad input: its arguments, and words that the sentence must hold."""
    np.save(folder / "two.npy", sphere(2))
    np.save(folder / "mm.npy", sphere(200, 40.0))
    np.save(folder / "nan.npy", np.where(np.arange(600).reshape(200, 3) < 592, np.nan, sphere(200)))
    (folder / "empty.xyz").write_text("")
    (folder / "empty.ply").write_bytes(b"")
    (folder / "cloud.docx").write_text("x")
    (folder / "file").write_text("x")
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.04)
    ball.update_faces(np.arange(len(ball.faces)) > 0)
    ball.export(folder / "open.ply")
    hand = ["--hand", "allegro"]
    return {
        "missing cloud": ([folder / "none.ply", *hand], ["CLOUD", "no file"]),
        "empty text": ([folder / "empty.xyz", *hand], ["CLOUD"]),
        "empty ply": ([folder / "empty.ply", *hand], ["CLOUD"]),
        "other suffix": ([folder / "cloud.docx", *hand], ["CLOUD", ".ply"]),
        "two points": ([folder / "two.npy", *hand], ["CLOUD", "2 points", "at least 4"]),
        "millimetres": ([folder / "mm.npy", *hand], ["CLOUD", "m"]),
        "nan": ([folder / "nan.npy", *hand], ["CLOUD", "NaN", "198 of 200", "at least 4"]),
        "unknown hand": ([VIEW, "--hand", "fist"], ["--hand", "'fist'", "allegro", "barrett"]),
        "open mesh": ([VIEW, *hand, "--mesh", folder / "open.ply", "--close"], ["--mesh", "open", "watertight"]),
        "missing mesh": ([VIEW, *hand, "--mesh", folder / "no.stl", "--close"], ["--mesh", "no file"]),
        "close without mesh": ([VIEW, *hand, "--close"], ["--close", "--mesh"]),
        "two tables": ([VIEW, *hand, "--table", "0", "--no-table"], ["--table", "--no-table"]),
        "no friction": ([VIEW, *hand, "--friction", "-1"], ["--friction", "-1"]),
        "nan friction": ([VIEW, *hand, "--friction", "nan"], ["--friction", "nan"]),
        "no starts": ([VIEW, *hand, "--starts", "0"], ["--starts", "0"]),
        "negative seed": ([VIEW, *hand, "--seed", "-1"], ["--seed", "-1"]),
        "nan viewpoint": ([VIEW, *hand, "--viewpoint", "nan", "0", "0"], ["--viewpoint", "nan"]),
    }


@pytest.mark.parametrize(
    "name",
    [
        "missing cloud",
        "empty text",
        "empty ply",
        "other suffix",
        "two points",
        "millimetres",
        "nan",
        "unknown hand",
        "open mesh",
        "missing mesh",
        "close without mesh",
        "two tables",
        "no friction",
        "nan friction",
        "no starts",
        "negative seed",
        "nan viewpoint",
    ],
)
def test_bad_input_ends_in_one_sentence_and_leaves_nothing(name, tmp_path, capsys, refuse_work):
    arguments, words = bad_inputs(tmp_path)[name]
    out = tmp_path / "made" / "out"
    assert cli.main(["grasp", *map(str, arguments), "--out", str(out)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("torchgrasp: ") and said.err.count("\n") == 1 and "Traceback" not in said.err
    assert "expected" in said.err and ", got " in said.err
    for word in words:
        assert word in said.err
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("name", ["a" * 300, "a/" * 3000, "a\0b", "\ud800"])
@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("CLOUD", ["grasp", "NAME", "--hand", "barrett", "--out", "out"]),
        ("--out", ["grasp", VIEW, "--hand", "barrett", "--out", "NAME"]),
        ("--out", ["hand", "sample", "--hand", "barrett", "--n", "10", "--out", "NAME"]),
        ("--checkpoint", ["hand", "train", "barrett", "--n", "100", "--checkpoint", "NAME", "--out", "out"]),
        ("--objects", ["evaluate", "--objects", "NAME", "--hand", "barrett", "--out", "out"]),
    ],
)
def test_what_no_file_can_be_called_is_refused_by_the_option(
    name, option, words, tmp_path, monkeypatch, capsys, refuse_work
):
    monkeypatch.chdir(tmp_path)
    assert cli.main([name if word == "NAME" else word for word in words]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"torchgrasp: {option}: expected") and said.count("\n") == 1 and len(said) < 300
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("out", ["file", "file/deeper", "/proc/nothing/here"])
def test_a_folder_that_cannot_be_written_is_refused_before_the_work(out, tmp_path, capsys, refuse_work):
    (tmp_path / "file").write_text("x")
    assert cli.main(["grasp", VIEW, "--hand", "allegro", "--out", str(tmp_path / out)]) == 2
    said = capsys.readouterr().err
    assert said.startswith("torchgrasp: --out: expected") and said.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_check_folder_leaves_a_folder_as_it_was(tmp_path):
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "report.html").write_text("old")
    check_folder(tmp_path / "kept")
    check_folder(tmp_path / "new" / "deep")
    assert [p.name for p in tmp_path.iterdir()] == ["kept"]
    assert (tmp_path / "kept" / "report.html").read_text() == "old"


@pytest.mark.promise("F9")
def test_a_missing_simulator_is_named_before_the_work(tmp_path, capsys, monkeypatch, refuse_work):
    monkeypatch.setattr(inputs.importlib.util, "find_spec", lambda name: None)
    arguments = [VIEW, "--hand", "allegro", "--mesh", MESH, "--close", "--out", str(tmp_path / "out")]
    assert cli.main(["grasp", *arguments]) == 2
    assert capsys.readouterr().err == f"torchgrasp: {MissingExtra('sapien', 'sim')}\n"


def test_a_simulator_without_its_libraries_is_named_before_the_work(tmp_path, capsys, monkeypatch, refuse_work):
    def fail(name):
        raise ImportError("libX11.so.6: cannot open shared object file")

    monkeypatch.setattr(inputs.importlib.util, "find_spec", lambda name: "found")
    monkeypatch.setattr(inputs.importlib, "import_module", fail)
    arguments = [VIEW, "--hand", "allegro", "--mesh", MESH, "--close", "--out", str(tmp_path / "out")]
    assert cli.main(["grasp", *arguments]) == 2
    said = capsys.readouterr().err
    assert "libX11" in said and said.count("\n") == 1 and not (tmp_path / "out").exists()


def test_an_error_during_the_work_is_one_sentence_too(tmp_path, capsys, monkeypatch):
    def fail(*args, **kwargs):
        raise MissingExtra("a package\nwith two lines", "sim")

    monkeypatch.setattr(grasps, "plan_grasps", fail)
    assert cli.main(["grasp", VIEW, "--hand", "allegro", "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_interrupt_ends_with_130_and_without_files(tmp_path, capsys, monkeypatch):
    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(grasps, "plan_grasps", interrupt)
    assert cli.main(["grasp", VIEW, "--hand", "allegro", "--out", str(tmp_path / "out")]) == 130
    assert capsys.readouterr().err == "torchgrasp: interrupted\n"
    assert not (tmp_path / "out").exists()


def test_objects_lists_files_that_exist(capsys):
    assert cli.main(["objects"]) == 0
    lines = capsys.readouterr().out.splitlines()
    paths = [line.split(": ")[1] for line in lines if ": " in line]
    assert len(paths) == 8 and all(Path(p).read_bytes()[:3] == b"ply" for p in paths)


def test_the_table_is_at_the_lowest_point_that_is_no_outlier_unless_it_is_given(tmp_path, monkeypatch):
    """Those are outliers whose eight nearest points are 2.5 times as far as half of the points have theirs."""
    seen = []

    def note(cloud, hand, spec, starts, seed, fingers, mode, observer, time_budget):
        assert mode == "joint" and fingers is None and time_budget is None
        apart = torch.cdist(cloud.points.double(), cloud.points.double()).sort(1).values[:, 1:9].mean(1)
        lowest = float(cloud.points[apart <= 2.5 * apart.median(), 2].min())
        seen.append((spec.table, spec.friction, starts, seed, lowest))
        raise KeyboardInterrupt

    monkeypatch.setattr(grasps, "plan_grasps", note)
    for extra in ([], ["--table", "-0.01"], ["--no-table", "--starts", "5", "--seed", "3", "--friction", "0.5"]):
        cli.main(["grasp", VIEW, "--hand", "barrett", "--out", str(tmp_path / "out"), *extra])
    assert seen[0][0] == seen[0][4] and seen[0][1:4] == (0.8, 1000, 0)
    assert seen[1][0] == -0.01
    assert seen[2][:4] == (None, 0.5, 5, 3)


def test_a_shipped_mesh_comes_with_its_parts_wherever_it_lies(tmp_path):
    copy = tmp_path / "copy.ply"
    copy.write_bytes((DATA / "jug" / "mesh.ply").read_bytes())
    mesh, parts = grasps.read_true_mesh(copy)
    assert parts is not None and len(parts) > 1
    assert sum(p.volume for p in parts) == pytest.approx(mesh.volume, rel=0.35)
    trimesh.creation.box((0.05, 0.05, 0.05)).export(tmp_path / "box.stl")
    assert grasps.read_true_mesh(tmp_path / "box.stl")[1] is None


def test_grasp_from_cloud_to_files(tmp_path, capsys):
    out = tmp_path / "out"
    code = cli.main(["grasp", VIEW, "--hand", "barrett", "--out", str(out), "--starts", "60"])
    said = capsys.readouterr()
    assert said.err == ""  # no bar where there is no terminal
    for stage in ("cloud", "shape", "plan", "certify", "query", "refine", "report"):
        assert any(line.startswith(stage) for line in said.out.splitlines())
    assert sorted(p.name for p in out.iterdir()) == ["grasps.safetensors", "report.html", "view.html"]
    assert 'href="view.html"' in (out / "report.html").read_text()

    from torchgrasp.values import load_grasps

    found = load_grasps(out / "grasps.safetensors")
    assert found.meta["hand"] == "barrett" and found.meta["seed"] == "0" and "metre" in found.meta["units"]
    assert code == (0 if bool((found.status == 0).any()) else 1)
    assert torch.isfinite(found.joints).all()
    assert said.out.splitlines()[-1].startswith("The barrett hand has")


def test_an_empty_result_names_what_would_help(tmp_path, capsys):
    code = cli.main(
        [
            "grasp",
            VIEW,
            "--hand",
            "barrett",
            "--out",
            str(tmp_path),
            "--starts",
            "10",
            "--friction",
            "0",
            "--table",
            "0",
            "--no-report",
        ]
    )
    said = capsys.readouterr().out
    assert code == 1 and [p.name for p in tmp_path.iterdir()] == ["grasps.safetensors"]
    assert any(line.startswith("change") and "executable" in line for line in said.splitlines())
    last = said.splitlines()[-1]
    assert (
        last.startswith("The barrett hand has no executable grasp") and "if the friction were 0.4 instead of 0" in last
    )


@pytest.mark.parametrize("words", [["cloud"], ["cloud", "--help"], ["shape", "-h"], ["cloud", "check", "--help"]])
def test_groups_of_commands_have_help(words, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(words)
    said = capsys.readouterr().out
    assert end.value.code == 0 and f"torchgrasp {' '.join(w for w in words if w[0] != '-')}" in said
    assert "evaluate" not in said


@pytest.mark.parametrize("command", list(cli.COMMANDS))
def test_help_says_no_default_that_says_nothing_and_breaks_lines_by_their_width(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit):
        cli.main([*command.split(), "--help"])
    said = capsys.readouterr().out
    assert "None" not in said and "default: False" not in said
    rows = [line.strip("│ ") for line in said.splitlines() if line.startswith("│ " + 10 * " ")]
    short = [row for row in rows if len(row) < 40]
    assert all(row.endswith((".", ")", "]")) for row in short), short


def test_too_few_numbers_of_an_option_are_refused_without_markup(capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["cloud", "check", VIEW, "--viewpoint", "1", "2"])
    said = capsys.readouterr().err
    assert end.value.code == 2 and "FLOAT FLOAT FLOAT" in said and "[bold]" not in said
    assert len({len(line) for line in said.splitlines()}) == 1  # the frame is in line


def test_lines_of_an_evaluation_keep_their_columns_for_names_of_any_length(capsys):
    scores = [ViewScore(name, "view0", 40, 4.0, note="x") for name in ("jug", "a" * 60)]
    for score in scores:
        print_score(score, (60, 5))
    short, long = capsys.readouterr().out.splitlines()
    assert short.index("view0") == long.index("view0") == 62 and len(short) == len(long)


def test_view_opens_the_page_of_a_folder_or_names_what_is_missing(tmp_path, capsys, monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    assert cli.main(["view", str(tmp_path)]) == 2 and "FOLDER: expected" in capsys.readouterr().err
    (tmp_path / "view.html").write_text("")
    assert cli.main(["view", str(tmp_path), "--no-browser"]) == 0 and opened == []
    assert cli.main(["view", str(tmp_path)]) == 0 and opened == [(tmp_path / "view.html").as_uri()]


def test_the_bare_command_shows_where_to_begin(capsys):
    assert cli.main([]) == 0
    said = capsys.readouterr().out
    shown = [line.strip() for line in said.splitlines() if line.startswith("  torchgrasp")]
    named = {line.removeprefix("torchgrasp ") for line in shown}
    assert len(named) == 4 and all(any(words.startswith(name) for name in cli.COMMANDS) for words in named)


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        (["clo"], {"cloud"}),
        (["ca"], {"campaign"}),
        (["cloud", ""], {"check", "cut", "depth", "scene", "thin", "render", "views"}),
        (["hand", "tr"], {"train"}),
        (["vi"], {"view"}),
        (["view", "--n"], {"--no-browser"}),
    ],
)
def test_the_shell_completes_commands_of_a_group(typed, offered, tmp_path, capsys):
    with pytest.raises(SystemExit):
        cli.main(["--tyro-print-completion", "bash"])
    (tmp_path / "completion").write_text(capsys.readouterr().out)
    words = " ".join(f"'{word}'" for word in ["torchgrasp", *typed])
    ask = f"source completion; COMP_WORDS=({words}); COMP_CWORD={len(typed)}; _tyro_torchgrasp; echo ${{COMPREPLY[@]}}"
    done = subprocess.run(["bash", "-c", ask], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) - {"--help", "-h"} == offered


def test_cloud_check_reports_a_view(capsys):
    assert cli.main(["cloud", "check", VIEW]) == 0
    said = capsys.readouterr().out
    for word in ("points      1000", "mm", "spacing", "noise", "outliers", "normals", "viewpoint   given"):
        assert word in said


def test_cloud_check_names_what_to_mend(tmp_path, capsys):
    points = sphere(6000)
    points[:3] += 0.3
    np.save(tmp_path / "ball.npy", np.concatenate([points, points[:5]]))
    assert cli.main(["cloud", "check", str(tmp_path / "ball.npy")]) == 1  # no camera sees a ball from all sides
    said = capsys.readouterr().out
    assert "6005 (5 of them copies)" in said and "torchgrasp cloud thin" in said
    assert next(line for line in said.splitlines() if line.startswith("outliers")).split()[1] == "3"


@pytest.mark.parametrize("name", ["missing cloud", "empty ply", "other suffix", "two points", "millimetres", "nan"])
def test_cloud_check_refuses_by_name(name, tmp_path, capsys):
    path = bad_inputs(tmp_path)[name][0][0]
    assert cli.main(["cloud", "check", str(path)]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.startswith("torchgrasp: FILE: expected") and said.err.count("\n") == 1


def test_cloud_render_writes_what_cloud_check_and_shape_surface_read(tmp_path, capsys):
    out = tmp_path / "made" / "view.ply"
    arguments = ["--azimuth", "200", "--elevation", "20", "--points", "300", "--seed", "4"]
    assert cli.main(["cloud", "render", MESH, "--out", str(out), *arguments]) == 0
    first = out.read_bytes()
    assert cli.main(["cloud", "render", MESH, "--out", str(out), *arguments]) == 0
    assert out.read_bytes() == first
    assert cli.main(["cloud", "check", str(out)]) == 0
    assert "300" in capsys.readouterr().out
    for suffix in ("ply", "glb"):
        surface = tmp_path / f"surface.{suffix}"
        assert cli.main(["shape", "surface", str(out), "--out", str(surface), "--resolution", "24"]) == 0
        mesh = trimesh.load(surface, force="mesh", process=False)
        height = np.ptp(mesh.vertices, axis=0).max()
        assert 0.7 < height / np.ptp(trimesh.load(MESH, force="mesh").vertices, axis=0).max() < 1.4
        assert len(np.unique(mesh.visual.vertex_colors, axis=0)) > 20
    assert "mm where it is yellow" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "start"),
    [
        (["cloud", "render", MESH, "--out", "a.pcd"], "--out: expected .*got a.pcd"),
        (["cloud", "render", "none.stl", "--out", "a.ply"], "MESH: expected .*got none.stl"),
        (["cloud", "render", MESH, "--out", "a.ply", "--elevation", "95"], "--elevation: expected .*got 95"),
        (["cloud", "render", MESH, "--out", "a.ply", "--azimuth", "nan"], "--azimuth: expected .*got nan"),
        (["cloud", "render", MESH, "--out", "a.ply", "--distance", "0"], "--distance: expected .*got 0"),
        (["cloud", "render", MESH, "--out", "a.ply", "--points", "2"], "--points: expected .*got 2"),
        (["cloud", "render", MESH, "--out", "a.ply", "--seed", "-1"], "--seed: expected .*got -1"),
        (["shape", "surface", VIEW, "--out", "a.obj"], "--out: expected .*got a.obj"),
        (["shape", "surface", VIEW, "--out", "a.ply", "--table", "0", "--no-table"], "--table"),
        (["shape", "surface", "no.ply", "--out", "a.ply"], "CLOUD: expected .*got no.ply"),
        (["shape", "surface", VIEW, "--out", "a.ply", "--resolution", "4"], "--resolution: expected .*got 4"),
    ],
)
def test_bad_options_are_named_and_nothing_is_left(words, start, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(words) == 2
    said = capsys.readouterr()
    assert said.out == "" and re.match(f"torchgrasp: {start}", said.err) and said.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
