"""The base classes of all values: frozen dataclasses of tensors, and batches of them.

The tensors of a batch share their first axis. What belongs to one index of this axis is a row, such
as one grasp.
"""

import dataclasses
import functools
import textwrap
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchgrasp.foundation.checks import read_number
from torchgrasp.foundation.errors import BadArgument, FailedRows, Status, one_line
from torchgrasp.foundation.rules import Range, check_moved, show
from torchgrasp.foundation.settings import usual_settings

# fewest and most fingertips on an object: two contacts do not resist a rotation about their line
FINGERTIPS = (3, 5)
# columns and lines of the text of a value
WIDTH = 110
LINES = 12
# rows on an accelerator for each row on a CPU: fewer leave it idle, more fill its memory
ROWS_ON_GPU = 256
Kept = TypeVar("Kept")
SomeValue = TypeVar("SomeValue", bound="Value")
SomeBatch = TypeVar("SomeBatch", bound="Batch")


def map_tensors(function: Callable[..., Tensor], *values: SomeValue) -> SomeValue:
    """Return one value, each of whose tensors is `function` of the tensors in the same field of all
    `values`.

    The `values` are of one class; `function` takes one tensor of each. Values in fields are mapped,
    too. Fields without tensors are copied from the first value. Raises `BadArgument` if a field
    holds a tensor in some of the values only.
    """

    def merge(name: str, *found: Any) -> Any:
        if isinstance(found[0], Value):
            return map_tensors(function, *found)
        tensors = [isinstance(x, Tensor) for x in found]
        if any(tensors) and not all(tensors):
            raise BadArgument(name, "None beside a tensor", "a tensor in every value, or in none")
        return function(*found) if all(tensors) else found[0]

    if torch.is_inference_mode_enabled():  # its tensors could not be differentiated later
        with torch.inference_mode(False), torch.no_grad():
            return map_tensors(function, *values)
    kind = type(values[0])
    names = [f.name for f in dataclasses.fields(kind)]  # pyright: ignore[reportArgumentType]
    fields = {name: merge(name, *(getattr(value, name) for value in values)) for name in names}
    if hasattr(kind, "__post_init__"):
        return kind(**fields)
    # checked fields need no second check, and loops make thousands of values
    new = object.__new__(kind)
    new.__dict__.update(fields)
    return new


class kept(functools.cached_property[Kept]):
    """A decorator for cached properties whose value is a tensor, or holds tensors. It is like
    `functools.cached_property`.

    Inside a transform of torch.func nothing is cached, because the tensors of the transform are
    invalid after it.
    """

    def __get__(self, instance: Any, owner: Any = None) -> Any:
        """Return the value of the property."""
        if torch.compiler.is_compiling():  # the compiler cannot trace the settings
            with torch.inference_mode(False):
                value = super().__get__(instance, owner)
        else:
            with torch.inference_mode(False), usual_settings():
                value = super().__get__(instance, owner)
        if instance is not None and torch._C._functorch.peek_interpreter_stack() is not None:  # pyright: ignore
            vars(instance).pop(self.attrname, None)
        return value


