"""What is promised about bad and odd clouds, for every public function that takes a cloud."""

import inspect
import math

import pytest
import torch

from tests.make import ball
from torchgrasp.cloud import check, diagnose, prepare
from torchgrasp.foundation.errors import (
    BadArgument,
    Flat,
    GraspError,
    SuspiciousScale,
    TooFewPoints,
)
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.fit import fit_shape
from torchgrasp.values.planning import PointCloud

FUNCTIONS = {
    "check_cloud": check.check_cloud,
    "remove_duplicates": check.remove_duplicates,
    "voxel_downsample": lambda cloud: check.voxel_downsample(cloud, 0.004),
    "remove_outliers": check.remove_outliers,
    "estimate_normals": prepare.estimate_normals,
    "clean_cloud": prepare.clean_cloud,
    "prepare_cloud": lambda cloud: prepare.prepare_cloud(cloud, torch.Generator()),
    "merge_clouds": lambda cloud: prepare.merge_clouds([cloud, cloud], [torch.eye(4).double()] * 2),
    "diagnose_cloud": diagnose.diagnose_cloud,
    "fit_shape": fit_shape,
    "fit_shape paper": lambda cloud: fit_shape(cloud, support="paper"),
}
WORK = (
    "scipy.spatial.KDTree.query",
    "torch.linalg.eigh",
    "torch.linalg.cholesky_ex",
    "torch.cdist",
)
"""What every function on clouds begins with, the checks apart."""
EYE = torch.tensor([0.3, 0.2, 0.5], dtype=torch.float64)


def refused(function, value, kind, match):
    """Check that a value is refused by name before any work: no neighbour is sought, nothing is
    factored.
    """

    def work(*_args, **_kwargs):
        pytest.fail("work was done before the refusal")

    with pytest.MonkeyPatch.context() as patch:
        for name in WORK:
            patch.setattr(name, work)
        with pytest.raises(kind, match=match):
            function(value)


@pytest.mark.promise("I1")
@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("field", ["points", "normals", "viewpoint"])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_no_number_is_refused_where_the_value_is_made_and_where_it_is_used(name, field, bad):
    cloud = ball(viewpoint=EYE.clone())
    tensor = getattr(cloud, field)
    spoilt = tensor.clone()
    spoilt.view(-1)[1] = bad
    refused(lambda t: PointCloud(**{"points": cloud.points, field: t}), spoilt, BadArgument, field)
    tensor.view(-1)[1] = bad  # after the value was made
    refused(FUNCTIONS[name], cloud, BadArgument, field)


@pytest.mark.promise("I2")
@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_fewer_than_four_points_are_refused(name, n):
    cloud = ball(viewpoint=EYE.clone())
    refused(lambda c: PointCloud(c.points[:n]), cloud, TooFewPoints, f"{n} points")
    copies = PointCloud(
        *(x.repeat(20, 1) for x in (cloud.points[: max(n, 1)], cloud.normals[: max(n, 1)]))
    )
    refused(FUNCTIONS[name], copies, BadArgument, "coincide|distinct")


@pytest.mark.promise("I3")
@pytest.mark.parametrize("distance", [0.0, 1e-12, 5e-10])
def test_copies_change_nothing(distance):
    cloud = ball(121, viewpoint=EYE.clone())
    jitter = (
        0.08
        * distance
        * unit(torch.randn(5 * 121, 3, generator=torch.Generator().manual_seed(1)).double())
    )
    copies = PointCloud(
        torch.cat([cloud.points, cloud.points.repeat(5, 1) + jitter]),
        cloud.normals.repeat(6, 1),
        cloud.viewpoint,
    )
    assert len(check.remove_duplicates(copies)) == 121
    assert diagnose.diagnose_cloud(copies).copies == 5 * 121
    for support in ("camera", "paper"):
        once, six = (
            fit_shape(c, support=support).predict(1.1 * cloud.points[:9]) for c in (cloud, copies)
        )
        torch.testing.assert_close(six.distance, once.distance, atol=1e-6, rtol=0)
        torch.testing.assert_close(six.variance, once.variance, atol=1e-6, rtol=0)


@pytest.mark.promise("I4")
@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_point_and_a_line_are_refused(name):
    along = (
        torch.linspace(0, 0.1, 50, dtype=torch.float64)[:, None]
        * torch.tensor([1.0, 2.0, -1.0]).double()
    )
    refused(FUNCTIONS[name], PointCloud(0 * along, along + 1), BadArgument, "coincide")
    refused(FUNCTIONS[name], PointCloud(along, along + 1), BadArgument, "line")


@pytest.mark.promise("I4")
@pytest.mark.parametrize("thickness", [0.0, 1e-12, 1e-6, 1e-3])
def test_a_flat_cloud_is_accepted_and_finite(thickness):
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = points * torch.tensor([0.1, 0.1, 0.1 * thickness]).double()
    report = diagnose.diagnose_cloud(PointCloud(points, None, EYE))
    assert any("one plane" in str(text) for text in report.advice)
    with pytest.warns(Flat):
        estimate = fit_shape(PointCloud(points, None, EYE)).predict(points[:20])
    for field in ("distance", "normal", "variance", "covariance", "std_m"):
        assert bool(torch.isfinite(getattr(estimate, field)).all())


