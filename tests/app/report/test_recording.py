"""Recordings are written and read back by Rerun itself, in its environment, and compared with the
run.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torchgrasp.app import cli
from torchgrasp.app.report import write_recording
from torchgrasp.app.report.solids import link_poses
from torchgrasp.app.report.viewer import POSTURES
from torchgrasp.foundation.errors import MissingExtra

ROOT = Path(__file__).parents[3]
PYTHON = ROOT / ".beside" / "rerun" / "bin" / "python"
READER = str(Path(__file__).with_name("read_recording.py"))


@pytest.fixture(scope="module")
def recorded(run, tmp_path_factory):
    """What Rerun reads in the recording of the run; this process borrows its package to write it."""
    if not PYTHON.exists() or sys.version_info < (3, 11):  # for which it has no package
        pytest.skip("scripts/beside rerun makes the environment of the viewer")
    folder = tmp_path_factory.mktemp("recording")
    ask = "import sysconfig; print(sysconfig.get_path('purelib'))"
    place = subprocess.run(
        [PYTHON, "-c", ask], capture_output=True, text=True, check=True
    ).stdout.strip()
    sys.path.append(place)
    try:
        path = write_recording(folder / "run.rrd", run)
    finally:
        sys.path.remove(place)
    subprocess.run(
        [PYTHON, READER, path, folder / "read.json"],
        check=True,
        env=os.environ | {"PYTHONPATH": ""},
    )
    return json.loads((folder / "read.json").read_text())


def poses_of(entity):
    """The poses of an entity, by its translations and quaternions xyzw."""
    poses = np.tile(np.eye(4), (len(entity["Transform3D:translation"]), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(
        np.array(entity["Transform3D:quaternion"])[:, 0]
    ).as_matrix()
    poses[:, :3, 3] = np.array(entity["Transform3D:translation"])[:, 0]
    return poses


def test_the_plan_is_in_the_frame_of_the_cloud(run, recorded):
    np.testing.assert_allclose(
        recorded["/world/obj/cloud"]["Points3D:positions"][0], run.cloud.points, atol=1e-6
    )
    surface = recorded["/world/obj/surface"]
    contacts = recorded["/world/obj/contacts"]
    np.testing.assert_allclose(
        surface["Mesh3D:vertex_positions"][0], run.surface.vertices, atol=1e-6
    )
    assert len(set(surface["Mesh3D:vertex_colors"][0])) > 20
    best = run.executable[0].contacts
    np.testing.assert_allclose(contacts["Arrows3D:origins"][0], best.points[0], atol=1e-6)
    np.testing.assert_allclose(contacts["Arrows3D:vectors"][0], 0.035 * best.normals[0], atol=1e-6)
    assert contacts["Arrows3D:labels"][0] == list(run.hand.tips.names)
    upright = run.upright().cloud.points.numpy()
    (frame,) = poses_of(recorded["/world/obj"])
    np.testing.assert_allclose(
        run.cloud.points.numpy() @ frame[:3, :3].T + frame[:3, 3], upright, atol=1e-6
    )


def test_the_hand_goes_through_its_postures(run, recorded):
    palm = recorded["/world/obj/plan/hand/palm"]
    assert palm["posture of Transform3D"] == [0, 1, 2, 3] and palm["posture of Mesh3D"] == [0]
    assert [text for (text,) in recorded["/postures"]["TextLog:text"]] == list(POSTURES)
    np.testing.assert_allclose(poses_of(palm)[2], run.executable[0].obj_from_hand[0], atol=1e-6)


def test_the_closing_is_on_a_timeline_of_seconds(run, recorded):
    closure = run.closure
    hand = run.hand
    time = closure.time.tolist()
    body = recorded["/world/obj/closing/object"]
    assert body["time of Transform3D"] == pytest.approx(time) and body["time of Mesh3D"] == [0.0]
    np.testing.assert_allclose(poses_of(body), closure.object_pose, atol=1e-6)
    links = link_poses(hand, closure.joints, closure.joint_names, closure.hand_pose)
    drawn = [name for name in hand.tree.link_names if f"/world/obj/closing/hand/{name}" in recorded]
    assert len(drawn) > 15
    for name in drawn:
        seen = poses_of(recorded[f"/world/obj/closing/hand/{name}"])
        np.testing.assert_allclose(seen, links[:, hand.tree.link_names.index(name)], atol=1e-6)
    for finger, name in enumerate(hand.tips.names):
        curve = recorded[f"/force/{name}"]
        np.testing.assert_allclose(
            np.ravel(curve["Scalars:scalars"]), closure.forces[:, finger], atol=1e-9
        )
        assert curve["time of Scalars"] == pytest.approx(time)
    forces = recorded["/world/obj/closing/forces"]
    assert [len(arrows) for arrows in forces["Arrows3D:vectors"]] == [3] * len(time)
    np.testing.assert_allclose(
        forces["Arrows3D:origins"][3], closure.hand_pose[3, :3, 3].expand(3, 3), atol=1e-6
    )
    assert [text for (text,) in recorded["/moments"]["TextLog:text"]][-1] == "the end"


def test_without_rerun_the_extra_is_named_before_any_work(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtra, match=r"torchgrasp\[rerun\]"):
        write_recording(tmp_path / "run.rrd", run)
    assert cli.main(["grasp", "jug", "--rerun", "--out", str(tmp_path / "out")]) == 2
    assert "torchgrasp[rerun]" in capsys.readouterr().err and not any(tmp_path.iterdir())
