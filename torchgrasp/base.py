"""What every value is made of: frozen dataclasses of tensors, batches with rows, checks and counts."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchgrasp.errors import BadArgument, FailedRows, Status

SomeValue = TypeVar("SomeValue", bound="Value")
SomeBatch = TypeVar("SomeBatch", bound="Batch")


class Value:
    """Base of all values: `.to()` maps every tensor inside, nested values included, into a new value."""

    def to(self: SomeValue, *args: Any, **kwargs: Any) -> SomeValue:
        """Return the value on another device or in another floating dtype; integers keep theirs."""

        def move(x: Any) -> Any:
            if isinstance(x, Value):
                return x.to(*args, **kwargs)
            if isinstance(x, Tensor):
                moved = x.to(*args, **kwargs)
                return moved if x.is_floating_point() else moved.to(x.dtype)
            return x

        fields = dataclasses.fields(self)  # pyright: ignore[reportArgumentType]
        return type(self)(**{f.name: move(getattr(self, f.name)) for f in fields})


class Batch(Value):
    """A value whose tensors share a leading batch axis: indexing selects rows, `len` counts them."""

    def __len__(self) -> int:
        """Count the rows."""
        return len(getattr(self, dataclasses.fields(self)[0].name))  # pyright: ignore[reportArgumentType]

    def __getitem__(self: SomeBatch, rows: Any) -> SomeBatch:
        """Select rows by a slice, a mask or an index tensor; an integer keeps the batch axis."""
        if isinstance(rows, int):
            rows = range(len(self))[rows]  # raises IndexError as a list would
            rows = slice(rows, rows + 1)

        def pick(x: Any) -> Any:
            return x[rows] if isinstance(x, (Tensor, Batch)) else x

        fields = dataclasses.fields(self)  # pyright: ignore[reportArgumentType]
        return type(self)(**{f.name: pick(getattr(self, f.name)) for f in fields})

    def __iter__(self: SomeBatch) -> Iterator[SomeBatch]:
        """Iterate over the rows, each a batch of one."""
        return (self[i] for i in range(len(self)))

    def raise_for_status(self: SomeBatch) -> SomeBatch:
        """Return the value itself when every row is `Status.OK`; raise `FailedRows` with counts otherwise."""
        counts = count_status(getattr(self, "status"))  # noqa: B009
        failed = {s: k for s, k in counts.items() if s is not Status.OK}
        if failed:
            raise FailedRows("; ".join(f"{k} of {len(self)} rows: {s.sentence}" for s, k in failed.items()))
        return self


def join(parts: Sequence[SomeBatch]) -> SomeBatch:
    """Put the rows of batches of one kind one below the other; what has no rows is the first one's."""

    def together(values: list[Any]) -> Any:
        if isinstance(values[0], Tensor):
            return torch.cat(values)
        return join(values) if isinstance(values[0], Value) else values[0]

    fields = dataclasses.fields(parts[0])  # pyright: ignore[reportArgumentType]
    return type(parts[0])(**{f.name: together([getattr(part, f.name) for part in parts]) for f in fields})


def pick(choose: Bool[Tensor, "b"], new: SomeValue, old: SomeValue) -> SomeValue:
    """Return the new rows of a value where `choose`, the old ones elsewhere."""

    def merge(a: Any, b: Any) -> Any:
        return pick(choose, a, b) if isinstance(a, Value) else torch.where(choose.view(-1, *[1] * (a.ndim - 1)), a, b)

    fields = dataclasses.fields(new)  # pyright: ignore[reportArgumentType]
    return type(new)(**{f.name: merge(getattr(new, f.name), getattr(old, f.name)) for f in fields})


def put(whole: SomeValue, at: Int[Tensor, "a"], part: SomeValue) -> SomeValue:
    """Return a value with `part` in the rows `at`."""

    def place(w: Any, p: Any) -> Any:
        return put(w, at, p) if isinstance(w, Value) else w.index_copy(0, at, p)

    fields = dataclasses.fields(whole)  # pyright: ignore[reportArgumentType]
    return type(whole)(**{f.name: place(getattr(whole, f.name), getattr(part, f.name)) for f in fields})


def count_status(status: Int[Tensor, "*b"]) -> dict[Status, int]:
    """Count the rows of each status, the most frequent first.

    >>> count_status(torch.tensor([0, 13, 0]))
    {<Status.OK: 0>: 2, <Status.NOT_CLOSED: 13>: 1}
    """
    codes, counts = torch.unique(status, return_counts=True)
    pairs = sorted(zip(codes.tolist(), counts.tolist(), strict=True), key=lambda p: (-p[1], p[0]))
    return {Status(code): count for code, count in pairs}


def check_tensor(name: str, value: Any, shape: tuple[int | None, ...]) -> Tensor:
    """Return `value` if it is a finite floating tensor of `shape` (None: any length); raise `BadArgument` otherwise."""
    wanted = "x".join("any" if s is None else str(s) for s in shape)
    if not isinstance(value, Tensor):
        raise BadArgument(name, type(value).__name__, f"a torch tensor of shape {wanted}")
    if value.ndim != len(shape) or any(s is not None and s != v for s, v in zip(shape, value.shape, strict=True)):
        raise BadArgument(name, f"shape {tuple(value.shape)}", f"shape {wanted}")
    if value.dtype not in (torch.float32, torch.float64):
        raise BadArgument(name, str(value.dtype), "torch.float32 or torch.float64")
    finite = torch.isfinite(value)
    if not bool(finite.all()):
        first = torch.nonzero(~finite)[0].tolist()
        raise BadArgument(name, f"{value[tuple(first)].item()} at index {first}", "finite numbers")
    return value


def check_whole(name: str, value: int, low: int, high: int) -> None:
    """Refuse a number that is not whole or is out of range; raise `BadArgument`."""
    if not low <= value <= high or value != int(value):
        raise BadArgument(name, value, f"a whole number in [{low}, {high}]")
