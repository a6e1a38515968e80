"""Completion of shapes whose hidden side is known in closed form."""

import math

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from tests.make import near, real
from torchgrasp import PointCloud, fit_shape
from torchgrasp.cloud import look_at, partial_view
from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.shape.completion.complete import (
    HIDDEN,
    MIRROR,
    Completion,
    complete_cloud,
)
from torchgrasp.shape.completion.silhouette import _distance, _Projection, silhouette
from torchgrasp.shape.completion.symmetry import SymmetryScorer, planes_near, reflect
from torchgrasp.shape.surface import extract_surface

CAMERA = real([0.45, 0.0, 0.3])


def _seen_box(half: tuple[float, float, float], camera: Tensor) -> PointCloud:
    """The seen faces of a box that stands on z = 0, with exact normals."""
    rng = torch.Generator().manual_seed(2)
    size = real(half)
    points = []
    normals = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            area = float(size.prod() / size[axis])
            p = (2 * torch.rand(int(3e5 * area), 3, dtype=torch.float64, generator=rng) - 1) * size
            p[:, axis] = sign * size[axis]
            n = torch.zeros_like(p)
            n[:, axis] = sign
            points.append(p + real([0.0, 0.0, half[2]]))
            normals.append(n)
    p = torch.cat(points)
    n = torch.cat(normals)
    seen = ((camera - p) * n).sum(-1) > 0.1 * torch.linalg.vector_norm(camera - p, dim=-1)
    return PointCloud(p[seen], n[seen], camera)


def _angles(found: Tensor, wanted: Tensor) -> Tensor:
    return torch.rad2deg(torch.arccos((found * wanted).sum(-1).clamp(-1, 1)))


def test_hidden_half_of_a_cylinder_is_found_and_respects_cloud_outline_and_table(
    seen_cylinder: PointCloud,
):
    found = complete_cloud(seen_cylinder, table=0.0)
    side = found.points[:, 2] < 0.11
    error = torch.linalg.vector_norm(found.points[side, :2], dim=-1) - 0.03
    assert len(found.points) >= 30 and (found.points[:, 0] < 0).double().mean() > 0.8
    assert error.abs().median() < 0.0015 and error.abs().max() < 0.004
    outward = found.points[side] * real([1.0, 1.0, 0.0])
    outward = outward / torch.linalg.vector_norm(outward, dim=-1, keepdim=True)
    assert _angles(found.normals[side], outward).median() < 5
    assert found.scores[0] > 0.3
    assert found.points[:, 2].min() > -0.002
    assert torch.cdist(found.points, seen_cylinder.points).min() > 0.006
    assert found.outline.hull_distance(found.points).max() < 0.001
    apart = torch.cdist(found.points, found.points) + torch.eye(len(found.points))
    assert apart.min() > 0.004
    assert len(complete_cloud(seen_cylinder, table=0.0, budget=7).points) == 7


def test_back_of_a_box_is_found_and_no_point_is_spent_on_the_face_on_the_table():
    camera = real([0.4, 0.2, 0.3])
    found = complete_cloud(_seen_box((0.025, 0.04, 0.06), camera), table=0.0)
    half = real([0.025, 0.04, 0.06])
    off = ((found.points - real([0.0, 0.0, 0.06])).abs() - half).amax(-1)
    assert off.abs().median() < 0.004 and off.abs().max() < 0.006
    assert (found.points[:, 0] < -0.02).any() and (found.points[:, 1] < -0.035).any()
    camera = real([0.5, 0.2, 0.3])
    found = complete_cloud(_seen_box((0.03, 0.03, 0.03), camera), table=0.0)
    assert (found.planes[:, 2].abs() > 0.9).any()  # the level plane images the top onto the table
    assert not ((found.points[:, 2] < 0.003) & (found.normals[:, 2] < -0.9)).any()


