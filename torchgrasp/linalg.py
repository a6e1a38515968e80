"""Linear algebra without silent repair: checked Cholesky factors, Mahalanobis distances."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.errors import IndefiniteCovariance

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
"""Golden section of the full circle [rad]."""


def unit(v: Float[Tensor, "*b d"]) -> Float[Tensor, "*b d"]:
    """Return vectors of length 1 in the direction of `v`; a zero vector gives NaN."""
    return v / torch.linalg.vector_norm(v, dim=-1, keepdim=True)


def fibonacci_sphere(
    n: int, like: Tensor, angle: float = math.pi * (1 + math.sqrt(5)), start: float = 0.5
) -> Float[Tensor, "n 3"]:
    """Return n unit vectors spread evenly over the sphere from +z to -z, in the dtype and on the device of `like`.

    Args:
        n: number of vectors.
        like: any tensor.
        angle: rotation about z from one vector to the next [rad], `GOLDEN_ANGLE` in either sense.
        start: rotation of the first vector, in units of `angle`.

    >>> fibonacci_sphere(4, torch.zeros(0))[:, 2]
    tensor([ 0.7500,  0.2500, -0.2500, -0.7500])
    """
    k = torch.arange(n, dtype=like.dtype, device=like.device)
    z = 1 - (2 * k + 1) / n
    rotation = angle * (k + start)
    ring = torch.sqrt(1 - z * z)
    return torch.stack([ring * torch.cos(rotation), ring * torch.sin(rotation), z], -1)


def cholesky(matrix: Float[Tensor, "*b n n"], what: str, remedy: str) -> Float[Tensor, "*b n n"]:
    """Return the lower Cholesky factor, without jitter.

    Raises:
        IndefiniteCovariance: with the smallest eigenvalue and the `remedy`.

    >>> cholesky(torch.eye(2), "I", "none needed")
    tensor([[1., 0.],
            [0., 1.]])
    """
    factor, info = torch.linalg.cholesky_ex(matrix)
    if bool((info != 0).any()) or not bool(torch.isfinite(factor).all()):
        finite = bool(torch.isfinite(matrix).all())
        smallest = float(torch.linalg.eigvalsh(matrix).min()) if finite else float("nan")
        raise IndefiniteCovariance(what, smallest, remedy)
    return factor


def squared_mahalanobis(difference: Float[Tensor, "*b d"], factor: Float[Tensor, "*b d d"]) -> Float[Tensor, "*b"]:
    """Return x^T Sigma^-1 x for the lower Cholesky factor of Sigma."""
    whitened = torch.linalg.solve_triangular(factor, difference[..., None], upper=False)[..., 0]
    return (whitened * whitened).sum(-1)
