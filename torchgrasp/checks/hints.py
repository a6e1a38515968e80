"""What an annotation allows: a reader for each kind of hint. Tensors stand in `tensors`."""

import collections.abc
import dataclasses
import functools
import itertools
import numbers
import types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import AbstractArray
from torch import Tensor

from torchgrasp.checks.paths import check_path
from torchgrasp.checks.ranges import ANY, FINITE, MOST, RIGID, Range, Rows
from torchgrasp.checks.tensors import Call, TensorHint, check_dense, show
from torchgrasp.errors import BadArgument

Reader = Callable[[str, Any, Call], Any]
"""Returns the argument of a name, numbers as Python's own; raises `BadArgument`."""
NUMBERS = Range(-MOST, MOST, "a finite number")
"""The range of a `float` without one of its own."""


@functools.cache
def reader(hint: Any) -> tuple[Reader, str]:
    """Return the reader of a hint, and in words what it allows."""
    origin, inside = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return _annotated(inside[0], inside[1])
    if origin in (typing.Union, types.UnionType):
        return _union(inside)
    if origin is typing.Literal:
        return _literal(inside)
    if is_subclass(hint, AbstractArray):
        return _tensor(hint)
    if hint in (int, float, bool):
        return _number(hint, Range(-(2**63), 2**63 - 1, "a whole number") if hint is int else NUMBERS)
    if origin is not None and isinstance(origin, type):
        return _container(origin, inside)
    if hint is Path:
        return _path(Path)
    if isinstance(hint, type) and hint not in (object, Any):
        return _instance(hint)
    return (lambda name, value, call: value), "anything"


def _number(kind: Callable[[Any], Any], allowed: Range) -> tuple[Reader, str]:
    """Read a number of a kind, NumPy's too, as Python's own."""
    if kind is bool:
        text = "True or False"
    else:
        text = allowed.describe("a whole number" if kind is int else "a number")

    def is_good(value: Any) -> bool:
        if kind is bool or isinstance(value, bool):
            return kind is bool and type(value).__name__ in ("bool", "bool_")
        if not isinstance(value, numbers.Integral if kind is int else numbers.Real):
            return False
        x: Any = value  # integers of any length are compared as they are, and NaN is in no range
        return bool(allowed.low <= x <= allowed.high and (abs(x) <= MOST or isinstance(x, float)))

    def read(name: str, value: Any, call: Call) -> Any:
        if not is_good(value):
            raise BadArgument(name, show(value), text)
        return kind(value)

    return read, text


def _literal(options: tuple[Any, ...]) -> tuple[Reader, str]:
    """Read one of some values."""
    text = "one of " * (len(options) > 1) + ", ".join(map(repr, options))

    def read(name: str, value: Any, call: Call) -> Any:
        if not any(type(value) is type(option) and value == option for option in options):
            raise BadArgument(name, show(value), text)
        return value

    return read, text


def _union(options: tuple[Any, ...]) -> tuple[Reader, str]:
    """Read what any option allows; of a tensor, the error says what the last option for tensors has against it."""
    options = tuple(x for x in options if x is not int or float not in options)  # whole numbers are numbers
    named = Path in options  # a text beside a path is one, too
    readers = [_path(str)[0] if named and option is str else reader(option)[0] for option in options]
    text = " or ".join(dict.fromkeys(reader(option)[1] for option in options))

    def read(name: str, value: Any, call: Call) -> Any:
        reasons = []
        for option in readers:
            try:
                return option(name, value, call)
            except BadArgument as reason:
                reasons.append(reason)
        near = [x for x in reasons if x.argument != name or x.found != show(value)]
        shapes = [x for x in near if str(x.found).startswith("shape")]
        if near and len(near) == len(shapes):
            raise BadArgument(near[0].argument, near[0].found, " or ".join(x.allowed for x in near))
        raise next(x for x in near if x not in shapes) if near else BadArgument(name, show(value), text)

    return read, text


def _tensor(hint: Any) -> tuple[Reader, str]:
    """Read a tensor by its annotation; that of floating numbers must be finite."""
    if hint.array_type is not Tensor:
        return _instance(hint.array_type)
    kind = hint.dtype.__name__
    expected = TensorHint(kind, hint.dim_str)

    def read(name: str, value: Any, call: Call) -> Any:
        expected.read(name, value, call)
        if kind == "Float":
            call.found[name] = value
        return value

    return read, f"a tensor of shape {expected.text}"


