"""The picture of a scene shows what each pixel was taken for."""

import dataclasses
import io

import numpy as np
import pytest
import torch
from PIL import Image

from torchgrasp.app.report import draw_scene
from torchgrasp.app.report.canvas import OBJECTS, rgb
from torchgrasp.app.report.scene import KINDS, encode_scene, sort_pixels
from torchgrasp.geometry.plane import Plane
from torchgrasp.scene import Scene

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
def scene():
    """A camera 0.8 m above a table, which sees a box, a wall, a hole in the measurement, and the floor."""
    depth = paint({"box": 0.7, "wall": 0.5, "hole": 0.0, "floor": 1.2}, 0.8)
    labels = paint({"box": 1}, 0).astype(int)
    table = Plane(torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64), -0.8)
    return Scene.from_depth(depth, (140.0, 140.0, 79.5, 59.5), labels=labels, table=table)


def test_every_pixel_has_its_kind(scene):
    kinds, labels = sort_pixels(scene)
    names = np.array(list(KINDS))[kinds]
    assert (names[PARTS["hole"]] == "not measured").all() and (names[PARTS["wall"]] == "obstacle").all()
    assert (names[PARTS["floor"]] == "not on the support").all() and labels[45:75, 35:65].min() == 1
    assert (names[0:30, 0:130] == "support, in squares of 10 cm").all() and not labels[0:30].any()


def test_objects_have_their_colours_and_unmeasured_pixels_are_black(scene):
    pixels = np.asarray(Image.open(io.BytesIO(encode_scene(scene)))) / 255
    assert pixels.shape[1] == 1200 and pixels.shape[0] > 900  # a legend below
    scale = 1200 / SHAPE[1]
    body, hole, top = (pixels[int(r * scale), int(c * scale)] for r, c in ((46, 36), (100, 40), (10, 15)))
    assert np.abs(body / body.max() - np.array(rgb(OBJECTS[0])) / max(rgb(OBJECTS[0]))).max() < 0.03
    assert hole.max() < 0.1 < 0.6 < top.min()


def test_only_a_target_has_a_white_rim(scene):
    chosen = dataclasses.replace(scene, target=1)
    white = [(np.asarray(Image.open(io.BytesIO(encode_scene(s))))[:900] == 255).all(-1).sum() for s in (scene, chosen)]
    assert white[1] > white[0] + 3000


def test_the_picture_is_written_and_reproducible(scene, tmp_path):
    assert draw_scene(scene, tmp_path / "a.png").read_bytes() == draw_scene(scene, tmp_path / "b.png").read_bytes()
