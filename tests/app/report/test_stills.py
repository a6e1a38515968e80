"""Pictures of a run, a scene and a hand; the picture of a scene shows what each pixel was taken
for.
"""

import dataclasses
import io

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import ndimage

from torchgrasp import Scene, load_scene
from torchgrasp.app.report import draw_scene
from torchgrasp.app.report.canvas import OBJECTS, SIZE, rgb
from torchgrasp.app.report.page import draw_pictures
from torchgrasp.app.report.scene_picture import KINDS, encode_scene, sort_pixels
from torchgrasp.app.report.solids import PARKED, finger_of_links, solids_from_hand
from torchgrasp.app.report.stills import (
    draw_among,
    draw_cloud,
    draw_contacts,
    draw_grasp,
    draw_hand,
    draw_surface,
    facing,
    view_of,
)
from torchgrasp.geometry.plane import Plane
from torchgrasp.hand.load import load_hand


def decode(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")) / 255


def test_stills_have_their_size_show_something_and_are_reproducible(run):
    view = view_of(run.cloud)
    stills = {
        "cloud": draw_cloud(run.cloud, run.spec.table),
        "surface": draw_surface(run.surface, view, run.spec.table),
        "contacts": draw_contacts(run.surface, run.grasps.contacts, view),
        "grasp": draw_grasp(run.surface, run.hand, run.grasps, facing(run.grasps), run.spec.table),
    }
    for name, png in stills.items():
        pixels = decode(png)
        assert pixels.shape == (SIZE[1], SIZE[0], 3), name
        covered = (np.abs(pixels - pixels[0, 0]).sum(-1) > 0.08).mean()
        assert 0.02 < covered < 0.95, (name, covered)
    assert draw_cloud(run.cloud, run.spec.table) == stills["cloud"]


def test_the_picture_of_contacts_holds_their_arrows_whole(run):
    low = dataclasses.replace(run.surface, vertices=0.5 * run.surface.vertices)
    for direction in ((1.0, 0.0, 0.4), (0.0, 1.0, 0.4)):
        pixels = decode(draw_contacts(low, run.grasps.contacts, direction))
        for border in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]):
            assert np.abs(border - pixels[0, 0]).max() < 0.01


def test_fingers_are_drawn_in_three_hues(run):
    pixels = decode(draw_grasp(run.surface, run.hand, run.grasps, facing(run.grasps)))
    red = pixels[..., 0]
    green = pixels[..., 1]
    blue = pixels[..., 2]
    assert ((blue > red + 0.24) & (blue > green + 0.12)).sum() > 500
    assert ((red > blue + 0.35) & (red > green + 0.2)).sum() > 500
    assert ((green > red + 0.24) & (green > blue + 0.02)).sum() > 500


@pytest.fixture(scope="module")
def scene():
    return load_scene().select(4)


def test_neighbours_are_drawn_and_the_target_is_not_drawn_twice(run, scene):
    lone = dataclasses.replace(scene, labels=torch.where(scene.labels == 4, 4, 0))
    grasp = run.executable[:1]
    among, alone = (
        decode(draw_among(s, run.surface, run.hand, grasp, (1.0, 0.5, 0.5))) for s in (scene, lone)
    )
    for color in OBJECTS[:3]:
        hue = np.array(rgb(color)) / max(rgb(color))
        like = [
            (np.abs(p / p.max(2, keepdims=True).clip(1e-6) - hue).max(2) < 0.05).sum()
            for p in (among, alone)
        ]
        assert like[0] > like[1] + 50


def test_a_run_in_a_scene_shows_it_first(run, scene, monkeypatch):
    for name in ("draw_cloud", "draw_surface", "draw_contacts", "draw_grasp", "draw_among"):
        monkeypatch.setattr(f"torchgrasp.app.report.stills.{name}", lambda *a: b"")
    monkeypatch.setattr("torchgrasp.app.report.page.draw_film", lambda *a: b"")
    sections = draw_pictures(dataclasses.replace(run, scene=scene))
    assert next(iter(sections)) == "The scene" and len(sections["The scene"]) == 2
    assert "The scene" not in draw_pictures(run)


def test_every_fingertip_belongs_to_its_finger_and_the_palm_to_none():
    for name in ("allegro", "barrett"):
        hand = load_hand(name)
        fingers = finger_of_links(hand)
        assert [fingers[tip] for tip in hand.tips.links] == [0, 1, 2]
        assert fingers[hand.tree.link_names[0]] == PARKED


