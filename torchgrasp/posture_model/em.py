"""Expectation-maximisation of Gaussian mixtures (Eqs. 19-20), in one process or in several.

torchrun starts several processes, which each hold a part of the data. A data row x is one sample of
d numbers. The log-density of a Gaussian is linear in its f features [1, x_i, x_i x_j]. So each step
is one matrix product. Sums of the features, weighted by responsibilities, suffice for the
maximisation and are small enough to add over processes. The data must have mean 0 and variance 1 in
every column. Otherwise differences of such sums would lose their digits. All numbers are therefore
standardised, without unit. n counts samples, m the Gaussians (components) of the mixture.
"""

import dataclasses
import math
from collections.abc import Callable

import torch
import torch.distributed
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Value, flatnonzero, row_numbers
from torchgrasp.foundation.errors import BadArgument, IndefiniteCovariance
from torchgrasp.geometry.linalg import dot, eye_like, matvec
from torchgrasp.posture_model.gaussian import whitening_matrices


@dataclasses.dataclass(frozen=True)
class EmNumbers:
    """Parameters of expectation-maximisation and of its start by k-means."""

    cached_rows: int = 2048
    """Number of samples (data rows) in one pass on a CPU. Their features and responsibilities stay
    in the cache.
    """
    device_rows: int = 2**17
    """Number of samples in one pass on a GPU, which smaller passes leave idle."""
    singular: float = 1e-12
    """Greatest conditional variance that counts as rounding; the variance of the data is 1."""
    most_reseeds: int = 3
    """Greatest number of times that a component may collapse: with more, the data support fewer
    components.
    """
    drawn: int = 20_000
    """Number of samples from which k-means++ draws the first means: some hundred for each
    component.
    """
    lloyd_steps: int = 10
    """Number of steps of k-means. EM follows, so the clusters need not converge."""


EM = EmNumbers()


@dataclasses.dataclass(frozen=True)
class EmRule:
    """The bounds at which a fit by expectation-maximisation (EM) ends, and the variance that it
    adds.
    """

    iterations: int
    """Greatest number of EM steps, including those before the state from which the fit starts."""
    tolerance: float
    """Least rise [nats] of the mean log-likelihood in a step, after which the fit goes on."""
    regularisation: float
    """Variance that is added in each dimension of a component; the variance of the data is 1."""


@dataclasses.dataclass(frozen=True)
class DataRows:
    """The samples (data rows) that one process has in a fit by several processes.

    These processes form the default group of torch.distributed.
    """

    # n samples of d numbers, standardised: each dimension has mean 0 and variance 1
    rows: Float[Tensor, "n d"]
    rank: int = 0  # index of this process among all
    processes: int = 1  # number of processes

    @staticmethod
    def of(rows: Float[Tensor, "n d"], distributed: bool) -> "DataRows":
        """Return `rows`, this process's own part of the data, with its rank and the number of
        processes.

        The rows are not divided here. If `distributed`, both numbers are those of the default group
        of torch.distributed; otherwise the process is alone. Raises `BadArgument` if `distributed`
        is True without such a group.
        """
        if not distributed:
            return DataRows(rows)
        if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
            allowed = "True after torch.distributed.init_process_group, as under torchrun"
            raise BadArgument("distributed", "True in a process without a group", allowed)
        return DataRows(rows, torch.distributed.get_rank(), torch.distributed.get_world_size())

    def sum(self, x: Tensor) -> Tensor:
        """Return the sum of the tensor `x` over all processes, entry by entry; every process gets
        the same bits.
        """
        if self.processes > 1:
            x = x.clone()
            torch.distributed.all_reduce(x)
        return x

    def count(self) -> int:
        """Return the number of samples (rows) in all processes together."""
        return int(self.sum(self.rows.new_tensor(len(self.rows), dtype=torch.int64)))

    def lengths(self) -> Int[Tensor, "p"]:
        """Return the number of samples (rows) in each of the p processes."""
        lengths = self.rows.new_zeros(self.processes, dtype=torch.int64)
        lengths[self.rank] = len(self.rows)
        return self.sum(lengths)


@dataclasses.dataclass(frozen=True)
class Components(Value):
    """The m Gaussians of a mixture in d dimensions: weights, means and covariances (Eqs. 19-20 of
    the paper).

    `FitProgress` reports them during a fit. The dimensions are then standardised: each has mean 0
    and variance 1 over the samples.

    Attributes:
        weights: shares (m,) of the Gaussians, of sum 1.
        means: means (m, d).
        covariances: covariances (m, d, d).

    >>> Components(torch.ones(1), torch.zeros(1, 2), torch.eye(2)[None]).means.shape
    torch.Size([1, 2])
    """

    weights: Float[Tensor, "m"]
    means: Float[Tensor, "m d"]
    covariances: Float[Tensor, "m d d"]


