"""The start of expectation-maximisation: k-means++ on a part of the data, then Lloyd's algorithm on all of them."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.errors import BadArgument
from torchgrasp.posture_model.em import CACHED_ROWS, Progress, Shard, features_from_data, maximisation

SUBSAMPLE = 20_000  # rows among which k-means++ chooses its centres: some hundred for each component
LLOYD_ROUNDS = 10  # rounds of Lloyd's algorithm: EM follows, so the clusters need not converge


def start_components(shard: Shard, m: int, seed: int, regularisation: float) -> Progress:
    """Return the clusters of k-means as m components; fewer different rows raise `BadArgument`."""
    generator = torch.Generator().manual_seed(seed)
    centres = _plus_plus(_subsample(shard, generator), m, generator)
    for _ in range(LLOYD_ROUNDS):
        sums = _sums_of_clusters(shard, centres, _ones_and_data)
        centres = torch.where(sums[:, :1] > 0, sums[:, 1:] / sums[:, :1], centres)  # a centre without data stays
    sums = _sums_of_clusters(shard, centres, features_from_data)
    n = round(float(sums[:, 0].sum()))
    components, reseeded = maximisation(sums, n, regularisation, torch.zeros(m, dtype=torch.long, device=sums.device))
    return Progress(components, reseeded, sums.new_empty(0))


def _subsample(shard: Shard, generator: torch.Generator) -> Float[Tensor, "s d"]:
    """Return random rows of all data, the same in every process."""
    x = shard.rows
    lengths = x.new_zeros(shard.processes, dtype=torch.int64)
    lengths[shard.rank] = len(x)
    lengths = shard.sum(lengths)
    order = torch.randperm(int(lengths.sum()), generator=generator)  # the same for any number of processes
    pick = order[:SUBSAMPLE].to(x.device) - lengths[: shard.rank].sum()
    here = (pick >= 0) & (pick < len(x))
    pool = x.new_zeros(len(pick), x.shape[1])
    pool[here] = x[pick[here]]
    return shard.sum(pool)


def _plus_plus(pool: Float[Tensor, "s d"], m: int, generator: torch.Generator) -> Float[Tensor, "m d"]:
    """Return centres drawn with probabilities proportional to the squared distance from the centres before."""
    centres = pool[:1]
    squared = ((pool - centres) ** 2).sum(1)
    for k in range(1, m):
        if not bool((squared > 0).any()):
            raise BadArgument("components", m, f"at most {k}, the number of different rows of the data")
        pick = torch.multinomial(squared.cpu(), 1, generator=generator).to(pool.device)
        centres = torch.cat([centres, pool[pick]])
        squared = torch.minimum(squared, ((pool - pool[pick]) ** 2).sum(1))
    return centres


def _sums_of_clusters(
    shard: Shard, centres: Float[Tensor, "m d"], features: Callable[[Float[Tensor, "r d"]], Float[Tensor, "f r"]]
) -> Float[Tensor, "m f"]:
    """Return the sums of the features over each cluster."""
    sums = centres.new_zeros(len(centres), len(features(centres[:1])))
    for rows in shard.rows.split(CACHED_ROWS):
        nearest = (0.5 * (centres**2).sum(1) - rows @ centres.T).argmin(1)
        member = nearest[:, None] == torch.arange(len(centres), device=rows.device)
        sums.addmm_(member.T.to(rows), features(rows).T)
    return shard.sum(sums)


def _ones_and_data(x: Float[Tensor, "r d"]) -> Float[Tensor, "f r"]:
    return torch.cat([torch.ones_like(x[:, :1]), x], dim=1).T
