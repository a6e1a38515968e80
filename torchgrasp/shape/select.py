"""The most informative points of a cloud, by a pivoted Cholesky factorisation in blocks of four rows."""

from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.linalg import cholesky
from torchgrasp.shape.gp import REMEDY, Observations
from torchgrasp.shape.kernel import covariance, thin_plate


def select_points(
    x: Float[Tensor, "n 3"],
    known: Observations,
    budget: int,
    psi: float,
    distance_noise: float,
    normal_noise: float,
) -> Int[Tensor, "picks"]:
    """Return the points to observe with normals, each the one of the greatest posterior variance given the former.

    The choice needs no observed values, since a posterior variance does not. The covariance of the candidates is
    never refitted: their rows, whitened by the growing factor, are kept, so that a pick costs O(rows n). For 50 of
    1000 points that is 25 ms, against 250 ms for refitting.

    Args:
        x: candidates, normalised.
        known: what is observed already, e.g. points inside and outside.
        budget: greatest number of picks; all candidates in order of their variance if there are fewer.
        psi: parameter of the thin plate kernel.
        distance_noise, normal_noise: standard deviations with which a pick will be observed.

    Raises:
        IndefiniteCovariance: psi is too small for these points.
    """
    profile = partial(thin_plate, psi=psi)
    none = torch.zeros(len(x), dtype=torch.bool, device=x.device)
    one = torch.ones(1, dtype=torch.bool, device=x.device)
    _, noise = known.rows()
    n_known, budget = len(noise), min(budget, len(x))
    start = covariance(known.x, known.x, known.has_normal, known.has_normal, profile) + torch.diag_embed(noise)
    factor = x.new_zeros(n_known + 4 * budget, n_known + 4 * budget)
    factor[:n_known, :n_known] = cholesky(start, "the covariance K + sigma^2 I", REMEDY)
    whitened = x.new_zeros(n_known + 4 * budget, len(x))  # L^-1 K(observed, candidates), distance rows only
    whitened[:n_known] = torch.linalg.solve_triangular(
        factor[:n_known, :n_known], covariance(known.x, x, known.has_normal, none, profile), upper=False
    )
    variance = psi**3 - (whitened[:n_known] ** 2).sum(0)
    own = covariance(x[:1], x[:1], one, one, profile)
    own = own + torch.diag(x.new_tensor([distance_noise, normal_noise, normal_noise, normal_noise]) ** 2)

    picks: list[Tensor] = []
    observed = torch.empty(0, 3, dtype=x.dtype, device=x.device)
    for k in range(budget):
        rows, p = n_known + 4 * k, torch.argmax(variance)
        here = x[p][None]
        cross = [covariance(known.x, here, known.has_normal, one, profile)]
        if k:
            ones = one.expand(k)
            by_component = covariance(observed, here, ones, one, profile)
            # The factor grows point by point: (component, point) rows become (point, component) rows.
            cross.append(by_component.reshape(4, k, 4).transpose(0, 1).reshape(4 * k, 4))
        before = torch.linalg.solve_triangular(factor[:rows, :rows], torch.cat(cross), upper=False)
        corner = cholesky(own - before.T @ before, "the covariance of a picked point", REMEDY)
        new = covariance(here, x, one, none, profile) - before.T @ whitened[:rows]
        whitened[rows : rows + 4] = torch.linalg.solve_triangular(corner, new, upper=False)
        factor[rows : rows + 4, :rows] = before.T
        factor[rows : rows + 4, rows : rows + 4] = corner
        variance = variance - (whitened[rows : rows + 4] ** 2).sum(0)
        variance[p] = -torch.inf
        picks.append(p)
        observed = torch.cat([observed, here])
    return torch.stack(picks) if picks else torch.empty(0, dtype=torch.long, device=x.device)
