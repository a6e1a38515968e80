"""Views of analytic bodies, rendered by ray casting that knows nothing of the library."""

import math
import re
import warnings

import numpy as np
import pytest
import torch

from torchgrasp.cloud.prepare import merge_clouds
from torchgrasp.cloud.read import read_cloud, save_cloud
from torchgrasp.foundation.errors import BadArgument, MendedInput, SuspiciousScale
from torchgrasp.geometry.frames import apply, rotation_angle, rotation_from_vector
from torchgrasp.shape.fit import fit_shape
from torchgrasp.values.planning import PointCloud

EYE = torch.eye(4, dtype=torch.float64)
SIDE = np.array([0.035, 0.045, 0.06])
RADIUS = 0.035
HEIGHT = 0.06  # half of the cylinder's


def hit_box(start, way):
    """Return the distance to a box of half sides SIDE along each ray; NaN for a miss."""
    with np.errstate(divide="ignore"):
        ends = (np.stack([-SIDE, SIDE])[:, None] - start) / way
    near = ends.min(0).max(-1)
    return np.where(near < ends.max(0).min(-1), near, np.nan)


def hit_ellipsoid(start, way):
    """Return the distance to an ellipsoid of half axes SIDE along each ray."""
    return hit_ball(start / SIDE, way / SIDE, 1.0)


def hit_ball(start, way, radius):
    """Return the first solution t of |start + t way| = radius."""
    a = (way**2).sum(-1)
    b = (start * way).sum(-1)
    with np.errstate(invalid="ignore"):
        return (-b - np.sqrt(b**2 - a * ((start**2).sum() - radius**2))) / a


def hit_cylinder(start, way):
    """Return the distance to an upright cylinder along each ray."""
    side = hit_ball(start[:2], way[:, :2], RADIUS)
    side = np.where(np.abs(start[2] + side * way[:, 2]) < HEIGHT, side, np.nan)
    lid = (HEIGHT - start[2]) / way[:, 2]
    inside = np.hypot(*(start[:2] + lid[:, None] * way[:, :2]).T) < RADIUS
    return np.fmin(side, np.where(inside, lid, np.nan))


# two cameras that both see three faces of the box: a face seen once may slide unseen
PAIR = {"box": (25.0, 65.0), "ellipsoid": (0.0, 70.0), "cylinder": (0.0, 70.0)}
BODIES = {"box": hit_box, "ellipsoid": hit_ellipsoid, "cylinder": hit_cylinder}


def off_body(name, points):
    """Return the distance of points from the surface of a body, nearly."""
    x = points.abs().numpy()
    if name == "ellipsoid":
        value = np.sqrt(((x / SIDE) ** 2).sum(-1))
        return np.abs(value - 1) * value / np.sqrt(((x / SIDE**2) ** 2).sum(-1))
    over = x - SIDE
    if name == "cylinder":
        over = np.stack([np.hypot(x[:, 0], x[:, 1]) - RADIUS, x[:, 2] - HEIGHT], -1)
    outside = np.linalg.norm(over.clip(0), axis=-1)
    return outside + np.abs(over.max(-1).clip(max=0))


def view(name, azimuth, noise=0.001, n=800, elevation=40.0, seed=0):
    """Return a view by a camera 0.6 m away, with normal noise along its rays."""
    a, e = np.radians([azimuth, elevation])
    away = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    start = 0.6 * away
    u, v = np.meshgrid(*2 * [np.linspace(-0.16, 0.16, 161)])
    way = -away + u.reshape(-1, 1) * right + v.reshape(-1, 1) * np.cross(right, away)
    way = way / np.linalg.norm(way, axis=-1, keepdims=True)
    random = np.random.default_rng(seed + int(azimuth))
    depth = BODIES[name](start, way)
    depth = depth + noise * random.standard_normal(len(depth))
    points = (start + depth[:, None] * way)[np.isfinite(depth)]
    rows = random.permutation(len(points))[:n]
    return PointCloud(torch.from_numpy(points[rows]), None, torch.from_numpy(start))


def shifted(axis, metres):
    pose = EYE.clone()
    pose[axis, 3] = metres
    return pose


