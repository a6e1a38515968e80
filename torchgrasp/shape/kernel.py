"""Radial kernels k(r), and the covariances of signed distances and normals that follow, Eqs.
(2)-(6) of the paper.

Distances r are normalised. Autograd of the scalar profile k(r) defines all derivatives. A kernel
may add a closed form, which plain tensors take. An oriented observation is one with a normal.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.rules import LEAST, Positive, Range, is_known, is_tracked
from torchgrasp.geometry.linalg import Points, eye_like

Profile = Callable[[Tensor], Tensor]
"""A radial kernel k(r), elementwise. It is smooth where r > 0, four times differentiable at 0 from
the right, and k'(0) = 0.
"""
Queries = Float[Tensor, "q 3"]
"""Query points (q, 3), normalised."""
CovarianceRows = Float[Tensor, "q rows"]
"""Covariances (q, rows) of a number at each query point with all observed numbers."""
KernelName = Literal["thin_plate", "matern52", "rbf"]
Orders = Annotated[int, Range(1, 4)]  # how many of k and its derivatives
# length over psi of the Matern kernel whose gradients have the prior variance 6 psi
MATERN52_LENGTH = math.sqrt(5.0 / 18.0)


@dataclasses.dataclass(frozen=True)
class ProfileNumbers:
    """Bounds for the derivatives of a profile near r = 0, where k'(r) / r is 0 / 0."""

    near_zero: float = 1e-4
    """Normalised distance r below which k(r) is replaced by its Taylor polynomial of degree 4."""
    power: float = 1.5
    """Power of the rounding error: two points coincide if their r^2 is at most this power.
    Otherwise rounding of the third derivative would dominate.
    """


PROFILE = ProfileNumbers()


class Formula(partial[Any]):
    """A partial application of a function that equals others of the same function and arguments.

    The function is one of a module. So a kernel made of it equals its copies, and can be pickled.
    """

    def _compared(self) -> tuple[Any, ...]:
        return self.func, self.args, tuple(sorted(self.keywords.items()))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Formula) and self._compared() == other._compared()

    def __hash__(self) -> int:
        return hash(self._compared())


@checked
@dataclasses.dataclass(frozen=True)
class Kernel:
    """A radial kernel: the covariance k(r) of the signed distances at two points a normalised
    distance r apart. One normalised unit is `ShapeGP.scale` [m], and k has squared normalised
    units.

    Use `thin_plate_kernel`, `matern52_kernel` or `rbf_kernel`, or your own profile. `fit_shape` and
    `condition` take a kernel. With `condition`, gradients also flow to tensors that the profile
    uses, such as a length scale.

    Args:
        profile: the function k(r), elementwise on a tensor of distances r >= 0. It must be smooth
            for r > 0, with k'(0) = 0.
        diameter: diameter, normalised, of the ball in which k is positive definite; infinite if k
            is positive definite everywhere.
        remedy: advice in the text of the error that is raised if the covariance is not positive
            definite.
        closed_form: function of distances `r` and a number `count` that returns what `derivatives`
            returns, but faster. This is a tuple of the first `count` of k, k1, k2, k3, each in the
            shape of `r`. False means autograd of the profile. Where a gradient is needed, autograd
            is used in any case.

    Raises `BadArgument` for a `diameter` that is not positive.

    >>> kernel = Kernel(lambda r: (1 + r) * torch.exp(-r))
    >>> [round(float(s), 4) for s in kernel.derivatives(torch.ones(1, dtype=torch.float64), 4)]
    [0.7358, -0.3679, 0.3679, -0.7358]
    """

    profile: Profile
    diameter: Annotated[float, Range(LEAST, math.inf)] = math.inf
    remedy: str = "use more noise, or a shorter length of the kernel"
    closed_form: Callable[[Tensor, int], tuple[Tensor, ...]] | Literal[False] = False

    @checked(gradients=True)
    def derivatives(
        self,
        r: Float[Tensor, "*s"],
        count: Orders,
    ) -> tuple[Float[Tensor, "*s"], ...]:
        """Return the first `count` of k(r), k1(r), k2(r), k3(r): k and its derivatives with respect
        to r^2 / 2.

        These are k1 = k' / r, k2 = k1' / r and k3 = k2' / r, where ' is d/dr. They are not the
        derivatives with respect to r. The results are differentiable. At r = 0 infinite values
        count as 0, and k3 is not reliable.

        Args:
            r: normalised distances (*s,) of any shape; one unit is `ShapeGP.scale` [m]. Each result
                has the same shape.
            count: number of results, 1 to 4.

        Raises `BadArgument` for a `count` out of range.

        >>> half_square = Kernel(lambda r: r**2 / 2)
        >>> half_square.derivatives(torch.tensor([2.0]), 3)
        (tensor([2.]), tensor([1.]), tensor([0.]))
        """
        if self.closed_form and is_plain(r):
            return self.closed_form(r, count)
        return differentiate(self.profile, r * r / 2, count)