def test_the_ranges_of_joints_have_a_margin_on_both_sides(monkeypatch):
    hand = load_hand("allegro")
    white = io.BytesIO()
    Image.new("RGB", (8, 8)).save(white, "PNG")
    monkeypatch.setattr("torchgrasp.app.report.stills.draw_posture", lambda *_: white.getvalue())
    drawn = []
    monkeypatch.setattr(
        "torchgrasp.app.report.canvas.encode_figure", lambda figure: drawn.append(figure) or b""
    )
    draw_hand(hand, hand.lower)
    (axis,) = drawn[0].subfigs[1].axes
    left, right = np.deg2rad(axis.get_xlim())
    assert left < float(hand.lower.min()) and right > float(hand.upper.max())


def test_solids_follow_the_pose_rigidly_whatever_the_order_of_the_joints_and_lie_at_the_tip():
    hand = load_hand("allegro")
    middle = ((hand.lower + hand.upper) / 2).double()
    joints = hand.expand_joints(middle)
    names = hand.tree.joint_names
    here = torch.eye(4, dtype=torch.float64)
    there = here.clone()
    shift = [0.1, -0.2, 0.3]
    there[:3, 3] = torch.tensor(shift)
    solids, moved = (solids_from_hand(hand, joints, names, place) for place in (here, there))
    turned = solids_from_hand(hand, joints.flip(0), names[::-1], here)
    for a, b, c in zip(solids, moved, turned, strict=True):
        np.testing.assert_allclose(
            b.vertices - a.vertices, np.tile(shift, (len(a.vertices), 1)), atol=1e-12
        )
        np.testing.assert_array_equal(a.vertices, c.vertices)
    centre = hand.tip_centres(middle)[0].numpy()
    middles = [(s.vertices.min(0) + s.vertices.max(0)) / 2 for s in solids if s.finger == 0]
    assert min(np.linalg.norm(m - centre) for m in middles) < 1e-6


SHAPE = (120, 160)
PARTS = {
    "box": np.s_[40:80, 30:70],
    "wall": np.s_[:, 140:],
    "hole": np.s_[90:110, 20:60],
    "floor": np.s_[90:110, 90:130],
}


def paint(values: dict[str, float], rest: float) -> np.ndarray:
    image = np.full(SHAPE, rest)
    for name, value in values.items():
        image[PARTS[name]] = value
    return image


@pytest.fixture(scope="module")
def painted():
    """A camera 0.8 m above a table, which sees a box, a wall, a hole in the measurement, and the
    floor.
    """
    depth = paint({"box": 0.7, "wall": 0.5, "hole": 0.0, "floor": 1.2}, 0.8)
    labels = paint({"box": 1}, 0).astype(int)
    table = Plane(torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64), -0.8)
    return Scene.from_depth(depth, (140.0, 140.0, 79.5, 59.5), labels=labels, table=table)


def test_every_pixel_has_its_kind(painted):
    kinds, labels = sort_pixels(painted)
    names = np.array(list(KINDS))[kinds]
    assert (names[PARTS["hole"]] == "not measured").all() and (
        names[PARTS["wall"]] == "obstacle"
    ).all()
    assert (names[PARTS["floor"]] == "not on the support").all() and labels[45:75, 35:65].min() == 1
    assert (names[0:30, 0:130] == "support, in squares of 10 cm").all() and not labels[0:30].any()


def test_objects_have_their_colours_and_unmeasured_pixels_are_black(painted):
    pixels = decode(encode_scene(painted))
    assert pixels.shape[1] == 1200 and pixels.shape[0] > 900  # a legend below
    scale = 1200 / SHAPE[1]
    body, hole, top = (
        pixels[int(r * scale), int(c * scale)] for r, c in ((46, 36), (100, 40), (10, 15))
    )
    assert np.abs(body / body.max() - np.array(rgb(OBJECTS[0])) / max(rgb(OBJECTS[0]))).max() < 0.03
    assert hole.max() < 0.1 < 0.6 < top.min()


def test_only_a_target_has_a_white_rim(painted):
    chosen = dataclasses.replace(painted, target=1)
    white = [(decode(encode_scene(s))[:900] == 1).all(-1).sum() for s in (painted, chosen)]
    assert white[1] > white[0] + 3000


def test_the_white_rim_of_a_target_hides_none_of_it(painted):
    body = sort_pixels(painted)[1] == 1
    # its middle has a white number
    row, column = np.nonzero(body & ~ndimage.binary_erosion(body, iterations=3))
    pixels = decode(encode_scene(dataclasses.replace(painted, target=1)))
    middle = 1200 / SHAPE[1] * (np.stack([row, column]) + 0.5)
    assert pixels[tuple(middle.astype(int))].min(1).max() < 0.9


def test_the_picture_is_written_and_reproducible(painted, tmp_path):
    assert (
        draw_scene(painted, tmp_path / "a.png").read_bytes()
        == draw_scene(painted, tmp_path / "b.png").read_bytes()
    )
