"""Visual meshes of hands: drawn where the URDF places them, kept by a draft, never needed."""

import numpy as np
import pytest
import trimesh

from torchgrasp.app import cli
from torchgrasp.app.author.visuals import VISUAL, _thinned, link_meshes
from torchgrasp.app.report.glb import write_glb
from torchgrasp.app.report.solids import solids_by_link, solids_of_links
from torchgrasp.data.shipped import load_object, load_shipped_grasp
from torchgrasp.hand.load import hands_folder, load_hand

FINE = 3  # subdivisions of the ball that is drawn


def visual(geometry, origin=""):
    return f"<visual>{origin}<geometry>{geometry}</geometry></visual>"


def with_visual(text, link, parts):
    """Return a URDF in which a link has the visuals."""
    return text.replace(f'<link name="{link}">', f'<link name="{link}">{parts}')


@pytest.fixture
def barrett(tmp_path):
    """The Barrett hand, one link of which has a ball of 40 mm as its visual, in millimetres."""
    folder = tmp_path / "mine"
    folder.mkdir()
    for file in ("hand.urdf", "hand.toml"):
        (folder / file).write_bytes((hands_folder() / "barrett" / file).read_bytes())
    (folder / "looks").mkdir()
    trimesh.creation.icosphere(FINE, 20.0).export(folder / "looks" / "ball.stl")
    mesh = '<mesh filename="looks/ball.stl" scale="0.001 0.001 0.001"/>'
    origin = '<origin xyz="0.01 0.02 0.03" rpy="0 0 1"/>'
    urdf = folder / "hand.urdf"
    urdf.write_text(with_visual(urdf.read_text(), "f1_dist", visual(mesh, origin)))
    return folder


def test_a_link_is_drawn_as_its_visual_and_the_others_as_their_shapes(barrett):
    plain = solids_by_link(load_hand("barrett"))
    drawn = solids_by_link(load_hand(barrett))
    ball = drawn["f1_dist"]
    assert len(ball.faces) == 20 * 4**FINE
    middle = np.array([0.01, 0.02, 0.03])
    np.testing.assert_allclose(np.linalg.norm(ball.vertices - middle, axis=1), 0.02, atol=1e-6)
    outward = (ball.vertices - middle) / 0.02
    np.testing.assert_allclose((ball.normals * outward).sum(1), 1.0, atol=0.01)
    assert ball.color == plain["f1_dist"].color
    for name, solid in plain.items():
        if name != "f1_dist":
            np.testing.assert_array_equal(solid.vertices, drawn[name].vertices)


@pytest.mark.parametrize(
    "parts",
    [
        visual('<mesh filename="nowhere.stl"/>'),
        visual('<mesh filename="../../secret.stl"/>'),
        visual('<capsule radius="1"/>'),
        visual('<sphere radius="nan"/>'),
        "<visual/>",
    ],
)
def test_a_visual_that_cannot_be_read_leaves_the_collision_shapes(barrett, parts):
    urdf = barrett / "hand.urdf"
    shipped = (hands_folder() / "barrett" / "hand.urdf").read_text()
    urdf.write_text(with_visual(shipped, "palm", parts))
    found = solids_of_links(load_hand(barrett))
    for one, other in zip(found, solids_of_links(load_hand("barrett")), strict=True):
        np.testing.assert_array_equal(one.vertices, other.vertices)


def test_a_link_with_too_much_detail_takes_no_place_of_the_others(barrett, monkeypatch):
    """The meshes of a hand have one limit; a link beyond it is left out, and no link after it."""
    fine = trimesh.creation.icosphere(FINE + 1, 20.0)
    fine.export(barrett / "looks" / "fine.stl")
    mesh = '<mesh filename="looks/fine.stl" scale="0.001 0.001 0.001"/>'
    urdf = barrett / "hand.urdf"
    urdf.write_text(with_visual(urdf.read_text(), "palm", visual(mesh)))
    both = link_meshes(urdf, urdf.read_bytes(), barrett)
    assert set(both) == {"palm", "f1_dist"}
    monkeypatch.setattr("torchgrasp.app.author.visuals.HAND_MESH_BYTES", fine.vertices.nbytes)
    link_meshes.cache_clear()
    assert set(link_meshes(urdf, urdf.read_bytes(), barrett)) == {"f1_dist"}
    link_meshes.cache_clear()


