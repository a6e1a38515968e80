import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from tests.make import directions
from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.cloud.diagnose import diagnose_cloud
from torchgrasp.cloud.neighbours import fit_local_planes
from torchgrasp.cloud.prepare import (
    MAX_POINTS,
    clean_cloud,
    compare_normals,
    estimate_normals,
    lie_across,
    point_inward,
    prepare_cloud,
    share_facing,
)
from torchgrasp.cloud.viewpoint import guess_viewpoint
from torchgrasp.data.shipped import list_objects, load_object
from torchgrasp.foundation.errors import CloudWarning, TooFewPoints
from torchgrasp.geometry.frames import apply, inverse
from torchgrasp.geometry.linalg import unit
from torchgrasp.values.planning import PointCloud


def truth(mesh, points):
    _, distance, face = trimesh.proximity.closest_point(mesh, points.numpy())
    return torch.from_numpy(mesh.face_normals[face]), torch.from_numpy(distance)


def surface(mesh, n, seed=0):
    points, face = trimesh.sample.sample_surface(mesh, n, seed=seed)
    return PointCloud(
        torch.from_numpy(np.asarray(points)), torch.from_numpy(mesh.face_normals[face].copy())
    )


def check_normals(cloud):
    return compare_normals(cloud.points, cloud.normals)


def estimate_viewpoint(cloud):
    return guess_viewpoint(cloud.points, fit_local_planes(cloud.points)[0])[0]


def flip(cloud, share, seed=0):
    """Flip a share of the normals, and tell which."""
    flipped = (
        torch.rand(len(cloud), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        < share
    )
    return PointCloud(
        cloud.points, torch.where(flipped[:, None], -cloud.normals, cloud.normals), cloud.viewpoint
    ), flipped


@pytest.fixture(scope="module")
def ball_view():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.04)
    return partial_view(ball, look_at(20.0, 30.0, target=ball), noise=False)


def test_normals_of_a_sphere_agree_with_the_closed_form(ball_view):
    cloud = estimate_normals(ball_view)
    cosine = (cloud.normals * unit(cloud.points)).sum(-1)
    assert torch.rad2deg(torch.arccos(cosine.clamp(-1, 1))).median() < 2.0
    assert (cosine > 0.9).all()
    torch.testing.assert_close(
        torch.linalg.vector_norm(cloud.normals, dim=-1), torch.ones(1000).double()
    )


def test_an_exact_plane_has_its_exact_normal_and_stays_where_it_is():
    generator = torch.Generator().manual_seed(0)
    flat = torch.rand(300, 2, generator=generator, dtype=torch.float64) * 0.1
    points = torch.cat([flat, flat @ torch.tensor([[0.3], [-0.2]], dtype=torch.float64)], -1)
    normal = torch.tensor([-0.3, 0.2, 1.0], dtype=torch.float64) / np.sqrt(1.13)
    cloud = clean_cloud(PointCloud(points, None, torch.tensor([0.0, 0.0, 1.0]).double()))
    torch.testing.assert_close(cloud.normals, normal.expand(len(cloud), 3), atol=1e-6, rtol=0)
    assert (cloud.points @ normal).abs().max() < 1e-12


@pytest.mark.parametrize("name", list_objects())
def test_nearly_all_normals_are_outward_with_and_without_the_viewpoint(name):
    thing = load_object(name)
    outward, _ = truth(thing.mesh, thing.view.points)
    known = estimate_normals(thing.view)
    guessed = estimate_normals(PointCloud(thing.view.points))
    assert ((known.normals * outward).sum(-1) > 0).double().mean() > 0.96
    assert ((guessed.normals * known.normals).sum(-1) > 0).double().mean() > 0.97
    assert torch.equal(known.viewpoint, thing.view.viewpoint)
    assert guessed.viewpoint is not None


def test_given_normals_decide_the_side_of_a_cloud_seen_from_all_around():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.04)
    points = torch.from_numpy(np.array(ball.vertices))
    cloud = estimate_normals(PointCloud(points, 3 * points))
    assert ((cloud.normals * points).sum(-1) > 0).all()
    assert cloud.viewpoint is None
    inward = clean_cloud(PointCloud(points, -points))
    assert ((inward.normals * inward.points).sum(-1) < 0).all()


def test_outliers_go_and_the_others_come_closer_to_the_surface():
    for name in ("jug", "spray"):
        thing = load_object(name)
        generator = torch.Generator().manual_seed(0)
        stray = thing.view.points[:20] + torch.tensor([0.0, 0.0, 0.08]).double()
        stray = stray + 0.05 * torch.randn(20, 3, generator=generator, dtype=torch.float64)
        _, far = truth(thing.mesh, stray)
        stray = stray[far > 0.02]
        dirty = PointCloud(torch.cat([thing.view.points, stray]), None, thing.view.viewpoint)
        cloud = clean_cloud(dirty)
        assert 0.9 * 1000 < len(cloud) <= 1000
        _, before = truth(thing.mesh, thing.view.points)
        _, after = truth(thing.mesh, cloud.points)
        assert after.max() < 0.012
        assert after.square().mean().sqrt() < before.square().mean().sqrt()


