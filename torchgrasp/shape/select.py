"""The most informative points, by pivoted Cholesky in blocks of four rows."""

import dataclasses
import math
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.geometry.linalg import cholesky
from torchgrasp.shape.condition import posterior_given
from torchgrasp.shape.gradient_kernel import cross_covariance
from torchgrasp.shape.kernel import Kernel
from torchgrasp.shape.observations import Observations
from torchgrasp.shape.posterior import Posterior
from torchgrasp.shape.update import extend_posterior

Criterion = Literal["variance", "error", "both"]


@dataclasses.dataclass(frozen=True)
class Selection(Value):
    """Rows of the picks, in order, and the posterior given them."""

    picks: Int[Tensor, "picks"]
    posterior: Posterior


def select_points(
    candidates: Observations,
    known: Observations,
    kernel: Kernel,
    budget: int,
    criterion: Criterion = "variance",
    stop: float = -math.inf,
) -> Selection:
    """Pick candidates to observe, each the most informative given the former.

    One Cholesky factor grows by four rows a pick. It becomes the posterior's own.

    Args:
        candidates: points of the surface, all with normals.
        known: what is observed already, such as points inside and outside.
        criterion: greatest posterior variance; greatest |mean distance| ("error"); |mean| + 2 sqrt(variance) ("both").
        stop: the selection ends when no candidate has a greater variance.
    """
    x, start = candidates.x, posterior_given(known, kernel)
    n, budget = len(x), min(budget, len(x))
    old, rows = len(start.factor), len(start.factor) + 4 * budget
    factor = x.new_zeros(rows, rows).T  # by columns, as the solver wants it: it copies any other matrix
    factor[:old, :old] = start.factor
    with_known = start.cross(x)
    whitened = x.new_empty(rows, n + 1)  # L^-1 [K(observed, distances of candidates), y]
    whitened[:old, :n] = torch.linalg.solve_triangular(start.factor, with_known[0].T, upper=False)
    whitened[:old, n] = start.factor.T @ start.weights
    variance = kernel.profile(x.new_zeros(())) - (whitened[:old, :n] ** 2).sum(0)
    error = whitened[:old, n] @ whitened[:old, :n]
    prior = start.prior_block()
    noise = torch.stack([candidates.distance_noise] + 3 * [candidates.normal_noise], 1) ** 2
    values = torch.cat([candidates.distance[:, None], candidates.normal], 1)

    picks = torch.empty(budget, dtype=torch.long, device=x.device)
    free = torch.zeros_like(error)  # minus infinity for the picks
    count = 0
    while count < budget:
        if stop > -math.inf and float((free + variance).max()) <= stop:
            break
        p = torch.argmax(free + _score(criterion, variance, error), keepdim=True)
        end, new = old + 4 * count, slice(old + 4 * count, old + 4 * count + 4)
        # (d, w) of the pick with (d, w) of every candidate; rows of the factor go pick by pick
        with_all = cross_covariance(kernel, x[p], x, n).view(4, 4, n)
        with_picks = with_all[:, :, picks[:count]].permute(2, 1, 0).reshape(4 * count, 4)
        cross = torch.cat([with_known[:, p].squeeze(1).T, with_picks])
        before = torch.linalg.solve_triangular(factor[:end, :end], cross, upper=False)
        own = prior + torch.diag(noise[p][0])
        corner = cholesky(own - before.T @ before, "the covariance of a picked point", kernel.remedy)
        left = torch.cat([with_all[:, 0], values[p].T], 1).addmm_(before.T, whitened[:end], alpha=-1.0)
        factor[new, :end], factor[new, new] = before.T, corner
        whitened[new] = torch.linalg.solve_triangular(corner, left, upper=False)
        variance -= (whitened[new, :n] ** 2).sum(0)
        error += whitened[new, n] @ whitened[new, :n]
        picks[count] = p[0]
        free.index_fill_(0, p, -math.inf)
        count += 1
    picks, rows = picks[:count], old + 4 * count
    by_pick = torch.arange(4 * count, device=x.device).reshape(4, count).T.flatten()
    observed = candidates[picks]
    return Selection(picks, extend_posterior(start, observed, factor[:rows, :rows], whitened[:rows, n], by_pick))


def _score(criterion: Criterion, variance: Float[Tensor, "n"], error: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Return how informative the candidates are."""
    if criterion == "variance":
        return variance
    if criterion == "error":
        return error.abs()
    return error.abs() + 2.0 * torch.sqrt(variance.clamp_min(0.0))  # negative by rounding alone