def test_hidden_half_is_found_without_a_table_wherever_the_object_is(
    seen_cylinder: PointCloud, motion: Tensor
):
    found = complete_cloud(seen_cylinder)
    error = torch.linalg.vector_norm(found.points[:, :2], dim=-1) - 0.03
    assert (found.points[:, 0] < -0.01).sum() > 10
    assert error[found.points[:, 2] < 0.11].abs().median() < 0.003
    assert seen_cylinder.normals is not None
    camera = apply(motion, CAMERA[None])[0]
    found = complete_cloud(
        PointCloud(
            apply(motion, seen_cylinder.points), rotate(motion, seen_cylinder.normals), camera
        )
    )
    back = (found.points - motion[:3, 3]) @ motion[:3, :3]
    error = torch.linalg.vector_norm(back[:, :2], dim=-1) - 0.03
    assert (back[:, 0] < -0.01).sum() > 10
    assert error[back[:, 2] < 0.11].abs().median() < 0.003


def test_noise_covers_the_error_grows_without_symmetry_and_is_shared_by_neighbours(
    seen_cylinder: PointCloud,
):
    found = complete_cloud(seen_cylinder, table=0.0)
    side = found.points[:, 2] < 0.11
    error = (torch.linalg.vector_norm(found.points[side, :2], dim=-1) - 0.03).abs()
    assert (error < _deviation(found)[side]).double().mean() > 0.9
    assert _deviation(found).median() < 0.008
    poor = complete_cloud(_without_symmetry(seen_cylinder), table=0.0)
    assert poor.scores[0] < found.scores[0]
    assert _deviation(poor).median() > _deviation(found).median()
    found = complete_cloud(_without_symmetry(seen_cylinder), table=0.0)
    parts = found.deviations[:, found.shared.shape[1] :]
    covariance = parts @ parts.T
    scale = torch.sqrt(covariance.diagonal()[:, None] * covariance.diagonal())
    apart = torch.cdist(found.points, found.points)
    near(covariance / scale, torch.exp(-0.5 * (apart / 0.02) ** 2), 1e-9)
    own = found.asymmetry**2 + (found.shared**2).sum(1)
    torch.testing.assert_close(covariance.diagonal(), own, atol=1e-12, rtol=1e-9)


@pytest.mark.parametrize("table", [0.0, None])
def test_shared_errors_are_those_of_a_moved_plane(seen_cylinder: PointCloud, table: float | None):
    """A plane's shift moves all its points along its normal, a turn those further away more: the
    rank stays small.
    """
    found = complete_cloud(seen_cylinder, table=table)
    free = 2 if table is not None else 3  # a shift and one or two turns
    values = torch.linalg.svdvals(found.shared)
    assert float((values[free * len(found.planes) :] ** 2).sum()) < 0.02 * float((values**2).sum())
    assert torch.linalg.vector_norm(found.shared, dim=1).min() > 0


def test_shared_errors_are_the_second_moment_of_the_mixture_of_planes():
    """Every plane near the chosen one moves a point; its probability follows from its score."""
    cloud = _seen_box((0.025, 0.04, 0.06), real([0.4, 0.2, 0.3]))
    found = complete_cloud(cloud, table=0.0)
    scorer = SymmetryScorer.of(cloud, 0.0)
    by_plane = found.shared.reshape(len(found.points), len(found.planes), -1)
    checked = 0
    for k, plane in enumerate(found.planes):
        # Points of this plane alone, mirrored once, since an image of an image has errors of two
        # planes.
        mine = (by_plane[:, k].abs().sum(-1) > 0) & (
            by_plane.abs().sum((1, 2)) == by_plane[:, k].abs().sum(-1)
        )
        sources = reflect(found.points[mine], plane)
        normals = found.normals[mine]
        steps = torch.linspace(-1, 1, MIRROR.near, dtype=torch.float64)
        moment = torch.zeros(len(sources), len(sources), dtype=torch.float64)
        total = 0.0
        for other in planes_near(
            scorer, plane, MIRROR.angle * steps, MIRROR.shift * scorer.size * steps
        ):
            chance = math.exp(float(scorer.score(other[None])[0]) / MIRROR.temperature)
            moved = ((reflect(sources, other) - found.points[mine]) * normals).sum(1)
            moment = moment + chance * moved[:, None] * moved
            total = total + chance
        torch.testing.assert_close(
            (found.shared @ found.shared.T)[mine][:, mine], moment / total, atol=1e-12, rtol=1e-9
        )
        checked += int(mine.sum())
    assert checked > 10


