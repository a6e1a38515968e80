"""Success rates and their 95 % intervals, by a bootstrap over families of objects.

Trials of one object are correlated, and so are objects of one family. The bootstrap therefore
resamples whole families, 10 000 times. The interval lies between the 2.5 % and 97.5 % quantiles.
"""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.checks import checked


@dataclasses.dataclass(frozen=True)
class BootstrapNumbers:
    """Parameters of the bootstrap that finds the confidence interval of a success rate."""

    resamples: int = 10_000
    """Number of resamples of the families of objects. With more, the ends of the interval vary
    less.
    """
    outside: float = 0.05
    """Probability that the true success rate lies outside the interval."""
    tails: tuple[float, float] = (0.025, 0.975)
    """Quantiles of the resampled success rates that are the ends of the interval."""


BOOTSTRAP = BootstrapNumbers()
Counts = Mapping[str, tuple[int | float, int]]
"""(passed, all): numbers of trials of each resampled unit, by the name of the unit (a family or an
object). For a mean: (sum, number) of the values.
"""


class Share(NamedTuple):
    """A success rate (or a mean, or a difference) with its 95 % interval; `summarise` makes it.

    The interval is found by resampling units, such as families of objects. With a single unit its
    ends are NaN. Without trials the value is also NaN.

    Attributes:
        value: the rate in [0, 1]; a mean or a difference has its own unit.
        low: lower end of the interval.
        high: upper end of the interval.
        total: number of trials.
        units: number of different units that were resampled.
    """

    value: float
    low: float
    high: float
    total: int
    units: int


@checked
def count_by(outcomes: Iterable[tuple[str, bool]]) -> dict[str, tuple[int, int]]:
    """Return (passed, all) for each unit, such as a family of objects, by its name. They are the
    numbers of trials that passed, and of all trials.

    `outcomes` are pairs of a unit's name and whether one trial passed.
    """
    counts: dict[str, tuple[int, int]] = {}
    for name, passed in outcomes:
        before = counts.get(name, (0, 0))
        counts[name] = before[0] + passed, before[1] + 1
    return counts


@checked
def share_over(counts: Counts) -> Share:
    """Return the success rate over all trials, with its 95 % interval from resampling the units.
    `counts` holds (passed, all), the numbers of trials of each unit, by its name.

    If all trials passed, or none, resampling gives no width. The interval is then the one-sided 95
    % bound of n independent trials, n being the number of units. Its lower end is 0.05 ** (1 / n)
    if all passed. Its upper end is 1 minus this if none passed.
    """
    found = contrast_over([counts], [1.0])
    if found.units > 1 and found.value in (0.0, 1.0):
        bound = BOOTSTRAP.outside ** (1 / found.units)
        return found._replace(low=bound) if found.value else found._replace(high=1 - bound)
    return found


@checked
def contrast_over(columns: Sequence[Counts], weights: Sequence[float]) -> Share:
    """Return a weighted sum of success rates, with a 95 % interval.

    Each of `columns` is for one rate. It holds (passed, all), the numbers of trials of each unit,
    by its name. `weights` are the weights of the rates: 1 and -1 give a difference. All rates use
    the same resampled units. `total` counts the trials of the first column. Resamples in which a
    column has no trial are left out. An interval of zero width means that the units agree, not that
    the value is exact.
    """
    names = sorted({name for counts in columns for name, (_, total) in counts.items() if total})
    total = sum(total for _, total in columns[0].values())
    if not names:
        return Share(math.nan, math.nan, math.nan, 0, 0)
    found = [[counts.get(name, (0, 0)) for counts in columns] for name in names]
    table = torch.tensor(found, dtype=torch.float64)  # (u, c, 2)
    value = float(_combine(table.sum(0), weights))
    if len(names) == 1:
        return Share(value, math.nan, math.nan, total, 1)
    shape = (BOOTSTRAP.resamples, len(names))
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randint(len(names), shape, generator=generator)
    times = torch.zeros(shape, dtype=torch.float64)
    times.scatter_add_(1, drawn, torch.ones_like(drawn, dtype=torch.float64))
    values = _combine(torch.einsum("ru,uck->rck", times, table), weights)
    low, high = values.nanquantile(torch.tensor(BOOTSTRAP.tails, dtype=torch.float64)).tolist()
    return Share(value, low, high, total, len(names))


def _combine(sums: Float[Tensor, "*r c 2"], weights: Sequence[float]) -> Float[Tensor, "*r"]:
    """Return the weighted sum of c success rates, given passed and all trials of each. It is NaN if
    a rate has no trial.
    """
    return (sums[..., 0] / sums[..., 1]) @ sums.new_tensor(weights)


@checked
def format_share(share: Share, unit: str = "families") -> str:
    """Return a success rate with its interval as text, such as "80.0 % [61.2, 93.1] of 40, 9
    families".

    The interval [low, high] is in per cent. The number of trials follows, then that of the
    resampled units. `unit` is the plural name of these units. NaN gives "nothing measured".
    """
    if math.isnan(share.value):
        return "nothing measured"
    value = f"{100.0 * share.value:.1f} %"
    if math.isnan(share.low):
        return f"{value} of {share.total}, one of the {unit}: no interval"
    ends = f"[{100.0 * share.low:.1f}, {100.0 * share.high:.1f}]"
    return f"{value} {ends} of {share.total}, {share.units} {unit}"
