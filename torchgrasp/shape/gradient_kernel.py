"""Covariances of signed distances and normals from a radial kernel k(r), Eqs. (2)-(5)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.shape.kernel import Kernel, Profile


def covariance(
    x: Float[Tensor, "n 3"],
    other: Float[Tensor, "m 3"],
    has_normal: Bool[Tensor, "n"],
    other_has_normal: Bool[Tensor, "m"],
    profile: Profile,
) -> Float[Tensor, "rows columns"]:
    """Return the covariance of observations by autograd of the profile, Eqs. (2)-(5): the definition.

    Rows and columns are ordered by component: all d, then w1, w2, w3 of points with normals.

    Args:
        x, other: points, normalised.
        has_normal, other_has_normal: which points are observed with their normal.
        profile: the radial kernel, e.g. `functools.partial(thin_plate, psi=3.6)`.

    Returns:
        The blocks, without a gradient to the points.

    >>> x, mask = torch.rand(5, 3), torch.tensor([True, True, False, False, False])
    >>> covariance(x, x, mask, mask, lambda r: torch.exp(-(r**2))).shape
    torch.Size([11, 11])
    """
    # Detached as the derivatives of the profile are: a gradient through one factor alone would be wrong.
    blocks = cross_covariance(Kernel(profile), x.detach(), other.detach(), len(other)).flatten(0, 1)
    rows, columns = (torch.cat([torch.ones_like(mask), mask.repeat(3)]) for mask in (has_normal, other_has_normal))
    return blocks[rows][:, columns]


def cross_covariance(
    kernel: Kernel,
    x: Float[Tensor, "q 3"],
    y: Float[Tensor, "n 3"],
    n_oriented: int,
    out: Float[Tensor, "4 q rows"] | None = None,
) -> Float[Tensor, "4 q rows"]:
    """Return the covariance of (d, w) at x with observations at y, Eqs. (2)-(5).

    The blocks are k, k' d, -k' d^T and -k' I - k'' d d^T. Here d = x - y, and k', k'' are derivatives in r^2 / 2.
    Eq. (5) takes one derivative in each argument: two in one argument would make the matrix indefinite.

    Args:
        kernel: the radial kernel.
        x: points, normalised.
        y: observed points, those with normals first.
        n_oriented: number of observed points with normals.
        out: where to write the result; new memory costs more than the arithmetic.

    Returns:
        A matrix for each component of (d, w) at x, with the columns of `covariance`.
    """
    n = len(y)
    d, r = separations(x, y)
    k, first, second = kernel.derivatives(r, 3)
    if out is None:
        out = x.new_empty(4, len(x), n + 3 * n_oriented)
    out[0, :, :n] = k
    for m in range(3):
        torch.mul(first, d[m], out=out[m + 1, :, :n])
    if not n_oriented:
        return out
    d, first, second = [part[:, :n_oriented] for part in d], -first[:, :n_oriented], -second[:, :n_oriented]
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


def separations(x: Float[Tensor, "q 3"], y: Float[Tensor, "n 3"]) -> tuple[list[Tensor], Float[Tensor, "q n"]]:
    """Return the components of x - y and its length, without cancellation."""
    d = [x[:, m, None] - y[None, :, m] for m in range(3)]
    return d, (d[0] * d[0]).addcmul_(d[1], d[1]).addcmul_(d[2], d[2]).sqrt_()


def covariance_rows(
    kernel: Kernel, x: Float[Tensor, "n 3"], n_oriented: int, y: Float[Tensor, "m 3"], other_oriented: int
) -> Float[Tensor, "rows columns"]:
    """Return `covariance` for points sorted with normals first.

    >>> from torchgrasp.shape.kernel import rbf_kernel
    >>> x = torch.rand(5, 3, dtype=torch.float64)
    >>> covariance_rows(rbf_kernel(1.0), x, 2, x, 0).shape
    torch.Size([11, 5])
    """
    block = cross_covariance(kernel, x, y, other_oriented)
    if n_oriented == len(x):
        return block.flatten(0, 1)
    return torch.cat([block[0], block[1:, :n_oriented].flatten(0, 1)])


def gram(kernel: Kernel, x: Float[Tensor, "n 3"], n_oriented: int) -> Float[Tensor, "rows rows"]:
    """Return the covariance of observations, of which the first `n_oriented` have normals."""
    return covariance_rows(kernel, x, n_oriented, x, n_oriented)