def _deviation(found: Completion) -> Tensor:
    """The standard deviation [m] of each point's whole error."""
    return torch.sqrt(HIDDEN.noise**2 + (found.deviations**2).sum(1))


def _without_symmetry(cloud: PointCloud) -> PointCloud:
    """The cloud with waves on its side that no mirror repeats."""
    assert cloud.normals is not None
    angle = torch.atan2(cloud.points[:, 1], cloud.points[:, 0])
    wave = 0.006 * torch.sin(4 * angle + 100 * cloud.points[:, 2] + 1)
    return PointCloud(cloud.points + wave[:, None] * cloud.normals, cloud.normals, cloud.viewpoint)


def test_project_faces_the_middle_of_the_points():
    corners = real([[-1.0, -2, 3], [5, 4, 9], [0, 0, 4]])
    seen = _Projection.of(torch.cat([corners, real([[2.0, 1, 6]])]), real([10.0, 7, -2]))
    near(seen.pixels[-1], torch.zeros(2, dtype=torch.float64), 1e-12)
    torch.testing.assert_close(seen.axes @ seen.axes.T, torch.eye(3, dtype=torch.float64))
    assert float(seen.depths[-1]) == pytest.approx(164**0.5)


def test_distances_are_those_of_the_nearest_cell_outside_the_mask():
    """Of a mask that reaches one side of the raster, and of an empty one."""
    generator = torch.Generator().manual_seed(5)
    mask = torch.zeros(14, 17, dtype=torch.bool)
    mask[3:11, 9:] = torch.rand(8, 8, generator=generator) < 0.9
    cells = torch.cartesian_prod(torch.arange(14), torch.arange(17)).double()
    apart = torch.cdist(cells, cells[~mask.flatten()], compute_mode="donot_use_mm_for_euclid_dist")
    assert torch.equal(torch.from_numpy(_distance(mask.numpy())).flatten(), apart.amin(1))
    assert not _distance(~mask.numpy() & mask.numpy()).any()


def test_silhouette_of_a_ball_is_its_circle():
    rng = torch.Generator().manual_seed(4)
    p = torch.randn(4000, 3, dtype=torch.float64, generator=rng)
    p = 0.04 * p / torch.linalg.vector_norm(p, dim=-1, keepdim=True)
    camera = real([0.0, 0.5, 0.0])
    outline = silhouette(PointCloud(p[((camera - p) * p).sum(-1) > 0], None, camera))
    # The tangent cone touches the ball on a circle of radius r sqrt(1 - (r/d)^2) at distance d -
    # r^2/d.
    ring = 0.04 * math.sqrt(1 - 0.08**2)
    assert len(outline.rim) == 16
    assert (torch.linalg.vector_norm(outline.rim[:, [0, 2]], dim=-1) - ring).abs().max() < 0.0025
    assert _angles(outline.rim_normals, outline.rim / 0.04).max() < 20
    probe = real([[0.0, -0.2, 0.0], [0.2, 0.0, 0.0], [0.0, 0.03, 0.0], [0.0, 0.07, 0.0]])
    hull = outline.hull_distance(probe)
    assert hull[0] < 0 and hull[1].item() == pytest.approx(0.16, abs=0.004) and hull[2] < 0
    violation = outline.violation(probe)
    assert violation[0] == 0 and violation[2] == 0
    assert violation[1] == hull[1] and violation[3].item() == pytest.approx(0.03 - 0.002, abs=0.002)


@pytest.mark.parametrize("turn", [45.0, 60.0])
def test_the_back_of_a_box_follows_from_a_plane_at_right_angles(turn: float):
    """Its own score is small: the images of the broad side are hidden, and only the narrow side and
    the top match.
    """
    camera = 0.6 * real([math.cos(math.radians(turn)), math.sin(math.radians(turn)), 0.4])
    half = (0.025, 0.05, 0.07)
    found = complete_cloud(_seen_box(half, camera), table=0.0)
    upright = found.planes[found.planes[:, 2].abs() < 0.5]
    assert (upright[:, :3] @ upright[:, :3].T).abs().min() < math.cos(math.radians(85.0))
    back = (found.normals[:, 0] < -0.9) & (found.points[:, 1].abs() < 0.04)
    assert back.sum() >= 5
    assert (
        found.points[back, 0] + half[0]
    ).abs().max() < 0.004  # the far side, 50 mm behind the broad one


