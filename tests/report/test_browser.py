"""The turning page in a headless browser; each state is asked for in the address."""

import dataclasses
import re
import shutil
import subprocess

import numpy as np
import pytest
import torch
from PIL import Image

from torchgrasp.report.turning import write_viewer

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium"),
]


@pytest.fixture(scope="module")
def browse(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    two = dataclasses.replace(run, grasps=run.grasps[torch.tensor([0, 0])], object_name="<b>jug</b>")
    two.grasps.obj_from_hand[1, 0, 3] += 0.05
    path = write_viewer(folder / "view.html", two)

    def visit(state):
        """The page as text and as pixels of its stage."""
        shot = folder / "shot.png"
        command = [
            CHROMIUM, "--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
            "--disable-background-networking", f"--user-data-dir={folder / 'profile'}", "--window-size=1000,700",
            "--virtual-time-budget=1000", f"--screenshot={shot}", "--dump-dom", f"{path.as_uri()}{state}",
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
        dom = re.sub(r"<script.*?</script>", "", done.stdout, flags=re.DOTALL)
        return dom, np.asarray(Image.open(shot).convert("RGB"))[:, :600].astype(int)

    return visit


def body(dom):
    (attributes,) = re.findall(r"<body([^>]*)>", dom)
    return dict(re.findall(r'data-(\w+)="([^"]*)"', attributes))


def errors(dom):
    (text,) = re.findall(r'<pre id="errors">(.*?)</pre>', dom, re.DOTALL)
    return text


def differ(a, b):
    return float((np.abs(a - b).max(-1) > 30).mean())


def test_every_interaction_changes_the_picture_and_the_elements(browse):
    dom, grasp = browse("")
    assert errors(dom) == "" and int(body(dom)["ready"]) > 0
    for name in ("legend", "sigma", "postures", "play", "tick", "plot", "grasps", "home"):
        assert f'id="{name}"' in dom
    assert dom.count("<button") == 6 and "<b>jug" not in dom and "&lt;b&gt;jug" in dom
    assert len(np.unique(grasp.reshape(-1, 3), axis=0)) > 200 and differ(grasp, grasp[:1, :1]) > 0.1
    for state, expected in {
        "#grasp=2": {"grasp": "2"},
        "#posture=approach": {"posture": "approach"},
        "#sigma=3": {"sigma": "3"},
        "#tick=4": {"tick": "4"},
    }.items():
        dom, picture = browse(state)
        assert errors(dom) == "" and expected.items() <= body(dom).items()
        assert differ(picture, grasp) > 0.01, state


def test_an_address_that_the_page_cannot_mean_is_told(browse):
    dom, _ = browse("#grasp=7&posture=fist")
    assert "grasp=7" in errors(dom) and "posture=fist" in errors(dom) and body(dom)["grasp"] == "1"
