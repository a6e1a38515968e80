"""`torchgrasp.shape.jets` as compiled loops, for thin plates.

The functions take the arguments and return the results of those of the same names there.
"""

import math

from torch import Tensor

from torchgrasp.foundation.fused import array, compiled, inlined
from torchgrasp.geometry.fused_vectors import put
from torchgrasp.geometry.linalg import Points
from torchgrasp.shape.jets import Arrays, Explain, Weighted, arrays_of
from torchgrasp.shape.kernel import CovarianceRows, Kernel, Queries, psi_of


def evaluate_mean(of: Weighted, x: Queries, gradient: bool) -> tuple[Tensor, ...]:
    """Return a surface's mean signed distance at q points and, if `gradient` is True, its gradient.

    The result is (distance,) or (distance, gradient), of the shapes (q,) and (q, 3). It is at the
    points `x` (q, 3), all normalised. `of` holds the observations of the surface and their weights.
    """
    found = _mean(of.arrays, x, bent=False)
    return found[:2] if gradient else found[:1]


def evaluate_mean_jet(of: Weighted, x: Queries) -> tuple[tuple[Tensor, Tensor, Tensor], None]:
    """Return ((distance, gradient, Hessian), None): a surface's mean signed distance with
    derivatives.

    They are (q,), (q, 3) and (q, 3, 3), at q points `x` (q, 3), all normalised. `of` holds the
    observations of the surface and their weights. The second result is always None: the compiled
    loops keep no kernel values for the variance, unlike `jets.evaluate_mean_jet`.
    """
    return _mean(of.arrays, x, bent=True), None


def evaluate_jet(of: Weighted, x: Queries, explain: Explain) -> tuple[Tensor, ...]:
    """Return mean and variance of a surface's signed distance, with derivatives, at q points `x`.

    They are distance (q,), gradient (q, 3), Hessian (q, 3, 3), variance (q,) and the variance's
    gradient (q, 3). All are normalised. `of` holds the observations of the surface and their
    weights. `explain` is `Posterior.explain` of their posterior.
    """
    mean = _mean(of.arrays, x, bent=True)
    near = len(of.b)
    explained, solved = explain(rows_at(of.x, near, of.kernel, x))
    n = len(of.x)
    own = arrays_of(of, solved[:, :n], solved[:, n:].unflatten(1, (3, near)))
    slope = _mean(own, x, bent=False)[1]
    variance = of.kernel.profile(x.new_zeros(len(x), 1))[:, 0] - explained
    return *mean, variance, -2.0 * slope


def rows_at(known: Points, near: int, kernel: Kernel, x: Queries) -> CovarianceRows:
    """Return the prior covariance (q, r) of the signed distances at q points `x` with all r
    observed numbers.

    The observed numbers are the distances at the n points `known`. Then come the normals at the
    first `near` of them, by component. Points are normalised. The `kernel` is a thin plate.
    """
    found = x.new_empty(len(x), len(known) + 3 * near)
    _put_rows(array(x), array(known.T), psi_of(kernel), near, found.numpy())
    return found


def _mean(arrays: Arrays, x: Queries, bent: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean (q,), gradient (q, 3) and, if `bent`, Hessian (q, 3, 3)."""
    found = x.new_empty(len(x)), x.new_empty(len(x), 3), x.new_empty(len(x) * bent, 3, 3)
    _sum_at(array(x), *arrays, *(y.numpy() for y in found))
    return found


@inlined
def sum_thin_plate(x, y, a, b, psi, bent):
    """Return distance, gradient and Hessian of a posterior mean at a point x, as tuples.

    The mean is that of a surface's signed distance, with a thin plate kernel of length `psi`, all
    normalised. The point x has 3 numbers. The results are sums over n observed points y (3, n). The
    weights are a (n,) of distances and b (3, n) of normals. The Hessian is the six numbers xx, yy,
    zz, xy, xz and yz, which are valid only if `bent`.
    """
    distance = g0 = g1 = g2 = trace = xx = yy = zz = xy = xz = yz = 0.0
    for j in range(len(a)):
        d0 = x[0] - y[0, j]
        d1 = x[1] - y[1, j]
        d2 = x[2] - y[2, j]
        b0 = b[0, j]
        b1 = b[1, j]
        b2 = b[2, j]
        square = d0 * d0 + d1 * d1 + d2 * d2
        r = math.sqrt(square)
        # the kernel and its derivatives by r^2 / 2
        k = square * (2.0 * r - 3.0 * psi) + psi**3
        first = 6.0 * (r - psi)
        second = 6.0 / r if r > 0.0 else 0.0
        third = -(second**3) / 36.0
        along = d0 * b0 + d1 * b1 + d2 * b2
        distance += k * a[j] - first * along
        c = first * a[j] - second * along
        g0 += c * d0 - first * b0
        g1 += c * d1 - first * b1
        g2 += c * d2 - first * b2
        if bent:
            trace += c
            outer = second * a[j] - third * along
            s0 = second * b0
            s1 = second * b1
            s2 = second * b2
            xx += (outer * d0 - 2.0 * s0) * d0
            yy += (outer * d1 - 2.0 * s1) * d1
            zz += (outer * d2 - 2.0 * s2) * d2
            xy += (outer * d0 - s0) * d1 - s1 * d0
            xz += (outer * d0 - s0) * d2 - s2 * d0
            yz += (outer * d1 - s1) * d2 - s2 * d1
    return distance, (g0, g1, g2), (xx + trace, yy + trace, zz + trace, xy, xz, yz)


@inlined
def put_hessian(hessian, curved):
    """Write six numbers xx, yy, zz, xy, xz and yz (`curved`) into a symmetric Hessian (3, 3)."""
    for k in range(3):
        hessian[k, k] = curved[k]
    hessian[0, 1] = hessian[1, 0] = curved[3]
    hessian[0, 2] = hessian[2, 0] = curved[4]
    hessian[1, 2] = hessian[2, 1] = curved[5]


@compiled
def _sum_at(x, y, a, b, psi, distance, gradient, hessian):
    """Write the sums at each point x (q, 3).

    The weights a (1 or q, n) and b (1 or q, 3, n) are common to all points x or their own.
    """
    bent = len(hessian) > 0
    for i in range(len(x)):
        own = i if len(a) > 1 else 0
        distance[i], slope, curved = sum_thin_plate(x[i], y, a[own], b[own], psi, bent)
        put(gradient[i], slope)
        if bent:
            put_hessian(hessian[i], curved)


@compiled
def _put_rows(x, y, psi, near, rows):
    """Write the rows of `rows_at` for points x (q, 3) and n observed points y (3, n)."""
    n = y.shape[1]
    for i in range(len(x)):
        for j in range(n):
            d0 = x[i, 0] - y[0, j]
            d1 = x[i, 1] - y[1, j]
            d2 = x[i, 2] - y[2, j]
            square = d0 * d0 + d1 * d1 + d2 * d2
            r = math.sqrt(square)
            rows[i, j] = square * (2.0 * r - 3.0 * psi) + psi**3
            if j < near:
                first = 6.0 * (psi - r)
                rows[i, n + j] = first * d0
                rows[i, n + near + j] = first * d1
                rows[i, n + 2 * near + j] = first * d2
