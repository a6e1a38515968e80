"""Pictures of a scene."""

import dataclasses
import io

import numpy as np
import pytest
import torch
from PIL import Image

from torchgrasp import load_scene
from torchgrasp.app.report.canvas import rgb
from torchgrasp.app.report.page import draw_pictures
from torchgrasp.app.report.stills import OBJECTS, draw_among, draw_depth


@pytest.fixture(scope="module")
def scene():
    return load_scene().select(4)


def read(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")) / 255


def test_the_target_has_its_colour_and_missing_pixels_are_white(scene):
    pixels = read(draw_depth(scene))
    row, column = scene.pixels[scene.rows_of()].T.numpy()
    target = pixels[row, column]
    hue = target / target.max(1, keepdims=True)
    assert np.abs(hue - np.array(rgb(OBJECTS[3])) / max(rgb(OBJECTS[3]))).max() < 0.02
    assert (pixels[scene.image.depth.numpy() == 0] == 1).all()
    other = scene.pixels[scene.rows_of(1)].T.numpy()
    assert pixels[other[0], other[1]].min() > target.min()  # the others are pale


def test_neighbours_are_drawn_and_the_target_is_not_drawn_twice(run, scene):
    lone = dataclasses.replace(scene, labels=torch.where(scene.labels == 4, 4, 0))
    grasp = run.executable[:1]
    among, alone = (read(draw_among(s, run.surface, run.hand, grasp, (1.0, 0.5, 0.5))) for s in (scene, lone))
    for color in OBJECTS[:3]:
        hue = np.array(rgb(color)) / max(rgb(color))
        like = [(np.abs(p / p.max(2, keepdims=True).clip(1e-6) - hue).max(2) < 0.05).sum() for p in (among, alone)]
        assert like[0] > like[1] + 50


def test_a_run_in_a_scene_shows_it_first(run, scene, monkeypatch):
    for name in (
        "draw_cloud",
        "draw_surface",
        "draw_contacts",
        "draw_grasp",
        "draw_film",
    ):
        monkeypatch.setattr(f"torchgrasp.app.report.page.{name}", lambda *a: b"")
    monkeypatch.setattr("torchgrasp.app.report.page.draw_among", lambda *a: b"")
    sections = draw_pictures(dataclasses.replace(run, scene=scene))
    assert next(iter(sections)) == "The scene" and len(sections["The scene"]) == 2
    assert "The scene" not in draw_pictures(run)
