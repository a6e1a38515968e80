"""Guessed cameras are above the support, and clouds in the frame of their camera are told."""

import functools

import pytest
import torch
import trimesh

from tests.make import box, real
from torchgrasp.cloud.camera import INTRINSICS, look_at, partial_view, render_depth
from torchgrasp.cloud.depth import cloud_from_depth
from torchgrasp.cloud.diagnose import diagnose_cloud
from torchgrasp.cloud.neighbours import draw_rows, fit_local_planes
from torchgrasp.cloud.viewpoint import can_see, guess_viewpoint, share_unseen
from torchgrasp.data.shipped import list_objects, load_object
from torchgrasp.geometry.frames import apply, inverse, rotation_from_vector
from torchgrasp.geometry.linalg import unit
from torchgrasp.values.planning import PointCloud

ELEVATIONS = (20.0, 45.0, 70.0)
SEEN = [
    (name, one)
    for k, name in enumerate(list_objects())
    for i, one in enumerate(ELEVATIONS)
    if (k + i) % 2 == 0
]
"""Half of the pairs of an object and the elevation of its camera [deg]; each occurs."""


@functools.cache
def view(name, elevation, table=False):
    """Return a noisy view of a shipped object, with or without the table about it, and the camera's
    pose.
    """
    mesh = load_object(name).mesh
    pose = look_at(10.0 + 3 * elevation, elevation, 0.6, mesh)
    if not table:
        return partial_view(mesh, pose, 800, seed=int(elevation)), pose
    bottom = float(mesh.bounds[0, 2])
    middle = mesh.bounds.mean(0)
    ground = box((0.3, 0.3, 0.01), (*middle[:2], bottom - 0.005))
    whole = trimesh.util.concatenate([mesh, ground])
    return partial_view(whole, pose, 2500, seed=int(elevation)), pose


@pytest.mark.parametrize(("name", "elevation"), SEEN)
def test_a_guessed_camera_is_above_the_support_in_any_frame(name, elevation):
    turn = rotation_from_vector(torch.tensor([1.0, 0.7, elevation]).double())
    for table in (True, False):  # the support is seen, or its normal is given
        points = view(name, elevation, table)[0].points.double() @ turn.T
        guess, angle = guess_viewpoint(
            points, fit_local_planes(points)[0], None if table else turn[:, 2]
        )
        assert float(guess @ turn[:, 2]) > float((points @ turn[:, 2]).min()) and 0 < angle <= 180


@pytest.mark.parametrize(
    ("name", "elevation", "known"),
    [
        (name, one, (k + i) % 2 == 0)
        for k, name in enumerate(list_objects())
        for i, one in enumerate(ELEVATIONS)
    ],
)
def test_a_cloud_in_the_frame_of_its_camera_is_told(name, elevation, known):
    cloud, pose = view(name, elevation)
    own = PointCloud(
        apply(inverse(pose), cloud.points), None, torch.zeros(3).double() if known else None
    )
    refused = [str(advice) for advice in diagnose_cloud(own).advice if advice.refused]
    assert any("camera's frame" in sentence and "--up" in sentence for sentence in refused)


@pytest.mark.parametrize(("name", "elevation"), SEEN)
def test_a_possible_viewpoint_is_kept_and_one_below_is_not(name, elevation):
    points = view(name, elevation, table=True)[0].points.double()
    normals = fit_local_planes(points)[0]
    (_, pose) = view(name, elevation)
    assert can_see(points, normals, pose[:3, 3])
    if elevation < 60:  # from far below, a table hides few points of what stands on it
        assert not can_see(points, normals, 2 * points.mean(0) - pose[:3, 3])


def test_a_rendered_scene_in_the_frame_of_its_camera_keeps_the_origin():
    pose = look_at(20.0, 45.0, 0.7)
    depth = render_depth([box((0.06, 0.05, 0.1)), box((0.05, 0.05, 0.06), (0.05, 0.14))], pose)[0]
    points = cloud_from_depth(torch.where(depth < 1.0, depth, 0.0), INTRINSICS).points
    points = points[draw_rows(len(points), 3000)]
    assert can_see(points, fit_local_planes(points)[0], torch.zeros(3).double())
    base = apply(pose, points)  # in the frame of the table, the origin cannot have been the camera
    assert not can_see(base, fit_local_planes(base)[0], torch.zeros(3).double())


@pytest.mark.parametrize("known", [True, False])
def test_a_cloud_of_opengls_camera_is_told_and_others_are_not(known):
    view = load_object("jug").view
    eye = view.viewpoint.double()
    for azimuth in (0.0, 120.0):
        pose = look_at(azimuth, 30.0, 0.6, load_object("jug").mesh).double()
        camera = apply(inverse(pose), view.points.double())
        gl = PointCloud(camera * torch.tensor([1.0, -1.0, -1.0]), None, torch.zeros(3).double())
        gl = gl if known else PointCloud(gl.points)
        told = [str(one) for one in diagnose_cloud(gl).advice]
        assert any("multiply them by diag(1, -1, -1)" in one for one in told)
    for right in (PointCloud(view.points.double(), None, eye), PointCloud(view.points)):
        assert not any("diag" in str(one) for one in diagnose_cloud(right).advice)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_points_that_look_edge_on_from_everywhere_contradict_no_camera(seed):
    """A camera sees uniform normals with |cos| < .17 in a share of .17, wherever it is."""
    rng = torch.Generator().manual_seed(seed)
    flat = torch.rand(4000, 2, generator=rng, dtype=torch.float64) - 0.5
    points = 0.1 * torch.cat([flat, 0.0 * flat[:, :1]], 1)
    camera = real([0.0, 0.0, 0.6])
    frame = share_unseen(points, unit(torch.randn(4000, 3, generator=rng).double()), camera)
    assert frame.edge_on == pytest.approx(0.17, abs=0.02)
    assert max(frame.excess) < 1


def test_a_plate_that_other_cameras_see_well_contradicts_a_camera_in_its_plane():
    """A camera 5 degrees above a plate sees all of it edge-on; one above it sees none."""
    rng = torch.Generator().manual_seed(0)
    flat = torch.rand(1000, 2, generator=rng, dtype=torch.float64) - 0.5
    points = 0.1 * torch.cat([flat, 0.0 * flat[:, :1]], 1)
    up = real([0.0, 0.0, 1.0]).expand(1000, 3)
    low = share_unseen(points, up, real([0.6, 0.0, 0.05]))
    high = share_unseen(points, up, real([0.1, 0.0, 0.6]))
    assert low.edge_on > 0.9 and low.least == 0.0 and low.excess[0] > 1
    assert high.edge_on == 0.0 and max(high.excess) < 1
