"""Covariances of signed distances and normals, derived from any radial kernel k(r), Eqs. (2)-(6)."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.linalg import safe_distance

Profile = Callable[[Tensor], Tensor]
"""A radial kernel k(r), elementwise and twice differentiable, with k'(0) = 0."""

NEAR = 1e-5
"""Distance below which k'(r)/r is taken as k''(r/2), its midpoint rule: exact for the thin plate, and no 0/0."""


def thin_plate(r: Float[Tensor, "*s"], psi: float) -> Float[Tensor, "*s"]:
    """Return the thin plate kernel 2 r^3 - 3 psi r^2 + psi^3 of a distance, Eq. (6).

    It is a covariance only on a ball of diameter 3/4 psi or less: with psi equal to the longest distance of the
    data, as the paper has it, three points and two normals suffice for a negative eigenvalue.

    Args:
        r: distances, normalised.
        psi: the distance at which the kernel and its slope vanish.

    >>> thin_plate(torch.tensor([0.0, 2.0]), psi=2.0)
    tensor([8., 0.])
    """
    # Not factored as (psi - r)^2 (psi + 2 r): its derivative would cancel at r -> 0, where normals need it.
    return r * r * (2.0 * r - 3.0 * psi) + psi**3


def radial_derivatives(
    profile: Profile, r: Float[Tensor, "*s"]
) -> tuple[Float[Tensor, "*s"], Float[Tensor, "*s"], Float[Tensor, "*s"]]:
    """Return k(r), k'(r)/r and k''(r) by autograd of the profile, with the limit k''(0) of k'(r)/r at r = 0.

    >>> k, slope, bend = radial_derivatives(lambda r: torch.exp(-(r**2)), torch.zeros(1))
    >>> slope, bend
    (tensor([-2.]), tensor([-2.]))
    """
    k, first, second = _differentiate(profile, r)
    near = r < NEAR
    _, _, midpoint = _differentiate(profile, r / 2)
    return k, torch.where(near, midpoint, first / torch.where(near, 1.0, r)), second


def covariance(
    x: Float[Tensor, "n 3"],
    other: Float[Tensor, "m 3"],
    has_normal: Bool[Tensor, "n"],
    other_has_normal: Bool[Tensor, "m"],
    profile: Profile,
) -> Float[Tensor, "rows columns"]:
    """Return the covariance between the observations at two sets of points, Eqs. (2)-(5).

    A point with a normal has four rows (d, w1, w2, w3), another only d. Rows are ordered by component: all d, then
    w1, w2, w3 of the points with normals. In Eq. (5) one derivative is of each argument; both of the same argument
    would flip the sign of the block and make the matrix indefinite.

    Args:
        x, other: points, normalised.
        has_normal, other_has_normal: which of them are observed with their normal.
        profile: the radial kernel, e.g. `functools.partial(thin_plate, psi=3.6)`.

    Returns:
        The blocks, without a gradient to the points.

    >>> x, mask = torch.rand(5, 3), torch.tensor([True, True, False, False, False])
    >>> covariance(x, x, mask, mask, lambda r: torch.exp(-(r**2))).shape
    torch.Size([11, 11])
    """
    # Detached as the derivatives of the profile are: a gradient through one factor alone would be wrong.
    difference = (x[:, None] - other[None]).detach()
    r = safe_distance(difference)
    k, slope, bend = radial_derivatives(profile, r)
    # d2k/dx_m dx'_n = -(k'/r) delta_mn - (k'' - k'/r) u_m u_n with u = d/r; at r = 0 the second term has no
    # direction, and k'' - k'/r vanishes there.
    direction = difference / torch.where(r == 0, 1.0, r)[..., None]
    tilt = bend - slope
    rows = [torch.cat([k] + [-(slope * difference[..., n])[:, other_has_normal] for n in range(3)], 1)]
    for m in range(3):
        block = [slope * difference[..., m]]
        for n in range(3):
            mixed = -tilt * direction[..., m] * direction[..., n]
            block.append((mixed - slope if m == n else mixed)[:, other_has_normal])
        rows.append(torch.cat(block, 1)[has_normal])
    return torch.cat(rows, 0)


def _differentiate(profile: Profile, r: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the profile and its first two derivatives, elementwise."""
    with torch.enable_grad():
        r = r.detach().requires_grad_()
        k = profile(r)
        (first,) = torch.autograd.grad(k.sum(), r, create_graph=True, materialize_grads=True)
        if first.requires_grad:
            (second,) = torch.autograd.grad(first.sum(), r, materialize_grads=True)
        else:  # a linear profile
            second = torch.zeros_like(first)
    return k.detach(), first.detach(), second.detach()
