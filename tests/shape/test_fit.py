"""Shapes of partial clouds whose true surface is known in closed form."""

import dataclasses
import math
from typing import Any, Literal

import pytest
import torch
from torch import Tensor

from tests.make import ball, cup_view, near, real
from torchgrasp import PointCloud, ShapeGP, fit_shape, load_object, plan_grasps
from torchgrasp.cloud.prepare import estimate_normals
from torchgrasp.foundation.errors import (
    BadArgument,
    IndefiniteCovariance,
    NoEffect,
    SuspiciousScale,
)
from torchgrasp.shape.conditioning import Criterion
from torchgrasp.shape.extra_observations import STD_FACTORS
from torchgrasp.shape.kernel import Kernel, KernelName, matern52_kernel


def _side(angle_from: float, angle_to: float) -> Tensor:
    """Points on the cylinder's side, by the angle [rad] from the camera's direction, away from its
    ends.
    """
    angle = torch.linspace(angle_from, angle_to, 12, dtype=torch.float64)
    height = torch.linspace(0.025, 0.095, 8, dtype=torch.float64)
    a, h = (g.reshape(-1) for g in torch.meshgrid(angle, height, indexing="ij"))
    return torch.stack([0.03 * a.cos(), 0.03 * a.sin(), h], -1)


