"""The live viewer: what it reads of a page, the nodes of its scene, and a hand that moves with grasp and posture."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchgrasp.app import cli
from torchgrasp.app.cli.results import write_results
from torchgrasp.app.report.turning import write_viewer
from torchgrasp.app.report.turning.buffers import pack
from torchgrasp.app.report.turning.contents import POSTURES, describe, describe_grasps
from torchgrasp.app.report.turning.shown import read_page, read_shown
from torchgrasp.cloud import save_cloud
from torchgrasp.errors import BadArgument
from torchgrasp.planner.provenance import digest
from torchgrasp.values import load_grasps


@pytest.fixture(scope="module")
def two(run):
    """A run with two grasps 50 mm apart."""
    grasps = run.grasps[torch.tensor([0, 0])]
    grasps.obj_from_hand[1, 0, 3] += 0.05
    return dataclasses.replace(run, grasps=grasps)


def test_a_page_is_read_as_what_was_written(two, tmp_path):
    shown, upright = read_page(write_viewer(tmp_path / "view.html", two)), two.upright()
    np.testing.assert_allclose(shown.surface.points, upright.surface.vertices, atol=1e-7)
    np.testing.assert_allclose(shown.cloud, upright.cloud.points, atol=1e-7)
    np.testing.assert_allclose(shown.points, upright.executable.contacts.points, atol=1e-7)
    np.testing.assert_allclose(shown.replay.forces, upright.closure.forces, atol=1e-7)
    assert [name for name, _ in shown.fingers] == list(two.hand.tips.names) and len(shown.rows) == 2
    again = read_shown(json.loads(json.dumps(describe(two))))
    assert again.title == shown.title and np.array_equal(again.links, shown.links)


def test_grasps_alone_have_no_shape_but_the_same_rows(two):
    alone, whole = read_shown(describe_grasps("x", two.hand, two.grasps)), read_shown(describe(two))
    assert alone.surface is None and alone.cloud is None and alone.replay is None
    assert alone.rows == whole.rows and alone.links.shape == whole.links.shape


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("title",), 3),
        (("fingers",), [["index", "red; }"]]),
        (("hand", 0, "link"), 10_000),
        (("hand", 0, "points", "data"), "AAAA"),
        (("hand", 0, "points", "shape"), [1, 3, 5]),
        (("hand", 0, "points", "kind"), "O"),
        (("surface", "faces", "shape"), [2**40, 3]),
        (("surface", "std"), None),
        (("grasps", "links", "shape"), [1, 4, 21, 4, 4]),
        (("grasps", "rows"), [["1"]]),
        (("replay", "ticks", "data"), "//////8="),
        (("table",), "javascript:alert(1)"),
    ],
)
def test_a_page_that_is_not_what_it_should_be_is_refused_by_field(two, place, value):
    contents = json.loads(json.dumps(describe(two)))
    within = contents
    for name in place[:-1]:
        within = within[name]
    within[place[-1]] = value
    with pytest.raises(BadArgument, match=place[0]):
        read_shown(contents)


def test_nan_in_a_buffer_and_a_page_without_data_are_refused(two, tmp_path):
    contents = json.loads(json.dumps(describe(two)))
    contents["cloud"] = pack(np.full((4, 3), np.nan))
    with pytest.raises(BadArgument, match="cloud"):
        read_shown(contents)
    (tmp_path / "empty.html").write_text("<p>nothing</p>")
    with pytest.raises(BadArgument, match="no data"):
        read_page(tmp_path / "empty.html")
    page = write_viewer(tmp_path / "view.html", two).read_text(encoding="utf-8")
    (tmp_path / "broken.html").write_text(page.replace('"most_mm":', '"most_mm":-Infinity,"x":'), encoding="utf-8")
    with pytest.raises(BadArgument, match="most_mm"):
        read_page(tmp_path / "broken.html")


@pytest.fixture(scope="module")
def live(two):
    pytest.importorskip("viser")
    from torchgrasp.app.report.turning.live import LiveView

    view = LiveView(read_shown(describe(two)), 8765)
    yield view
    view.stop()


def placed(view):
    """The points of the hand's pieces, from the nodes of the scene as a browser gets them."""
    parts = []
    for (node, _), piece in zip(view.pieces, view.shown.hand, strict=True):
        w, x, y, z = node.wxyz
        parts.append(piece.points @ Rotation.from_quat([x, y, z, w]).as_matrix().T + node.position)
    return np.concatenate(parts)


def expected(view, grasp, posture):
    poses = view.shown.links[grasp, POSTURES.index(posture)].astype(float)
    parts = [p.points @ poses[p.link, :3, :3].T + poses[p.link, :3, 3] for p in view.shown.hand]
    return np.concatenate(parts)


def test_the_scene_holds_the_named_nodes(live):
    assert {"cloud", "surface", "shell", "hand", "contacts", "object", "table"} <= set(live.nodes)
    assert len(live.pieces) == len(live.shown.hand) > 10
    assert live.address.startswith("http://127.0.0.1:")


