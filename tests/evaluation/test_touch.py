"""Whether fingertips touch before any force, against bodies whose distances have a formula."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
import trimesh

from tests.pinch import HEIGHT, RADIUS, cylinder, pinch
from torchgrasp import PointCloud, load_hand, load_object
from torchgrasp.app import cli
from torchgrasp.data import load_shipped_grasp
from torchgrasp.evaluation import Touch, measure_touch
from torchgrasp.evaluation.summary import ProtocolResult, ViewScore, summarise
from torchgrasp.export import format_grasps
from torchgrasp.foundation.errors import BadArgument, MeshError, Status, SuspiciousScale

LIMIT = 0.003


def spheres(hand, grasp):
    """Centres (f, 3) and radii (f,) [m] of the pads, by the tree of all links."""
    every = hand.tree.poses(hand.expand_joints(grasp.joints))[0].numpy()
    root = grasp.obj_from_hand[0].numpy()
    centres = []
    for link, centre in zip(hand.tips.links, hand.tips.center.numpy(), strict=True):
        pose = root @ every[hand.tree.link_names.index(link)]
        centres.append(pose[:3, :3] @ centre + pose[:3, 3])
    return np.stack(centres), hand.tips.radius.numpy()


def of_box(points, sides, middle):
    """Signed distances of points from a box along the axes."""
    beyond = np.abs(points - middle) - sides / 2
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    return outside + np.minimum(beyond.max(1), 0)


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_gaps_are_those_of_a_box_and_of_a_sphere(name):
    hand, grasp = pinch(name)
    centres, radii = spheres(hand, grasp)
    for shift in ([0.0, 0.0, 0.0], [0.01, -0.02, 0.03], [0.0, 0.02, 0.0]):
        middle = centres.mean(0) + shift
        sides = np.array([0.05, 0.04, 0.07])
        box = trimesh.creation.box(sides)
        ball = trimesh.creation.icosphere(5, 0.03)
        for mesh in (box, ball):
            mesh.apply_translation(middle)
        wanted = of_box(centres, sides, middle) - radii
        assert np.abs(measure_touch(hand, grasp, box).gaps[0].numpy() - wanted).max() < 1e-6
        wanted = np.linalg.norm(centres - middle, axis=1) - 0.03 - radii
        assert np.abs(measure_touch(hand, grasp, ball).gaps[0].numpy() - wanted).max() < 5e-5


def test_a_hand_of_other_fingers_is_refused():
    """The joints of the middle finger would move the ring finger."""
    jug = load_object("jug").mesh
    grasp = load_shipped_grasp("jug", "allegro")
    right = measure_touch(load_hand("allegro"), grasp, jug)
    assert right.verdicts == ["touches"]
    with pytest.raises(BadArgument, match=r"expected index,middle,thumb.*got index,ring,thumb"):
        measure_touch(load_hand("allegro", ("index", "ring", "thumb")), grasp, jug)
    # an import from elsewhere names no fingers
    bare = dataclasses.replace(grasp, meta={})
    assert torch.equal(measure_touch(load_hand("allegro"), bare, jug).gaps, right.gaps)


def test_a_mesh_inside_out_or_in_millimetres_is_refused_and_an_open_one_is_not():
    hand, grasp = pinch("barrett")
    body = cylinder()
    truth = measure_touch(hand, grasp, body)
    # trimesh turns faces by a view of them, too
    for faces in (body.faces[:, ::-1], body.faces[:, ::-1].copy()):
        inside_out = trimesh.Trimesh(body.vertices, faces, process=False)
        with pytest.raises(MeshError, match=r"surface: expected .*faces turned outward"):
            measure_touch(hand, grasp, inside_out)
        turned = trimesh.Trimesh(body.vertices, inside_out.faces[:, ::-1], process=False)
        assert torch.equal(measure_touch(hand, grasp, turned).gaps, truth.gaps)
    large = body.copy().apply_scale(1000.0)
    with pytest.raises(SuspiciousScale, match="use metres"):
        measure_touch(hand, grasp, large)
    low = body.triangles_center[:, 2] < body.triangles_center[:, 2].min() + 1e-6
    without_base = trimesh.Trimesh(body.vertices, body.faces[~low], process=False)
    assert not without_base.is_watertight
    near = measure_touch(hand, grasp, without_base).gaps
    torch.testing.assert_close(near, truth.gaps, atol=1e-6, rtol=0)


def test_an_object_in_another_frame_is_refused_and_one_that_is_missed_is_not():
    hand, grasp = pinch("barrett")
    body = cylinder()
    missed = body.copy().apply_translation([0.3, 0.0, 0.0])
    assert measure_touch(hand, grasp, missed).verdicts == ["apart"]
    for surface in (
        body.copy().apply_translation([0.0, 0.0, 1.0]),
        PointCloud(torch.from_numpy(body.vertices + 5.0)),
    ):
        with pytest.raises(BadArgument, match="surface: expected the grasped object"):
            measure_touch(hand, grasp, surface)


@pytest.mark.parametrize(
    ("gap", "verdict"),
    [(0.002, "touches"), (-0.002, "touches"), (0.004, "apart"), (-0.004, "penetrates")],
)
def test_a_fingertip_at_a_known_gap_has_its_verdict(gap, verdict):
    hand, grasp = pinch("allegro")
    centres, radii = spheres(hand, grasp)
    # three balls, each at the gap from one fingertip, on the side of the axis
    away = centres * [1, 1, 0]
    away = away / np.linalg.norm(away, axis=1)[:, None]
    balls = []
    for k in range(3):
        reach = (gap if k == 0 else 0.0) + radii[k] + 0.01
        ball = trimesh.creation.icosphere(4, 0.01)
        balls.append(ball.apply_translation(centres[k] - reach * away[k]))
    touch = measure_touch(hand, grasp, trimesh.util.concatenate(balls), LIMIT)
    assert touch.verdicts == [verdict]
    assert float(touch.gaps[0, 0]) == pytest.approx(gap, abs=1e-4)
    assert touch.gaps[0, 1:].abs().max() < 1e-4
    extreme = touch.largest if gap > 0 else touch.deepest
    assert float(extreme[0]) == pytest.approx(gap, abs=1e-4)


def test_a_cloud_knows_the_seen_side_only():
    hand, grasp = pinch("allegro")
    centres, radii = spheres(hand, grasp)
    angle, height = np.meshgrid(np.linspace(0, math.pi, 120), np.linspace(0, HEIGHT, 180))
    normals = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1).reshape(-1, 3)
    points = RADIUS * normals + np.stack([0 * angle, 0 * angle, height], -1).reshape(-1, 3)
    eye = torch.tensor([0.0, 0.6, 0.1], dtype=torch.float64)
    cloud = PointCloud(torch.tensor(points), torch.tensor(normals), eye)
    wanted = np.linalg.norm(centres[:, :2], axis=1) - RADIUS - radii
    seen = centres[:, 1] > 0
    touch = measure_touch(hand, grasp, cloud, 0.02)
    found = touch.gaps[0].numpy()
    assert np.isnan(found[~seen]).all() and np.abs(found - wanted)[seen].max() < 5e-4
    assert touch.verdicts == ["unseen"] and (~seen).any() and seen.any()
    blind = dataclasses.replace(cloud, normals=None)
    again = measure_touch(hand, grasp, blind, 0.02).gaps[0].numpy()
    assert np.abs(again - wanted)[seen].max() < 1e-3 and np.isnan(again[~seen]).all()


def test_verdicts_name_the_worst_finger_and_nothing_is_known_of_no_grasp():
    bad = math.nan
    gaps = torch.tensor(
        [[0.001, 0.002], [0.004, -0.01], [0.002, -0.004], [0.001, bad], [0.004, bad], [bad, bad]]
    )
    touch = Touch(gaps.double(), LIMIT)
    assert touch.verdicts == ["touches", "apart", "penetrates", "unseen", "apart", "unseen"]
    assert touch.largest[:5].tolist() == pytest.approx([0.002, 0.004, 0.002, 0.001, 0.004])
    assert touch.deepest[:5].tolist() == pytest.approx([0.001, -0.01, -0.004, 0.001, 0.004])
    assert touch.largest[5].isnan() and touch.deepest[5].isnan()
    assert Touch(gaps[:0].double()).verdicts == []
    with pytest.raises(BadArgument, match=r"limit: expected a number in \[0, 0\.1\], got 3"):
        Touch(gaps.double(), 3.0)  # in millimetres, every finger would touch


@pytest.mark.parametrize("moved", [0.0, 0.008])
def test_the_import_prints_and_writes_the_verdict(tmp_path, capsys, moved):
    hand, grasp = pinch("allegro")
    grasp = grasp[0]
    centres, radii = spheres(hand, grasp)
    mesh = cylinder((0.0, moved))
    mesh.export(tmp_path / "tin.ply")
    (tmp_path / "a.json").write_text(format_grasps(hand, grasp))
    words = ["import", str(tmp_path / "a.json"), "--hand", "allegro"]
    words += ["--out", str(tmp_path / "a.safetensors"), "--mesh", str(tmp_path / "tin.ply")]
    words += ["--touch", str(tmp_path / "touch.json"), "--gap", "0.004"]
    assert cli.main(words) in (0, 1)
    told = capsys.readouterr().out
    content = json.loads((tmp_path / "touch.json").read_text())
    wanted = 1000 * (np.linalg.norm(centres[:, :2] - [0, moved], axis=1) - RADIUS - radii)
    (row,) = content["grasps"]
    assert content["limit_mm"] == 4.0
    assert row["gap_mm"] == pytest.approx(wanted.max(), abs=0.2)
    assert row["deepest_mm"] == pytest.approx(wanted.min(), abs=0.2)
    verdict = "apart" if wanted.max() > 4 else "penetrates" if wanted.min() < -4 else "touches"
    assert row["touch"] == verdict and f"within 4 mm: 1 {verdict}" in told
    assert f"{row['gap_mm']:.1f}" in told and f"{row['deepest_mm']:.1f}" in told


def test_a_mesh_elsewhere_is_refused_by_the_import(tmp_path, capsys):
    hand, grasp = pinch("allegro")
    cylinder((0.1, 0.0)).export(tmp_path / "tin.ply")
    (tmp_path / "a.json").write_text(format_grasps(hand, grasp))
    words = ["import", str(tmp_path / "a.json"), "--hand", "allegro", "--out"]
    words += [str(tmp_path / "a.safetensors")]
    assert cli.main([*words, "--mesh", str(tmp_path / "tin.ply")]) == 2
    assert "--mesh" in capsys.readouterr().err and not (tmp_path / "a.safetensors").exists()
    assert cli.main([*words, "--touch", str(tmp_path / "t.json")]) == 2
    assert "--touch" in capsys.readouterr().err


def test_the_summary_counts_the_verdicts():
    def tried(gap, verdict):
        return ProtocolResult(0, 0, True, Status.OK, gap_mm=gap, deepest_mm=-1.0, touch=verdict)

    lost = ProtocolResult(0, 0, False, Status.TIMED_OUT)
    tries = (tried(1.0, "touches"), tried(5.0, "apart"), tried(2.0, "touches"), lost)
    found = summarise([ViewScore("tin", "view0", 4, 1.0, tries)])
    assert found["touch"] == {"touches": 2, "apart": 1}
    assert found["gap_mm"] == pytest.approx((2.0, 4.7))