@dataclasses.dataclass(frozen=True)
class FitProgress(Value):
    """The state of a fit of m Gaussians after t steps of EM; `fit_mixture` gives it to its
    `observer`.

    Attributes:
        components: the Gaussians, in standardised dimensions.
        reseeded: number of times (m,) that each Gaussian was placed anew. The reason is a singular
            covariance, or too few samples. The likelihood may fall after that.
        log_likelihood: mean log-likelihood (t,) [nats] of the standardised data before each step.
        jumped: whether the likelihood may fall in the next step. It may if the last step has placed
            a Gaussian anew. It also may if the next step uses another subset of the samples (the
            argument `subset` of `fit_mixture`).
        rows: number of samples that the last step used; 0 before the first step.

    >>> start = Components(torch.ones(1), torch.zeros(1, 2), torch.eye(2)[None])
    >>> FitProgress(start, torch.zeros(1, dtype=torch.int64), torch.zeros(0)).jumped
    False
    """

    components: Components
    reseeded: Int[Tensor, "m"]
    log_likelihood: Float[Tensor, "t"]
    jumped: bool = False
    rows: int = 0


@dataclasses.dataclass(frozen=True)
class Fit(FitProgress):
    """The result of a fit of m Gaussians by expectation-maximisation (EM).

    The attributes are those of `FitProgress`, but `log_likelihood` has one value more, that of the
    final `components`. `converged` says whether the last step raised the log-likelihood by less
    than the tolerance.
    """

    converged: bool = False

    def resumed(self) -> FitProgress:
        """Return the state from which EM can continue this fit.

        It lacks the last value of `log_likelihood`, which the next step computes again.
        """
        history = self.log_likelihood[:-1]
        return FitProgress(self.components, self.reseeded, history, self.jumped, self.rows)


def likeliest(starts: list[FitProgress], fit: Callable[[FitProgress], Fit]) -> FitProgress:
    """Return the best of several `starts` of EM, after a fit from each by the function `fit`.

    The result is the final state of the fit whose last log-likelihood is greatest; EM can continue
    from it. A single start is returned unfitted.
    """
    if len(starts) == 1:
        return starts[0]
    return max(map(fit, starts), key=lambda found: float(found.log_likelihood[-1])).resumed()


def expectation_maximisation(
    shard: DataRows,
    start: FitProgress,
    rule: EmRule,
    observer: Callable[[FitProgress], None] = lambda progress: None,
) -> Fit:
    """Fit a mixture by EM steps from the state `start`, until convergence or the last allowed step.

    `rule` gives the tolerance of convergence and the greatest number of steps. `shard` holds the
    data rows of this process; `observer` is called with the state after each step. Raises
    `IndefiniteCovariance` for a start with an indefinite covariance. Raises it also if a component
    collapses more than three times: singular covariance, or too few samples.
    """
    n = shard.count()
    state = start
    while True:
        sums, log_likelihood = expectation(shard, state.components)
        history = torch.cat([state.log_likelihood, (log_likelihood / n)[None]])
        known = len(history) > 1 and not state.jumped
        converged = known and float(history[-1] - history[-2]) < rule.tolerance
        if converged or len(history) > rule.iterations:
            return Fit(state.components, state.reseeded, history, state.jumped, n, converged)
        components, reseeded = maximisation(sums, n, rule.regularisation, state.reseeded)
        state = FitProgress(components, reseeded, history, reseeded is not state.reseeded, n)
        observer(state)


def expectation(
    shard: DataRows, components: Components
) -> tuple[Float[Tensor, "m f"], Float[Tensor, ""]]:
    """Return the results of an E step of EM: (sums, log-likelihood) of all data under m components.

    `sums` (m, f) are over the data rows x of all processes. What is summed are the f features 1,
    x_i and x_i x_j (i <= j) of a row. Their weight is each component's responsibility for the row.
    The log-likelihood [nats] is the total of all rows.
    """
    x = shard.rows
    coefficients = coefficients_from_components(components)
    sums = torch.zeros_like(coefficients)
    log_likelihood = x.new_zeros(())
    at_once = EM.cached_rows if x.device.type == "cpu" else EM.device_rows
    at_once = min(at_once, len(x) or 1)
    # Every pass uses these again.
    features = x.new_empty(coefficients.shape[1], at_once)
    joint = x.new_empty(len(coefficients), at_once)
    floor = math.log(torch.finfo(x.dtype).tiny) / 2  # far below rounding; denormal numbers are slow
    for rows in x.split(at_once):
        phi = features_from_data(rows, features[:, : len(rows)])
        # log joint density (m, rows), then log-sum-exp written out: its exponentials are the
        # responsibilities
        responsibility = torch.mm(coefficients, phi, out=joint[:, : len(rows)])
        largest = responsibility.amax(0)
        density = responsibility.sub_(largest).clamp_(min=floor).exp_().sum(0)
        sums.addmm_(responsibility.div_(density), phi.T)
        log_likelihood += (density.log() + largest).sum()
    statistics = shard.sum(torch.cat([sums.flatten(), log_likelihood[None]]))
    return statistics[:-1].reshape(sums.shape), statistics[-1]