def test_the_smallest_cloud_and_a_cloud_of_copies():
    points = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], dtype=torch.float64)
    normals = estimate_normals(PointCloud(points, None, torch.ones(3, dtype=torch.float64))).normals
    assert torch.isfinite(normals).all()
    with pytest.raises(TooFewPoints, match="distinct"):
        estimate_normals(PointCloud(points[[0, 1, 2, 2, 1]]))


def test_cleaning_takes_the_noise_and_leaves_a_ball_its_radius():
    """Planes would move the points inward, by 0.12 mm, and 0.24 mm where they are sparse."""
    generator = torch.Generator().manual_seed(0)
    outward = unit(torch.randn(4000, 3, generator=generator, dtype=torch.float64))
    outward = outward[outward[:, 2] > 0]
    noise = 0.0008 * torch.randn(len(outward), 1, generator=generator, dtype=torch.float64)
    camera = torch.tensor([0.0, 0.0, 0.6], dtype=torch.float64)
    noisy = PointCloud(0.03 * outward + noise * outward, None, camera)
    sparse = PointCloud(noisy.points[::2], None, camera)
    for cloud in (noisy, sparse):
        clean = clean_cloud(cloud).points
        height = torch.linalg.vector_norm(clean[clean[:, 2] > 0.008], dim=-1) - 0.03
        assert height.mean().abs() < 0.00006
        assert height.std() < 0.6 * noise.std()


def rng(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_prepared_view_is_the_clean_cloud_and_its_points_in_float64(dtype):
    view = load_object("jug").view.to(dtype)
    prepared = prepare_cloud(view, rng())
    clean = clean_cloud(view)
    assert torch.equal(prepared.cloud.points, clean.points) and torch.equal(
        prepared.cloud.normals, clean.normals
    )
    assert torch.equal(prepared.points, clean.points.double())
    assert torch.equal(prepared.normals, unit(clean.normals.double()))
    assert torch.equal(prepared.viewpoint, view.viewpoint.double()) and prepared.one_sided


def test_a_missing_viewpoint_is_estimated_also_of_a_whole_surface():
    unknown = prepare_cloud(PointCloud(load_object("jug").view.points), rng())
    assert unknown.viewpoint.shape == (3,) and unknown.one_sided
    whole = prepare_cloud(PointCloud(0.04 * directions(600), directions(600)), rng())
    assert whole.viewpoint.shape == (3,) and whole.cloud.viewpoint is None and not whole.one_sided


def test_a_whole_surface_is_not_turned_towards_its_viewpoint():
    viewpoint = torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64)
    prepared = prepare_cloud(PointCloud(0.04 * directions(600), directions(600), viewpoint), rng())
    assert ((prepared.normals * prepared.points).sum(-1) > 0).all() and not prepared.one_sided


def test_without_cleaning_points_and_given_normals_stay_as_they_are():
    points = 0.04 * directions(600)
    prepared = prepare_cloud(
        PointCloud(points.repeat(2, 1), 3 * directions(600).repeat(2, 1)), rng(), clean=False
    )
    assert torch.equal(prepared.points, points)
    torch.testing.assert_close(prepared.normals, directions(600))
    fitted = prepare_cloud(PointCloud(points), rng(), clean=False)
    assert torch.equal(fitted.points, points) and fitted.cloud.normals is not None


@pytest.mark.parametrize("copies", [1, 12])
def test_normals_of_random_signs_are_ignored_however_often_a_point_was_given(copies):
    """Copies of a point agree with each other: counted as neighbours they would hide that the signs
    are random.
    """
    view = load_object("cylinder").view
    normals = flip(estimate_normals(view), 0.5)[0].normals
    spoilt = PointCloud(view.points.repeat(copies, 1), normals.repeat(copies, 1), view.viewpoint)
    prepared = prepare_cloud(spoilt, rng())
    assert torch.equal(prepared.normals, prepare_cloud(view, rng()).normals)


def test_of_many_points_a_random_part_is_taken_by_the_generator():
    cloud = PointCloud(0.04 * directions(5000), directions(5000))
    first, again, other = (prepare_cloud(cloud, rng(seed)) for seed in (0, 0, 1))
    assert len(first.points) == MAX_POINTS and len(first.cloud) > 4900
    assert torch.equal(first.points, again.points) and not torch.equal(first.points, other.points)


