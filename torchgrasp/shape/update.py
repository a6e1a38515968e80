"""Later observations: rows appended to the Cholesky factor of a posterior, at O(rows^2) each."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.linalg import cholesky
from torchgrasp.shape.observe import Observations
from torchgrasp.shape.posterior import Posterior, cross_covariance


def append_observations(posterior: Posterior, new: Observations) -> Posterior:
    """Return the posterior given `new` observations, too; it equals the one of all observations at once.

    With B = L^-1 K(old, new), the factor grows by the rows [B^T, C], C being the Cholesky factor of what the old
    observations leave of K(new, new) + noise.

    Args:
        posterior: the one to extend.
        new: normalised, float64, on the posterior's device.

    Raises:
        IndefiniteCovariance: the new points are too far away for the kernel.
    """
    kernel, old = posterior.kernel, len(posterior.factor)
    new = new.with_normals_first()
    y, noise = new.rows()
    fresh = int(new.has_normal.sum())
    cross = _rows(cross_covariance(kernel, new.x, posterior.x, posterior.oriented), fresh).T
    own = _rows(cross_covariance(kernel, new.x, new.x, fresh), fresh) + torch.diag_embed(noise)
    order = torch.arange(old, device=y.device) if posterior.order is None else posterior.order
    before = torch.linalg.solve_triangular(posterior.factor, cross[order], upper=False)
    corner = cholesky(own - before.T @ before, "the covariance of new observations", kernel.remedy)
    factor = torch.cat([torch.cat([posterior.factor, torch.zeros_like(before)], 1), torch.cat([before.T, corner], 1)])

    # L^-1 y of the old rows is L^T times their weights; the observed numbers themselves need not be kept.
    whitened = posterior.factor.T @ posterior.weights[order]
    rest = torch.linalg.solve_triangular(corner, (y - before.T @ whitened)[:, None], upper=False)
    solved = torch.linalg.solve_triangular(factor.T, torch.cat([whitened[:, None], rest]), upper=True)[:, 0]

    has = torch.cat([posterior.has_normal, new.has_normal])
    points = torch.argsort(~has, stable=True)
    order = torch.cat([order, old + torch.arange(len(y), device=y.device)])
    order = _row_of_each(posterior.has_normal, new.has_normal)[order]
    weights = torch.empty_like(solved)
    weights[order] = solved
    return Posterior(torch.cat([posterior.x, new.x])[points], has[points], weights, factor, order, kernel)


def _rows(block: Float[Tensor, "4 q columns"], oriented: int) -> Float[Tensor, "rows columns"]:
    """Return the rows of points of which the first `oriented` only have normals."""
    return torch.cat([block[0], block[1:, :oriented].flatten(0, 1)])


def _row_of_each(old: Bool[Tensor, "n"], new: Bool[Tensor, "m"]) -> Int[Tensor, "rows"]:
    """Return where the rows of old and new points, listed one set after the other, are among the rows of both."""
    n, m, near, fresh = len(old), len(new), int(old.sum()), int(new.sum())
    total, oriented = n + m, near + fresh
    line = torch.arange(total, device=old.device)
    place = torch.cat([line[:near], oriented + line[: n - near]])  # of old points: those with normals stay first
    placed = torch.cat([near + line[:fresh], oriented + (n - near) + line[: m - fresh]])
    before = [place] + [total + c * oriented + line[:near] for c in range(3)]
    after = [placed] + [total + c * oriented + near + line[:fresh] for c in range(3)]
    return torch.cat(before + after)
