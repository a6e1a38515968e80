"""The plug-in for LeRobot, run by LeRobot's own recorder, player and loader in their own
environment.
"""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.data.others import PYTHON, ROOT
from torchgrasp import load_hand
from torchgrasp.control import squeeze
from torchgrasp.data import load_shipped_grasp
from torchgrasp.foundation.errors import Status

PLUGIN = ROOT / "examples" / "lerobot_robot_torchgrasp"
pytestmark = [pytest.mark.sim, pytest.mark.slow]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What LeRobot's programs did with the installed plug-in."""
    pytest.importorskip("mujoco")
    if not PYTHON.exists():
        pytest.skip("scripts/beside lerobot makes the environment of LeRobot")
    folder = tmp_path_factory.mktemp("lerobot")
    # a copy, as the build leaves files in the folder
    source = shutil.copytree(PLUGIN, folder / "source")
    installed = folder / "installed"
    words = ["--no-index", "--no-deps", "--no-build-isolation", "--target", str(installed)]
    pip = [sys.executable, "-m", "pip", "install", "--quiet", *words, str(source)]
    done = subprocess.run(pip, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    load_shipped_grasp("jug", "barrett").save(folder / "plan.safetensors")
    load_shipped_grasp("jug", "allegro").save(folder / "allegro.safetensors")
    failed = load_shipped_grasp("jug", "barrett")
    failed = dataclasses.replace(
        failed, status=torch.full_like(failed.status, int(Status.TABLE_COLLISION))
    )
    failed.save(folder / "failed.safetensors")
    environment = os.environ | {
        "PYTHONPATH": f"{installed}:{ROOT}",
        "HF_HOME": str(folder / "cache"),
        "HF_LEROBOT_HOME": str(folder / "home"),
        "HF_HUB_OFFLINE": "1",
        "LEROBOT_REPLACE": "1",
    }
    script = Path(__file__).with_name("lerobot_plugin.py")
    call = [str(PYTHON), "-W", "ignore", str(script), str(folder)]
    done = subprocess.run(call, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def planned() -> np.ndarray:
    """The plan's targets (84, 15) at 30 Hz: approach, closing, squeeze, lift and hold."""
    hand = load_hand("barrett")
    grasp = load_shipped_grasp("jug", "barrett")
    pressed = squeeze(hand, grasp, force=4.0).joints
    postures = [hand.expand(q) for q in (grasp.pregrasp, grasp.joints, pressed)]
    open_, closed, pressing = (
        np.array([float(q) for q in posture.values()]) for posture in postures
    )
    pose = grasp.obj_from_hand[0].double().numpy()
    turned = Rotation.from_matrix(pose[:3, :3]).as_quat()
    along = grasp.approach[0].double().numpy()
    place = pose[:3, 3]
    up = np.array([0.0, 0.0, 1.0])
    rows = []
    for tick in range(1, 85):
        time = tick / 30
        near = min(time / 0.5, 1.0)
        first = np.clip((time - 0.5) / 0.4, 0.0, 1.0)
        second = np.clip((time - 0.9) / 0.4, 0.0, 1.0)
        lifted = np.clip(time - 1.3, 0.0, 1.0)
        joints = open_ + first * (closed - open_) + second * (pressing - closed)
        rows.append([*joints, *(place - 0.1 * (1 - near) * along + 0.1 * lifted * up), *turned])
    return np.array(rows)


def test_lerobot_finds_the_plug_in_by_its_name(found):
    assert not found["before"]
    assert "torchgrasp_hand" in found["robots"]
    assert "torchgrasp_plan" in found["teleoperators"]


def test_the_recorded_actions_are_the_targets_of_the_plan(found, planned):
    """LeRobot's loader reads them; a hand that is at its targets at once is where it was sent."""
    code, _, said = found["dry"]
    assert code == 0 and said["frames"] == 84 and said["risen"] is None
    data = found["dry data"]
    names = [*load_hand("barrett").tree.joint_names]
    names += [f"hand.{x}" for x in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    assert data["names"] == names and data["robot"] == "torchgrasp_hand"
    assert (data["fps"], data["episodes"]) == (30, 1)
    assert data["tasks"] == ["grasp the object and lift it"]
    np.testing.assert_allclose(data["action"], planned, atol=1e-6)
    np.testing.assert_allclose(data["state"][1:], data["action"][:-1], atol=1e-7)


def test_the_simulated_hand_lifts_the_jug(found, planned):
    code, _, said = found["mujoco"]
    assert code == 0 and said["risen"] > 0.09  # of 0.1
    data = found["mujoco data"]
    np.testing.assert_allclose(data["action"], planned, atol=1e-6)
    off = np.abs(np.array(data["state"])[1:] - planned[:-1])
    assert off[:, 8:11].max() < 0.02, "the mount follows"
    assert off[-1, :8].max() > 0.02, "the fingers press on the jug"


def test_lerobots_recorder_writes_what_the_body_was_sent(found, planned):
    assert found["record"] == ""
    data = found["record data"]
    count = len(data["action"])
    # the clock decides how many
    assert 2 <= count <= 31 and data["tasks"] == ["lift the jug"]
    np.testing.assert_allclose(data["action"], planned[:count], atol=1e-6)
    np.testing.assert_allclose(found["recorded"], data["action"], atol=1e-6)


def test_lerobots_player_sends_the_recorded_actions_again(found):
    assert found["replay"] == ""
    np.testing.assert_array_equal(
        np.float32(found["replayed"]), np.float32(found["dry data"]["action"])
    )


def test_actions_of_another_hand_are_not_sent(found):
    told = found["other replay"]
    assert "action: expected those of the allegro hand, 23 by name, got 15 numbers" in told


@pytest.mark.parametrize(
    ("case", "told"),
    [
        ("hand", "hand: expected barrett, for which the grasps were planned, got allegro"),
        ("row", "row: expected the number of one of 1 grasps"),
        ("failed", "row: expected a grasp that passed all checks, got 0, which failed: "),
        ("object", "object: expected a shipped object or a mesh, for MuJoCo, got none"),
        ("body", 'body: expected "dry", "mujoco", or "module:Class"'),
        ("fps", "fps: expected at least one target a second, got 0"),
        ("root", "root: expected a folder that is not there yet"),
    ],
)
def test_what_the_plug_in_cannot_do_is_said_in_one_sentence(found, case, told):
    code, err, said = found[f"refused {case}"]
    assert code == 2 and said is None
    assert told in err and err.count("\n") == 1
    assert not found["left"]
