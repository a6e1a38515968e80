"""Shapes of partial clouds whose true surface is known in closed form."""

from typing import Literal

import pytest
import torch
from torch import Tensor

from torchgrasp.errors import BadArgument, IndefiniteCovariance, SuspiciousScale
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.conditioning import Criterion
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.kernel import Kernel, KernelName, matern52_kernel
from torchgrasp.shape.support import STD_FACTORS
from torchgrasp.values import PointCloud


def _side(angle_from: float, angle_to: float) -> Tensor:
    """Points on the cylinder's side, by the angle [rad] from the camera's direction, away from its ends."""
    angle = torch.linspace(angle_from, angle_to, 12, dtype=torch.float64)
    height = torch.linspace(0.025, 0.095, 8, dtype=torch.float64)
    a, h = (g.reshape(-1) for g in torch.meshgrid(angle, height, indexing="ij"))
    return torch.stack([0.03 * a.cos(), 0.03 * a.sin(), h], -1)


@pytest.fixture(scope="module")
def shape(request: pytest.FixtureRequest) -> ShapeGP:
    return fit_shape(_cylinder(), table=0.0)


def _cylinder(noise: float = 0.0005) -> PointCloud:
    """A noisy single view of a cylinder, r 30 mm and h 120 mm, without normals."""
    rng = torch.Generator().manual_seed(1)
    camera = torch.tensor([0.45, 0.0, 0.3], dtype=torch.float64)
    angle = (torch.rand(1000, generator=rng, dtype=torch.float64) - 0.5) * 3.0
    height = torch.rand(1000, generator=rng, dtype=torch.float64) * 0.12
    side = torch.stack([0.03 * angle.cos(), 0.03 * angle.sin(), height], -1)
    radius = 0.03 * torch.rand(200, generator=rng, dtype=torch.float64).sqrt()
    turn = torch.rand(200, generator=rng, dtype=torch.float64) * 6.2832
    top = torch.stack([radius * turn.cos(), radius * turn.sin(), torch.full_like(turn, 0.12)], -1)
    points = torch.cat([side, top])
    return PointCloud(points + noise * torch.randn(points.shape, generator=rng, dtype=torch.float64), None, camera)


def test_seen_side_is_within_a_millimetre_and_a_few_degrees(shape: ShapeGP):
    points = _side(-1.2, 1.2)
    found = shape.predict(points)
    assert (found.distance.abs() * shape.scale).median() < 0.001
    assert _normal_error(found.normal, points).median() < 8
    assert found.variance.median() < 0.03


def test_hidden_side_is_within_three_millimetres_and_less_certain(shape: ShapeGP):
    points = _side(2.2, 4.1)
    found, seen = shape.predict(points), shape.predict(_side(-1.2, 1.2))
    assert (found.distance.abs() * shape.scale).median() < 0.003
    assert _normal_error(found.normal, points).median() < 15
    assert found.std_m.median() > seen.std_m.median()
    assert (found.distance.abs() * shape.scale < 2 * found.std_m).double().mean() > 0.9


def test_the_hidden_side_is_better_than_with_the_papers_support(shape: ShapeGP):
    paper = fit_shape(_cylinder(), support="paper")
    points = _side(2.2, 4.1)
    ours, theirs = shape.predict(points), paper.predict(points)
    assert _normal_error(ours.normal, points).median() < _normal_error(theirs.normal, points).median()
    assert ours.variance.median() < theirs.variance.median()


def test_what_is_observed_outside_allows_for_the_hidden_side(shape: ShapeGP):
    """Measured to the cloud alone, points behind the object would be a diameter too far away, and shrink it."""
    outside = shape.metres(shape.x[torch.linalg.vector_norm(shape.x, dim=-1).sub(1.2).abs() < 1e-9])
    assert len(outside) == 20
    radial = torch.linalg.vector_norm(outside[:, :2], dim=-1) - 0.03
    axial = torch.maximum(outside[:, 2] - 0.12, -outside[:, 2])
    true = torch.where(radial < 0, axial, torch.hypot(radial.clamp_min(0), axial.clamp_min(0)))
    error = shape.predict(outside).distance * shape.scale - true
    assert error.abs().max() < 0.012 and error.median().abs() < 0.003