def turned(axis, degrees, factor=1.0):
    vector = torch.zeros(3, dtype=torch.float64)
    vector[axis] = math.radians(degrees)
    pose = EYE.clone()
    pose[:3, :3] = factor * rotation_from_vector(vector)
    return pose


def moved(cloud, pose):
    return PointCloud(
        apply(pose, cloud.points), None, apply(pose, cloud.viewpoint[None])[0].contiguous()
    )


def merge(clouds, **options):
    """Return the merged cloud, None if it is refused with both numbers, and what was told."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            merged = merge_clouds(clouds, [EYE] * len(clouds), **options)
        except BadArgument as error:
            found, allowed = (
                float(re.search(r"([\d.]+) mm", text)[1]) for text in (error.found, error.allowed)
            )
            assert found > allowed > 3.0
            return None, ""
    # a camera that is guessed is told, too
    said = [warning for warning in said if "are guessed" not in str(warning.message)]
    assert all(warning.category is MendedInput for warning in said)
    return merged, " ".join(str(warning.message) for warning in said)


@pytest.mark.parametrize("name", BODIES)
def test_views_that_agree_are_taken_in_silence(name):
    for noise, count, azimuths in (
        (0.0, 700, (0.0, 60.0)),
        (0.001, 700, (10.0, 100.0, 190.0)),
        (0.002, 2500, (30.0, 70.0)),
        (0.002, 300, (0.0, 90.0, 180.0, 270.0)),
    ):
        views = [view(name, azimuth, noise, count) for azimuth in azimuths]
        merged = merge_clouds(views, [EYE] * len(views))  # warnings are errors
        assert merged.pose_error is None or float(merged.pose_error.max()) < 0.0025
    views = [view(name, 20.0, 0.002, 2500), view(name, 80.0, 0.0, 300)]
    assert len(merge_clouds(views, [EYE] * 2)) == 2800


WRONG = {
    **{f"shift {axis} {mm}": shifted(axis, 1e-3 * mm) for axis in range(3) for mm in (5, 10, -20)},
    **{f"turn {axis} {deg}": turned(axis, deg) for axis in range(3) for deg in (3, -10)},
    "scale 1.02": turned(0, 0.0, 1.02),
    "scale 1.1": turned(0, 0.0, 1.1),
}


@pytest.mark.parametrize("name", BODIES)
def test_what_views_differ_is_refused_or_told_and_stated(name):
    """The true distance is how far the surface moves along its normals."""
    first, second = (view(name, azimuth) for azimuth in PAIR[name])
    right = merge_clouds([first, second], [EYE, EYE])
    normals = right.normals[len(first) :]
    for what, pose in WRONG.items():
        far = moved(second, pose)
        true = float(((far.points - second.points) * normals).sum(-1).square().mean().sqrt())
        merged, said = merge([first, far])
        if merged is None:
            assert true > 0.002, what
            continue
        assert true < 0.007, what
        stated = 0.0 if merged.pose_error is None else float(merged.pose_error.max())
        assert abs(stated - true) < 0.0025, what
        assert true < 0.0025 or "views 0 and 1 are about" in said, what


@pytest.mark.parametrize("name", ["box", "cylinder"])
def test_the_band_holds_the_true_surface_of_views_that_differ(name):
    first, second = (view(name, azimuth) for azimuth in PAIR[name])
    points = merge_clouds([view(name, a, 0.0, 400) for a in PAIR[name]], [EYE] * 2).points
    exact = fit_shape(merge_clouds([first, second], [EYE] * 2)).predict(points).std_m
    for pose in (shifted(1, 0.005), turned(0, 5.0)):
        merged, said = merge([first, moved(second, pose)])
        shape = fit_shape(merged)
        found = shape.predict(points)
        assert "standard deviations grow" in said
        assert float(found.std_m.median()) > 1.2 * float(exact.median())
        inside = (shape.scale * found.distance).abs() < 2 * found.std_m
        assert float(inside.double().mean()) > 0.93


@pytest.mark.parametrize("name", BODIES)
def test_views_are_aligned_when_asked_and_the_motion_is_told(name):
    first, second = (view(name, azimuth) for azimuth in PAIR[name])
    for pose in (shifted(0, 0.02), shifted(1, -0.015), shifted(2, 0.02), turned(1, 8.0)):
        merged, said = merge([first, moved(second, pose)], align=True)
        off = off_body(name, merged.points)
        assert np.median(off) < 0.0015 and np.quantile(off, 0.95) < 0.005
        told = re.search(r"view 1 moved by ([\d.]+) mm and turned by ([\d.]+) degrees", said)
        assert told and "apart" not in said
        turn = math.degrees(float(rotation_angle(pose[:3, :3])))
        if name != "ellipsoid":  # nearly a ball: its turns are hidden
            assert float(told[2]) == pytest.approx(turn, abs=4.0)


def test_aligned_views_stay_and_too_large_motions_are_refused():
    first, second = view("box", 0.0), view("box", 70.0)
    kept = merge_clouds([first, second], [EYE, EYE], align=True)
    assert torch.equal(kept.points[:800], first.points)
    assert float((kept.points[800:] - second.points).norm(dim=-1).max()) < 1e-12
    for pose in (shifted(2, 0.12), shifted(0, -0.4)):
        assert merge([first, moved(second, pose)], align=True)[0] is None
    millimetres = moved(second, turned(0, 0.0, 1000.0))
    with pytest.raises(SuspiciousScale, match="in mm"):
        merge_clouds([first, millimetres], [EYE, EYE], align=True)


def test_of_several_views_the_wrong_one_is_found():
    views = [view("box", azimuth) for azimuth in (15.0, 45.0, 75.0, 60.0)]
    views[2] = moved(views[2], shifted(1, 0.004))
    merged, said = merge(views)
    errors = merged.pose_error.reshape(4, 800)[:, 0]
    assert float(errors[2]) > 0.002 and float(errors[[0, 1, 3]].max()) < 0.002
    assert re.search(r"views (0 and 2|1 and 2|2 and 3)", said)
    views[2] = moved(views[2], shifted(0, 0.02))
    assert merge(views)[0] is None
    aligned, said = merge(views, align=True)
    assert "view 2 moved" in said and "view 1 moved" not in said
    assert np.quantile(off_body("box", aligned.points), 0.95) < 0.004


def test_views_without_cameras_are_compared_and_aligned():
    views = [view("box", 0.0), moved(view("box", 60.0), shifted(2, 0.006))]
    bare = [PointCloud(each.points) for each in views]
    merged, said = merge(bare)
    assert "apart" in said and float(merged.pose_error.max()) > 0.002
    aligned, said = merge(bare, align=True)
    assert "view 1 moved" in said
    assert np.quantile(off_body("box", aligned.points), 0.95) < 0.004


def test_the_errors_of_poses_are_kept_in_files_and_by_filters(tmp_path):
    merged, _ = merge([view("box", 0.0), moved(view("box", 70.0), shifted(2, 0.005))])
    back = read_cloud(save_cloud(merged, tmp_path / "merged.npz"))
    assert torch.equal(back.pose_error, merged.pose_error)
    assert all(float(part.pose_error.min()) > 0.002 for part in merged.split_views())
    again, _ = merge([merged, view("box", 40.0)])
    assert float(again.pose_error[: len(merged)].min()) > 0.002
    bare = PointCloud(merged.points, pose_error=merged.pose_error)
    with pytest.raises(BadArgument, match=r"\.npz"):
        save_cloud(bare, tmp_path / "merged.ply")


def test_a_view_that_is_added_to_a_shape_is_compared_with_it():
    first, second = (view("cylinder", azimuth) for azimuth in (0.0, 40.0))
    shape = fit_shape(first)
    points = second.points[::10]
    right = shape.update(points)  # warnings are errors
    assert right.std_factor == shape.std_factor
    with pytest.warns(MendedInput, match=r"points about [\d.]+ mm off the cloud"):
        near = shape.update(points + torch.tensor([0.0, 0.005, 0.0]))
    assert float(near.predict(points).std_m.median()) > 0.002
    for pose in (shifted(0, 0.02), turned(0, 0.0, 1.3)):
        with pytest.raises(BadArgument, match=r"view within \d\.\d mm .* check its pose"):
            shape.update(apply(pose, points))
    # a finger may find the hidden side anywhere
    assert len(shape.update(torch.tensor([[-0.05, 0.0, 0.0]]).double()).x) == len(shape.x) + 1
