"""The choice of the most informative points, as compiled loops for thin plates."""

import math

import numpy as np
import torch
from torch import Tensor

from torchgrasp.foundation.fused import array, compiled, inlined
from torchgrasp.geometry.fused_vectors import dot, factorise, minus
from torchgrasp.geometry.linalg import cholesky
from torchgrasp.shape.estimate import Observations
from torchgrasp.shape.kernel import psi_of
from torchgrasp.shape.posterior import Posterior


def choose_points(
    start: Posterior, candidates: Observations, budget: int, criterion: str, stop: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Choose the most informative of some observations (active learning), for a thin plate kernel.

    Return (picks, L, L^-1 y). `picks` are the indices of the chosen candidates, in the order of
    their choice. L is the Cholesky factor of the covariance of all observed numbers y. These are
    the numbers of `start`, then the distance and normal of each pick.

    Args:
        start: the posterior given the known observations.
        candidates: the observations to choose from, all with normals.
        budget: greatest number of picks.
        criterion: what a pick has most of: "variance" of the distance, or "error" of the predicted
            distance. With "both" it is |error| + 2 sqrt(variance).
        stop: variance, in squared normalised units; the choice ends when none exceeds it.
    """
    x = candidates.x
    n = len(x)
    old = len(start.factor)
    rows = old + 4 * budget
    factor = x.new_zeros(rows, rows)
    factor[:old, :old] = start.factor
    known = start.cross(x).transpose(0, 1)  # (n, 4, old)
    # a row for each candidate; the last one is that of the observed numbers
    whitened = x.new_zeros(n + 1, rows)
    columns = torch.linalg.solve_triangular(start.factor, known[:, 0].T, upper=False)
    whitened[:n, :old] = columns.T
    whitened[n, :old] = start.factor.T @ start.weights
    noise = torch.stack([candidates.distance_noise] + 3 * [candidates.normal_noise], 1) ** 2
    values = torch.cat([candidates.distance[:, None], candidates.normal], 1)
    picks = torch.zeros(budget, dtype=torch.long)
    own = x.new_zeros(4, 4)
    count = _choose(
        *map(array, (x, known, values, noise)),
        psi_of(start.kernel),
        criterion != "error",
        criterion != "variance",
        stop,
        *(y.numpy() for y in (factor, whitened, picks, own)),
    )
    if count < 0:
        # which raises `IndefiniteCovariance`
        cholesky(own, "the covariance of a picked point", start.kernel.remedy)
    end = old + 4 * count
    return picks[:count], factor[:end, :end], whitened[n, :end]


@inlined
def _most_informative(free, variance, error, by_variance, by_error):
    """Return the first of the free candidates with the greatest score, and the greatest variance of
    free ones.
    """
    pick = 0
    most = -np.inf
    widest = -np.inf
    for j in range(len(free)):
        if free[j]:
            widest = max(widest, variance[j])
            score = variance[j]
            if by_error:
                score = abs(error[j])
                if by_variance:
                    score += 2.0 * math.sqrt(max(variance[j], 0.0))  # negative by rounding alone
            if score > most:
                most = score
                pick = j
    return pick, widest


@inlined
def _with_distance(d, psi):
    """Return the covariances of (d, w) at a point with the distance at another one, which the
    vector d leads to the point.
    """
    square = dot(d, d)
    r = math.sqrt(square)
    first = 6.0 * (r - psi)
    return square * (2.0 * r - 3.0 * psi) + psi**3, first * d[0], first * d[1], first * d[2]


@inlined
def _put_with_pick(d, psi, at, cross):
    """Write the covariances of (d, w) at two points into the columns `at` to `at` + 3 of `cross`; d
    leads from the second point to the first, which has the rows.
    """
    r = math.sqrt(dot(d, d))
    second = 6.0 / r if r > 0.0 else 0.0
    one = _with_distance(d, psi)
    cross[0, at] = one[0]
    for a in range(3):
        # distance and gradient change their sign with the order of the points
        cross[1 + a, at] = one[1 + a]
        cross[0, at + 1 + a] = -one[1 + a]
        for b in range(3):
            cross[1 + a, at + 1 + b] = -second * d[a] * d[b]
        cross[1 + a, at + 1 + a] -= 6.0 * (r - psi)


@inlined
def _products(row, before, end):
    """Return the products of a row with each of the four rows of `before`, over `end` columns."""
    s0 = s1 = s2 = s3 = 0.0
    for k in range(end):
        s0 += row[k] * before[0, k]
        s1 += row[k] * before[1, k]
        s2 += row[k] * before[2, k]
        s3 += row[k] * before[3, k]
    return s0, s1, s2, s3


@inlined
def _append(row, values, before, corner, end):
    """Append four whitened numbers to a row, given their covariances or observed values."""
    explained = _products(row, before, end)
    for a in range(4):
        rest = values[a] - explained[a]
        for b in range(a):
            rest -= corner[a, b] * row[end + b]
        row[end + a] = rest / corner[a, a]


@compiled
def _choose(
    x, known, values, noise, psi, by_variance, by_error, stop, factor, whitened, picks, own
):
    """Write the choice, the factor and the whitened rows, and return the number of picks.

    `own` becomes the covariance of the last pick, given all before. If it is indefinite, return -1.
    """
    n = len(x)
    old = known.shape[2]
    variance = np.full(n, psi**3)
    error = np.zeros(n)
    for j in range(n):
        for k in range(old):
            variance[j] -= whitened[j, k] * whitened[j, k]
            error[j] += whitened[j, k] * whitened[n, k]
    free = np.full(n, True)
    before = np.empty((4, len(factor)))
    corner = np.empty((4, 4))
    for count in range(len(picks)):
        p, widest = _most_informative(free, variance, error, by_variance, by_error)
        if widest <= stop:
            return count
        picks[count] = p
        free[p] = False
        end = old + 4 * count
        for a in range(4):
            for k in range(old):
                before[a, k] = known[p, a, k]
        for c in range(count):
            _put_with_pick(minus(x[p], x[picks[c]]), psi, old + 4 * c, before)
        # its solution with the triangular factor
        for i in range(end):
            explained = _products(factor[i], before, i)
            for a in range(4):
                before[a, i] = (before[a, i] - explained[a]) / factor[i, i]
        for a in range(4):
            explained = _products(before[a], before, end)
            for b in range(4):
                own[a, b] = -explained[b]
            own[a, a] += noise[p, a] + (psi**3 if a == 0 else 6.0 * psi)
            for b in range(4):
                corner[a, b] = own[a, b]
        if not factorise(corner):
            return -1
        for a in range(4):
            for k in range(end):
                factor[end + a, k] = before[a, k]
            for b in range(a + 1):
                factor[end + a, end + b] = corner[a, b]
        _append(whitened[n], values[p], before, corner, end)
        for j in range(n):
            _append(whitened[j], _with_distance(minus(x[p], x[j]), psi), before, corner, end)
            for k in range(end, end + 4):
                variance[j] -= whitened[j, k] * whitened[j, k]
                error[j] += whitened[j, k] * whitened[n, k]
    return len(picks)