def test_a_glb_shows_the_visual(barrett, tmp_path):
    grasp = load_shipped_grasp("jug", "barrett")
    file = write_glb(tmp_path / "x.glb", load_hand(barrett), grasp, load_object("jug").mesh)
    shown = trimesh.load_scene(file).geometry["f1_dist"]
    assert len(shown.faces) == 20 * 4**FINE
    assert np.ptp(shown.vertices, axis=0) == pytest.approx([0.04] * 3, abs=5e-4)


def test_a_draft_keeps_visuals_in_the_frames_of_the_links_that_stay(claw, tmp_path, capsys):
    """A massless frame with a visual is merged into the link that it is fixed to."""
    trimesh.creation.icosphere(1, 0.004).export(claw.parent / "ball.stl")
    ball = visual('<mesh filename="package://claw/ball.stl"/>', '<origin xyz="0 0.001 0"/>')
    text = with_visual(claw.read_text(), "left_far", visual('<box size="0.01 0.01 0.04"/>'))
    text = with_visual(text, "thumb_far", visual('<mesh filename="nowhere.stl"/>'))
    frames = (
        f'<link name="mark">{ball}</link><joint name="m" type="fixed"><parent link="left_far"/>'
        '<child link="mark"/><origin xyz="0.03 0 0" rpy="0 0 1.5707963267948966"/></joint>'
        f'<link name="sign">{ball}</link><joint name="s" type="fixed"><parent link="thumb_far"/>'
        '<child link="sign"/></joint>'
    )
    claw.write_text(text.replace("</robot>", f"{frames}</robot>"))
    out = tmp_path / "out"
    tips = "left_tip", "right_tip", "thumb_tip"
    assert cli.main(["hand", "new", str(claw), "--out", str(out), "--tips", *tips]) == 0
    assert "written: 1 visual meshes for pictures" in capsys.readouterr().out
    drawn = solids_by_link(load_hand(out))
    corners = drawn["left_far"].vertices
    # the frame is turned by 90 degrees about z: its y is minus x of the link
    beyond = corners[corners[:, 0] > 0.006]
    np.testing.assert_allclose((beyond.min(0) + beyond.max(0)) / 2, [0.029, 0, 0], atol=1e-6)
    box = corners[corners[:, 0] <= 0.006]
    np.testing.assert_allclose(np.ptp(box, axis=0), [0.01, 0.01, 0.04], atol=1e-6)
    # of the thumb a part is missing: it is drawn by its collision shapes
    plain = {link.name: link for link in (out / "visual").glob("*")}
    assert len(plain) == 1 and "left_far" in next(iter(plain))


def test_a_sensor_tip_is_drawn_with_the_visual_of_its_tip(claw, tmp_path):
    claw.write_text(with_visual(claw.read_text(), "left_tip", visual('<sphere radius="0.011"/>')))
    out = tmp_path / "out"
    tips = "left_tip", "right_tip", "thumb_tip"
    words = ["hand", "new", str(claw), "--out", str(out), "--tips", *tips]
    assert cli.main([*words, "--tip-offset", "0.02", "--tip-radius", "0.005"]) == 0
    hand = load_hand(out)
    corners = solids_by_link(hand)["left_tip"].vertices
    centre = hand.tips.center[0].numpy()
    # the sensor ends one radius beyond its centre, along z of the tip
    assert corners[:, 2].max() == pytest.approx(centre[2] + 0.005, abs=2e-4)
    assert corners[:, 2].min() == pytest.approx(-0.011, abs=2e-4)


def test_a_fine_mesh_gets_few_triangles_in_the_same_place():
    ball = trimesh.creation.icosphere(6, 0.03)
    vertices, faces = _thinned(np.array(ball.vertices), np.array(ball.faces))
    assert 200 < len(faces) <= VISUAL.most_faces < len(ball.faces)
    radius = np.linalg.norm(vertices, axis=1)
    assert radius.max() <= 0.03 + 1e-9 and radius.min() > 0.028
    thin = trimesh.Trimesh(vertices, faces)
    assert thin.area == pytest.approx(ball.area, rel=0.05)