@pytest.mark.promise("I5")
@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1e3, 1e6])
def test_a_wrong_unit_is_refused_by_name(name, factor):
    cloud = ball(viewpoint=EYE.clone())
    scaled = PointCloud(factor * cloud.points, cloud.normals, factor * EYE)
    refused(FUNCTIONS[name], scaled, SuspiciousScale, "mm" if factor > 1 else "metres")


@pytest.mark.promise("I5")
@pytest.mark.parametrize("factor", [0.25, 8.0])
def test_results_scale_with_the_cloud(factor):
    cloud = ball(viewpoint=EYE.clone())
    large = PointCloud(factor * cloud.points, cloud.normals, factor * EYE)
    one = diagnose.diagnose_cloud(cloud)
    other = diagnose.diagnose_cloud(large)
    for name in ("spacing", "noise"):
        assert getattr(other, name) == pytest.approx(factor * getattr(one, name), rel=1e-9)
    assert (
        other.density == pytest.approx(one.density / factor**2, rel=1e-9)
        and other.outliers == one.outliers
    )
    a = prepare.clean_cloud(cloud)
    b = prepare.clean_cloud(large)
    torch.testing.assert_close(b.points, factor * a.points, rtol=1e-9, atol=1e-12)
    small = check.voxel_downsample(cloud, 0.01)
    big = check.voxel_downsample(large, 0.01 * factor)
    torch.testing.assert_close(big.points, factor * small.points, rtol=1e-9, atol=1e-12)


@pytest.mark.promise("I6")
def test_far_from_the_origin_nothing_changes():
    cloud = ball(viewpoint=EYE.clone())
    shift = torch.tensor([1e4, -1e4, 1e4], dtype=torch.float64)
    far = PointCloud(cloud.points + shift, cloud.normals, EYE + shift)
    a = prepare.clean_cloud(cloud)
    b = prepare.clean_cloud(far)
    torch.testing.assert_close(b.points - shift, a.points, atol=1e-7, rtol=0)
    torch.testing.assert_close(b.normals, a.normals, atol=1e-7, rtol=0)
    at = 1.05 * cloud.points[:20]
    for support in ("camera", "paper"):
        one, other = (fit_shape(c, support=support) for c in (cloud, far))
        torch.testing.assert_close(
            other.predict(at + shift).distance, one.predict(at).distance, atol=1e-7, rtol=0
        )


@pytest.mark.promise("I7")
@pytest.mark.parametrize("dtype", [torch.int64, torch.float16, torch.complex64])
def test_other_dtypes_and_shapes_are_refused(dtype):
    refused(lambda p: PointCloud(p), torch.ones(9, 3).to(dtype), (BadArgument, TypeError), "points")
    for shape in ((9,), (9, 2), (1, 9, 3), (3, 9)):
        refused(lambda p: PointCloud(p), torch.rand(shape), (BadArgument, TypeError), "points")


@pytest.mark.promise("I7")
@pytest.mark.parametrize("name", FUNCTIONS)
def test_gradients_are_refused_and_strides_do_not_matter(name):
    cloud = ball(viewpoint=EYE.clone())
    function = FUNCTIONS[name]
    refused(
        function,
        PointCloud(cloud.points.clone().requires_grad_(), cloud.normals),
        BadArgument,
        "detach",
    )
    strided = PointCloud(
        cloud.points.T.contiguous().T,
        torch.stack([cloud.normals, cloud.normals], -1)[..., 0],
        EYE[None].expand(2, 3)[1],
    )
    one = function(cloud)
    other = function(strided)
    if isinstance(one, PointCloud):
        assert torch.equal(one.points, other.points)
    elif isinstance(one, torch.Tensor):
        torch.testing.assert_close(one, other)


@pytest.mark.promise("I8")
def test_outliers_go_lengths_do_not_matter_and_zero_is_refused():
    cloud = ball(400, viewpoint=EYE.clone())
    generator = torch.Generator().manual_seed(5)
    far = 0.15 * unit(torch.randn(40, 3, generator=generator, dtype=torch.float64))
    dirty = PointCloud(torch.cat([cloud.points, far]), torch.cat([cloud.normals, far]), None)
    clean = prepare.clean_cloud(dirty)
    assert float(torch.linalg.vector_norm(clean.points, dim=-1).max()) < 0.06
    long = PointCloud(cloud.points, 7 * cloud.normals)
    assert diagnose.diagnose_cloud(long).normals.scaled == 400
    one, other = (
        fit_shape(PointCloud(c.points, c.normals), support="paper") for c in (cloud, long)
    )
    torch.testing.assert_close(
        one.predict(cloud.points).distance, other.predict(cloud.points).distance
    )
    zero = cloud.normals.clone()
    zero[3] = 0
    refused(check.check_cloud, PointCloud(cloud.points, zero), BadArgument, "length zero")


def test_every_function_on_clouds_is_in_the_table():
    public = {
        name
        for module in (check, prepare, diagnose)
        for name, function in inspect.getmembers(module, inspect.isfunction)
        if function.__module__ == module.__name__ and not name.startswith("_")
        if "cloud" in str(inspect.signature(function))
    }
    assert public - {"format_report", "compare_normals", "share_facing"} <= set(FUNCTIONS)
    assert issubclass(BadArgument, GraspError)
