"""Linear algebra without silent repair: checked Cholesky factors, Mahalanobis distances."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.errors import IndefiniteCovariance


def unit(v: Float[Tensor, "*b d"]) -> Float[Tensor, "*b d"]:
    """Return vectors of length 1 in the direction of `v`; a zero vector gives NaN."""
    return v / torch.linalg.vector_norm(v, dim=-1, keepdim=True)


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