def features_from_data(
    x: Float[Tensor, "n d"], out: Float[Tensor, "f n"] | None = None
) -> Float[Tensor, "f n"]:
    """Return the f features [1, x_i, x_i x_j (i <= j)] of each data row x, as a column.

    The data `x` are n rows of d numbers. So f is 1 + d + d (d + 1) / 2. `out` is a buffer to write
    into; None makes a new tensor.
    """
    n, d = x.shape
    out = x.new_empty(1 + d + d * (d + 1) // 2, n) if out is None else out
    out[0] = 1
    columns = out[1 : 1 + d].copy_(x.T)
    for i, product in enumerate(out[1 + d :].split(list(range(d, 0, -1)))):
        torch.mul(columns[i:], columns[i], out=product)
    return out


def coefficients_from_components(components: Components) -> Float[Tensor, "m f"]:
    """Return the coefficients of the f features (`features_from_data`) in each component's log
    joint density.

    This density is log(weight) + log N(x | mean, covariance). It is linear in the features 1, x_i
    and x_i x_j of a point x.
    """
    means = components.means
    d = means.shape[1]
    whitening = whitening_matrices(components.covariances)
    precision = whitening.mT @ whitening
    linear = matvec(precision, means)
    log_scale = whitening.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    constant = (
        components.weights.log()
        - 0.5 * d * math.log(2 * math.pi)
        + log_scale
        - 0.5 * dot(linear, means)
    )
    i, j = torch.triu_indices(d, d, device=means.device)
    # A mixed product occurs twice in the square.
    quadratic = precision[:, i, j] * torch.where(i == j, -0.5, -1.0)
    return torch.cat([constant[:, None], linear, quadratic], dim=1)


def maximisation(
    sums: Float[Tensor, "m f"], n: int, regularisation: float, reseeded: Int[Tensor, "m"]
) -> tuple[Components, Int[Tensor, "m"]]:
    """Return the results of the M step of EM: the components of greatest likelihood, and how often
    each has collapsed so far, (m,).

    Args:
        sums: sums over all rows of the f features (`features_from_data`), weighted by each
            component's responsibilities.
        n: number of rows.
        regularisation: added to every variance; the variance of the data is 1.
        reseeded: how often each component has collapsed before.

    A component in d dimensions collapses if its covariance is singular or it has fewer than d + 1
    rows. It is replaced by half of the heaviest component, split across its longest axis. Raises
    `IndefiniteCovariance` if a component collapses more than three times (`EM.most_reseeds`).
    """
    components = components_from_sums(sums, n, regularisation)
    covariances = components.covariances
    factor, info = torch.linalg.cholesky_ex(covariances)
    variances = factor.diagonal(dim1=-2, dim2=-1) ** 2  # (m, d), each given those before it
    regular = (info == 0) & (variances > EM.singular).all(-1)
    collapsed = (sums[:, 0] < covariances.shape[-1] + 1) | ~regular
    if bool(collapsed.any()):
        reseeded = reseeded + collapsed
        if bool(collapsed.all()) or int(reseeded.max()) > EM.most_reseeds:
            k = int(reseeded.argmax())
            smallest = 0.0
            if bool(covariances[k].isfinite().all()):
                smallest = float(torch.linalg.eigvalsh(covariances[k]).min())
            what = (
                f"the covariance of component {k}, of {float(sums[k, 0]):.1f} rows, "
                f"collapsed {int(reseeded[k])} times,"
            )
            raise IndefiniteCovariance(what, smallest, "use fewer components or more samples")
        components = _split_heaviest(components, collapsed)
    weights = components.weights / components.weights.sum()
    return dataclasses.replace(components, weights=weights), reseeded


def _split_heaviest(components: Components, collapsed: Bool[Tensor, "m"]) -> Components:
    """Replace each `collapsed` component by half of the heaviest, split across its longest axis."""
    weights = components.weights.clone()
    means = components.means.clone()
    covariances = components.covariances.clone()
    weights[collapsed] = 0
    for k in flatnonzero(collapsed).tolist():
        heaviest = int(weights.argmax())
        spread, axes = torch.linalg.eigh(covariances[heaviest])
        half = 0.5 * spread[-1].sqrt() * axes[:, -1]
        weights[[k, heaviest]] = weights[heaviest] / 2
        middle = means[heaviest].clone()
        means[k] = middle + half
        means[heaviest] = middle - half
        covariances[k] = covariances[heaviest]
    return Components(weights, means, covariances)


def components_from_sums(sums: Float[Tensor, "m f"], n: int, regularisation: float) -> Components:
    """Return weights, means and covariances of m components, given weighted sums over n data rows.

    `sums` (m, f) are of the f features (`features_from_data`), weighted by each component's
    responsibilities. `regularisation` is added to every variance. A component without data gets
    NaN.
    """
    # from the number of features, 1 + d + d (d + 1) / 2
    d = round((math.sqrt(8 * sums.shape[1] + 1) - 3) / 2)
    count = sums[:, :1]
    means = sums[:, 1 : d + 1] / count
    i, j = torch.triu_indices(d, d, device=sums.device)
    second = sums.new_zeros(len(sums), d, d)
    second[:, i, j] = sums[:, d + 1 :] / count
    second[:, j, i] = second[:, i, j]
    covariances = second - means[:, :, None] * means[:, None, :]
    return Components(count[:, 0] / n, means, covariances + regularisation * eye_like(d, sums))


def start_components(shard: DataRows, m: int, seed: int, regularisation: float) -> FitProgress:
    """Return the initial state of a fit: m Gaussians, one for each cluster that k-means finds in
    the data of all processes.

    `shard` holds the data rows of this process. `regularisation` is added to every variance, and
    `seed` draws the first centres. Raises `BadArgument` for fewer than m distinct rows.
    """
    generator = torch.Generator().manual_seed(seed)
    centres = _plus_plus(_subsample(shard, generator), m, generator)

    def count_and_sum(x: Float[Tensor, "r d"]) -> Float[Tensor, "f r"]:
        return torch.cat([torch.ones_like(x[:, :1]), x], dim=1).T

    for _ in range(EM.lloyd_steps):
        sums = _sums_of_clusters(shard, centres, count_and_sum)
        # A centre without data stays.
        centres = torch.where(sums[:, :1] > 0, sums[:, 1:] / sums[:, :1], centres)
    sums = _sums_of_clusters(shard, centres, features_from_data)
    n = round(float(sums[:, 0].sum()))
    never = torch.zeros(m, dtype=torch.long, device=sums.device)
    components, reseeded = maximisation(sums, n, regularisation, never)
    return FitProgress(components, reseeded, sums.new_empty(0))


def _subsample(shard: DataRows, generator: torch.Generator) -> Float[Tensor, "s d"]:
    """Return random data rows, drawn from all processes; every process gets the same rows."""
    x = shard.rows
    lengths = shard.lengths()
    # The number of processes does not change the order.
    order = torch.randperm(int(lengths.sum()), generator=generator, device="cpu")
    pick = order[: EM.drawn].to(x.device) - lengths[: shard.rank].sum()
    here = (pick >= 0) & (pick < len(x))
    pool = x.new_zeros(len(pick), x.shape[1])
    pool[here] = x[pick[here]]
    return shard.sum(pool)


def _plus_plus(
    pool: Float[Tensor, "s d"], m: int, generator: torch.Generator
) -> Float[Tensor, "m d"]:
    """Return m initial cluster centres, drawn from the rows of `pool` by k-means++."""
    centres = pool[:1]
    squared = ((pool - centres) ** 2).sum(1)
    for k in range(1, m):
        if not bool((squared > 0).any()):
            allowed = f"at most {k}, the number of different rows of the data"
            raise BadArgument("components", m, allowed)
        pick = torch.multinomial(squared.cpu(), 1, generator=generator).to(pool.device)
        centres = torch.cat([centres, pool[pick]])
        squared = torch.minimum(squared, ((pool - pool[pick]) ** 2).sum(1))
    return centres


def _sums_of_clusters(
    shard: DataRows,
    centres: Float[Tensor, "m d"],
    features: Callable[[Float[Tensor, "r d"]], Float[Tensor, "f r"]],
) -> Float[Tensor, "m f"]:
    """Return for each cluster the sum of the features of its rows; a row belongs to the nearest
    centre.
    """
    sums = centres.new_zeros(len(centres), len(features(centres[:1])))
    for rows in shard.rows.split(EM.cached_rows):
        nearest = (0.5 * (centres**2).sum(1) - rows @ centres.T).argmin(1)
        member = nearest[:, None] == row_numbers(centres)
        sums.addmm_(member.T.to(rows), features(rows).T)
    return shard.sum(sums)
