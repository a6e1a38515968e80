"""Grasps shown from Python: a 3D page in the browser, a table and a picture in a notebook."""

import base64
import dataclasses
import io
import re

import numpy as np
import pytest
import torch
from PIL import Image

from torchgrasp import GraspError, Status, load_object
from torchgrasp.app.report import show_grasps
from torchgrasp.app.report.canvas import OBJECT, SIZE, rgb
from torchgrasp.data import load_shipped_grasp


def test_grasps_are_shown_in_the_browser_on_a_page_that_is_whole(monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    path = show_grasps(load_object("jug").view.points.numpy(), load_shipped_grasp("jug", "barrett"))
    assert opened == [path.as_uri()] and path.read_text().rstrip().endswith("</html>")


def pictures_in(html):
    found = re.findall(r'src="data:image/png;base64,([^"]*)"', html)
    return [Image.open(io.BytesIO(base64.b64decode(one))).convert("RGB") for one in found]


def test_a_notebook_shows_a_table_and_a_picture_of_the_best_grasps():
    grasps = load_shipped_grasp("jug", "barrett")[torch.zeros(8, dtype=torch.long)]
    html = grasps._repr_html_()
    assert html.count("<tr>") == 1 + 5 and "8 of 8 executable" in html
    assert f"{float(grasps.success[0]):.0%}" in html
    (picture,) = pictures_in(html)
    assert picture.size == SIZE and len(html) < 100_000
    assert "<script" not in html and "http" not in html


def test_the_object_is_in_the_picture_if_its_cloud_is_given():
    grasps = load_shipped_grasp("jug", "barrett")
    jug = load_object("jug")
    sand = np.array(rgb(OBJECT)) / max(rgb(OBJECT))

    def count(sheet):
        pixels = np.asarray(Image.open(io.BytesIO(sheet.picture)).convert("RGB")) / 255
        hue = pixels / pixels.max(-1, keepdims=True).clip(1e-6)
        return (np.abs(hue - sand).max(-1) < 0.04).sum()

    with_object = grasps.show(jug)
    assert count(with_object) > 10 * max(count(grasps.show()), 100)
    text = str(with_object)
    assert text.splitlines()[0].startswith("1 of 1 executable") and "closure margin" in text
    assert pictures_in(with_object._repr_html_())
    with pytest.raises(GraspError, match=r"cloud: expected"):
        grasps.show(jug.view.points + 1.0)
    with pytest.raises(GraspError, match=r"hand: expected barrett"):
        grasps.show(hand="allegro")


def test_without_a_known_hand_or_an_executable_grasp_there_is_no_picture():
    grasps = load_shipped_grasp("jug", "barrett")
    strange = dataclasses.replace(grasps, meta={**grasps.meta, "hand": "<b>mine</b>"})
    html = strange._repr_html_()
    assert "<table" in html and "<img" not in html and "&lt;b&gt;mine" in html
    with pytest.raises(GraspError):
        strange.show()
    failed = dataclasses.replace(
        grasps, status=torch.full_like(grasps.status, int(Status.TIP_ERROR))
    )
    for none in (failed, grasps[:0]):
        assert none.show().picture is None and "<table" not in none._repr_html_()
        assert "0 of" in str(none.show())