@pytest.mark.promise("I8")
@pytest.mark.parametrize("name", list_objects())
def test_flips_are_reported_and_good_normals_are_not(name):
    thing = load_object(name)
    for cloud in (surface(thing.mesh, 1000), estimate_normals(thing.view)):
        good = check_normals(cloud)
        assert good.oriented and good.scaled == 0 and good.opposed < 0.03
        assert float(good.flipped.double().mean()) < 0.04
        spoilt, flipped = flip(cloud, 0.1)
        found = check_normals(spoilt)
        assert found.oriented and 0.1 < found.opposed < 0.25
        assert float((found.flipped == flipped).double().mean()) > 0.95
        assert not check_normals(flip(cloud, 0.5)[0]).oriented


def test_a_thin_plate_and_a_coarse_ball_are_oriented():
    assert check_normals(surface(trimesh.creation.box((0.15, 0.2, 0.002)), 1000)).oriented
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    assert check_normals(PointCloud(0.05 * axes, axes)).oriented


def test_the_guess_follows_a_rigid_motion_and_finds_the_camera(ball_view):
    for seed in range(3):
        turn = torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
        moved = PointCloud(ball_view.points @ turn.T + 0.3)
        camera = ball_view.viewpoint @ turn.T
        guess = estimate_viewpoint(moved) - 0.3
        angle = torch.arccos(
            guess @ camera / torch.linalg.vector_norm(guess) / torch.linalg.vector_norm(camera)
        )
        assert torch.rad2deg(angle) < 25


def test_a_cloud_in_the_frame_of_its_camera_was_seen_from_the_origin():
    thing = load_object("jug")
    pose = look_at(60.0, 35.0, target=thing.mesh)
    torch.testing.assert_close(pose[:3, 3], thing.view.viewpoint, atol=1e-6, rtol=0)
    assert estimate_viewpoint(PointCloud(apply(inverse(pose), thing.view.points))).tolist() == [
        0,
        0,
        0,
    ]


@pytest.mark.parametrize("name", list_objects())
def test_a_view_faces_its_camera_and_a_whole_surface_does_not(name):
    view = estimate_normals(load_object(name).view)
    assert share_facing(view.points, view.normals, view.viewpoint) > 0.9
    both = torch.cat([view.normals, -view.normals])
    assert share_facing(view.points.repeat(2, 1), both, view.viewpoint) == pytest.approx(0.5)
    each = view.viewpoint.expand(len(view), 3)
    assert share_facing(view.points, view.normals, each) == share_facing(
        view.points, view.normals, view.viewpoint
    )


def outward(name: str) -> tuple[PointCloud, PointCloud]:
    """Return a view and the whole surface of an object, both with normals that point outward."""
    seen = estimate_normals(load_object(name).view)
    return PointCloud(seen.points, seen.normals), surface(load_object(name).mesh, 1500)


@pytest.mark.parametrize("name", list_objects())
def test_normals_to_the_middle_are_noticed(name):
    for cloud in outward(name):
        assert not point_inward(cloud.points, cloud.normals)
        assert point_inward(cloud.points, -cloud.normals)


def test_normals_to_the_middle_are_told_where_no_camera_shows_their_side():
    for cloud in outward("jug"):
        inward = PointCloud(cloud.points, -cloud.normals)
        assert not any("to the middle" in str(x) for x in diagnose_cloud(cloud).advice)
        (said,) = [x for x in diagnose_cloud(inward).advice if "to the middle" in str(x)]
        assert not said.refused and "--no-normals" in said.fix
        prepare_cloud(cloud, torch.Generator())
        with pytest.warns(CloudWarning, match="normals: they point to the middle"):
            prepare_cloud(inward, torch.Generator())


WRONG = {
    "one direction": lambda points: torch.zeros_like(points).index_fill(1, torch.tensor([2]), 1.0),
    "colours": lambda points: torch.rand(points.shape, generator=torch.Generator().manual_seed(0)),
    "one colour": lambda points: torch.full_like(points, 128.0),
}


@pytest.mark.parametrize("name", WRONG)
def test_vectors_across_the_surface_are_no_normals_and_told(name):
    view = load_object("cylinder").view
    points = view.points.double()
    given = PointCloud(points, WRONG[name](points).double())
    generator = torch.Generator().manual_seed(0)
    with pytest.warns(CloudWarning, match=r"normals: they are across the surface .* or None"):
        prepare_cloud(given, generator)
    assert any("across the surface" in one.found for one in diagnose_cloud(given).advice)


@pytest.mark.parametrize("count", [100, 400])
@pytest.mark.parametrize("noise", [0.0, 0.004])
def test_normals_of_few_and_noisy_points_are_not_taken_for_colours(count, noise):
    mesh = load_object("rabbit").mesh
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=0)[:2]
    points = points + noise * np.random.default_rng(0).normal(size=points.shape)
    normals = torch.from_numpy(mesh.face_normals[faces].copy())
    assert not lie_across(torch.from_numpy(points), normals)