def test_signed_distance_is_metric(shape: ShapeGP):
    axis = torch.tensor([[0.045, 0.0, 0.06], [0.03, 0.0, 0.06], [0.02, 0.0, 0.06]], dtype=torch.float64)
    distance = shape.predict(axis).distance * shape.scale
    torch.testing.assert_close(distance, torch.tensor([0.015, 0.0, -0.01], dtype=torch.float64), rtol=0, atol=0.003)


def test_paper_support_observes_what_the_paper_does():
    shape = fit_shape(_cylinder(), support="paper", budget=60, seed=3)
    inner, outer = shape.x[~shape.has_normal][0], shape.x[~shape.has_normal][1:]
    assert len(shape.x) == 60 and shape.std_factor == 1.0
    assert inner.abs().max() == 0
    torch.testing.assert_close(torch.linalg.vector_norm(outer, dim=-1), torch.full((20,), 1.2, dtype=torch.float64))
    assert torch.linalg.vector_norm(shape.x[shape.has_normal], dim=-1).max() <= 1 + 1e-12
    values = shape.predict(shape.metres(shape.x[~shape.has_normal])).distance
    torch.testing.assert_close(values, torch.tensor([-1.0] + [1.0] * 20, dtype=torch.float64), rtol=0, atol=0.02)


@pytest.mark.parametrize("support", ["camera", "paper"])
def test_the_papers_psi_raises_and_its_fix_works(support: str):
    with pytest.raises(IndefiniteCovariance, match=r"psi_scale of at least 1\.34"):
        fit_shape(_cylinder(), psi_scale=1.0, support=support)  # pyright: ignore[reportArgumentType]
    fit_shape(_cylinder(), psi_scale=1.34, support=support)  # pyright: ignore[reportArgumentType]


def test_equal_seeds_give_equal_shapes_and_no_global_generator_is_touched():
    before = torch.get_rng_state()
    a, b = (fit_shape(_cylinder(), support="paper", seed=5) for _ in range(2))
    other = fit_shape(_cylinder(), support="paper", seed=6)
    assert torch.equal(a.weights, b.weights) and not torch.equal(a.x, other.x)
    assert torch.equal(torch.get_rng_state(), before)


def test_a_whole_surface_needs_no_completion():
    rng = torch.Generator().manual_seed(0)
    n = torch.randn(900, 3, generator=rng, dtype=torch.float64)
    n = n / torch.linalg.vector_norm(n, dim=-1, keepdim=True)
    shape = fit_shape(PointCloud(0.04 * n, n))
    assert len(shape.x) == 85
    found = shape.predict(0.04 * n)
    assert (found.distance.abs() * shape.scale).max() < 0.002
    assert found.std_m.max() < 0.006


def test_a_viewpoint_does_not_turn_the_normals_of_a_whole_surface_inward():
    rng = torch.Generator().manual_seed(0)
    n = torch.randn(900, 3, generator=rng, dtype=torch.float64)
    n = n / torch.linalg.vector_norm(n, dim=-1, keepdim=True)
    shape = fit_shape(PointCloud(0.04 * n, n, torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64)))
    assert (shape.predict(0.04 * n).normal * n).sum(-1).min() > 0.98


@pytest.mark.parametrize("viewpoint", [None, torch.tensor([0.3, 0.1, 0.4], dtype=torch.float64)])
def test_a_whole_surface_without_normals_is_refused_and_not_turned_inside_out(viewpoint: Tensor | None):
    rng = torch.Generator().manual_seed(0)
    ball = 0.04 * unit(torch.randn(900, 3, generator=rng, dtype=torch.float64))
    for shape in (torch.tensor([1.0, 1.0, 1.0]), torch.tensor([0.4, 1.0, 2.0])):
        with pytest.raises(BadArgument, match=r"cloud: .* outward normals.* behind others"):
            fit_shape(PointCloud(ball * shape.double(), None, viewpoint))