@pytest.fixture(scope="module")
def cloud(seen_cylinder: PointCloud) -> PointCloud:
    """A noisy single view of a cylinder, r 30 mm and h 120 mm, without normals."""
    noise = torch.randn(
        seen_cylinder.points.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    return PointCloud(seen_cylinder.points + 0.0005 * noise, None, seen_cylinder.viewpoint)


@pytest.fixture(scope="module")
def shape(cloud: PointCloud) -> ShapeGP:
    return fit_shape(cloud, table=0.0)


@pytest.fixture(scope="module")
def paper(cloud: PointCloud) -> ShapeGP:
    return fit_shape(cloud, support="paper", budget=60, seed=3)


def test_seen_side_is_within_a_millimetre_and_the_hidden_one_better_than_the_papers(
    shape: ShapeGP, paper: ShapeGP
):
    points = _side(-1.2, 1.2)
    found = shape.predict(points)
    assert (found.distance.abs() * shape.scale).median() < 0.001
    assert _normal_error(found.normal, points).median() < 8
    assert found.variance.median() < 0.03
    points = _side(2.2, 4.1)
    found = shape.predict(points)
    seen = shape.predict(_side(-1.2, 1.2))
    assert (found.distance.abs() * shape.scale).median() < 0.003
    assert _normal_error(found.normal, points).median() < 15
    assert found.std_m.median() > seen.std_m.median()
    assert (found.distance.abs() * shape.scale < 2 * found.std_m).double().mean() > 0.9
    ours = shape.predict(points)
    theirs = paper.predict(points)
    assert (
        _normal_error(ours.normal, points).median() < _normal_error(theirs.normal, points).median()
    )
    assert ours.variance.median() < theirs.variance.median()


def test_what_is_observed_outside_allows_for_the_hidden_side_and_distance_is_metric(shape: ShapeGP):
    """Measured to the cloud alone, points behind the object would be a diameter too far away, and
    shrink it.
    """
    outside = shape.metres(shape.x[torch.linalg.vector_norm(shape.x, dim=-1).sub(1.2).abs() < 1e-9])
    assert len(outside) == 20
    radial = torch.linalg.vector_norm(outside[:, :2], dim=-1) - 0.03
    axial = torch.maximum(outside[:, 2] - 0.12, -outside[:, 2])
    true = torch.where(radial < 0, axial, torch.hypot(radial.clamp_min(0), axial.clamp_min(0)))
    error = shape.predict(outside).distance * shape.scale - true
    assert error.abs().max() < 0.012 and error.median().abs() < 0.003
    axis = real([[0.045, 0.0, 0.06], [0.03, 0.0, 0.06], [0.02, 0.0, 0.06]])
    near(shape.predict(axis).distance * shape.scale, real([0.015, 0.0, -0.01]), 0.003)


def test_paper_support_observes_what_the_paper_does_and_copies_change_nothing(
    paper: ShapeGP, cloud: PointCloud
):
    inner = paper.x[~paper.has_normal][0]
    outer = paper.x[~paper.has_normal][1:]
    assert len(paper.x) == 60 and paper.std_factor == 1.0
    assert inner.abs().max() == 0
    torch.testing.assert_close(
        torch.linalg.vector_norm(outer, dim=-1), torch.full((20,), 1.2, dtype=torch.float64)
    )
    assert torch.linalg.vector_norm(paper.x[paper.has_normal], dim=-1).max() <= 1 + 1e-12
    near(
        paper.predict(paper.metres(paper.x[~paper.has_normal])).distance,
        real([-1.0] + [1.0] * 20),
        0.02,
    )
    before = torch.get_rng_state()
    again, other = (fit_shape(cloud, support="paper", budget=60, seed=seed) for seed in (3, 6))
    assert torch.equal(again.weights, paper.weights) and not torch.equal(again.x, other.x)
    assert torch.equal(torch.get_rng_state(), before)
    once = ball()
    rows = torch.cat([torch.arange(300), torch.arange(150)])
    assert once.normals is not None
    twice = PointCloud(once.points[rows], once.normals[rows])
    assert torch.equal(
        fit_shape(once, support="paper").weights, fit_shape(twice, support="paper").weights
    )


@pytest.mark.parametrize("support", ["camera", "paper"])
def test_the_papers_psi_raises_and_its_fix_works(
    cloud: PointCloud, support: Literal["camera", "paper"]
):
    with pytest.raises(IndefiniteCovariance, match=r"psi_scale of at least 1\.34"):
        fit_shape(cloud, psi_scale=1.0, support=support)
    fit_shape(cloud, psi_scale=1.34, support=support)


@pytest.mark.parametrize("viewpoint", [None, real([0.0, 0.0, 0.5])])
def test_a_whole_surface_needs_no_completion_and_a_viewpoint_does_not_turn_it(
    viewpoint: Tensor | None,
):
    whole = ball(900, viewpoint=viewpoint)
    assert whole.normals is not None
    shape = fit_shape(whole)
    found = shape.predict(whole.points)
    assert len(shape.x) == 85
    assert (found.distance.abs() * shape.scale).max() < 0.002 and found.std_m.max() < 0.006
    assert (found.normal * whole.normals).sum(-1).min() > 0.98


@pytest.mark.parametrize("viewpoint", [None, real([0.3, 0.1, 0.4])])
def test_a_whole_surface_without_normals_is_refused_and_not_turned_inside_out(
    viewpoint: Tensor | None,
):
    for shape in (real([1.0, 1.0, 1.0]), real([0.4, 1.0, 2.0])):
        with pytest.raises(BadArgument, match=r"cloud: .* outward normals.* behind others"):
            fit_shape(PointCloud(ball(900).points * shape, None, viewpoint))


@pytest.mark.promise("N8")
@pytest.mark.filterwarnings("ignore::torchgrasp.foundation.errors.FewPoints")
def test_few_points_in_float32_give_a_shape_in_float64(cloud: PointCloud):
    few = PointCloud(cloud.points[::30], None, cloud.viewpoint).to(torch.float32)
    shape = fit_shape(few)
    assert torch.isfinite(shape.weights).all() and shape.weights.dtype == torch.float64
    assert shape.predict(few.points).distance.dtype == torch.float32


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        ("noise", 0.0),
        ("noise", -1.0),
        ("noise", math.nan),
        ("budget", 3),
        ("budget", 0),
        ("budget", 1001),
        ("psi_scale", 0.9),
        ("psi_scale", math.inf),
        ("seed", -1),
        ("table", math.nan),
        ("seed", 1.5),
        ("budget", 70.5),
        ("kernel", "cubic"),
        ("criterion", "chance"),
        ("budget", "many"),
        ("support", "guess"),
    ],
)
def test_bad_arguments_are_refused_by_name(cloud: PointCloud, name: str, bad: Any):
    with pytest.raises(
        (BadArgument, TypeError), match=name
    ):  # TypeError: annotations, checked in tests
        fit_shape(cloud, **{name: bad})


def test_clouds_in_millimetres_or_around_their_viewpoint_are_refused(cloud: PointCloud):
    with pytest.raises(SuspiciousScale, match="mm"):
        fit_shape(PointCloud(cloud.points * 1000))
    with pytest.raises(BadArgument, match=r"viewpoint: .* beside or behind it"):
        fit_shape(PointCloud(cloud.points, None, cloud.points.mean(0)))


@pytest.mark.parametrize(
    ("criterion", "support"), [("variance", "camera"), ("error", "paper"), ("both", "camera")]
)
def test_points_are_taken_until_the_whole_cloud_is_certain(
    cloud: PointCloud, criterion: Criterion, support: Literal["camera", "paper"]
):
    shape, few = (
        fit_shape(cloud, budget=n, support=support, criterion=criterion) for n in ("sure", 30)
    )
    assert shape.predict(shape.cloud.points).variance.max() <= 0.01
    assert len(few.x) < len(shape.x) and few.predict(few.cloud.points).variance.max() > 0.01


