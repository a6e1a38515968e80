"""The posterior given observations, Eqs. (7)-(8) of the paper: all at once, added later, or the
most informative.

All is in the normalised frame, without units. Each function builds one Cholesky factor L of K +
noise, the covariance of the observed numbers. Further observations append rows to L.
"""

import dataclasses
import math
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Value, map_tensors
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.fused import is_fused
from torchgrasp.foundation.rules import is_known
from torchgrasp.geometry.linalg import Points, cholesky, norm
from torchgrasp.shape.estimate import Observations
from torchgrasp.shape.kernel import Kernel, covariance_rows, cross_covariance, gram, is_thin
from torchgrasp.shape.posterior import Posterior

Criterion = Literal["variance", "error", "both"]
# factor that lowers a bound on distances by more than rounding
BELOW = 1.0 - 1e-9
# least covariance of neighbouring points, as a share of the variance, of a kernel that is of use
TIED = 0.05


def posterior_given(observations: Observations, kernel: Kernel) -> Posterior:
    """Return the Gaussian process (`Posterior`) of the signed distance, given observations and a
    kernel.

    It computes one Cholesky factor, that of the covariance of all observed numbers. Raises
    `IndefiniteCovariance` if this covariance is not positive definite.
    """
    observations = observations.with_normals_first()
    y, noise = observations.rows()
    near = int(observations.has_normal.sum())
    matrix = gram(kernel, observations.x, near) + torch.diag_embed(noise)
    factor = cholesky(matrix, "the covariance K + sigma^2 I", kernel.remedy)
    weights = torch.cholesky_solve(y[:, None], factor)[:, 0]
    return Posterior(observations.x, observations.has_normal, weights, factor, None, kernel)


def check_kernel(posterior: Posterior, least_noise: float) -> None:
    """Raise `IndefiniteCovariance` if the covariance K of the observations is indefinite.

    That can happen if observations are farther apart than the kernel's `diameter`; only then is it
    tested. `least_noise` is the least standard deviation of the observations, normalised. Its
    square is added to the diagonal of K.
    """
    kernel = posterior.kernel
    posterior = map_tensors(torch.detach, posterior)
    if longest_distance(posterior.x) > kernel.diameter:
        matrix = gram(kernel, posterior.x, posterior.n_oriented)
        # greater noise of some observations can hide an indefinite K
        matrix.diagonal().add_(least_noise**2)
        cholesky(matrix, "the covariance K", kernel.remedy)


def check_reach(posterior: Posterior) -> None:
    """Raise `BadArgument` for a kernel so short that neighbouring points are almost independent.

    The covariance at the median distance of nearest neighbours is then below a twentieth of the
    variance (`TIED`). The surface would be known at its points alone, as with a length in metres.
    """
    x = posterior.x
    if not is_known(x) or len(x) < 2:
        return
    x = x.detach()
    away = torch.cdist(x, x, compute_mode="donot_use_mm_for_euclid_dist")
    away.fill_diagonal_(torch.inf)
    near = away.amin(1).median()
    (covariance,) = posterior.kernel.derivatives(torch.stack([torch.zeros_like(near), near]), 1)
    if is_known(covariance) and float(covariance[1].detach()) < TIED * float(
        covariance[0].detach()
    ):
        share = float((covariance[1] / covariance[0]).detach())
        found = f"one whose covariance {float(near):.3g} apart is {share:.2g} of its variance"
        allowed = "a longer one: its distances are normalised, one unit is the shape's scale"
        raise BadArgument("kernel", found, allowed)


def longest_distance(x: Points) -> float:
    """Return the longest distance between any two of the points (n, 3), in their unit."""
    x = x.detach()
    away = norm(x - x.mean(0))
    # no pair is farther apart than the sum of its distances from the middle
    known = norm(x - x[away.argmax()]).max()
    ends = x[away + away.max() >= BELOW * known]
    return float(torch.cdist(ends, ends, compute_mode="donot_use_mm_for_euclid_dist").max())


