"""The most informative points of a cloud, by a pivoted Cholesky factorisation in blocks of four rows."""

import math
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.errors import BadArgument
from torchgrasp.linalg import cholesky
from torchgrasp.shape.kernel import covariance
from torchgrasp.shape.observe import Observations
from torchgrasp.shape.profiles import Kernel, kernel_by_name

Criterion = Literal["variance", "error", "both"]


def select_points(
    x: Float[Tensor, "n 3"],
    known: Observations,
    budget: int,
    psi: float,
    distance_noise: float,
    normal_noise: float,
    *,
    kernel: str | Kernel = "thin_plate",
    criterion: Criterion = "variance",
    normals: Float[Tensor, "n 3"] | None = None,
    stop: float = -math.inf,
) -> Int[Tensor, "picks"]:
    """Return the points of the surface to observe with normals, each the most informative one given the former.

    The most informative point has the greatest posterior variance; or the greatest error, its mean signed distance
    instead of 0; or the greatest |error| + 2 sqrt(variance). Only the first needs no observed values. The covariance
    of the candidates is never refitted: their rows, whitened by the growing factor, are kept, so that a pick costs
    O(rows n). For 50 of 1000 points that is 25 ms, against 250 ms for refitting.

    Args:
        x: candidates, normalised.
        known: what is observed already, e.g. points inside and outside.
        budget: greatest number of picks; all candidates in order of their variance if there are fewer.
        psi: length of the kernel, normalised.
        distance_noise, normal_noise: standard deviations with which a pick will be observed.
        kernel: as for `condition`.
        criterion: "variance", "error" or "both".
        normals: unit normals of the candidates, which "error" and "both" need.
        stop: picking ends as soon as the criterion of the best point is no greater. For "variance" and
            `stop=distance_noise` that is after 22 to 40 of 1000 points of the project's four objects.

    Raises:
        BadArgument: an unknown criterion, or no normals for one that needs them.
        IndefiniteCovariance: psi is too small for these points.
    """
    if criterion not in ("variance", "error", "both"):
        raise BadArgument("criterion", repr(criterion), "'variance', 'error' or 'both'")
    if criterion != "variance" and normals is None:
        raise BadArgument("normals", None, f"the candidates' unit normals, for the criterion {criterion!r}")
    kernel = kernel_by_name(kernel, psi) if isinstance(kernel, str) else kernel
    profile = kernel.profile
    none = torch.zeros(len(x), dtype=torch.bool, device=x.device)
    one = torch.ones(1, dtype=torch.bool, device=x.device)
    known = known.with_normals_first()
    y, noise = known.rows()
    n_known, budget = len(noise), min(budget, len(x))
    start = covariance(known.x, known.x, known.has_normal, known.has_normal, profile) + torch.diag_embed(noise)
    factor = x.new_zeros(n_known + 4 * budget, n_known + 4 * budget)
    factor[:n_known, :n_known] = cholesky(start, "the covariance K + sigma^2 I", kernel.remedy)
    whitened = x.new_zeros(n_known + 4 * budget, len(x))  # L^-1 K(observed, candidates), distance rows only
    whitened[:n_known] = torch.linalg.solve_triangular(
        factor[:n_known, :n_known], covariance(known.x, x, known.has_normal, none, profile), upper=False
    )
    own = covariance(x[:1], x[:1], one, one, profile)
    variance = own[0, 0] - (whitened[:n_known] ** 2).sum(0)
    z = torch.linalg.solve_triangular(factor[:n_known, :n_known], y[:, None], upper=False)  # L^-1 y
    error = (whitened[:n_known] * z).sum(0)
    own = own + torch.diag(x.new_tensor([distance_noise, normal_noise, normal_noise, normal_noise]) ** 2)

    picks: list[Tensor] = []
    observed = torch.empty(0, 3, dtype=x.dtype, device=x.device)
    for k in range(budget):
        spread = torch.sqrt(variance.clamp_min(0.0))  # of points not picked; only rounding makes it negative
        score = {"variance": variance, "error": error.abs(), "both": error.abs() + 2.0 * spread}[criterion]
        if picks:
            score[torch.stack(picks)] = -torch.inf
        rows, p = n_known + 4 * k, torch.argmax(score)
        if float(score[p]) <= stop:
            break
        here = x[p][None]
        cross = [covariance(known.x, here, known.has_normal, one, profile)]
        if k:
            ones = one.expand(k)
            by_component = covariance(observed, here, ones, one, profile)
            # The factor grows point by point: (component, point) rows become (point, component) rows.
            cross.append(by_component.reshape(4, k, 4).transpose(0, 1).reshape(4 * k, 4))
        before = torch.linalg.solve_triangular(factor[:rows, :rows], torch.cat(cross), upper=False)
        corner = cholesky(own - before.T @ before, "the covariance of a picked point", kernel.remedy)
        new = covariance(here, x, one, none, profile) - before.T @ whitened[:rows]
        whitened[rows : rows + 4] = torch.linalg.solve_triangular(corner, new, upper=False)
        factor[rows : rows + 4, :rows] = before.T
        factor[rows : rows + 4, rows : rows + 4] = corner
        variance = variance - (whitened[rows : rows + 4] ** 2).sum(0)
        if normals is not None:
            value = torch.cat([x.new_zeros(1), normals[p]])[:, None]
            new_z = torch.linalg.solve_triangular(corner, value - before.T @ z, upper=False)
            error = error + (whitened[rows : rows + 4] * new_z).sum(0)
            z = torch.cat([z, new_z])
        picks.append(p)
        observed = torch.cat([observed, here])
    return torch.stack(picks) if picks else torch.empty(0, dtype=torch.long, device=x.device)