@pytest.mark.parametrize("kernel", ["matern52", "rbf", matern52_kernel(0.8, 5.0)])
def test_other_kernels_find_the_seen_surface(cloud: PointCloud, kernel: KernelName | Kernel):
    assert fit_shape(cloud, kernel=kernel).predict(cloud.points).distance.abs().mean() < 0.03


def _normal_error(found: Tensor, points: Tensor) -> Tensor:
    """Return the angle [deg] from the cylinder's outward normals."""
    wanted = torch.cat([points[:, :2] / 0.03, torch.zeros_like(points[:, 2:])], 1)
    return torch.rad2deg(torch.arccos((found * wanted).sum(-1).clamp(-1, 1)))


def test_the_less_is_known_of_the_hidden_side_the_larger_is_its_deviation():
    known = ("whole", "ball", "revolution", "mirrored", "guess", "cut off")
    for table in (True, False):
        factors = [STD_FACTORS[kind, table] for kind in known]
        assert factors == sorted(factors) and factors[-3] < factors[-2] < factors[-1] <= 2.0
    assert all(STD_FACTORS[kind, True] <= STD_FACTORS[kind, False] for kind in known)
    assert STD_FACTORS["ball", True] <= STD_FACTORS["vessel", True] < STD_FACTORS["guess", True]


@pytest.mark.parametrize("table", [0.0, None])
def test_the_deviation_has_the_factor_of_the_kind_and_the_table(seen_cylinder, table):
    shape = fit_shape(seen_cylinder, table=table)
    assert (
        shape.kind == "revolution"
        and shape.std_factor == STD_FACTORS[shape.kind, table is not None]
    )


def test_the_default_device_and_dtype_change_no_shape(cloud: PointCloud, shape: ShapeGP):
    view = cup_view(0.003)
    points = cloud.points[:5]
    vessel = fit_shape(view, table=0.0)
    torch.set_default_device("meta")
    torch.set_default_dtype(torch.float64)
    try:
        found = fit_shape(cloud, table=0.0)
        hollow = fit_shape(view, table=0.0)
        touched = found.update(points[:1])
        drawn = found.sample(points, 2)
        slopes = found.differentiate(points)
    finally:
        torch.set_default_device(None)
        torch.set_default_dtype(torch.float32)
    for a, b in ((found, shape), (hollow, vessel), (touched, shape.update(points[:1]))):
        near(a.weights, b.weights, 1e-9 * float(b.weights.abs().max()))
    near(drawn, shape.sample(points, 2), 1e-6)
    assert slopes.normal.dtype == points.dtype and slopes.normal.device.type == "cpu"


def opposite(view: PointCloud) -> PointCloud:
    """Return a view with the camera on the far side of the object, as high as the true one."""
    assert view.viewpoint is not None
    across = 2.0 * (view.points.mean(0) - view.viewpoint)
    return PointCloud(view.points, None, view.viewpoint + across * real([1.0, 1.0, 0.0]))


@pytest.mark.parametrize("name", ["cylinder", "jug", "rabbit"])
@pytest.mark.parametrize("support", ["camera", "paper"])
def test_a_camera_that_the_points_contradict_is_refused_and_the_true_one_is_not(
    name: str, support: Literal["camera", "paper"]
):
    view = load_object(name).view
    assert fit_shape(view, support=support).cloud.viewpoint is not None
    with pytest.raises(BadArgument, match=r"viewpoint: .* points contradict"):
        fit_shape(opposite(view), support=support)


def test_plans_refuse_such_a_camera_and_one_cloud_of_several_alone():
    view = load_object("jug").view
    with pytest.raises(BadArgument, match=r"viewpoint: .* points contradict"):
        plan_grasps(opposite(view), "barrett", starts=8)
    right, wrong = plan_grasps([view, opposite(view)], "barrett", starts=8)
    assert len(right) and not len(wrong) and "viewpoint" in wrong.meta["refused"]


@pytest.mark.parametrize("support", ["camera", "paper"])
def test_inward_normals_of_a_view_are_refused(support: Literal["camera", "paper"]):
    view = estimate_normals(load_object("jug").view)
    assert view.normals is not None
    fit_shape(view, support=support)
    with pytest.raises(BadArgument, match=r"normals: .* away from the camera"):
        fit_shape(dataclasses.replace(view, normals=-view.normals), support=support)


def test_a_camera_beside_what_the_normals_of_a_view_show_is_told():
    view = estimate_normals(load_object("jug").view)
    assert view.viewpoint is not None
    across = torch.linalg.cross(view.viewpoint, real([0.0, 0.0, 1.0]))
    beside = dataclasses.replace(view, viewpoint=2.0 * across)
    with pytest.warns(NoEffect, match="viewpoint changes nothing: .* of the normals face it"):
        fit_shape(beside)