def append_observations(
    old: Posterior,
    new: Observations,
    shared: Float[Tensor, "n c"] | None = None,
) -> Posterior:
    """Return the posterior given the observations of the `old` posterior and the `new` ones.

    It equals conditioning on all at once. The Cholesky factor L of the covariance K + noise grows
    by the rows [B^T, C] with B = L^-1 K(old, new). C is the factor of K(new, new) + noise - B^T B.
    `shared` (n, c) holds correlated errors of the n new distances, normalised: a column for each of
    c independent causes. Raises `IndefiniteCovariance` if the grown covariance is not positive
    definite.
    """
    kernel = old.kernel
    if shared is not None:
        shared = shared[torch.argsort(~new.has_normal, stable=True)]
    new = new.with_normals_first()
    y, noise = new.rows()
    fresh = int(new.has_normal.sum())
    cross = covariance_rows(kernel, old.x, old.n_oriented, new.x, fresh)
    own = gram(kernel, new.x, fresh) + torch.diag_embed(noise)
    if shared is not None:
        own[: len(new.x), : len(new.x)] += shared @ shared.T
    before = torch.linalg.solve_triangular(old.factor, old.ordered(cross), upper=False)
    corner = cholesky(own - before.T @ before, "the covariance of new observations", kernel.remedy)
    above = torch.cat([old.factor, torch.zeros_like(before)], 1)
    factor = torch.cat([above, torch.cat([before.T, corner], 1)])

    # L^-1 y of the old rows is L^T times their weights; the observed numbers themselves need not be
    # kept.
    whitened = old.factor.T @ old.ordered(old.weights)
    rest = (y - before.T @ whitened)[:, None]
    rest = torch.linalg.solve_triangular(corner, rest, upper=False)[:, 0]
    return _extend(old, new, factor, torch.cat([whitened, rest]))


@dataclasses.dataclass(frozen=True)
class Selection(Value):
    """The observations that were chosen among candidates as the most informative, and the posterior
    with them.
    """

    picks: Int[Tensor, "picks"]  # indices of the chosen candidates, in the order of their choice
    posterior: Posterior  # the Gaussian process given the known and the chosen observations


def select_points(
    candidates: Observations,
    known: Observations,
    kernel: Kernel,
    budget: int,
    criterion: Criterion = "variance",
    stop: float = -math.inf,
) -> Selection:
    """Return at most `budget` chosen candidates, and the posterior given them and the known
    observations.

    Each choice is the most informative candidate, given the known and the earlier chosen ones.

    Args:
        candidates: observations to choose from, all with normals.
        known: observations that are given.
        kernel: kernel of the posterior.
        budget: largest number of chosen candidates.
        criterion: what is greatest at the most informative candidate. It is the "variance" of its
            distance, the "error" of the predicted distance, or with "both" |error| + 2
            sqrt(variance).
        stop: the selection ends when no candidate's variance (squared normalised units) exceeds it.

    Each choice appends four rows to the Cholesky factor.
    """
    start = posterior_given(known, kernel)
    budget = min(budget, len(candidates.x))
    choose = choose_points
    if is_fused(candidates.x) and is_thin(kernel):
        from torchgrasp.shape import fused_selection  # it imports numba

        choose = fused_selection.choose_points
    picks, factor, whitened = choose(start, candidates, budget, criterion, stop)
    count = len(picks)
    by_pick = torch.arange(4 * count, device=picks.device)
    by_pick = by_pick.reshape(4, count).T.flatten()
    return Selection(picks, _extend(start, candidates[picks], factor, whitened, by_pick))