def is_plain(*tensors: Tensor) -> bool:
    """Return whether torch neither differentiates the tensors nor maps over them (torch.vmap).

    Then operations in place are allowed, and buffers may be reused.
    """
    return all(is_known(x) and not is_tracked(x) for x in tensors)


def differentiate(
    profile: Profile,
    u: Float[Tensor, "*s"],
    count: int,
) -> tuple[Float[Tensor, "*s"], ...]:
    """Return the first `count` (1 to 4) of k, dk/du, d2k/du2 and d3k/du3, by autograd.

    `profile` is the kernel k as a function of the normalised distance r, and u = r^2 / 2. The
    results are differentiable by u to any order. At r = 0, only k and its first two derivatives
    are right. Higher and infinite ones count as 0 there: covariances multiply them by a power of r.
    """
    least = PROFILE.near_zero**2 / 2
    near = u < least
    r = torch.sqrt(2.0 * torch.where(near, least, u))
    values = _differentiate_by_distance(profile, r, count - 1)
    inverse = 1.0 / r
    if count > 1:
        values[1] = values[1] * inverse
    if count > 2:
        values[2] = (values[2] - values[1]) * inverse**2
    if count > 3:
        values[3] = (values[3] * inverse - 3.0 * values[2]) * inverse**2
    if is_known(near) and not bool(near.any()):
        return tuple(values)
    k, _, second, third, fourth = _differentiate_by_distance(profile, u.new_zeros(()), 4)
    apart = 2.0 * u > torch.finfo(u.dtype).eps ** PROFILE.power
    # the gradient of r is finite at 0, too
    r = torch.where(apart, torch.sqrt(2.0 * torch.where(apart, u, 1.0)), 0.0)
    inverse = torch.where(apart, 1.0 / torch.where(apart, r, 1.0), 0.0)
    series = (
        k + u * (second + u * fourth / 6) + r**3 * third / 6,
        second + u * fourth / 3.0 + r * third / 2.0,
        fourth / 3.0 + inverse * third / 2.0,
        -(inverse**3) * third / 2.0,
    )
    return tuple(torch.where(near, a, b) for a, b in zip(series, values, strict=False))


def _differentiate_by_distance(
    profile: Profile,
    r: Tensor,
    order: int,
) -> list[Tensor]:
    """Return the profile k(r) and its derivatives by r up to an order, elementwise and
    differentiable.
    """
    if not order:
        return [profile(r)]

    def total(r: Tensor) -> tuple[Tensor, list[Tensor]]:
        values = _differentiate_by_distance(profile, r, order - 1)
        return values[-1].sum(), values

    slope, values = torch.func.grad(total, has_aux=True)(r)
    return [*values, slope]


def thin_plate(
    r: Float[Tensor, "*s"],
    psi: float | Float[Tensor, "*p"],
) -> Float[Tensor, "*s"]:
    """Return the thin plate kernel 2 r^3 - 3 psi r^2 + psi^3 at normalised distances r, Eq. (6).

    It is positive definite, and so a covariance, only in a ball of diameter 3/4 psi. `psi` is the
    kernel's length, normalised.
    """
    # Not factored as (psi - r)^2 (psi + 2 r): its derivative would cancel at r -> 0, where normals
    # need it.
    return r * r * (2.0 * r - 3.0 * psi) + psi**3


@checked
def thin_plate_kernel(psi: Positive, closed_form: bool = True) -> Kernel:
    """Return the thin plate kernel k(r) = 2 r^3 - 3 psi r^2 + psi^3, Eq. (6) of the paper.

    r is the distance of two points. Lengths are normalised: one unit is `ShapeGP.scale` [m].

    Args:
        psi: the kernel's length, normalised. k is positive definite only in a ball of diameter
            3/4 `psi`.
        closed_form: whether derivatives are in closed form; False means autograd of the profile,
            which is slower.

    Raises `BadArgument` for a `psi` that is not positive.

    >>> kernel = thin_plate_kernel(psi=2.0)
    >>> kernel.diameter
    1.5
    """
    remedy = (
        "use a psi_scale of at least 1.34: "
        "the thin plate kernel is a covariance only within 3/4 psi"
    )
    fast = closed_form and Formula(differentiate_thin_plate, psi)
    return Kernel(Formula(thin_plate, psi=psi), psi / (4.0 / 3.0), remedy, fast)


def is_thin(kernel: Kernel) -> bool:
    """Return whether a kernel is a thin plate whose derivatives are in closed form."""
    form = kernel.closed_form
    return isinstance(form, partial) and form.func is differentiate_thin_plate