def _annotated(hint: Any, mark: Any) -> tuple[Reader, str]:
    """Read a number in a range, or numbers that may or must not be NaN or infinite."""
    if isinstance(mark, Range):
        return _number(hint, mark)
    inner, text = reader(hint)

    def read(name: str, value: Any, call: Call) -> Any:
        if mark == ANY and hint is float and isinstance(value, float):
            return value
        if isinstance(mark, Rows):
            result = inner(name, value, call)
            if (wanted := call.sizes.setdefault(mark.letter, len(result))) != len(result):
                raise BadArgument(name, f"{len(result)} rows", f"{wanted}, as many as the others have")
            return result
        if mark not in (ANY, FINITE) or (mark == ANY and call.strict):
            result = inner(name, value, call)
            if mark == RIGID:
                call.rigid[name] = result
            return result
        own = Call(call.gradients, call.deep, call.strict or mark == FINITE, call.sizes)
        own.found = call.found if mark == FINITE else own.found
        own.rigid = call.rigid
        result = inner(name, value, own)
        call.sizes = own.sizes
        return result

    return read, text


def _container(origin: type, inside: tuple[Any, ...]) -> tuple[Reader, str]:
    """Read a tuple, a sequence or a mapping, and what is in it; other generic types by their own type."""
    name_of = {collections.abc.Callable: "a function"}.get(origin, f"a {origin.__name__.lower()}")
    fixed = origin is tuple and inside[-1:] != (...,)
    items = [reader(x)[0] for x in inside if x is not ...] if origin is not collections.abc.Callable else []

    def read(name: str, value: Any, call: Call) -> Any:
        wrong = not isinstance(value, origin) or isinstance(value, str | bytes | Tensor | np.ndarray)
        if wrong or (fixed and len(value) != len(items)):
            raise BadArgument(name, show(value), f"{name_of} of {len(items)}" if fixed else name_of)
        if isinstance(value, collections.abc.Mapping):
            parts = {items[0](name, k, call): items[1](f"{name}[{k!r}]", x, call) for k, x in value.items()}
            return parts if type(value) is dict else value
        if not items or not isinstance(value, collections.abc.Iterable):
            return value
        readers = items if fixed else itertools.repeat(items[0])
        parts = (r(f"{name}[{i}]", x, call) for i, (r, x) in enumerate(zip(readers, value, strict=False)))
        if not isinstance(value, collections.abc.Sized):
            return parts  # a stream is read when it comes
        parts = tuple(parts)
        if isinstance(value, collections.abc.Sequence):
            return list(parts) if isinstance(value, list) else parts
        return value

    return read, name_of


def _path(kind: type[Path | str]) -> tuple[Reader, str]:
    """Read a path, or a text that is one."""
    inner, text = _instance(kind)

    def read(name: str, value: Any, call: Call) -> Any:
        check_path(name, inner(name, value, call))
        return value

    return read, text


def _instance(kind: type) -> tuple[Reader, str]:
    """Read an object of a class; a tensor has its numbers, and a checked value is checked again inside."""
    text = {type(None): "None", str: "a text"}.get(kind, f"a {kind.__name__}")

    def read(name: str, value: Any, call: Call) -> Any:
        if not isinstance(value, kind):
            raise BadArgument(name, show(value), text)
        if isinstance(value, Tensor):
            check_dense(name, value)
            if value.requires_grad and not call.gradients:
                raise BadArgument(name, "a tensor that requires a gradient", f"one without: {name}.detach()")
        elif call.deep and (fields := getattr(type(value), "__checked_fields__", None)):
            inner = call.inner()
            for field, hint in fields().items():
                reader(hint)[0](f"{name}.{field}", getattr(value, field), inner)
        return value

    return read, text


def has_tensor(hint: Any) -> bool:
    """Tell whether a hint names a tensor."""
    inner = () if typing.get_origin(hint) is collections.abc.Callable else typing.get_args(hint)
    return is_subclass(hint, AbstractArray, Tensor) or any(has_tensor(x) for x in inner)


def is_subclass(hint: Any, *kinds: type) -> bool:
    """Tell whether a hint is a class, and below one of others.

    `list[int]` is none: Python 3.10 calls it a type all the same, and then refuses it to `issubclass`.

    >>> is_subclass(bool, int), is_subclass(list[int], list)
    (True, False)
    """
    return typing.get_origin(hint) is None and isinstance(hint, type) and issubclass(hint, kinds)


def fields_of(kind: type, hints: Callable[[type], dict[str, Any]]) -> Callable[[], dict[str, Any]]:
    """Return a function of the hints of a dataclass's fields, which it finds once, when they are needed."""

    @functools.cache
    def fields() -> dict[str, Any]:
        found = hints(kind)
        return {field.name: found[field.name] for field in dataclasses.fields(kind)}  # pyright: ignore[reportArgumentType]

    return fields
