"""Closings as LeRobot episodes: LeRobot's own loader reads offline what the simulation recorded."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.campaign.cheap import contents
from tests.data.others import read_foreign
from tests.make import load_hand
from torchgrasp import ClosureResult, TrialSpec, close_hand, load_object
from torchgrasp.data import load_shipped_grasp, write_lerobot
from torchgrasp.foundation.errors import BadArgument

pytest.importorskip("pyarrow")
pytestmark = pytest.mark.sim
SPEC = TrialSpec(hold_time=0.2, simulator="mujoco")


@pytest.fixture(scope="module")
def sent() -> list[np.ndarray]:
    """What the drives of the simulator are sent, tick by tick."""
    return []


@pytest.fixture(scope="module")
def closing(sent: list[np.ndarray]) -> ClosureResult:
    """A grasp of the jug that lifts it."""
    scene = pytest.importorskip("torchgrasp.sim.mujoco_scene").MujocoScene
    jug = load_object("jug")
    drive = scene.drive
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            scene,
            "drive",
            lambda self, targets: (sent.append(targets.copy()), drive(self, targets)),
        )
        grasp = load_shipped_grasp("jug", "allegro")
        return close_hand(grasp, load_hand("allegro"), jug.mesh, SPEC, parts=jug.parts)


@pytest.fixture(scope="module")
def slipped(closing: ClosureResult) -> ClosureResult:
    """The first half of the closing, as if it had failed there, upside down from its middle on."""
    half = len(closing.time) // 2
    turned = closing.object_pose[:half].clone()
    turns = torch.linspace(0, 2 * np.pi, half, dtype=torch.float64)
    turned[:, :3, :3] = torch.from_numpy(
        Rotation.from_rotvec(turns[:, None].numpy() * [[1.0, 0.0, 0.0]]).as_matrix()
    )
    return part(closing, slice(0, half), held=False, object_pose=turned)


def part(closing: ClosureResult, ticks: slice, **changes: Any) -> ClosureResult:
    """Return some ticks of a closing."""
    names = ("time", "forces", "object_pose", "hand_pose", "joints", "targets")
    trace = {name: x[ticks] for name, x in vars(closing.trace).items()}
    cut = {name: getattr(closing, name)[ticks] for name in names} | {
        "trace": type(closing.trace)(**trace)
    }
    return type(closing)(**{**vars(closing), **cut, **changes})


def test_lerobot_reads_episodes_with_joints_by_name(
    closing: ClosureResult, slipped: ClosureResult, tmp_path: Path
):
    episodes = [("lift the jug", closing), ("let the jug fall", slipped), ("lift the jug", closing)]
    hand = load_hand("allegro")
    written = write_lerobot(tmp_path / "data", episodes, hand)
    (found,) = read_foreign("episodes", [written], tmp_path)
    assert (found["fps"], found["robot"], found["episodes"]) == (100, "allegro", 3)
    counts = [len(x.time) - 1 for _, x in episodes]
    assert found["rows"] == len(found["tasks"]) == sum(counts)
    assert found["tasks"] == [
        task for (task, _), n in zip(episodes, counts, strict=True) for _ in range(n)
    ]
    assert found["second"] == [counts[1], "let the jug fall", counts[0]]
    frames = {name: np.array(x) for name, x in found["frames"].items()}
    names = found["names"]
    first = frames["episode_index"] == 0
    state = frames["observation.state"][first]
    action = frames["action"][first]
    for joint in hand.tree.joint_names:
        k = names["observation.state"].index(joint)
        own = closing.joint_names.index(joint)
        np.testing.assert_allclose(state[:, k], closing.joints[:-1, own], atol=1e-6)
        k = names["action"].index(joint)
        np.testing.assert_allclose(action[:, 0, k], closing.targets[1:, own], atol=1e-6)
        np.testing.assert_array_equal(action[:-1, 1, k], action[1:, 0, k])
    at = [names["action"].index(f"hand.{x}") for x in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    np.testing.assert_allclose(action[:, 0, at[:3]], closing.hand_pose[1:, :3, 3], atol=1e-6)
    turns = Rotation.from_quat(action[:, 0, at[3:]]).as_matrix()
    np.testing.assert_allclose(turns, closing.hand_pose[1:, :3, :3], atol=1e-5)
    assert names["observation.forces"][-1] == f"{hand.finger_names[-1]}.z"
    np.testing.assert_allclose(
        frames["observation.forces"][first, -1], closing.trace.forces[:-1, -1, 2], atol=1e-5
    )
    ends = np.cumsum(counts) - 1
    assert np.flatnonzero(frames["next.done"]).tolist() == ends.tolist()
    assert np.flatnonzero(frames["next.success"]).tolist() == [ends[0], ends[2]]
    np.testing.assert_allclose(frames["timestamp"][first], closing.time[:-1], atol=1e-6)
    assert found["policy"]["action"] == ["ACTION", 23] and found["policy"]["observation.state"] == [
        "STATE",
        23,
    ]
    assert found["policy"]["observation.environment_state"] == ["ENV", 7]
    of_second = frames["observation.environment_state"][frames["episode_index"] == 1]
    assert np.abs(np.diff(of_second[:, 3:], axis=0)).max() < 0.1, (
        "quaternions go on where their signs could jump"
    )
    for name, theirs in found["theirs"].items():
        ours = found["stats"][name]
        assert set(ours) == set(theirs)
        column = np.array(found["frames"][name], dtype=float).reshape(len(found["tasks"]), -1)[
            :, : len(ours["min"])
        ]
        for key in ("min", "max", "mean", "std", "count"):
            np.testing.assert_allclose(ours[key], theirs[key], rtol=1e-5, atol=1e-5)
        for q in (
            1,
            10,
            50,
            90,
            99,
        ):  # theirs are of a histogram: these are held to what a quantile is
            at = np.array(ours[f"q{q:02}"])
            assert np.all((column < at - 1e-9).mean(0) <= q / 100 + 2 / len(column))
            assert np.all((column <= at + 1e-9).mean(0) >= q / 100 - 2 / len(column))


def test_actions_are_what_the_drives_were_sent(closing: ClosureResult, sent: list[np.ndarray]):
    np.testing.assert_array_equal(
        closing.targets[1:].numpy(), np.array(sent[1:])
    )  # the first is the start
    assert closing.held and float((closing.targets - closing.joints)[-1].abs().max()) > 0.02, (
        "fingers press [rad]"
    )


def test_what_is_no_episode_is_refused_and_the_same_call_changes_nothing(
    closing: ClosureResult, tmp_path: Path
):
    hand = load_hand("allegro")
    good = ("lift the jug", closing)
    late = part(closing, slice(0, None, 2))
    for bad in (part(closing, slice(0, 1)), late):
        with pytest.raises(BadArgument, match=r"episodes\[1\]"):
            write_lerobot(tmp_path / "bad", [good, ("", bad)], hand)
    with pytest.raises(BadArgument, match=r"episodes\[0\]"):
        write_lerobot(tmp_path / "bad", [good], load_hand("barrett"))
    # one number would spoil the statistics of all episodes
    for name in ("joints", "targets", "hand_pose", "object_pose"):
        diverged = getattr(closing, name).clone()
        diverged[5, 0] = torch.nan
        lost = part(dataclasses.replace(closing, **{name: diverged}), slice(None))
        with pytest.raises(BadArgument, match=rf"episodes\[1\]: .*{name} that are not finite"):
            write_lerobot(tmp_path / "bad", [good, ("", lost)], hand)
    # forces would have the names of other fingers
    for fingers in (("index", "ring", "thumb"), ("thumb", "index", "middle")):
        with pytest.raises(BadArgument, match=r"episodes\[0\].*fingers index, middle, thumb$"):
            write_lerobot(tmp_path / "bad", [good], load_hand("allegro", fingers))
    assert closing.finger_names == hand.finger_names
    with pytest.raises(BadArgument, match="at least one"):
        write_lerobot(tmp_path / "bad", [], hand)
    assert not (tmp_path / "bad").exists()
    before = contents(write_lerobot(tmp_path / "data", [good], hand))
    assert contents(write_lerobot(tmp_path / "data", [good], hand)) == before
    assert json.loads(before["meta/info.json"])["codebase_version"] == "v3.0"
    with pytest.raises(ValueError, match="other data"):
        write_lerobot(tmp_path / "data", [good, good], hand)