def choose_points(
    start: Posterior,
    candidates: Observations,
    budget: int,
    criterion: Criterion,
    stop: float,
) -> tuple[Int[Tensor, "picks"], Float[Tensor, "rows rows"], Float[Tensor, "rows"]]:
    """Return (picks, L, L^-1 y): the chosen observations, and the Cholesky factor that includes
    them.

    `picks` are the indices of at most `budget` candidates, in the order of their choice. `start` is
    the posterior given the known observations, whose Cholesky factor grows to L by four rows for
    each pick. y are the observed numbers: those of `start`, then those of each pick. `criterion`
    says what is greatest at a pick: "variance", "error" or "both", as for `select_points`. `stop`
    is the variance (squared normalised units) below which no pick is made.
    """
    x = candidates.x
    kernel = start.kernel
    n = len(x)
    old = len(start.factor)
    rows = old + 4 * budget
    # by columns, as the solver wants it: it copies any other matrix
    factor = x.new_zeros(rows, rows).T
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
        end = old + 4 * count
        new = slice(end, end + 4)
        with_candidates, with_picks = _pick_covariances(kernel, x, p, picks[:count])
        cross = torch.cat([with_known[:, p].squeeze(1).T, with_picks])
        before = torch.linalg.solve_triangular(factor[:end, :end], cross, upper=False)
        own = prior + torch.diag(noise[p][0])
        own = own - before.T @ before
        corner = cholesky(own, "the covariance of a picked point", kernel.remedy)
        left = torch.cat([with_candidates, values[p].T], 1)
        left.addmm_(before.T, whitened[:end], alpha=-1.0)
        factor[new, :end] = before.T
        factor[new, new] = corner
        whitened[new] = torch.linalg.solve_triangular(corner, left, upper=False)
        variance -= (whitened[new, :n] ** 2).sum(0)
        error += whitened[new, n] @ whitened[new, :n]
        picks[count] = p[0]
        free.index_fill_(0, p, -math.inf)
        count += 1
    rows = old + 4 * count
    return picks[:count], factor[:rows, :rows], whitened[:rows, n]


def _pick_covariances(
    kernel: Kernel,
    x: Points,
    p: Int[Tensor, "1"],
    picks: Int[Tensor, "picks"],
) -> tuple[Float[Tensor, "4 n"], Float[Tensor, "rows 4"]]:
    """Return the prior covariances of (d, w) at the point with the index `p`.

    First with the distances at all n points `x`, then with (d, w) at the points `picks`: four rows
    for each.
    """
    with_all = cross_covariance(kernel, x[p], x, len(x)).view(4, 4, len(x))
    with_picks = with_all[:, :, picks].permute(2, 1, 0)
    return with_all[:, 0], with_picks.reshape(4 * len(picks), 4)


def _score(
    criterion: Criterion,
    variance: Float[Tensor, "n"],
    error: Float[Tensor, "n"],
) -> Float[Tensor, "n"]:
    """Return a score of each candidate point: the higher, the more an observation of the point
    reduces the uncertainty.
    """
    if criterion == "variance":
        return variance
    if criterion == "error":
        return error.abs()
    return error.abs() + 2.0 * torch.sqrt(variance.clamp_min(0.0))  # negative by rounding alone


def _extend(
    posterior: Posterior,
    new: Observations,
    factor: Float[Tensor, "rows rows"],
    whitened: Float[Tensor, "rows"],
    new_order: Int[Tensor, "fresh"] | None = None,
) -> Posterior:
    """Return the posterior given `new` observations too, from the grown Cholesky factor L and
    `whitened` = L^-1 y.

    `new_order` gives, for each new row of L, its place in `new.rows()`; by default, the order is
    the same.
    """
    n = len(posterior.x)
    has = torch.cat([posterior.has_normal, new.has_normal])
    points = torch.argsort(~has, stable=True)
    place = torch.argsort(points)
    near = int(has.sum())

    # rows of some points after joining: distances of all points, then normals by component
    def rows(at: Int[Tensor, "n"], has_normal: Bool[Tensor, "n"]) -> Int[Tensor, "rows"]:
        return torch.cat([at, *(len(has) + c * near + at[has_normal] for c in range(3))])

    old = posterior.ordered(rows(place[:n], posterior.has_normal))
    fresh = rows(place[n:], new.has_normal)
    order = torch.cat([old, fresh if new_order is None else fresh[new_order]])
    solved = torch.linalg.solve_triangular(factor.T, whitened[:, None], upper=True)[:, 0]
    weights = solved[torch.argsort(order)]
    return Posterior(
        torch.cat([posterior.x, new.x])[points],
        has[points],
        weights,
        factor,
        order,
        posterior.kernel,
    )
