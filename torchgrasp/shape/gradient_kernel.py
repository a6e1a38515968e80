"""Covariances of signed distances and normals from a radial kernel k(r), Eqs. (2)-(5)."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.shape.kernel import Kernel


def cross_covariance(
    kernel: Kernel,
    x: Float[Tensor, "q 3"],
    y: Float[Tensor, "n 3"],
    n_oriented: int,
    out: Float[Tensor, "4 q rows"] | None = None,
) -> Float[Tensor, "4 q rows"]:
    """Return the covariance of each component of (d, w) at x with observations at y, Eqs. (2)-(5).

    The blocks are k, k' d, -k' d^T and -k' I - k'' d d^T. Here d = x - y, and k', k'' are derivatives in r^2 / 2.
    Eq. (5) takes one derivative in each argument: two in one argument would make the matrix indefinite.

    The first `n_oriented` of y have normals. Columns go by component: d of all, then w1, w2, w3 with normals. `out`
    takes the result: new memory costs more than the arithmetic.
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
    """Return the covariance of two lists of observations. Points with normals are first."""
    block = cross_covariance(kernel, x, y, other_oriented)
    if n_oriented == len(x):
        return block.flatten(0, 1)
    return torch.cat([block[0], block[1:, :n_oriented].flatten(0, 1)])


def gram(kernel: Kernel, x: Float[Tensor, "n 3"], n_oriented: int) -> Float[Tensor, "rows rows"]:
    """Return the covariance of observations, of which the first `n_oriented` have normals."""
    return covariance_rows(kernel, x, n_oriented, x, n_oriented)
