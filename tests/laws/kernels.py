"""The laws of kernels: what a shape needs of a radial covariance."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.errors import BrokenLaw
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.kernel import PROFILE, Kernel, differentiate, gram

SPREADS = (0.3, 1.0, 3.0, 10.0)
"""Diameters of point sets over the kernel's own length: points that all agree, and points that
hardly do.
"""
POINTS = 40
"""Points of a set, with normals: 160 rows, whose eigenvalues take 3 ms."""
ROUNDING = 1e-7
"""Negative eigenvalue over the largest that rounding may leave: Matern of length 0.01 has 1e-8,
noise adds 1e-7.
"""


def check_kernel(kernel: Kernel, seed: int = 0) -> Kernel:
    """Check a radial kernel k(r) of your own for `fit_shape`, and return it.

    The laws, by the name that an error gives them:

    * `finite`: k and its first derivatives are finite in the kernel's ball, at r = 0 too.
    * `variance`: k(0) and -k''(0), the prior variances of distance and normal, are positive.
    * `smooth`: k'(0) = 0, without which surfaces have no normals.
    * `derivatives`: a closed form equals autograd of the profile, which equals finite differences
      of k.
    * `covariance`: no combination of distances and normals in the ball has a negative variance.
    """
    length = _length(kernel)
    _check_start(kernel, length)
    r = _distances(kernel, length)
    _check_finite(kernel, r)
    _check_derivatives(kernel, r, length)
    for spread in SPREADS:
        _check_covariance(kernel, min(spread * length, kernel.diameter), seed)
    return kernel


def _length(kernel: Kernel) -> float:
    """Return the least power of 2 at which the kernel has changed by a quarter of k(0)."""
    r = torch.cat(
        [torch.zeros(1, dtype=torch.float64), 2.0 ** torch.arange(-20, 11, dtype=torch.float64)]
    )
    k = kernel.profile(r)
    if not 0 < float(k[0]) < math.inf:
        raise BrokenLaw("variance", f"k(0) = {float(k[0]):.3g}", "a positive variance of distances")
    changed = ((k - k[0]).abs() > 0.25 * k[0]) & (r < kernel.diameter)
    return float(r[changed][0]) if bool(changed.any()) else min(1.0, kernel.diameter)


def _check_start(kernel: Kernel, length: float) -> None:
    """Refuse a kernel with a kink at r = 0, found by a finite difference, and one that does not
    fall from there.
    """
    step = 1e-4 * length  # a smooth kernel falls by 1e-8 / 2, one with a kink by 1e-4
    near, at = kernel.profile(torch.tensor([step, 0.0], dtype=torch.float64)).tolist()
    slope = (near - at) / at / 1e-4
    if not abs(slope) < 1e-2:
        raise BrokenLaw("smooth", f"k'(0) = {slope * at / length:.3g}", "0")
    curvature = float(differentiate(kernel.profile, torch.zeros(1, dtype=torch.float64), 2)[1])
    if not -math.inf < curvature < 0:
        raise BrokenLaw("variance", f"-k''(0) = {-curvature:.3g}", "a positive variance of normals")


def _distances(kernel: Kernel, length: float) -> Float[Tensor, " n"]:
    """Return distances from 0 to the end of the ball, tiny ones among them."""
    end = min(10.0 * length, kernel.diameter)
    tiny = length * torch.tensor([0.0, 1e-12, 1e-8, 1e-5, 1e-3], dtype=torch.float64)
    return torch.cat([tiny, torch.linspace(0.02, 1.0, 50, dtype=torch.float64) * end])


def _check_finite(kernel: Kernel, r: Float[Tensor, " n"]) -> None:
    """Refuse a kernel or derivative that is no number."""
    for order, values in enumerate(kernel.derivatives(r, 4)):
        if values.shape != r.shape or not bool(torch.isfinite(values).all()):
            at = float(r[~torch.isfinite(values)][0]) if values.shape == r.shape else math.nan
            raise BrokenLaw(
                "finite",
                f"derivative {order} in r^2/2 at r = {at:.3g}",
                "a finite number for every r",
            )


def _check_derivatives(kernel: Kernel, r: Float[Tensor, " n"], length: float) -> None:
    """Compare the closed form with autograd, and autograd with finite differences of k.

    Each derivative in u = r^2 / 2 counts with the power of r with which covariances take it. The
    third may have no limit at r = 0, where autograd leaves it out.
    """
    k = float(kernel.profile(torch.zeros(1, dtype=torch.float64)))
    factors = (
        torch.ones_like(r) / k,
        length**2 / k,
        r**2 * (length**2 / k),
        r**3 * (length**3 / k),
    )
    given = kernel.derivatives(r, 4)
    exact = differentiate(kernel.profile, r * r / 2, 4)
    for order, (a, b, factor) in enumerate(zip(given, exact, factors, strict=True)):
        error = ((a - b) * factor).abs().where((r > PROFILE.near_zero) | (order < 3), 0.0)
        if not float(error.max()) < 1e-6:
            place = float(r[error.argmax()])
            found = f"derivative {order} of the closed form off by {float(error.max()):.3g} at r = {place:.3g}"
            raise BrokenLaw("derivatives", found, "that of the profile")
    middle = r[10:-1]
    step = 1e-5 * length
    slope = (kernel.profile(middle + step) - kernel.profile(middle - step)) / (2 * step)
    error = (slope - middle * differentiate(kernel.profile, middle * middle / 2, 2)[1]).abs() * (
        length / k
    )
    if not float(error.max()) < 1e-6:
        found = f"k' off by {float(error.max()):.3g} k(0) / length at r = {float(middle[error.argmax()]):.3g}"
        raise BrokenLaw("derivatives", found, "that of finite differences")


def _check_covariance(kernel: Kernel, diameter: float, seed: int) -> None:
    """Refuse a negative variance among distances and normals of points in a ball."""
    for name, points in point_sets(seed).items():
        matrix = gram(kernel, 0.5 * diameter * points, len(points))
        values = torch.linalg.eigvalsh(matrix)
        if not float(values[0]) > -ROUNDING * float(values[-1]):
            found = f"an eigenvalue of {float(values[0]):.3g}, {POINTS} points on a {name} of diameter {diameter:.3g}"
            raise BrokenLaw(
                "covariance",
                found,
                f"at least {-ROUNDING * float(values[-1]):.3g}, or a smaller `diameter`",
            )


def point_sets(seed: int) -> dict[str, Float[Tensor, "n 3"]]:
    """Return points in the unit ball: throughout it, on its surface, on a line, and in two heaps
    far apart.
    """
    generator = torch.Generator().manual_seed(seed)
    directions = unit(torch.randn(POINTS, 3, generator=generator, dtype=torch.float64))
    radius = torch.rand(POINTS, 1, generator=generator, dtype=torch.float64) ** (1 / 3)
    along = torch.linspace(-1.0, 1.0, POINTS, dtype=torch.float64)[:, None]
    heaps = directions * torch.tensor([0.05, 0.05, 0.05], dtype=torch.float64)
    heaps[:, 0] += torch.where(torch.arange(POINTS) % 2 == 0, 0.9, -0.9)
    return {
        "ball": radius * directions,
        "sphere": directions,
        "line": along * directions[:1],
        "pair of heaps": heaps,
    }
