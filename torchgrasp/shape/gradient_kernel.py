"""Covariances of signed distances and normals in closed form, from a kernel's slopes: what all fast paths use.

`kernel.covariance` defines them by autograd of the profile, and the tests hold the two against each other.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.shape.kernels import Kernel


def cross_covariance(
    kernel: Kernel,
    x: Float[Tensor, "q 3"],
    y: Float[Tensor, "n 3"],
    near: int,
    out: Float[Tensor, "4 q rows"] | None = None,
) -> Float[Tensor, "4 q rows"]:
    """Return the covariance of (d, w) at points x with what is observed at points y, Eqs. (2)-(5).

    With d = x - y and k', k'' the derivatives of the kernel in r^2 / 2, the blocks are k, k' d, -k' d^T and
    -k' I - k'' d d^T.

    Args:
        kernel: the radial kernel.
        x: points, normalised.
        y: points, of which the first `near` are observed with normals.
        near: see `y`.
        out: where to write the result; new memory costs more than the arithmetic.

    Returns:
        For each component of (d, w) at x a matrix with the columns of `covariance`: first all d, then w1, w2, w3.
    """
    n = len(y)
    d, r = separations(x, y)
    k, slope, bend = kernel.slopes(r, 3)
    if out is None:
        out = x.new_empty(4, len(x), n + 3 * near)
    out[0, :, :n] = k
    for m in range(3):
        torch.mul(slope, d[m], out=out[m + 1, :, :n])
    if not near:
        return out
    d, slope, bend = [part[:, :near] for part in d], -slope[:, :near], -bend[:, :near]
    for m in range(3):
        columns = slice(n + m * near, n + (m + 1) * near)
        torch.mul(slope, d[m], out=out[0, :, columns])
        tilted = bend * d[m]
        torch.addcmul(slope, tilted, d[m], out=out[m + 1, :, columns])
        for p in range(m):
            block = out[m + 1, :, n + p * near : n + (p + 1) * near]
            torch.mul(tilted, d[p], out=block)
            out[p + 1, :, columns] = block
    return out


def separations(x: Float[Tensor, "q 3"], y: Float[Tensor, "n 3"]) -> tuple[list[Tensor], Float[Tensor, "q n"]]:
    """Return x - y component by component, and its length, without the cancellation of |x|^2 - 2 x.y + |y|^2."""
    d = [x[:, m, None] - y[None, :, m] for m in range(3)]
    return d, (d[0] * d[0]).addcmul_(d[1], d[1]).addcmul_(d[2], d[2]).sqrt_()


def covariance_rows(
    kernel: Kernel, x: Float[Tensor, "n 3"], near: int, y: Float[Tensor, "m 3"], other_near: int
) -> Float[Tensor, "rows columns"]:
    """Return what `covariance` does for two sets of points of which the first `near` and `other_near` have normals.

    >>> from torchgrasp.shape.kernels import rbf_kernel
    >>> x = torch.rand(5, 3, dtype=torch.float64)
    >>> covariance_rows(rbf_kernel(1.0), x, 2, x, 0).shape
    torch.Size([11, 5])
    """
    block = cross_covariance(kernel, x, y, other_near)
    if near == len(x):
        return block.flatten(0, 1)
    return torch.cat([block[0], block[1:, :near].flatten(0, 1)])


def gram(kernel: Kernel, x: Float[Tensor, "n 3"], near: int) -> Float[Tensor, "rows rows"]:
    """Return the covariance of what is observed at points, of which the first `near` have normals; symmetric."""
    return covariance_rows(kernel, x, near, x, near)
