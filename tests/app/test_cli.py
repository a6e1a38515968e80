"""The command line: what a bad input ends with, and that nothing is left behind."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from tests.make import run_python
from torchgrasp import GraspTask, load_grasps
from torchgrasp.app import cli
from torchgrasp.app.cli import grasp as grasps
from torchgrasp.app.cli import inputs
from torchgrasp.app.cli.evaluate import print_score
from torchgrasp.app.cli.inputs import check_folder
from torchgrasp.app.cli.results import read_true_mesh
from torchgrasp.data.shipped import DATA
from torchgrasp.evaluation.summary import ViewScore
from torchgrasp.foundation.errors import MissingExtra
from torchgrasp.planner.explain import ExplainNumbers

VIEW = str(DATA / "cylinder" / "view.ply")
MESH = str(DATA / "cylinder" / "mesh.ply")


@pytest.fixture
def refuse_work(monkeypatch):
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
        "friction of no edge": ([VIEW, "--table-friction", "0.5"], ["--table-friction", "--edge"]),
        "two points": ([folder / "two.npy", *hand], ["CLOUD", "2 points", "at least 4"]),
        "millimetres": ([folder / "mm.npy", *hand], ["CLOUD", "m"]),
        "nan": ([folder / "nan.npy", *hand], ["CLOUD", "NaN", "198 of 200", "at least 4"]),
        "unknown hand": ([VIEW, "--hand", "fist"], ["--hand", "'fist'", "allegro", "barrett"]),
        "open mesh": (
            [VIEW, *hand, "--mesh", folder / "open.ply", "--close"],
            ["--mesh", "open", "watertight"],
        ),
        "missing mesh": (
            [VIEW, *hand, "--mesh", folder / "no.stl", "--close"],
            ["--mesh", "no file"],
        ),
        "close without mesh": ([VIEW, *hand, "--close"], ["--close", "--mesh"]),
        "open region": (
            [VIEW, *hand, "--keep", folder / "open.ply"],
            ["--keep", "open", "watertight"],
        ),
        "half a box": ([VIEW, *hand, "--avoid", "-1 0 0"], ["--avoid", "six numbers", "-1 0 0"]),
        "turned box": ([VIEW, *hand, "--keep", "1 0 0 -1 1 1"], ["--keep", "less than high"]),
        "two tables": ([VIEW, *hand, "--table", "0", "--no-table"], ["--table", "--no-table"]),
        "no friction": ([VIEW, *hand, "--friction", "-1"], ["--friction", "-1"]),
        "nan friction": ([VIEW, *hand, "--friction", "nan"], ["--friction", "nan"]),
        "no interval": ([VIEW, *hand, "--mass", "0.1-0.4"], ["--mass", "'0.1-0.4'", "0.3:0.8"]),
        "wide interval": ([VIEW, *hand, "--friction", "0.3:11"], ["--friction", "0.3 to 11"]),
        "no starts": ([VIEW, *hand, "--starts", "0"], ["--starts", "0"]),
        "negative seed": ([VIEW, *hand, "--seed", "-1"], ["--seed", "-1"]),
        "nan viewpoint": ([VIEW, *hand, "--viewpoint", "nan", "0", "0"], ["--viewpoint", "nan"]),
    }


def test_grasp_refuses_bad_input_in_one_sentence_and_leaves_nothing(tmp_path, refusal, refuse_work):
    for name, (arguments, words) in bad_inputs(tmp_path).items():
        error = refusal("grasp", *arguments, "--out", tmp_path / "made" / "out")
        assert all(word in error for word in words), (name, error)
        assert not (tmp_path / "made").exists()


def test_regions_of_the_command_line_reach_the_planner(monkeypatch, run_command, tmp_path):
    def see(*args, keep, avoid, resist, **options):
        assert resist == ("lift", "pour")
        points = torch.tensor([[0.0, 0.0, 0.04], [0.0, 0.0, 0.06]])
        assert (keep(points) < 0).tolist() == [False, True]
        assert (avoid(points) < 0).tolist() == [True, True]
        raise MissingExtra("seen", "seen")

    monkeypatch.setattr(grasps, "plan_grasps", see)
    words = "--hand", "barrett", "--keep", "-1 -1 0.05 1 1 1", "--avoid", MESH
    assert (
        "seen"
        in run_command(
            "grasp", VIEW, *words, "--resist", "lift", "pour", "--out", tmp_path / "out"
        )[2]
    )


@pytest.mark.parametrize("name", ["a" * 300, "a/" * 3000, "a\0b", "\ud800"])
@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("CLOUD", ["grasp", "NAME", "--hand", "barrett", "--out", "out"]),
        ("--out", ["grasp", VIEW, "--hand", "barrett", "--out", "NAME"]),
        ("--out", ["hand", "sample", "--hand", "barrett", "--n", "10", "--out", "NAME"]),
        (
            "--checkpoint",
            ["hand", "train", "barrett", "--n", "100", "--checkpoint", "NAME", "--out", "out"],
        ),
        ("--objects", ["evaluate", "--objects", "NAME", "--hand", "barrett", "--out", "out"]),
    ],
)
def test_a_path_that_no_file_can_have_is_refused_by_its_option(
    name, option, words, tmp_path, monkeypatch, refusal, refuse_work
):
    monkeypatch.chdir(tmp_path)
    error = refusal(*(name if word == "NAME" else word for word in words))
    assert error.startswith(f"{option}: ") and len(error) < 300 and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("out", ["file", "file/deeper", "/proc/nothing/here"])
def test_a_folder_that_cannot_be_written_is_refused_before_the_work(
    out, tmp_path, refusal, refuse_work
):
    (tmp_path / "file").write_text("x")
    assert refusal("grasp", VIEW, "--out", tmp_path / out).startswith("--out: ")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_check_folder_leaves_a_folder_as_it_was(tmp_path):
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "report.html").write_text("old")
    check_folder(tmp_path / "kept")
    check_folder(tmp_path / "new" / "deep")
    assert [p.name for p in tmp_path.iterdir()] == ["kept"]
    assert (tmp_path / "kept" / "report.html").read_text() == "old"


@pytest.mark.promise("F9")
@pytest.mark.parametrize("missing", ["sapien", "libX11.so.6: cannot open shared object file"])
def test_a_missing_simulator_is_named_before_the_work(
    missing, tmp_path, run_command, monkeypatch, refuse_work
):
    find = inputs.importlib.util.find_spec
    load = inputs.importlib.import_module

    def fail(name, *package):
        """Other packages may be imported here for the first time."""
        if name != "sapien":
            return load(name, *package)
        raise ImportError(missing)

    def look(name, *package):
        return find(name, *package) if name != "sapien" else None if missing == name else "found"

    monkeypatch.setattr(inputs.importlib.util, "find_spec", look)
    monkeypatch.setattr(inputs.importlib, "import_module", fail)
    code, _, error = run_command(
        "grasp", VIEW, "--mesh", MESH, "--close", "--out", tmp_path / "out"
    )
    assert (
        code == 2
        and missing in error
        and error.count("\n") == 1
        and not (tmp_path / "out").exists()
    )


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (
            MissingExtra("a package\nwith two lines", "sim"),
            2,
            "torchgrasp: a package with two lines is not installed",
        ),
        (KeyboardInterrupt(), 130, "torchgrasp: interrupted\n"),
    ],
)
def test_an_error_during_the_work_is_one_sentence_and_leaves_nothing(
    error, code, said, tmp_path, run_command, monkeypatch
):
    def fail(*args, **kwargs):
        raise error

    monkeypatch.setattr(grasps, "plan_grasps", fail)
    found, _, err = run_command("grasp", VIEW, "--hand", "allegro", "--out", tmp_path / "out")
    assert (
        found == code
        and err.startswith(said)
        and err.count("\n") == 1
        and not (tmp_path / "out").exists()
    )


def test_objects_lists_files_that_exist(capsys):
    assert cli.main(["objects"]) == 0
    lines = capsys.readouterr().out.splitlines()
    paths = [line.split(": ")[1] for line in lines if ": " in line]
    assert len(paths) == 8 and all(Path(p).read_bytes()[:3] == b"ply" for p in paths)
    assert run_python("-m", "torchgrasp", "objects").stdout.splitlines() == lines


def test_the_table_is_at_the_lowest_point_that_is_no_outlier_unless_it_is_given(
    tmp_path, monkeypatch
):
    """Those are outliers whose eight nearest points are 2.5 times as far as half of the points have
    theirs.
    """
    seen = []

    def note(
        cloud,
        hand,
        spec,
        starts,
        seed,
        fingers,
        mode,
        observer,
        time_budget,
        task,
        promise,
        **where,
    ):
        assert mode == "joint" and fingers is None and time_budget is None and promise is None
        assert where == {"keep": None, "avoid": None, "resist": None}
        assert task == GraspTask()
        apart = (
            torch.cdist(cloud.points.double(), cloud.points.double()).sort(1).values[:, 1:9].mean(1)
        )
        lowest = float(cloud.points[apart <= 2.5 * apart.median(), 2].min())
        seen.append((spec.table, spec.friction, starts, seed, lowest))
        raise KeyboardInterrupt

    monkeypatch.setattr(grasps, "plan_grasps", note)
    for extra in (
        [],
        ["--table", "-0.01"],
        ["--no-table", "--starts", "5", "--seed", "3", "--friction", "0.5"],
    ):
        cli.main(["grasp", VIEW, "--hand", "barrett", "--out", str(tmp_path / "out"), *extra])
    assert seen[0][0] == seen[0][4] and seen[0][1:4] == (0.8, 1000, 0)
    assert seen[1][0] == -0.01
    assert seen[2][:4] == (None, 0.5, 5, 3)


def test_a_shipped_mesh_comes_with_its_parts_wherever_it_lies(tmp_path):
    copy = tmp_path / "copy.ply"
    copy.write_bytes((DATA / "jug" / "mesh.ply").read_bytes())
    mesh, parts = read_true_mesh(copy)
    assert parts is not None and len(parts) > 1
    assert sum(p.volume for p in parts) == pytest.approx(mesh.volume, rel=0.35)
    trimesh.creation.box((0.05, 0.05, 0.05)).export(tmp_path / "box.stl")
    assert read_true_mesh(tmp_path / "box.stl")[1] is None


def test_grasp_writes_grasps_and_pages_for_a_shipped_object_by_name(
    tmp_path, run_command, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    code, out, err = run_command("grasp", "cylinder", "--hand", "barrett", "--starts", "20")
    assert err == ""  # no bar where there is no terminal
    for stage in ("cloud", "shape", "plan", "certify", "query", "refine", "report"):
        assert any(line.startswith(stage) for line in out.splitlines())
    folder = tmp_path / "out" / "cylinder"
    names = ["grasps.safetensors", "report.html", "surface.ply", "view.html"]
    assert sorted(p.name for p in folder.iterdir()) == names
    assert 'href="view.html"' in (folder / "report.html").read_text()
    found = load_grasps(folder / "grasps.safetensors")
    assert (
        found.meta["hand"] == "barrett"
        and found.meta["seed"] == "0"
        and "metre" in found.meta["units"]
    )
    assert (
        code == (0 if bool((found.status == 0).any()) else 1) and torch.isfinite(found.joints).all()
    )
    assert out.splitlines()[-1].startswith("The barrett hand has")
    # the best grasp is likely enough, so no second view is asked for
    assert float(found.best.success) > 0.9 and "look next" not in out


@pytest.mark.parametrize(
    ("words", "near"),
    [
        (["gras", "x"], "grasp"),
        (["grasp", "jgu"], "jug"),
        (["grasp", "jug", "--hand", "alegro"], "allegro"),
    ],
)
def test_a_misspelt_name_is_answered_with_the_nearest_one(
    words, near, tmp_path, monkeypatch, refusal, refuse_work
):
    monkeypatch.chdir(tmp_path)
    assert refusal(*words).endswith(f"; did you mean {near}?\n")


def test_an_empty_result_names_what_would_help_and_leaves_no_page_of_an_earlier_plan(
    tmp_path, run_command, monkeypatch
):
    for name in ("surface.ply", "report.html", "view.html", "run.rrd"):
        (tmp_path / name).write_text("of another plan")
    monkeypatch.setattr("torchgrasp.planner.explain.EXPLAIN", ExplainNumbers(trials=1))
    options = ["--starts", "5", "--friction", "0", "--table", "0", "--no-report"]
    code, out, _ = run_command("grasp", VIEW, "--hand", "barrett", "--out", tmp_path, *options)
    assert code == 1 and [p.name for p in tmp_path.iterdir()] == ["grasps.safetensors"]
    assert any(line.startswith("change") and "executable" in line for line in out.splitlines())
    last = out.splitlines()[-1]
    assert last.startswith("The barrett hand has no executable grasp")
    assert "if the friction were 0.4 instead of 0" in last


@pytest.mark.parametrize(
    "words", [["cloud"], ["cloud", "--help"], ["shape", "-h"], ["cloud", "check", "--help"]]
)
def test_groups_of_commands_have_help(words, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(words)
    said = capsys.readouterr().out
    assert end.value.code == 0 and f"torchgrasp {' '.join(w for w in words if w[0] != '-')}" in said
    assert "evaluate" not in said


@pytest.mark.parametrize("command", list(cli.COMMANDS))
def test_help_says_no_default_that_says_nothing_and_breaks_lines_by_their_width(
    command, capsys, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit):
        cli.main([*command.split(), "--help"])
    said = capsys.readouterr().out
    assert "None" not in said and "default: False" not in said
    rows = [line.strip("│ ") for line in said.splitlines() if line.startswith("│ " + 10 * " ")]
    short = [row for row in rows if len(row) < 40]
    assert all(row.endswith((".", ")", "]")) for row in short), short


def test_no_command_overwrites_a_file_that_it_reads(tmp_path, monkeypatch, refusal):
    monkeypatch.chdir(tmp_path)
    files = {
        "mesh.ply": Path(MESH),
        "view.ply": Path(VIEW),
        "plan/grasps.safetensors": DATA / "jug" / "barrett.safetensors",
    }
    (tmp_path / "plan").mkdir()
    for name, source in files.items():
        shutil.copy(source, name)
    (tmp_path / "link.ply").symlink_to("mesh.ply")
    (tmp_path / "plan" / "surface.ply").symlink_to("../mesh.ply")
    np.save("depth.npy", np.ones((4, 4)))
    (tmp_path / "depth.npy").rename("depth.npz")
    for words in (
        ["cloud", "render", "mesh.ply", "--out", "./mesh.ply"],
        ["cloud", "render", "mesh.ply", "--out", "link.ply"],
        ["cloud", "thin", "view.ply", "--out", tmp_path / "view.ply"],
        ["shape", "surface", "view.ply", "--out", "view.ply"],
        ["cloud", "scene", "depth.npz", "--frames", "depth.npz", "--out", "depth.npz"],
        ["export", "plan", "--out", "plan/grasps.safetensors"],
        ["export", "plan/grasps.safetensors", "--out", "plan/surface.ply"],
        ["import", "view.ply", "--hand", "barrett", "--out", "view.ply"],
    ):
        assert refusal(*words).startswith("--out: "), words
    assert all(Path(name).read_bytes() == source.read_bytes() for name, source in files.items())


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
    assert (
        cli.main(["view", "jug"]) == 2
        and "torchgrasp grasp CLOUD --out jug" in capsys.readouterr().err
    )
    (tmp_path / "view.html").write_text("")
    assert cli.main(["view", str(tmp_path), "--no-browser"]) == 0 and opened == []
    assert cli.main(["view", str(tmp_path)]) == 0 and opened == [(tmp_path / "view.html").as_uri()]
    assert (
        "No browser was found" in capsys.readouterr().out
    )  # `append` returns None, as a machine without a browser
    (tmp_path / "grasps.safetensors").write_text("")
    assert cli.main(["view", str(tmp_path / "grasps.safetensors")]) == 0 and opened[1] == opened[0]
    (tmp_path / "out" / "jug").mkdir(parents=True)
    mine = tmp_path / "mine.html"
    jug = tmp_path / "out" / "jug" / "view.html"
    monkeypatch.chdir(tmp_path)
    for asked, page in (("mine.html", mine), ("jug", jug)):
        page.write_text("")
        assert cli.main(["view", asked]) == 0 and opened[-1] == page.as_uri()


def test_the_bare_command_shows_where_to_begin_and_help_lists_every_command_in_a_chapter(capsys):
    assert cli.main(["--help"]) == 0
    said = capsys.readouterr().out
    assert all(f"\n  {name} " in said for name in cli.COMMANDS) and "Plan grasps" in said
    assert cli.main([]) == 0
    said = capsys.readouterr().out
    shown = [line.strip() for line in said.splitlines() if line.startswith("  torchgrasp")]
    named = {line.removeprefix("torchgrasp ") for line in shown}
    assert len(named) == 4 and all(
        any(words.startswith(name) for name in cli.COMMANDS) for words in named
    )


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
    done = subprocess.run(
        ["bash", "-c", ask], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert set(done.stdout.split()) - {"--help", "-h"} == offered


def test_cloud_check_reports_a_view(run_command):
    code, out, _ = run_command("cloud", "check", VIEW)
    assert code == 0
    for word in (
        "points      1000",
        "mm",
        "spacing",
        "noise",
        "outliers",
        "normals",
        "viewpoint   given",
    ):
        assert word in out


def test_cloud_check_names_fixes(tmp_path, run_command):
    points = sphere(6000)
    points[:3] += 0.3
    np.save(tmp_path / "ball.npy", np.concatenate([points, points[:5]]))
    code, out, _ = run_command("cloud", "check", tmp_path / "ball.npy")
    assert (
        code == 1 and "6005 (5 of them copies)" in out and "torchgrasp cloud thin" in out
    )  # no camera sees all sides
    assert next(line for line in out.splitlines() if line.startswith("outliers")).split()[1] == "3"


def test_cloud_check_refuses_by_name(tmp_path, refusal):
    inputs = bad_inputs(tmp_path)
    for name in ("missing cloud", "empty ply", "other suffix", "two points", "millimetres", "nan"):
        assert refusal("cloud", "check", inputs[name][0][0]).startswith("FILE: ")


def test_cloud_render_writes_a_cloud_that_cloud_check_and_shape_surface_read(tmp_path, run_command):
    out = tmp_path / "made" / "view.ply"
    words = [
        "cloud",
        "render",
        MESH,
        "--out",
        out,
        "--azimuth",
        "200",
        "--elevation",
        "20",
        "--points",
        "300",
    ]
    assert run_command(*words)[0] == 0
    first = out.read_bytes()
    assert run_command(*words)[0] == 0 and out.read_bytes() == first
    assert "300" in run_command("cloud", "check", out)[1]
    for suffix in ("ply", "glb"):
        surface = tmp_path / f"surface.{suffix}"
        code, said, _ = run_command("shape", "surface", out, "--out", surface, "--resolution", "24")
        assert code == 0 and "mm where it is yellow" in said
        mesh = trimesh.load(surface, force="mesh", process=False)
        height = np.ptp(mesh.vertices, axis=0).max()
        assert 0.7 < height / np.ptp(trimesh.load(MESH, force="mesh").vertices, axis=0).max() < 1.4
        assert len(np.unique(mesh.visual.vertex_colors, axis=0)) > 20


@pytest.mark.parametrize(
    ("words", "start"),
    [
        (["cloud", "render", MESH, "--out", "a.pcd"], "--out: expected .*got a.pcd"),
        (["cloud", "render", "none.stl", "--out", "a.ply"], "MESH: expected .*got none.stl"),
        (
            ["cloud", "render", MESH, "--out", "a.ply", "--elevation", "95"],
            "--elevation: expected .*got 95",
        ),
        (
            ["cloud", "render", MESH, "--out", "a.ply", "--azimuth", "nan"],
            "--azimuth: expected .*got nan",
        ),
        (
            ["cloud", "render", MESH, "--out", "a.ply", "--distance", "0"],
            "--distance: expected .*got 0",
        ),
        (
            ["cloud", "render", MESH, "--out", "a.ply", "--points", "2"],
            "--points: expected .*got 2",
        ),
        (["cloud", "render", MESH, "--out", "a.ply", "--seed", "-1"], "--seed: expected .*got -1"),
        (["shape", "surface", VIEW, "--out", "a.obj"], "--out: expected .*got a.obj"),
        (["shape", "surface", VIEW, "--out", "a.ply", "--table", "0", "--no-table"], "--table"),
        (["shape", "surface", "no.ply", "--out", "a.ply"], "CLOUD: expected .*got no.ply"),
        (
            ["shape", "surface", VIEW, "--out", "a.ply", "--resolution", "4"],
            "--resolution: expected .*got 4",
        ),
    ],
)
def test_bad_options_are_named_and_nothing_is_left(words, start, tmp_path, refusal, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert re.match(start, refusal(*words)) and list(tmp_path.iterdir()) == []