def test_the_underside_of_a_lying_rod_is_mirrored_from_its_top():
    rng = torch.Generator().manual_seed(3)
    angle = 2 * math.pi * torch.rand(6000, generator=rng, dtype=torch.float64)
    along = 0.15 * (torch.rand(6000, generator=rng, dtype=torch.float64) - 0.5)
    normals = torch.stack([angle.cos(), torch.zeros_like(angle), angle.sin()], 1)
    axis = real([0.0, 0.0, 0.02])
    radius = 0.02
    points = radius * normals + axis + along[:, None] * real([0.0, 1.0, 0.0])
    camera = real([0.5, 0.0, 0.3])
    seen = ((camera - points) * normals).sum(1) > 0.1 * torch.linalg.vector_norm(
        camera - points, dim=1
    )
    found = complete_cloud(PointCloud(points[seen], normals[seen], camera), table=0.0)
    under = found.normals[:, 2] < -0.5
    assert under.sum() >= 5
    off = torch.linalg.vector_norm((found.points - axis)[under][:, [0, 2]], dim=1) - radius
    assert off.abs().median() < 0.002


@pytest.mark.filterwarnings("ignore::torchgrasp.foundation.errors.Flat")
@pytest.mark.parametrize("depth", [0.03, 0.05, 0.08])
def test_a_box_that_shows_one_face_does_not_know_its_depth(depth: float):
    """Mirror planes of any depth hide their images, so their scores are equal: the back lies
    anywhere behind.
    """
    camera = real([0.5, 0.0, 0.06])
    cloud = _seen_box((depth / 2, 0.04, 0.06), camera)
    assert cloud.normals is not None and (cloud.normals[:, 0] == 1).all()
    shape = fit_shape(cloud, table=0.0)
    y = torch.linspace(-0.03, 0.03, 7, dtype=torch.float64)
    z = torch.linspace(0.02, 0.1, 7, dtype=torch.float64)
    back = torch.cartesian_prod(real([-depth / 2]), y, z)
    found = shape.predict(back)
    assert (
        found.distance.abs() <= 2 * shape.std_factor * found.variance.sqrt()
    ).double().mean() > 0.9
    assert found.std_m.median() > 0.01


@pytest.mark.filterwarnings("ignore::torchgrasp.foundation.errors.Gap")
@pytest.mark.parametrize("azimuth", [15.0, 70.0])
def test_a_frame_of_thin_bars_is_as_deep_as_the_bars_are_wide_and_its_rings_are_open(
    azimuth: float,
):
    upright = trimesh.transformations.rotation_matrix(math.pi / 2, [0, 1, 0])
    rings = []
    for side in (-0.028, 0.028):
        ring = trimesh.creation.torus(0.022, 0.0025, 48, 16).apply_transform(upright)
        rings.append(ring.apply_translation([0.0, side, 0.0245]))
        ends = [[0.0, 1.8 * side, 0.0245], [-0.09, 1.8 * side, 0.0245]]
        rings.append(trimesh.creation.cylinder(0.0025, segment=ends, sections=16))
    frame = trimesh.util.concatenate(rings)
    volume = sum(float(part.volume) for part in rings)
    view = partial_view(frame, look_at(azimuth, 40.0, target=frame), seed=0)
    shape = fit_shape(view, table=0.0)
    assert extract_surface(shape).mesh().volume < 3.5 * volume
    points, faces = trimesh.sample.sample_surface(frame, 500, seed=0)
    truth = torch.from_numpy(np.asarray(points))
    normals = torch.from_numpy(frame.face_normals[faces])
    far = shape.predict(truth[((view.viewpoint - truth) * normals).sum(-1) < 0])
    error = (far.distance * shape.scale).abs()
    assert error.median() < 0.0012 and (error < 2 * far.std_m).double().mean() > 0.9