def psi_of(kernel: Kernel) -> float:
    """Return the normalised length psi of a thin plate kernel."""
    form = kernel.closed_form
    assert isinstance(form, partial)
    return float(form.args[0])


def differentiate_thin_plate(
    psi: float | Tensor,
    r: Tensor,
    count: int,
) -> tuple[Tensor, ...]:
    """Return the thin plate kernel k(r) and its derivatives with respect to r^2 / 2, in closed form.

    They are the first `count` (1 to 4) of k, k1, k2, k3, as `Kernel.derivatives` defines them, each
    in the shape of `r`. The kernel is 2 r^3 - 3 psi r^2 + psi^3 (`thin_plate`). Its length `psi`
    and the distances `r`, of any shape, are normalised. At r = 0 infinite values count as 0.
    """
    # each pass over the distances counts: k is r^2 (k' / 3 - psi) + psi^3
    first = (r - psi).mul_(6)
    values = [(first / 3).sub_(psi).mul_(r).mul_(r).add_(psi**3), first]
    if count > 2:
        values.append((6 / r).nan_to_num_(nan=math.nan, posinf=0.0))
        if count > 3:
            values.append((values[2] * values[2]).mul_(values[2]).mul_(-1 / 36))
    return tuple(values[:count])


@checked
def matern52_kernel(length: Positive, variance: Positive = 1.0) -> Kernel:
    """Return the Matern 5/2 kernel k(r) = variance (1 + s + s^2 / 3) exp(-s), with s = sqrt(5) r /
    length.

    r is the distance of two points. Lengths are normalised: one unit is `ShapeGP.scale` [m].

    Args:
        length: length scale, normalised.
        variance: prior variance of the signed distance, in squared normalised units.

    Raises `BadArgument` for a length or variance that is not positive.

    >>> float(matern52_kernel(1.0).profile(torch.zeros(())))
    1.0
    """
    scale = math.sqrt(5) / length
    profile = Formula(_matern52, scale, variance)
    return Kernel(profile, closed_form=Formula(_differentiate_matern52, scale, variance))


def _matern52(scale: float, variance: float, r: Tensor) -> Tensor:
    s = scale * r
    return variance * (1.0 + s + s * s / 3.0) * torch.exp(-s)


def _differentiate_matern52(
    scale: float, variance: float, r: Tensor, count: int
) -> tuple[Tensor, ...]:
    fall = torch.exp(-scale * r) * (variance / 3.0)
    inverse = torch.reciprocal(r).masked_fill(r == 0, 0.0)
    orders = (
        -(scale**2) * (1.0 + scale * r) * fall,
        scale**4 * fall,
        -(scale**5) * inverse * fall,
    )
    return _matern52(scale, variance, r), *orders[: count - 1]


@checked
def rbf_kernel(length: Positive, variance: Positive = 1.0) -> Kernel:
    """Return the squared exponential kernel k(r) = variance exp(-r^2 / (2 length^2)).

    r is the distance of two points. Lengths are normalised: one unit is `ShapeGP.scale` [m].

    Args:
        length: length scale, normalised.
        variance: prior variance of the signed distance, in squared normalised units.

    Raises `BadArgument` for a length or variance that is not positive.

    >>> float(rbf_kernel(1.0).profile(torch.zeros(())))
    1.0
    """
    profile = Formula(_rbf, length, variance)
    return Kernel(profile, closed_form=Formula(_differentiate_rbf, length, variance))


def _rbf(length: float, variance: float, r: Tensor) -> Tensor:
    return variance * torch.exp(r * r * (-0.5 / length**2))


def _differentiate_rbf(length: float, variance: float, r: Tensor, count: int) -> tuple[Tensor, ...]:
    k = _rbf(length, variance, r)
    return tuple(k * (-1.0 / length**2) ** order for order in range(count))


def kernel_of(kernel: KernelName | Kernel, psi: float) -> Kernel:
    """Return the `Kernel` of a name, or a given kernel itself.

    The length of a named kernel follows from the normalised length `psi`. Then the variance of a
    distance is psi^3.
    """
    return kernel_by_name(kernel, psi) if isinstance(kernel, str) else kernel


@checked
def kernel_by_name(name: KernelName, psi: Positive) -> Kernel:
    """Return the kernel "thin_plate", "matern52" or "rbf"; its length follows from `psi`,
    normalised.

    All have the prior variance psi^3 of the distance and 6 psi of a gradient component.
    """
    if name == "thin_plate":
        return thin_plate_kernel(psi)
    if name == "matern52":
        return matern52_kernel(psi * MATERN52_LENGTH, psi**3)
    return rbf_kernel(psi / math.sqrt(6), psi**3)


