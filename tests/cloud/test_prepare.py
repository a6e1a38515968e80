import numpy as np
import pytest
import torch
import trimesh

from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.cloud.prepare import MAX_POINTS, clean_cloud, estimate_normals, prepare_cloud
from torchgrasp.data.shipped import list_objects, load_object
from torchgrasp.errors import TooFewPoints
from torchgrasp.geometry.linalg import unit
from torchgrasp.values import PointCloud


def truth(mesh, points):
    _, distance, face = trimesh.proximity.closest_point(mesh, points.numpy())
    return torch.from_numpy(mesh.face_normals[face]), torch.from_numpy(distance)


@pytest.fixture(scope="module")
def ball_view():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.04)
    return partial_view(ball, look_at(20.0, 30.0, target=ball), noise=False)


def test_normals_of_a_sphere_agree_with_the_closed_form(ball_view):
    cloud = estimate_normals(ball_view)
    cosine = (cloud.normals * unit(cloud.points)).sum(-1)
    assert torch.rad2deg(torch.arccos(cosine.clamp(-1, 1))).median() < 2.0
    assert (cosine > 0.9).all()
    torch.testing.assert_close(torch.linalg.vector_norm(cloud.normals, dim=-1), torch.ones(1000).double())


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
    for name in list_objects():
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


def test_duplicates_change_nothing(ball_view):
    twice = PointCloud(ball_view.points.repeat(3, 1), None, ball_view.viewpoint)
    for function in (estimate_normals, clean_cloud):
        once, thrice = function(ball_view), function(twice)
        assert len(once) == len(thrice)
        torch.testing.assert_close(once.points, thrice.points)
        torch.testing.assert_close(once.normals, thrice.normals)


def test_results_scale_with_the_cloud_and_keep_its_dtype(ball_view):
    small, large = clean_cloud(ball_view), clean_cloud(PointCloud(7 * ball_view.points, None, 7 * ball_view.viewpoint))
    torch.testing.assert_close(7 * small.points, large.points, atol=1e-12, rtol=1e-9)
    torch.testing.assert_close(small.normals, large.normals, atol=1e-7, rtol=0)
    single = clean_cloud(PointCloud(ball_view.points.float(), None, ball_view.viewpoint.float()))
    assert single.points.dtype == single.normals.dtype == torch.float32


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


def ball(n):
    return unit(torch.randn(n, 3, generator=rng(), dtype=torch.float64))


def random_signs(normals):
    return normals * torch.randn(len(normals), 1, generator=rng(1), dtype=torch.float64).sign()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_prepared_view_is_the_clean_cloud_and_its_points_in_float64(dtype):
    view = load_object("jug").view.to(dtype)
    prepared = prepare_cloud(view, rng())
    clean = clean_cloud(view)
    assert torch.equal(prepared.cloud.points, clean.points) and torch.equal(prepared.cloud.normals, clean.normals)
    assert torch.equal(prepared.points, clean.points.double())
    assert torch.equal(prepared.normals, unit(clean.normals.double()))
    assert torch.equal(prepared.viewpoint, view.viewpoint.double()) and prepared.one_sided


def test_a_missing_viewpoint_is_estimated_also_of_a_whole_surface():
    unknown = prepare_cloud(PointCloud(load_object("jug").view.points), rng())
    assert unknown.viewpoint.shape == (3,) and unknown.one_sided
    whole = prepare_cloud(PointCloud(0.04 * ball(600), ball(600)), rng())
    assert whole.viewpoint.shape == (3,) and whole.cloud.viewpoint is None and not whole.one_sided


def test_a_whole_surface_is_not_turned_towards_its_viewpoint():
    viewpoint = torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64)
    prepared = prepare_cloud(PointCloud(0.04 * ball(600), ball(600), viewpoint), rng())
    assert ((prepared.normals * prepared.points).sum(-1) > 0).all() and not prepared.one_sided


def test_without_cleaning_points_and_given_normals_stay_as_they_are():
    points = 0.04 * ball(600)
    prepared = prepare_cloud(PointCloud(points.repeat(2, 1), 3 * ball(600).repeat(2, 1)), rng(), clean=False)
    assert torch.equal(prepared.points, points)
    torch.testing.assert_close(prepared.normals, ball(600))
    fitted = prepare_cloud(PointCloud(points), rng(), clean=False)
    assert torch.equal(fitted.points, points) and fitted.cloud.normals is not None


@pytest.mark.parametrize("copies", [1, 12])
def test_normals_of_random_signs_are_ignored_however_often_a_point_was_given(copies):
    """Copies of a point agree with each other: counted as neighbours they would hide that the signs are random."""
    view = load_object("cylinder").view
    normals = random_signs(estimate_normals(view).normals)
    spoilt = PointCloud(view.points.repeat(copies, 1), normals.repeat(copies, 1), view.viewpoint)
    prepared = prepare_cloud(spoilt, rng())
    assert torch.equal(prepared.normals, prepare_cloud(view, rng()).normals)


def test_of_many_points_a_random_part_is_taken_by_the_generator():
    cloud = PointCloud(0.04 * ball(5000), ball(5000))
    first, again, other = (prepare_cloud(cloud, rng(seed)) for seed in (0, 0, 1))
    assert len(first.points) == MAX_POINTS and len(first.cloud) > 4900
    assert torch.equal(first.points, again.points) and not torch.equal(first.points, other.points)
