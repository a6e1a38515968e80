"""`torchgrasp grasp --realsense` on the software device of pyrealsense2, in its own environment."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from tests.make import HALF, halved
from torchgrasp import load_grasps
from torchgrasp.cloud.camera import look_at, render_depth

ROOT = Path(__file__).parents[2]
PYTHON = ROOT / ".beside" / "realsense" / "bin" / "python"
UNIT = 0.0005  # metres of one count, as in software_camera.py


@pytest.fixture(scope="module")
def depth() -> torch.Tensor:
    """A box on a table, as a RealSense measures it, in half of the pixels."""
    box = trimesh.creation.box([0.06, 0.06, 0.12]).apply_translation([0.0, 0.0, 0.06])
    return halved(render_depth([box], look_at(20.0, 45.0, 0.7), noise="realsense")[0])


@pytest.fixture(scope="module")
def found(depth, tmp_path_factory):
    """What the commands did with the software devices, and the folder of their results."""
    # there is no driver for macOS
    if not [*PYTHON.parents[1].glob("lib/*/site-packages/pyrealsense2")]:
        pytest.skip("scripts/beside realsense makes the environment of the camera")
    folder = tmp_path_factory.mktemp("live")
    np.save(folder / "shown.npy", np.round(depth.numpy() / UNIT).astype(np.uint16))
    np.save(folder / "pose.npy", look_at(20.0, 45.0, 0.7).numpy())
    script = Path(__file__).with_name("software_camera.py")
    words = [str(PYTHON), "-W", "ignore", str(script), str(folder), str(folder / "shown.npy")]
    done = subprocess.run(
        words, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": ROOT}
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1]), folder


def test_a_grasp_is_planned_on_what_the_camera_shows(found, depth):
    """The scene has the depth shown, by the scale and the pixels that the stream states."""
    cases, folder = found
    code, out, err = cases["good"]
    assert code == 0, out + err
    assert "camera  Software RealSense 1: " in out
    scene = np.load(folder / "good" / "scene.npz")
    seen = depth.numpy()
    np.testing.assert_allclose(scene["depth"], np.where(seen > 0, seen, 0.0), atol=0.51 * UNIT)
    np.testing.assert_allclose(scene["intrinsics"], HALF.numpy(), rtol=1e-6)
    assert (folder / "good" / "scene.png").is_file()
    assert len(load_grasps(folder / "good" / "grasps.safetensors"))


def test_the_pose_of_the_camera_gives_the_frame_of_the_results(found):
    cases, folder = found
    code, out, err = cases["posed"]
    assert code == 0, out + err
    scene = np.load(folder / "posed" / "scene.npz")
    np.testing.assert_allclose(scene["camera_pose"], np.load(folder / "pose.npy"), atol=1e-9)
    # the table is at the height 0 there
    np.testing.assert_allclose(scene["table"], [0.0, 0.0, 1.0, 0.0], atol=0.03)


def test_a_camera_can_be_used_again_and_is_chosen_by_its_number(found):
    cases, _ = found
    assert cases["real"] >= 0  # of pyrealsense2's own list
    assert cases["again"] == "Software RealSense 1"
    assert cases["second"] == "Software RealSense 2"


@pytest.mark.parametrize(
    ("case", "told"),
    [
        ("unplugged", "--realsense: expected a RealSense at a USB port"),
        ("two", "--serial: expected one of 1, 2, got 2 connected cameras"),
        ("unknown", "--serial: expected one of 1, 2, got 3"),
        ("bent", "distortion [0.1"),
        ("moved", "--realsense: expected frames of a camera and a scene that stand still"),
    ],
)
def test_what_a_camera_cannot_do_is_said_in_one_sentence(found, case, told):
    cases, folder = found
    code, _, err = cases[case]
    assert code == 2 and told in err
    assert err.count("\n") == 1 and not (folder / "none").exists()


def test_a_camera_without_frames_is_not_awaited_for_ever(found):
    cases, _ = found
    sentence, seconds = cases["still"]
    assert "Software RealSense 1" in sentence and "a frame within 0.1 s" in sentence
    assert seconds < 5.0


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "CLOUD: expected one input"),
        (["jug", "--realsense"], "jug beside --realsense"),
        (["jug", "--serial", "3"], "--serial: expected"),
        (["--realsense", "--mode", "paper"], "--mode: expected the cloud of one object"),
        (["--realsense", "--close", "--unit", "mm"], "--close, --unit: expected the cloud of one"),
    ],
)
def test_options_of_the_camera_are_checked_before_any_work(words, told, tmp_path, run_command):
    code, _, err = run_command("grasp", *words, "--out", tmp_path / "out")
    assert code == 2 and told in err


def test_without_the_package_the_extra_is_named(monkeypatch, tmp_path, run_command):
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    code, _, err = run_command("grasp", "--realsense", "--out", tmp_path / "out")
    assert code == 2 and "torchgrasp[realsense]" in err
