"""Checked linear algebra."""

import numpy as np
import pytest
import torch

from torchgrasp.foundation.errors import IndefiniteCovariance
from torchgrasp.geometry.linalg import (
    cholesky,
    farthest_points,
    limit_norm,
    number_components,
    number_rows,
    solve_least_squares,
    squared_mahalanobis,
    unit,
    unit_of_any,
)


@pytest.mark.promise("I11")
def test_cholesky_adds_nothing_and_raises_with_the_smallest_eigenvalue(generator):
    matrix = torch.tensor([[1.0, 2.0], [2.0, 1.0]], dtype=torch.float64)
    with pytest.raises(IndefiniteCovariance, match="buy a better matrix") as caught:
        cholesky(matrix, "K", "buy a better matrix")
    assert caught.value.smallest_eigenvalue == pytest.approx(-1.0)
    with pytest.raises(IndefiniteCovariance):
        cholesky(torch.full((2, 2), float("nan")), "K", "-")
    a = torch.randn(5, 5, generator=generator, dtype=torch.float64)
    matrix = a @ a.T + torch.eye(5, dtype=torch.float64)
    factor = cholesky(matrix, "K", "-")
    torch.testing.assert_close(factor @ factor.T, matrix, rtol=1e-14, atol=1e-14)


def test_mahalanobis_against_the_inverse(generator):
    a = torch.randn(7, 4, 4, generator=generator, dtype=torch.float64)
    sigma = a @ a.transpose(1, 2) + torch.eye(4, dtype=torch.float64)
    x = torch.randn(7, 4, generator=generator, dtype=torch.float64)
    expected = torch.einsum("bi,bij,bj->b", x, torch.linalg.inv(sigma), x)
    torch.testing.assert_close(squared_mahalanobis(x, torch.linalg.cholesky(sigma)), expected)


def test_unit_vectors_of_any_length_and_limited_norms_keep_the_direction(generator):
    v = torch.randn(9, 3, generator=generator)
    torch.testing.assert_close(unit(v).norm(dim=-1), torch.ones(9))
    assert bool(torch.isnan(unit(torch.zeros(3))).all())
    v = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    for length in (1.0, 1e-300, 1e160, 1e300):
        assert torch.allclose(unit_of_any(v * length), unit(v), rtol=0, atol=1e-15)
    for length in (1.0, 1e-9, 1e9):
        assert torch.equal(unit_of_any(v * length), unit(v * length))
    assert torch.equal(unit_of_any(v.float()), unit(v.float()))
    assert bool(unit_of_any(torch.zeros(1, 3)).isnan().all())
    v = torch.cat([torch.randn(20, 3, generator=generator, dtype=torch.float64), torch.zeros(1, 3)])
    short = limit_norm(v, 1.0)
    assert (short.norm(dim=-1) <= 1.0 + 1e-12).all()
    within = v.norm(dim=-1) <= 1.0
    assert torch.equal(short[within], v[within])
    torch.testing.assert_close(unit(short[:20]), unit(v[:20]))


def test_each_farthest_point_is_the_farthest_from_those_before_it_and_the_first_of_a_tie(generator):
    p = torch.rand(5, 3, generator=generator)
    assert sorted(farthest_points(p, 9).tolist()) == [0, 1, 2, 3, 4]
    assert len(farthest_points(p[:0], 9)) == 0
    p = torch.rand(60, 3, generator=generator, dtype=torch.float64)
    picks = farthest_points(p, 12, first=7).tolist()
    assert picks[0] == 7
    for k in range(1, 12):
        nearest = torch.cdist(p, p[picks[:k]]).amin(1)
        assert nearest[picks[k]] == nearest.max()
    p = torch.tensor([[0.0], [1.0], [1.0 + 1e-12]], dtype=torch.float64)
    assert farthest_points(p, 2).tolist() == [0, 2] and farthest_points(
        p, 2, tie=1e-9
    ).tolist() == [0, 1]


def test_farthest_points_by_any_distance_keep_away_from_points_before(generator):
    p = torch.rand(200, 3, generator=generator, dtype=torch.float64).round(decimals=1)  # with ties
    picks = farthest_points(p, 40, first=3, tie=1e-9)
    assert torch.equal(
        picks,
        farthest_points(p, 40, first=3, tie=1e-9, distance=lambda x, y: (x - y).square().sum(-1)),
    )
    points = torch.rand(40, 2, generator=generator)
    before = torch.rand(7, 2, generator=generator)
    picks = farthest_points(points, 12, before=before).tolist()
    known = [*before]
    for pick in picks:
        gaps = torch.stack([torch.stack([(p - q).norm() for q in known]).min() for p in points])
        assert float(gaps[pick]) >= float(gaps.max()) - 1e-7
        known.append(points[pick])
    assert len(set(picks)) == 12
    assert torch.equal(
        farthest_points(points, 5, 3, before=points[:0]), farthest_points(points, 5, 3)
    )


@pytest.mark.parametrize(("n", "k", "rank"), [(984, 2, 2), (40, 7, 7), (40, 5, 3), (3, 6, 3)])
def test_least_squares_are_the_shortest(generator, n, k, rank):
    rows = torch.randn(n, rank, generator=generator, dtype=torch.float64)
    rows = rows @ torch.randn(rank, k, generator=generator, dtype=torch.float64)
    values = torch.randn(n, generator=generator, dtype=torch.float64)
    oracle = np.linalg.lstsq(rows.numpy(), values.numpy(), rcond=None)[0]
    torch.testing.assert_close(
        solve_least_squares(rows, values), torch.from_numpy(oracle), rtol=1e-9, atol=1e-9
    )


@pytest.mark.promise("N10")
def test_least_squares_have_the_same_bits_in_every_call(generator):
    """Memory that others have used lies below each call: a workspace that is read before it is set
    shows.
    """
    rows = torch.randn(984, 2, generator=generator, dtype=torch.float64)
    values = torch.randn(984, generator=generator, dtype=torch.float64)
    first = solve_least_squares(rows, values)
    for size in range(200):
        used = torch.full((size,), 7)
        del used
        assert torch.equal(solve_least_squares(rows, values), first)


@pytest.mark.parametrize("dtype", [torch.int64, torch.float64])
def test_rows_are_numbered_as_torch_does_however_large_their_numbers_are(dtype, generator):
    rows = torch.randint(-3, 3, (200, 3), generator=generator).to(dtype)
    far = torch.tensor([[10**15, -(10**15), 0], [10**15, -(10**15), 1]]).to(dtype)
    rows = torch.cat([rows, far, rows[:5], far])
    for some in (rows, rows[:200]):  # the latter have few numbers
        assert torch.equal(number_rows(some), torch.unique(some, dim=0, return_inverse=True)[1])
    assert number_rows(rows[:0]).tolist() == []


def test_components_are_those_of_the_pairs_and_keep_the_order_of_nodes():
    assert number_components(np.array([[3, 1], [4, 3]]), 6).tolist() == [0, 1, 2, 1, 1, 3]
    assert number_components(np.empty((0, 2), dtype=np.int64), 3).tolist() == [0, 1, 2]