class Value:
    """Base class of all values: frozen dataclasses of tensors. `.to()` returns a copy on another
    device or dtype.

    Two values are equal if they are of one class and all their fields are equal. Equal tensors have
    the same shape, dtype, device and numbers; NaN equals NaN. Copies and pickled values do not keep
    cached properties.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for name in ("__repr__", "__eq__", "__hash__"):  # before `dataclass` writes its own
            if name not in vars(cls):
                setattr(cls, name, vars(Value)[name])

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        assert isinstance(other, Value)
        return _same(self._compared(), other._compared())

    def __hash__(self) -> int:
        return _digest(self._compared())

    def __getstate__(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}  # pyright: ignore[reportArgumentType]

    def _compared(self) -> tuple[Any, ...]:
        """Return the fields that equal values share."""
        return tuple(getattr(self, f.name) for f in dataclasses.fields(self) if f.compare)  # pyright: ignore

    def __repr__(self) -> str:
        """Return the fields as text of at most 12 lines. It has types and shapes of tensors, and
        the numbers of small tensors.
        """
        fields = [f for f in dataclasses.fields(self) if f.repr]  # pyright: ignore[reportArgumentType]
        parts = [*self._about(), *(f"{f.name}={_short(getattr(self, f.name))}" for f in fields)]
        lines = textwrap.wrap(
            f"{type(self).__name__}({', '.join(parts)})", WIDTH, subsequent_indent="    "
        )
        return "\n".join(lines if len(lines) <= LINES else [*lines[: LINES - 1], "    ...)"])

    def _about(self) -> list[str]:
        """Return texts that precede the fields in the text of a value."""
        return []

    def to(self: SomeValue, *args: Any, **kwargs: Any) -> SomeValue:
        """Return the value on another device or in another floating dtype; integer tensors keep
        their dtype.

        The arguments are those of `torch.Tensor.to`. Raises `BadArgument` if the device does not
        exist, or the dtype is neither float32 nor float64.
        """
        check_moved(*args, **kwargs)

        def move(x: Tensor) -> Tensor:
            moved = x.to(*args, **kwargs)
            return moved if x.is_floating_point() else moved.to(x.dtype)

        return map_tensors(move, self)


def _same(one: Any, other: Any) -> bool:
    """Return whether two fields of values are equal; NaN equals NaN."""
    if isinstance(one, Tensor) and isinstance(other, Tensor):
        alike = (one.shape, one.dtype, one.device) == (other.shape, other.dtype, other.device)
        return alike and bool(((one == other) | ((one != one) & (other != other))).all())
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_same(one[key], other[key]) for key in one)
    if isinstance(one, tuple | list) and type(one) is type(other):
        return len(one) == len(other) and all(map(_same, one, other))
    return one is other or bool(one == other) or (_is_nan(one) and _is_nan(other))


def _digest(value: Any) -> int:
    """Return a number that equal fields share, from a few numbers of each tensor."""
    if isinstance(value, Tensor):
        flat = value.detach().reshape(-1)
        some = 8
        return hash((value.shape, *flat[:: max(1, len(flat) // some)].nan_to_num().tolist()))
    if isinstance(value, dict):
        return hash(frozenset((key, _digest(x)) for key, x in value.items()))
    if isinstance(value, tuple | list):
        return hash(tuple(map(_digest, value)))
    return hash(not _is_nan(value) and value)


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and value != value


def _short(value: Any) -> str:
    """Return a short text for one field's value. It is type and shape of a tensor, length of a long
    list, or the value.
    """
    if isinstance(value, Tensor):
        if value.numel() <= 4 and value.device.type == "cpu":
            return _digits(value.tolist())
        return f"{str(value.dtype).removeprefix('torch.')}{list(value.shape)}"
    if isinstance(value, dict | list | tuple) and len(value) > 4:
        return f"{type(value).__name__} of {len(value)}"
    text = repr(value)
    if isinstance(value, Value):  # it is wrapped once, as a whole
        text = one_line(text)
    if len(text) <= WIDTH or isinstance(value, Value):
        return text
    return f"{text[: WIDTH - len('...')]}..."


def _digits(value: Any) -> str:
    """Return a number, or nested lists of numbers, as text with five significant digits."""
    if isinstance(value, list):
        return f"[{', '.join(map(_digits, value))}]"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


class Batch(Value):
    """A value whose tensors share their first axis: a row is what belongs to one index of this
    axis.

    `batch[index]` returns a batch of some rows, and `len(batch)` the number of rows.
    """

    def __len__(self) -> int:
        return len(getattr(self, dataclasses.fields(self)[0].name))  # pyright: ignore[reportArgumentType]

    def __getitem__(self: SomeBatch, rows: Any) -> SomeBatch:
        """Return a batch of the rows that a slice, a mask or indices select. A single index gives a
        batch of one row.

        Raises `BadArgument` for an index of another kind, such as a single boolean, and
        `IndexError` beyond the last row.
        """
        # once for all tensors: on a GPU the host waits for the number of rows
        chosen = read_rows(rows, len(self))
        return map_tensors(lambda x: x[chosen], self)

    def __iter__(self: SomeBatch) -> Iterator[SomeBatch]:
        """Iterate over the rows, each a batch of one."""
        return (self[i] for i in range(len(self)))

    def raise_for_status(self: SomeBatch) -> SomeBatch:
        """Return this batch if every row has `Status.OK`; else raise `FailedRows`.

        The error's text says how many rows have each other status, and explains each status.
        """
        counts = count_status(getattr(self, "status"))  # noqa: B009
        failed = {s: k for s, k in counts.items() if s is not Status.OK}
        if failed:
            raise FailedRows(
                "; ".join(f"{k} of {len(self)} rows: {s.sentence}" for s, k in failed.items())
            )
        return self


def read_rows(rows: Any, count: int) -> slice | Tensor:
    """Return any index of a batch of `count` rows as a slice, or as a tensor of indices (k,). A row
    is what belongs to one index of the batch's first axis.

    `rows` is an index, a slice, a mask (count,), or a list or tensor (k,) of indices. Indices of a
    list or tensor are not compared with `count`. Raises `BadArgument` for anything else, such as a
    mask of another length. Raises `IndexError` for a single index out of range.
    """
    refused = BadArgument(
        "rows", show(rows), "an index, a slice, a mask of all rows or a tensor of indices"
    )
    if isinstance(rows, slice):
        return rows
    try:
        # on the CPU, whatever torch's default device is: it serves tensors of any device
        index = rows if isinstance(rows, Tensor) else torch.as_tensor(rows, device="cpu")
    except (TypeError, ValueError, RuntimeError) as error:
        raise refused from error
    if index.layout is not torch.strided or index.is_meta or index.ndim > 1:
        raise refused
    if index.dtype == torch.bool:
        if index.shape != (count,):
            raise refused
        return flatnonzero(index)
    if not isinstance(rows, Tensor) and not len(index.reshape(-1)):
        return slice(0, 0)  # an empty list
    if index.dtype not in (torch.int64, torch.int32):  # torch takes bytes for a mask
        raise refused
    if index.ndim:
        return index
    row = range(count)[int(index)]
    return slice(row, row + 1)


def join(parts: Sequence[SomeBatch]) -> SomeBatch:
    """Return one batch: the tensors of several batches, concatenated along their first axis. Fields
    without tensors are copied from the first batch.

    Raises `BadArgument` if a field holds a tensor in some of the batches only.
    """
    return map_tensors(lambda *tensors: torch.cat(tensors), *parts)


def pick(choose: Bool[Tensor, "b"], new: SomeBatch, old: SomeBatch) -> SomeBatch:
    """Return a batch that takes each row from `new` where `choose` is True, and from `old` where it
    is False. A row is what belongs to one index of the first axis.

    The batches `new` and `old` have b rows each. Fields without tensors are those of `new`.
    """
    return map_tensors(
        lambda a, b: torch.where(choose.view(-1, *[1] * (a.ndim - 1)), a, b), new, old
    )


def put(whole: SomeBatch, at: Int[Tensor, "a"], part: SomeBatch) -> SomeBatch:
    """Return a copy of the batch `whole` in which the rows of the batch `part` replace the rows at
    the indices `at` (a,). A row is what belongs to one index of the first axis; `part` has a rows.
    """
    return map_tensors(lambda rows, new: rows.index_copy(0, at, new), whole, part)


def spread(value: float | Tensor, like: Tensor, own: int = 0) -> float | Tensor:
    """Return `value` with axes of size 1 added, so that it broadcasts with the tensor `like`.

    A number is returned as it is. A tensor holds one value for each index of the first axis of
    `like`. Each of these values has `own` axes, which match the last axes of `like`. For example,
    `value` (b, 3) becomes (b, 1, 3) for `like` (b, n, 3) and `own` 1.
    """
    if not isinstance(value, Tensor) or not value.ndim:
        return value
    return value.reshape(len(value), *[1] * (like.ndim - 1 - own), *value.shape[1:])


def at_once(x: Tensor, size: int) -> int:
    """Return how many rows of the tensor `x`, along its first axis, to process at a time.

    The argument `size` is this number on a CPU, whose cache then holds all temporaries. On an
    accelerator, such as a GPU, the result is 256 times `size` (`ROWS_ON_GPU`).
    """
    return size if x.device.type == "cpu" else ROWS_ON_GPU * size


def in_chunks(
    evaluate: Callable[[Tensor], tuple[Any, ...]], x: Tensor, size: int
) -> tuple[Any, ...]:
    """Return the outputs of a function for all rows of `x`, computed in chunks of `size` rows to
    save memory. A row is one index of the first axis.

    `evaluate` takes a tensor (at most `size`, ...), and returns a tuple of tensors with as many
    rows. Each output is concatenated over the chunks.
    """
    if len(x) <= size:
        return evaluate(x)
    return tuple(map(torch.cat, zip(*map(evaluate, x.split(size)), strict=True)))


def map_rows(
    function: Callable[..., tuple[Tensor, ...]],
    size: int,
    axes: tuple[int | None, ...],
    arguments: tuple[Tensor, ...],
) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
    """Return (results, axes) for a function under torch.vmap, called once for all entries of the
    mapped axis. The results have the mapped axis first, so all returned axes are 0.

    A torch.autograd.Function calls this in its method `vmap`. `function` takes tensors (n, ...) of
    n independent rows, and returns tensors of n rows. The rows of all entries are stacked for it.

    Args:
        function: the function of rows.
        size: length of the mapped axis.
        axes: the mapped axis of each argument; None means that all entries share the argument.
        arguments: the tensors (n, ...), each with the mapped axis at its place in `axes`.
    """
    parts = [
        x.expand(size, *x.shape) if axis is None else x.movedim(axis, 0)
        for x, axis in zip(arguments, axes, strict=True)
    ]
    found = function(*(x.flatten(0, 1) for x in parts))
    rows = parts[0].shape[1]
    return tuple(x.unflatten(0, (size, rows)) for x in found), (0,) * len(found)


def row_numbers(rows: Tensor) -> Int[Tensor, "n"]:
    """Return the integers 0 to n - 1 for the n rows of a tensor, on its device."""
    return torch.arange(len(rows), device=rows.device)


def flatnonzero(mask: Bool[Tensor, "n"]) -> Int[Tensor, "k"]:
    """Return the indices (k,) of the k entries of a mask (n,) that are True, ascending."""
    return torch.nonzero(mask)[:, 0]


def lexical_order(*keys: Tensor) -> Int[Tensor, "g"]:
    """Return the indices that sort g rows ascending by the first key, equal ones by the next key.

    Each key holds a number for each row (g,).
    """
    order = torch.argsort(keys[-1], stable=True)
    for key in reversed(keys[:-1]):
        order = order[torch.argsort(key[order], stable=True)]
    return order


def rank_in_group(group: Int[Tensor, "g"], *keys: Tensor) -> Int[Tensor, "g"]:
    """Return the rank (from 0) of each row in its group, ascending by the first key, then by the
    next.

    `group` is the index of each row's group. Each key holds a number for each row (g,); without
    keys the order of the rows counts.
    """
    order = lexical_order(group, *keys)
    grouped = group[order].contiguous()
    rank = torch.empty_like(order)
    rank[order] = row_numbers(order) - torch.searchsorted(grouped, grouped)
    return rank


def named_tensors(value: Value, prefix: str = "") -> dict[str, Tensor]:
    """Return all tensors of a value and of the values in its fields by dotted name, such as
    `contacts.points`.

    `prefix` is put before each name.
    """
    tensors: dict[str, Tensor] = {}
    for field in dataclasses.fields(value):  # pyright: ignore[reportArgumentType]
        inner = getattr(value, field.name)
        if isinstance(inner, Tensor):
            tensors[prefix + field.name] = inner
        elif isinstance(inner, Value):
            tensors |= named_tensors(inner, f"{prefix}{field.name}.")
    return tensors


def changes_in_place(*tensors: Tensor) -> int:
    """Return how often the `tensors` were changed in place since they were made, all together.

    A value that was computed from them is out of date once this number has grown. Tensors made in
    inference mode count 0, because torch does not count their changes.
    """
    return sum(0 if x.is_inference() else x._version for x in tensors)


def settle(value: SomeValue, device: torch.device) -> SomeValue:
    """Return `value` with all its tensors on the device `device`. A value that is already there is
    returned itself, with its cached properties.
    """
    there = all(x.device == device for x in named_tensors(value).values())
    return value if there else value.to(device)


def check_device(name: str, found: torch.device, beside: str, wanted: torch.device) -> None:
    """Raise `BadArgument` unless argument `name`, on the device `found`, is on the same device as
    argument `beside`.

    `wanted` is the device of `beside`.
    """
    if found != wanted:
        raise BadArgument(
            name, f"tensors on {found}", f"tensors on {wanted}, as {beside}: `.to` moves them"
        )


def count_status(status: Int[Tensor, "*b"]) -> dict[Status, int]:
    """Return how often each `Status` occurs in a tensor (*b,) of status codes. The most frequent
    status comes first.
    """
    codes, counts = torch.unique(status, return_counts=True)
    pairs = sorted(zip(codes.tolist(), counts.tolist(), strict=True), key=lambda p: (-p[1], p[0]))
    return {Status(code): count for code, count in pairs}


def check_whole(name: str, value: Any, low: int, high: int) -> None:
    """Raise `BadArgument` unless a value is a whole number in [low, high]. `name` is the value's
    name in the error.
    """
    read_number(name, value, int, Range(low, high))