def test_grasp_and_posture_move_the_hand(live):
    for grasp, posture in ((0, "grasp"), (1, "grasp"), (1, "approach"), (0, "squeeze")):
        live.show(grasp=grasp, posture=posture, tick=None)
        np.testing.assert_allclose(placed(live), expected(live, grasp, posture), atol=1e-5)


def test_the_panel_does_what_show_does(live):
    live.show(grasp=0, posture="grasp", tick=None)
    before = placed(live)
    live.grasps.value = live.grasps.options[1]
    assert live.grasp == 1
    np.testing.assert_allclose(np.linalg.norm(placed(live) - before, axis=1), 0.05, atol=1e-5)
    assert "margin" in live.text.content and "0.0200" in live.text.content
    live.shell.value = 2.0
    away = live.nodes["shell"].vertices - live.shown.surface.points
    np.testing.assert_allclose(away, 2.0 * live.shown.surface.std[:, None] * live.shown.surface.normals, atol=1e-6)
    assert live.nodes["shell"].visible and not live.nodes["object"].visible
    live.ticks.value = 4
    assert live.nodes["object"].visible and not live.nodes["surface"].visible
    np.testing.assert_allclose(live.nodes["object"].position, live.shown.replay.object[4, :3, 3], atol=1e-6)
    assert "1.00 s" in live.text.content


def test_names_are_shown_as_text(two):
    pytest.importorskip("viser")
    from torchgrasp.app.report.turning.live import LiveView

    odd = dataclasses.replace(two, object_name="<img src=x onerror=alert(1)>", closure=None, mesh=None)
    view = LiveView(read_shown(describe(odd)), 8766)
    try:
        assert "<img" not in view.head.content and "&lt;img" in view.head.content
    finally:
        view.stop()


@pytest.fixture
def folder(two, tmp_path):
    """What `torchgrasp grasp` leaves."""
    write_results(tmp_path, dataclasses.replace(two, grasps=signed(two)), no_report=False)
    return tmp_path


def signed(run):
    """The grasps with the names that a plan gives them."""
    names = {"hand": "allegro", "finger_names": ",".join(run.hand.finger_names)}
    return dataclasses.replace(run.grasps, meta=names)


def end(monkeypatch, opened):
    """End the command as Ctrl-C does, where it would wait."""

    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchgrasp.app.cli.results.time.sleep", interrupt)
    monkeypatch.setattr("torchgrasp.app.cli.results.webbrowser.open", opened.append)


def test_the_command_prints_its_address_and_ends_on_ctrl_c(folder, monkeypatch, capsys):
    pytest.importorskip("viser")
    opened = []
    end(monkeypatch, opened)
    for options in (["--no-browser"], []):
        assert cli.main(["view", str(folder), "--port", "8799", *options]) == 130
    said = capsys.readouterr()
    assert said.out.startswith("2 grasps at http://127.0.0.1:") and "Traceback" not in said.err + said.out
    assert len(opened) == 1 and opened[0].startswith("http://127.0.0.1:")


def test_a_page_of_other_grasps_is_left_aside(folder, monkeypatch, capsys):
    pytest.importorskip("viser")
    end(monkeypatch, [])
    file = folder / "grasps.safetensors"
    load_grasps(file)[0].save(file)
    assert cli.main(["view", str(file)]) == 130
    said = capsys.readouterr().out
    assert "shows other grasps" in said and "1 grasps at" in said


def test_without_a_page_a_cloud_is_shown_if_it_is_theirs(two, tmp_path, monkeypatch, capsys):
    pytest.importorskip("viser")
    end(monkeypatch, [])
    seen, other = (tmp_path / f"{name}.npz" for name in ("seen", "other"))
    save_cloud(two.cloud, seen), save_cloud(two.cloud.select(torch.arange(200)), other)
    run = dataclasses.replace(two, grasps=signed(two))
    run.grasps.meta["cloud_sha256"] = digest(two.cloud)
    write_results(tmp_path, run, no_report=True)
    shown = []
    monkeypatch.setattr("torchgrasp.app.report.turning.live.LiveView._add_panel", lambda view: shown.append(view.shown))
    monkeypatch.setattr("torchgrasp.app.report.turning.live.LiveView.show", lambda view: None)
    assert cli.main(["view", str(tmp_path), "--no-browser"]) == 130
    assert "--cloud FILE" in capsys.readouterr().out and shown[-1].cloud is None
    assert cli.main(["view", str(tmp_path), "--no-browser", "--cloud", str(seen)]) == 130
    assert "note" not in capsys.readouterr().out
    np.testing.assert_allclose(shown[-1].cloud, two.cloud.points, atol=1e-6)
    assert cli.main(["view", str(tmp_path), "--no-browser", "--cloud", str(other)]) == 2
    assert "--cloud: found" in capsys.readouterr().err


def test_what_cannot_be_viewed_is_told(folder, monkeypatch, capsys):
    assert cli.main(["view", str(folder / "none")]) == 2 and "GRASPS" in capsys.readouterr().err
    assert cli.main(["view", str(folder), "--port", "0"]) == 2 and "--port" in capsys.readouterr().err
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert cli.main(["view", str(folder)]) == 2
    assert "pip install 'torchgrasp[view]'" in capsys.readouterr().err
