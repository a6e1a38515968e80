"""Pictures of a run, a scene and a hand."""

import dataclasses
import io

import numpy as np
import pytest
import torch
from PIL import Image

from torchgrasp import load_scene
from torchgrasp.app.report.canvas import SIZE, rgb
from torchgrasp.app.report.page import draw_pictures
from torchgrasp.app.report.solids import PARKED, finger_of_links, solids_from_hand
from torchgrasp.app.report.stills import (
    OBJECTS,
    draw_among,
    draw_cloud,
    draw_contacts,
    draw_grasp,
    draw_surface,
    facing,
    view_of,
)
from torchgrasp.hand.load import load_hand


def decode(png: bytes) -> np.ndarray:
    """Return the pixels of a PNG in [0, 1]."""
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")) / 255


def test_stills_have_their_size_and_show_something(run):
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


def test_fingers_are_drawn_in_three_hues(run):
    pixels = decode(draw_grasp(run.surface, run.hand, run.grasps, facing(run.grasps)))
    red, green, blue = pixels[..., 0], pixels[..., 1], pixels[..., 2]
    assert ((blue > red + 0.24) & (blue > green + 0.12)).sum() > 500
    assert ((red > blue + 0.35) & (red > green + 0.2)).sum() > 500
    assert ((green > red + 0.24) & (green > blue + 0.02)).sum() > 500


def test_pictures_are_reproducible(run):
    assert draw_cloud(run.cloud) == draw_cloud(run.cloud)


@pytest.fixture(scope="module")
def scene():
    return load_scene().select(4)


def test_neighbours_are_drawn_and_the_target_is_not_drawn_twice(run, scene):
    lone = dataclasses.replace(scene, labels=torch.where(scene.labels == 4, 4, 0))
    grasp = run.executable[:1]
    among, alone = (decode(draw_among(s, run.surface, run.hand, grasp, (1.0, 0.5, 0.5))) for s in (scene, lone))
    for color in OBJECTS[:3]:
        hue = np.array(rgb(color)) / max(rgb(color))
        like = [(np.abs(p / p.max(2, keepdims=True).clip(1e-6) - hue).max(2) < 0.05).sum() for p in (among, alone)]
        assert like[0] > like[1] + 50


def test_a_run_in_a_scene_shows_it_first(run, scene, monkeypatch):
    for name in ("draw_cloud", "draw_surface", "draw_contacts", "draw_grasp", "draw_film"):
        monkeypatch.setattr(f"torchgrasp.app.report.page.{name}", lambda *a: b"")
    monkeypatch.setattr("torchgrasp.app.report.page.draw_among", lambda *a: b"")
    sections = draw_pictures(dataclasses.replace(run, scene=scene))
    assert next(iter(sections)) == "The scene" and len(sections["The scene"]) == 2
    assert "The scene" not in draw_pictures(run)


def test_every_fingertip_belongs_to_its_finger_and_the_palm_to_none():
    for name in ("allegro", "barrett"):
        hand = load_hand(name)
        fingers = finger_of_links(hand)
        assert [fingers[tip] for tip in hand.tips.links] == [0, 1, 2]
        assert fingers[hand.tree.link_names[0]] == PARKED


def test_solids_follow_the_pose_of_the_hand_rigidly():
    hand = load_hand("allegro")
    joints = hand.expand_joints(((hand.lower + hand.upper) / 2).double())
    here = torch.eye(4, dtype=torch.float64)
    there = here.clone()
    there[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
    pairs = zip(
        solids_from_hand(hand, joints, hand.tree.joint_names, here),
        solids_from_hand(hand, joints, hand.tree.joint_names, there),
        strict=True,
    )
    for a, b in pairs:
        np.testing.assert_allclose(b.vertices - a.vertices, np.tile([0.1, -0.2, 0.3], (len(a.vertices), 1)), atol=1e-12)


def test_the_order_of_the_joints_does_not_matter():
    hand = load_hand("barrett")
    joints = hand.expand_joints(hand.upper.double() * 0.5)
    names = hand.tree.joint_names
    place = torch.eye(4, dtype=torch.float64)
    turned = solids_from_hand(hand, joints.flip(0), names[::-1], place)
    for a, b in zip(solids_from_hand(hand, joints, names, place), turned, strict=True):
        np.testing.assert_array_equal(a.vertices, b.vertices)


def test_a_fingertip_solid_lies_at_the_tip():
    hand = load_hand("allegro")
    joints = ((hand.lower + hand.upper) / 2).double()
    centre = hand.tip_centres(joints)[0].numpy()
    solids = solids_from_hand(hand, hand.expand_joints(joints), hand.tree.joint_names, torch.eye(4).double())
    middles = [(s.vertices.min(0) + s.vertices.max(0)) / 2 for s in solids if s.finger == 0]
    assert min(np.linalg.norm(m - centre) for m in middles) < 1e-6
