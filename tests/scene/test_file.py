"""Scenes from and to files."""

import numpy as np
import pytest

from tests.make import cup
from torchgrasp import Scene, load_scene, read_scene, save_scene
from torchgrasp.cloud import look_at, read_cloud_file
from torchgrasp.cloud.camera import INTRINSICS, render_depth
from torchgrasp.foundation.errors import BadArgument, CloudFileError
from torchgrasp.scene.image import is_scene


def test_a_saved_scene_comes_back(tmp_path):
    scene = load_scene()
    again = read_scene(save_scene(scene, tmp_path / "scene.npz"))
    assert again == scene
    assert is_scene(tmp_path / "scene.npz")


def test_the_target_of_a_saved_scene_comes_back(tmp_path):
    scene = load_scene()
    for target in (None, 3, scene.things[0]):
        chosen = scene if target is None else scene.select(target)
        assert read_scene(save_scene(chosen, tmp_path / "scene.npz")).target == target


def test_masks_of_objects_that_the_library_found_are_not_noted(tmp_path):
    dish = cup(0.006, radius=0.09, floor=0.002)
    depth, _ = render_depth([dish], look_at(20.0, 55.0, 0.5), noise=False)
    half = INTRINSICS / 2
    half[2, 2] = 1.0
    scene = Scene.from_depth(depth[::2, ::2], half)
    path = save_scene(scene, tmp_path / "scene.npz")
    assert read_scene(path) == scene and read_scene(path).notes == scene.notes == ()
    # the same labels as a user's lose the pixels of the floor
    np.savez(path, **dict(np.load(path)) | {"given": np.array(scene.things)})
    own = read_scene(path)
    assert any("lie on the support" in note for note in own.notes)
    assert own.rows_of(1).sum() < scene.rows_of(1).sum()


@pytest.mark.parametrize(
    ("target", "error"), [(7, BadArgument), (2.5, CloudFileError), ([1, 2], CloudFileError)]
)
def test_a_target_that_is_no_label_is_refused(tmp_path, target, error):
    path = save_scene(load_scene(), tmp_path / "scene.npz")
    np.savez(path, **dict(np.load(path)) | {"target": np.array(target)})
    with pytest.raises(error):
        read_scene(path)


def test_arrays_that_are_not_read_are_told(tmp_path):
    path = save_scene(load_scene(), tmp_path / "scene.npz")
    arrays = dict(np.load(path))
    # other names of the pose and of the unit: without them the frame is the camera's
    np.savez(path, **arrays, pose=arrays.pop("camera_pose"), depth_scale=0.001)
    assert "arrays depth_scale, pose were not read" in read_scene(path).notes
    cloud = tmp_path / "cloud.npz"
    np.savez(cloud, points=np.random.default_rng(0).random((50, 3)), camera_pose=np.eye(4))
    assert read_cloud_file(cloud).notes == ("arrays camera_pose were not read",)


def test_the_shipped_scene_stands_on_its_table():
    scene = load_scene()
    assert scene.things == (1, 2, 3, 4) and scene.advice == ()
    heights = scene.table.height(scene.points)
    assert float(heights[scene.labels == 0].abs().quantile(0.9)) < 0.005
    for label in scene.things:
        assert 0.05 < float(heights[scene.rows_of(label)].max()) < 0.3


def test_other_files_are_refused(tmp_path):
    np.savez(tmp_path / "cloud.npz", points=np.zeros((5, 3)))
    assert not is_scene(tmp_path / "cloud.npz")
    for name in ("cloud.npz", "none.npz", "scene.ply"):
        with pytest.raises(CloudFileError, match="depth and intrinsics"):
            read_scene(tmp_path / name)
    with pytest.raises(BadArgument, match="npz"):
        save_scene(load_scene(), tmp_path / "scene.ply")


def test_pickled_arrays_are_refused(tmp_path):
    np.savez(tmp_path / "scene.npz", depth=np.array([{}], dtype=object), intrinsics=np.eye(3))
    with pytest.raises(CloudFileError):
        read_scene(tmp_path / "scene.npz")