def cross_covariance(
    kernel: Kernel,
    x: Queries,
    y: Float[Tensor, "*q n 3"],
    n_oriented: int,
) -> Float[Tensor, "4 q rows"]:
    """Return the prior covariance (4, q, r) of distance and gradient at q points with r observed
    numbers.

    The q points `x` and the n observed points `y` are normalised. With d = x - y, and derivatives
    by r^2 / 2, Eqs. (2)-(5) of the paper give the blocks. They are k, k' d, -k' d^T and -k' I - k''
    d d^T. The first axis holds the distance, then the gradient (x, y, z). The last axis holds the
    distances at all y. Then follows each gradient component at the first `n_oriented` points, which
    have normals. With a leading axis, `y` holds the observations of each x.
    """
    if not (kernel.closed_form and is_plain(x, y)):
        return _differentiable_cross_covariance(kernel, x, y, n_oriented)
    n = y.shape[-2]
    d, r = separations(x, y)
    k, first, second = kernel.derivatives(r, 3)
    out = x.new_empty(4, len(x), n + 3 * n_oriented)
    out[0, :, :n] = k
    for m in range(3):
        torch.mul(first, d[m], out=out[m + 1, :, :n])
    if not n_oriented:
        return out
    d = [part[:, :n_oriented] for part in d]
    first = -first[:, :n_oriented]
    second = -second[:, :n_oriented]
    for m in range(3):
        columns = slice(n + m * n_oriented, n + (m + 1) * n_oriented)
        torch.mul(first, d[m], out=out[0, :, columns])
        tilted = second * d[m]
        torch.addcmul(first, tilted, d[m], out=out[m + 1, :, columns])
        for p in range(m):
            block = out[m + 1, :, n + p * n_oriented : n + (p + 1) * n_oriented]
            torch.mul(tilted, d[p], out=block)
            out[p + 1, :, columns] = block
    return out


def _differentiable_cross_covariance(
    kernel: Kernel,
    x: Queries,
    y: Points,
    n_oriented: int,
) -> Float[Tensor, "4 q rows"]:
    """Return the result of `cross_covariance` by operations without side effects, differentiable to
    any order.
    """
    d = x[:, None] - y
    u = (d * d).sum(-1) / 2
    k, first, second = (f[..., None] for f in differentiate(kernel.profile, u, 3))
    near = d[:, :n_oriented]
    slope = -first[:, :n_oriented]
    one = eye_like(3, x)
    tilted = second[:, :n_oriented, :, None] * near[..., :, None]
    bent = slope[..., None] * one - tilted * near[..., None, :]  # (q, n_oriented, 3, 3)
    with_distances = torch.cat([k, first * d], -1).permute(2, 0, 1)
    with_normals = torch.cat([(slope * near)[..., None, :], bent], -2)  # (q, n_oriented, 4, 3)
    with_normals = with_normals.permute(2, 0, 3, 1).flatten(2)
    return torch.cat([with_distances, with_normals], -1)


def separations(
    x: Queries,
    y: Float[Tensor, "*q n 3"],
) -> tuple[list[Tensor], Float[Tensor, "q n"]]:
    """Return (differences, distances): the three components (q, n) of x - y, and |x - y|, of all
    pairs.

    The distances are computed from the differences, without cancellation. With a leading axis, `y`
    holds the points that each x is compared with.
    """
    pairs = zip(x[:, None].unbind(2), y.unbind(-1), strict=True)
    d = [one - other for one, other in pairs]
    square = d[0] * d[0]
    square.addcmul_(d[1], d[1]).addcmul_(d[2], d[2])
    return d, square.sqrt_()


def covariance_rows(
    kernel: Kernel,
    x: Points,
    n_oriented: int,
    y: Float[Tensor, "m 3"],
    other_oriented: int,
) -> Float[Tensor, "rows columns"]:
    """Return the prior covariance of the observed numbers at normalised points x with those at y.

    The first `n_oriented` points of x and `other_oriented` of y have normals. Rows are the numbers
    at x, and columns those at y. Distances come first, then normals by component.
    """
    block = cross_covariance(kernel, x, y, other_oriented)
    if n_oriented == len(x):
        return block.flatten(0, 1)
    return torch.cat([block[0], block[1:, :n_oriented].flatten(0, 1)])


def gram(
    kernel: Kernel,
    x: Points,
    n_oriented: int,
) -> Float[Tensor, "rows rows"]:
    """Return the prior covariance matrix (r, r) of all r observed numbers at n normalised points x.

    The first `n_oriented` points have normals. The n distances come first, then normals by
    component. Noise is not included.
    """
    return covariance_rows(kernel, x, n_oriented, x, n_oriented)
