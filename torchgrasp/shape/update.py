"""Later observations, as rows appended to the Cholesky factor."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.geometry.linalg import cholesky
from torchgrasp.shape.gradient_kernel import covariance_rows, gram
from torchgrasp.shape.observations import Observations
from torchgrasp.shape.posterior import Posterior


def append_observations(
    posterior: Posterior, new: Observations, shared: Float[Tensor, "n c"] | None = None
) -> Posterior:
    """Return the posterior given `new` observations, too, as if all had come at once.

    The factor L grows by the rows [B^T, C] with B = L^-1 K(old, new). C is the factor of K(new, new) + noise - B^T B.

    `shared` holds correlated errors of the new distances, a column of deviations for each independent cause. They add
    shared shared^T to the noise.
    """
    kernel = posterior.kernel
    if shared is not None:
        shared = shared[torch.argsort(~new.has_normal, stable=True)]
    new = new.with_normals_first()
    y, noise = new.rows()
    fresh = int(new.has_normal.sum())
    cross = covariance_rows(kernel, posterior.x, posterior.n_oriented, new.x, fresh)
    own = gram(kernel, new.x, fresh) + torch.diag_embed(noise)
    if shared is not None:
        own[: len(new.x), : len(new.x)] += shared @ shared.T
    before = torch.linalg.solve_triangular(posterior.factor, posterior.ordered(cross), upper=False)
    corner = cholesky(own - before.T @ before, "the covariance of new observations", kernel.remedy)
    factor = torch.cat([torch.cat([posterior.factor, torch.zeros_like(before)], 1), torch.cat([before.T, corner], 1)])

    # L^-1 y of the old rows is L^T times their weights; the observed numbers themselves need not be kept.
    whitened = posterior.factor.T @ posterior.ordered(posterior.weights)
    rest = torch.linalg.solve_triangular(corner, (y - before.T @ whitened)[:, None], upper=False)[:, 0]
    return extend_posterior(posterior, new, factor, torch.cat([whitened, rest]))


def extend_posterior(
    posterior: Posterior,
    new: Observations,
    factor: Float[Tensor, "rows rows"],
    whitened: Float[Tensor, "rows"],
    new_order: Int[Tensor, "fresh"] | None = None,
) -> Posterior:
    """Return the posterior given `new` observations, too, from the factor of all rows.

    In `new` points with normals are first. `whitened` is L^-1 y. `new_order` gives the row of `Observations.rows` for
    each new row of the factor; None: the same.
    """
    old, total = len(posterior.factor), len(factor)
    solved = torch.linalg.solve_triangular(factor.T, whitened[:, None], upper=True)[:, 0]
    line = torch.arange(total, device=factor.device)
    later = line[old:] if new_order is None else old + new_order
    order = _row_of_each(posterior.has_normal, new.has_normal)[torch.cat([posterior.ordered(line[:old]), later])]
    weights = torch.empty_like(solved)
    weights[order] = solved
    has = torch.cat([posterior.has_normal, new.has_normal])
    points = torch.argsort(~has, stable=True)
    x = torch.cat([posterior.x, new.x])[points]
    return Posterior(x, has[points], weights, factor, order, posterior.kernel)


def _row_of_each(old: Bool[Tensor, "n"], new: Bool[Tensor, "m"]) -> Int[Tensor, "rows"]:
    """Return the row in the joint order of each old and each new row."""
    n, m, near, fresh = len(old), len(new), int(old.sum()), int(new.sum())
    total, oriented = n + m, near + fresh
    line = torch.arange(total, device=old.device)
    moved = torch.cat([line[:near], oriented + line[: n - near]])  # of old points: those with normals stay first
    added = torch.cat([near + line[:fresh], oriented + (n - near) + line[: m - fresh]])
    before = [moved] + [total + c * oriented + line[:near] for c in range(3)]
    after = [added] + [total + c * oriented + near + line[:fresh] for c in range(3)]
    return torch.cat(before + after)
