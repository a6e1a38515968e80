"""The distribution of an uncertain number, such as a friction coefficient or a mass."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.base import Value, kept
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import (
    ANY,
    Measured,
    Positive,
    Range,
    Seed,
    is_known,
    show,
)
from torchgrasp.geometry.frames import real

MOST_PARTS = 10_000
"""Largest number of parts, and of samples that are drawn at once."""
FORM = "a number, an interval such as 0.3:0.8, or several of them with | between"
"""What a text of a distribution may be."""
Few = Annotated[int, Range(1, MOST_PARTS)]
"""A number of nodes or samples."""


@checked
@dataclasses.dataclass(frozen=True)
class Distribution(Value):
    """The distribution of an uncertain number: a mixture of intervals, in each of which all numbers
    are equally likely.

    The number may have any unit, such as a mass [kg]. An interval (x, x) is the single number x.
    Further ways to make a distribution are `parse`, `read`, `of`, `between` and `of_samples`.

    Args:
        parts: intervals (least, greatest) in the unit of the number, 1 to 10,000 of them.
        weights: weight of each part, of which only the ratios count; None means equal weights.

    Raises `BadArgument` for:

    * no part, or more than 10,000;
    * an interval whose first number is the greater one;
    * weights that are not positive, or not one for each part.

    >>> friction = Distribution.parse("0.3:0.8|1.0")
    >>> friction.mean, friction.cdf(torch.tensor([0.55, 1.0])).tolist()
    (0.775, [0.25, 1.0])
    """

    parts: tuple[tuple[float, float], ...]
    weights: tuple[Positive, ...] | None = None

    def __post_init__(self) -> None:
        count = len(self.parts)
        if not 1 <= count <= MOST_PARTS:
            raise BadArgument("parts", f"{count} parts", f"1 to {MOST_PARTS} parts")
        for low, high in self.parts:
            if low > high:
                raise BadArgument("parts", f"{low:g} to {high:g}", "the lesser number first")
        if self.weights is not None and len(self.weights) != count:
            raise BadArgument("weights", f"{len(self.weights)} weights", f"{count}, one a part")

    @classmethod
    @checked
    def of(cls, value: "float | Distribution") -> "Distribution":
        """Return the distribution of a number that is certain, in the unit of the number. Its only
        part is the interval (value, value).

        A `Distribution` is returned as it is.
        """
        return value if isinstance(value, Distribution) else cls(((value, value),))

    @classmethod
    @checked
    def between(cls, low: float, high: float) -> "Distribution":
        """Return the distribution in which all numbers in [low, high] are equally likely.

        `low` and `high` have the unit of the number. Raises `BadArgument` if `low` is the greater
        one.
        """
        return cls(((low, high),))

    @classmethod
    @checked
    def of_samples(cls, samples: Float[Tensor, "n"]) -> "Distribution":
        """Return the distribution in which each of n samples (n,) is equally likely.

        The samples may have any unit. Raises `BadArgument` for no sample, more than 10,000, or one
        that is not finite.
        """
        return cls(tuple((x, x) for x in samples.tolist()))

    @classmethod
    @checked
    def read(cls, text: str) -> "float | Distribution":
        """Return the number or the `Distribution` that a text names.

        The text is a number "0.5", an interval "0.3:0.8", or several of them with "|" between
        (`parse`). A text of one number gives a float; `parse` gives a `Distribution` in any case.
        Raises `BadArgument` for another text.

        >>> Distribution.read("0.5"), str(Distribution.read("0.3:0.8"))
        (0.5, '0.3:0.8')
        """
        return cls.parse(text).simplest

    @classmethod
    @checked
    def parse(cls, text: str) -> "Distribution":
        """Return the `Distribution` that a text names, also for a text of one number.

        The text is a number "0.5", an interval "0.3:0.8", or several of them with "|" between. A
        part may have a weight behind "@", by default 1. `str` writes such a text. Raises
        `BadArgument` for another text.

        >>> str(Distribution.parse(".3:.8@2|1"))
        '0.3:0.8@2|1@1'
        """
        parts = list[tuple[float, float]]()
        weights = list[float]()
        for part in text.split("|"):
            interval, at, weight = part.partition("@")
            low, colon, high = interval.partition(":")
            try:
                parts.append((float(low), float(high if colon else low)))
                weights.append(float(weight if at else 1))
            except ValueError as error:
                raise BadArgument("text", show(text), FORM) from error
        return cls(tuple(parts), tuple(weights) if "@" in text else None)

    def __str__(self) -> str:
        """Return the distribution as a text that `parse` reads."""
        texts = [
            _text(low) if low == high else f"{_text(low)}:{_text(high)}" for low, high in self.parts
        ]
        if self.weights is not None:
            texts = [f"{text}@{_text(x)}" for text, x in zip(texts, self.weights, strict=True)]
        return "|".join(texts)

    @functools.cached_property
    def shares(self) -> tuple[float, ...]:
        """The probability of each interval in `parts`, in this order; their sum is 1."""
        weights = self.weights or (1.0,) * len(self.parts)
        total = math.fsum(weights)
        return tuple(x / total for x in weights)

    @property
    def simplest(self) -> "float | Distribution":
        """The number as a float if only one number is possible, else this `Distribution`."""
        return self.least if self.least == self.most else self

    @property
    def mean(self) -> float:
        """The mean, in the unit of the number."""
        middles = [(low + high) / 2 for low, high in self.parts]
        return math.fsum(p * x for p, x in zip(self.shares, middles, strict=True))

    @property
    def std(self) -> float:
        """The standard deviation, in the unit of the number."""
        squares = [(low * low + low * high + high * high) / 3 for low, high in self.parts]
        square = math.fsum(p * x for p, x in zip(self.shares, squares, strict=True))
        return math.sqrt(max(square - self.mean**2, 0.0))

    @property
    def least(self) -> float:
        """The smallest possible value, in the unit of the number."""
        return min(low for low, _ in self.parts)

    @property
    def most(self) -> float:
        """The greatest possible value, in the unit of the number."""
        return max(high for _, high in self.parts)

    @kept
    def _intervals(self) -> Float[Tensor, "k 3"]:
        """Least number, length and share of each interval that is longer than 0."""
        pairs = zip(self.parts, self.shares, strict=True)
        found = [(low, high - low, share) for (low, high), share in pairs if high > low]
        return real(found).reshape(-1, 3)

    @kept
    def _points(self) -> Float[Tensor, "k 2"]:
        """The single numbers in ascending order, each with its share."""
        pairs = zip(self.parts, self.shares, strict=True)
        found = [(low, share) for (low, high), share in pairs if high == low]
        return real(sorted(found)).reshape(-1, 2)

    @kept
    def _steps(self) -> Float[Tensor, "2 k"]:
        """The cumulative distribution function as a polygon: numbers, and its values there.

        Every number stands twice, with the values below and at a jump.
        """
        low, length, _ = self._intervals.unbind(1)
        ends = torch.cat([low, low + length, self._points[:, 0]]).unique()
        below = self._below(ends, reached=False)
        upto = self._below(ends, reached=True)
        values = torch.stack([below, upto], 1).flatten().cummax(0).values
        return torch.stack([ends.repeat_interleave(2), values / values[-1]])

    @checked
    def times(self, factor: Positive) -> "Distribution":
        """Return the distribution of the number multiplied by `factor` (no unit).

        Raises `BadArgument` for a `factor` that is not positive.
        """
        return self._mapped(lambda x: factor * x)

    @checked
    def clamped(self, low: Measured, high: Measured) -> "Distribution":
        """Return the distribution with the ends of each interval clamped to [low, high]; weights
        are kept.

        An interval outside becomes the nearer of the two numbers. `low` and `high` have the unit of
        the number, and may be infinite. Raises `BadArgument` if `low` is the greater one.
        """
        if low > high:
            raise BadArgument("low", f"{low:g} beside high {high:g}", "at most high")
        return self._mapped(lambda x: min(max(x, low), high))

    def _mapped(self, function: Callable[[float], float]) -> "Distribution":
        """Return the distribution whose intervals have their ends mapped by a function."""
        parts = tuple((function(low), function(high)) for low, high in self.parts)
        return dataclasses.replace(self, parts=parts)

    @checked(gradients=True)
    def cdf(self, x: Annotated[Float[Tensor, "*b"], ANY]) -> Float[Tensor, "*b"]:
        """Return the probability (*b,) that the number is at most `x` (*b,); NaN for NaN.

        `x` is in the unit of the number. The result is differentiable in `x`. The derivative is the
        density of the intervals; it does not show the jumps at single numbers.
        """
        return torch.where(x.isnan(), x, self._below(x, reached=True).clamp(0, 1))

    def _below(self, x: Float[Tensor, "*b"], reached: bool) -> Float[Tensor, "*b"]:
        """Return P(X < x), or P(X <= x) if `reached`."""
        low, length, share = self._intervals.to(x).unbind(1)
        points, jump = self._points.to(x).unbind(1)
        passed = ((x[..., None] - low) / length).clamp(0, 1)  # (*b, k)
        index = torch.searchsorted(points.contiguous(), x.detach().contiguous(), right=reached)
        jumps = torch.cat([jump.new_zeros(1), jump.cumsum(0)])
        return (share * passed).sum(-1) + jumps[index]

    @checked(gradients=True)
    def quantile(self, q: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """Return the quantile (*b,) for each probability `q` (*b,) in [0, 1], in the unit of the
        number.

        It is the least number x with `cdf`(x) >= q. The result is differentiable in `q`. The
        derivative is one over the density, and 0 where x is a single number. Raises `BadArgument`
        for a `q` outside [0, 1]; torch.vmap and torch.compile leave this check out.
        """
        if is_known(q) and not bool(((q >= 0) & (q <= 1)).all()):
            raise BadArgument("q", "a number outside [0, 1]", "probabilities in [0, 1]")
        numbers, values = self._steps.to(q)
        values = values.contiguous()
        end = torch.searchsorted(values, q.detach().contiguous()).clamp(1, len(values) - 1)
        rise = (values[end] - values[end - 1]).clamp_min(torch.finfo(q.dtype).tiny)
        share = ((q - values[end - 1]) / rise).clamp(0, 1)
        return torch.lerp(numbers[end - 1], numbers[end], share)

    @checked
    def sample(self, count: Few, seed: Seed) -> Float[Tensor, "n"]:
        """Return `count` independent random samples (count,) in the unit of the number, as float64
        on the CPU.

        `count` is 1 to 10,000, and `seed` the random seed.

        Raises `BadArgument` for a `count` or `seed` out of range.
        """
        generator = torch.Generator().manual_seed(seed)
        drawn = torch.rand(count, generator=generator, dtype=torch.float64, device="cpu")
        return self.quantile(drawn)

    @checked
    def share(self, low: Measured, high: Measured) -> float:
        """Return the probability, in [0, 1], that the number is in [low, high], both ends included.

        The ends have the unit of the number, and may be infinite. The result is 0 if `low` is
        greater than `high`.
        """
        upto = self._below(real([high]), reached=True)
        below = self._below(real([low]), reached=False)
        return min(max(float(upto - below), 0.0), 1.0)

    @checked
    def given(self, low: Measured, high: Measured) -> "Distribution":
        """Return the distribution of the number once it is known to be in [low, high].

        The ends have the unit of the number, and may be infinite. Raises `BadArgument` if the
        number cannot be in this interval.

        >>> str(Distribution.between(0.2, 1.0).given(0.3, 0.5))
        '0.3:0.5'
        """
        found = list[tuple[tuple[float, float], float]]()
        for (least, most), share in zip(self.parts, self.shares, strict=True):
            kept = max(least, low), min(most, high)
            if least == most:
                weight = share * (low <= least <= high)
            else:
                weight = share * (kept[1] - kept[0]) / (most - least)
            if weight > 0.0:
                found.append((kept, weight))
        if not found:
            raise BadArgument("low", f"{low:g} to {high:g}", f"an interval in which {self} may be")
        parts = tuple(kept for kept, _ in found)
        return Distribution(parts, tuple(x for _, x in found) if len(found) > 1 else None)

    @checked
    def nodes(self, count: Few) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
        """Return (numbers, probabilities): n nodes (n,) that stand for the distribution, in the
        unit of the number, and their probabilities (n,).

        The sum of probability times f(number) approximates the mean of a function f. Here n is at
        most `count` (1 to 10,000).

        A part that is a single number is one node. An interval is cut into equal pieces, and their
        middles are the nodes. The greater an interval's probability, the more pieces it has. If the
        distribution has more `parts` than `count`, the nodes are `count` quantiles. Their levels
        are (i + 1/2) / `count` for i = 0 to `count` - 1. Each has the probability 1 / `count`.

        Raises `BadArgument` for a `count` out of range.

        >>> [node.tolist() for node in Distribution.between(0.0, 1.0).nodes(2)]
        [[0.25, 0.75], [0.5, 0.5]]
        """
        if len(self.parts) > count:
            middles = (torch.arange(count, dtype=torch.float64, device="cpu") + 0.5) / count
            return self.quantile(middles), torch.full_like(middles, 1 / count)
        numbers = list[float]()
        weights = list[float]()
        spare = count - len(self.parts)
        wide = math.fsum(self._intervals[:, 2].tolist())
        for (low, high), share in zip(self.parts, self.shares, strict=True):
            n = 1 if low == high else 1 + int(spare * share / wide)
            numbers += [low + (high - low) * (i + 0.5) / n for i in range(n)]
            weights += [share / n] * n
        return real(numbers), real(weights)


def check_within(name: str, value: float | Distribution, allowed: Range) -> None:
    """Raise `BadArgument` if `value` is a distribution with numbers outside the range `allowed`.

    A plain number is not checked. Errors call the distribution by `name`.
    """
    if (
        isinstance(value, Distribution)
        and not allowed.low <= value.least <= value.most <= allowed.high
    ):
        within = f"a distribution in [{allowed.low:g}, {allowed.high:g}]"
        raise BadArgument(name, f"{value.least:g} to {value.most:g}", within)


def _text(x: float) -> str:
    """Return a number as text, in full if it has more than six digits."""
    return f"{x:g}" if float(f"{x:g}") == x else repr(x)
