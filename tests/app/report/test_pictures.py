import io

import numpy as np
from PIL import Image

from torchgrasp.app.report.canvas import SIZE
from torchgrasp.app.report.stills import (
    draw_cloud,
    draw_contacts,
    draw_grasp,
    draw_surface,
    facing,
    view_of,
)


def decode(png):
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


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
        covered = (np.abs(pixels - pixels[0, 0]).sum(-1) > 20).mean()
        assert 0.02 < covered < 0.95, (name, covered)


def test_fingers_are_drawn_in_three_hues(run):
    pixels = decode(draw_grasp(run.surface, run.hand, run.grasps, facing(run.grasps)))
    red, green, blue = pixels[..., 0], pixels[..., 1], pixels[..., 2]
    assert ((blue > red + 60) & (blue > green + 30)).sum() > 500
    assert ((red > blue + 90) & (red > green + 50)).sum() > 500
    assert ((green > red + 60) & (green > blue + 5)).sum() > 500


def test_pictures_are_reproducible(run):
    assert draw_cloud(run.cloud) == draw_cloud(run.cloud)