def test_a_viewpoint_within_a_single_view_is_refused():
    cloud = _cylinder()
    with pytest.raises(BadArgument, match=r"viewpoint: .* beside or behind it"):
        fit_shape(PointCloud(cloud.points, None, cloud.points.mean(0)))


def test_copies_of_points_with_normals_change_nothing_in_the_papers_support():
    rng = torch.Generator().manual_seed(0)
    n = torch.randn(300, 3, generator=rng, dtype=torch.float64)
    n = n / torch.linalg.vector_norm(n, dim=-1, keepdim=True)
    once = fit_shape(PointCloud(0.04 * n, n), support="paper")
    twice = fit_shape(PointCloud(0.04 * torch.cat([n, n[:150]]), torch.cat([n, n[:150]])), support="paper")
    assert torch.equal(once.weights, twice.weights)


@pytest.mark.promise("N8")
def test_a_float32_cloud_gives_a_float64_shape():
    cloud = _cylinder().to(torch.float32)
    shape = fit_shape(cloud)
    assert shape.weights.dtype == torch.float64
    assert shape.predict(cloud.points).distance.dtype == torch.float32


def test_few_points_are_enough_for_a_shape():
    cloud = _cylinder()
    shape = fit_shape(PointCloud(cloud.points[::30], None, cloud.viewpoint))
    assert torch.isfinite(shape.weights).all()


@pytest.mark.parametrize(
    "bad",
    [
        {"noise": 0.0},
        {"noise": -1.0},
        {"noise": float("nan")},
        {"budget": 3},
        {"budget": 0},
        {"budget": 1001},
        {"psi_scale": 0.9},
        {"psi_scale": float("inf")},
        {"seed": -1},
        {"table": float("nan")},
    ],
)
def test_bad_arguments_are_refused_by_name(bad: dict[str, float]):
    with pytest.raises(BadArgument, match=next(iter(bad))):
        fit_shape(_cylinder(), **bad)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("bad", [{"seed": 1.5}, {"budget": 70.5}])
def test_numbers_that_are_no_integers_are_refused(bad: dict[str, float]):
    with pytest.raises((BadArgument, TypeError), match=next(iter(bad))):  # TypeError: annotations, checked in tests
        fit_shape(_cylinder(), **bad)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("bad", [{"kernel": "cubic"}, {"criterion": "chance"}, {"budget": "many"}])
def test_an_unknown_kernel_criterion_or_budget_is_refused(bad: dict[str, str]):
    with pytest.raises((BadArgument, TypeError), match=next(iter(bad))):  # TypeError: annotations, checked in tests
        fit_shape(_cylinder(), **bad)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("support", ["camera", "paper"])
@pytest.mark.parametrize("criterion", ["variance", "error", "both"])
def test_points_are_taken_until_the_whole_cloud_is_certain(criterion: Criterion, support: Literal["camera", "paper"]):
    cloud = _cylinder()
    shape = fit_shape(cloud, budget="sure", support=support, criterion=criterion)
    assert shape.predict(shape.cloud.points).variance.max() <= 0.01
    few = fit_shape(cloud, budget=30, support=support, criterion=criterion)
    assert len(few.x) < len(shape.x) and few.predict(few.cloud.points).variance.max() > 0.01


@pytest.mark.parametrize("kernel", ["matern52", "rbf", matern52_kernel(0.8, 5.0)])
def test_other_kernels_find_the_seen_surface(kernel: KernelName | Kernel):
    cloud = _cylinder()
    shape = fit_shape(cloud, kernel=kernel)
    assert shape.predict(cloud.points).distance.abs().mean() < 0.03


def test_an_unknown_support_is_refused():
    with pytest.raises((BadArgument, TypeError), match="support"):
        fit_shape(_cylinder(), support="guess")  # pyright: ignore[reportArgumentType]


def test_a_cloud_in_millimetres_is_refused():
    with pytest.raises(SuspiciousScale, match="mm"):
        fit_shape(PointCloud(_cylinder().points * 1000))


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
    assert shape.kind == "revolution" and shape.std_factor == STD_FACTORS[shape.kind, table is not None]
