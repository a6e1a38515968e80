"""The camera of a view whose pixels were kept is where they form a regular lattice."""

import math

import pytest
import torch

from tests.make import random_motion
from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.cloud.check import voxel_downsample
from torchgrasp.cloud.diagnose import diagnose_cloud
from torchgrasp.cloud.pixels import find_pixel_camera
from torchgrasp.cloud.prepare import prepare_cloud
from torchgrasp.data.shipped import load_object
from torchgrasp.geometry.frames import apply, inverse, rotate
from torchgrasp.values.planning import PointCloud

UP = torch.tensor([0.0, 0.0, 1.0])


def take(name: str, elevation: float, distance: float, pixels: int = 100_000):
    """Return a noisy view of a shipped object, and the pose of the camera that took it."""
    mesh = load_object(name).mesh
    pose = look_at(3 * elevation, elevation, distance, mesh)
    return partial_view(mesh, pose, pixels, seed=int(elevation)).points, pose


def off(eye, camera, points):
    """Return by which angle [deg] and share of the distance an estimated camera is off."""
    centre = (points.amax(0) + points.amin(0)) / 2
    found = (eye - centre).double()
    true = (camera - centre).double()
    cosine = torch.nn.functional.cosine_similarity(found, true, 0)
    angle = math.degrees(math.acos(min(float(cosine), 1.0)))
    return angle, float((found.norm() / true.norm()).log().abs())


@pytest.mark.parametrize(
    ("name", "elevation", "distance"),
    [("cylinder", 20.0, 0.4), ("jug", 35.0, 0.6), ("rabbit", 50.0, 0.8), ("spray", 65.0, 0.5)],
)
def test_the_camera_of_a_noisy_view_is_found_in_any_frame(name, elevation, distance):
    points, pose = take(name, elevation, distance)
    motion = random_motion(int(elevation))
    moved = apply(motion, points.double())
    up = rotate(motion, UP.double()[None])[0]
    for side in (up, None):
        eye = find_pixel_camera(moved, side)
        assert eye is not None
        angle, stretch = off(eye, apply(motion, pose[:3, 3][None])[0], moved)
        assert angle < 2.0 and stretch < 0.15


def test_half_of_the_pixels_suffice_and_a_thinned_or_whole_cloud_shows_none():
    points, pose = take("jug", 35.0, 0.5)
    half = find_pixel_camera(points[::2], UP)
    assert half is not None and off(half, pose[:3, 3], points)[0] < 2.0
    for none in (points[:800], voxel_downsample(PointCloud(points), 0.004).points):
        assert find_pixel_camera(none, UP) is None
    whole = torch.from_numpy(load_object("jug").mesh.sample(3000, seed=0))
    assert find_pixel_camera(whole, UP) is None


def test_a_cloud_in_the_frame_of_its_camera_was_taken_from_the_origin():
    points, pose = take("rabbit", 35.0, 0.5)
    eye = find_pixel_camera(apply(inverse(pose), points.double()), UP)
    assert eye is not None and not bool(eye.any())


def test_shapes_and_reports_take_the_camera_that_the_pixels_show():
    points, pose = take("jug", 25.0, 0.7)
    cloud = PointCloud(points)
    seen = prepare_cloud(cloud, torch.Generator().manual_seed(0), up=UP)
    report = diagnose_cloud(cloud)
    for eye in (seen.viewpoint, report.viewpoint):
        assert eye is not None and off(eye, pose[:3, 3], points)[0] < 2.0
    assert not any("guess" in str(one) for one in report.advice)
