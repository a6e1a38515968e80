"""Annotations of every call are checked as jaxtyping does, in a fraction of its time.

A function gets its check at its first call, and nested functions share one check. Shapes are compared without copies.
"""

import dataclasses
import functools
import inspect
import typing
from collections.abc import Callable
from types import CodeType, FunctionType, SimpleNamespace
from typing import Any, NamedTuple

import jaxtyping
import torch
from beartype import BeartypeConf, beartype
from jaxtyping import _array_types as arrays
from jaxtyping._storage import get_shape_memo, pop_shape_memo, push_shape_memo
from torch import Tensor

by_jaxtyping, instance_by_jaxtyping = jaxtyping.jaxtyped, arrays._MetaAbstractArray.__instancecheck__
CHECKS: dict[CodeType, FunctionType] = {}
"""A function with a check, by the code of the function."""


def jaxtyped(thing: Any = None, **options: Any) -> Any:
    """Check the annotations of a function or dataclass, as the decorator of jaxtyping does."""
    if "typechecker" not in options or inspect.isgeneratorfunction(thing):
        return by_jaxtyping(thing, **options)
    if thing is None:
        return functools.partial(jaxtyped, **options)
    if isinstance(thing, type):
        if dataclasses.is_dataclass(thing) and getattr(thing.__init__, "__globals__", None) is not globals():
            setattr(thing, "__init__", jaxtyped(thing.__init__, **options))  # noqa: B010
        return thing
    return with_check(thing) if thing.__annotations__ else thing


def with_check(thing: FunctionType) -> Callable[..., Any]:
    """Return a function whose calls are checked; each call binds the letters of its shapes anew."""
    checked: Any = None

    @functools.wraps(thing)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal checked
        checked = checked or bound(thing)
        push_shape_memo({})
        try:
            return checked(*args, **kwargs)
        finally:
            pop_shape_memo()

    return call


def bound(thing: FunctionType) -> FunctionType:
    """Return a function with its check, which is made once for all functions of the same code."""
    if thing.__code__ not in CHECKS:
        hints = {name: resolved(hint, thing.__globals__) for name, hint in thing.__annotations__.items()}
        CHECKS[thing.__code__] = beartype(conf=BeartypeConf(violation_type=TypeError))(copied(thing, thing, hints))
    check = CHECKS[thing.__code__]
    if "__beartype_func" not in (check.__kwdefaults__ or {}):  # nothing of it can be checked
        return thing
    return copied(check, check, check.__annotations__, __beartype_func=thing)


def copied(code: FunctionType, names: FunctionType, hints: dict[str, Any], **defaults: Any) -> FunctionType:
    """Return a copy of a function with other annotations and with other defaults of keywords."""
    copy = FunctionType(code.__code__, code.__globals__, names.__name__, code.__defaults__, code.__closure__)
    copy.__kwdefaults__ = {**(code.__kwdefaults__ or {}), **defaults}
    copy.__qualname__, copy.__module__, copy.__annotations__ = names.__qualname__, names.__module__, hints
    return copy


def resolved(hint: Any, names: dict[str, Any]) -> Any:
    """Return an annotation without texts; `Any` where a text names what is not defined."""
    try:
        return typing.get_type_hints(SimpleNamespace(__annotations__={"it": hint}), names, include_extras=True)["it"]
    except NameError:
        return Any


class Axes(NamedTuple):
    """The axes of a tensor in an annotation: their sizes and letters."""

    first: tuple[int | str, ...]
    many: str | None
    """The name of any number of axes between the first and the last ones."""
    last: tuple[int | str, ...]


@functools.cache
def axes_of(hint: Any) -> Axes | None:
    """Return the axes of an annotation; none if it has others than sizes and letters."""
    fixed, named = arrays._FixedDim, arrays._NamedDim | arrays._NamedVariadicDim
    for axis in hint.dims:
        if not isinstance(axis, fixed | named) or axis.broadcastable or getattr(axis, "treepath", False):
            return None
    sizes, at = tuple(axis.size if isinstance(axis, fixed) else axis.name for axis in hint.dims), hint.index_variadic
    return Axes(sizes, None, ()) if at is None else Axes(sizes[:at], sizes[at], sizes[at + 1 :])


@functools.cache
def takes(hint: Any, dtype: torch.dtype) -> bool:
    """Return whether an annotation takes tensors of a type of numbers."""
    number = torch.empty((), dtype=dtype, device="meta")
    return issubclass(Tensor, hint.array_type) and instance_by_jaxtyping(hint.dtype[Tensor, "..."], number)


def is_instance(hint: Any, value: Any) -> bool:
    """Return whether a value fits an annotation, and bind its letters; jaxtyping decides in rare cases."""
    axes = axes_of(hint)
    if axes is None or not isinstance(value, Tensor) or not takes(hint, value.dtype):
        return instance_by_jaxtyping(hint, value)
    shape, (letters, shapes, *_) = tuple(value.shape), get_shape_memo()
    first, many, last = axes
    between = shape[len(first) : len(shape) - len(last)]
    if len(shape) < len(first) + len(last) or (many is None and between):
        return False
    new: dict[int | str, int] = {}
    for axis, size in zip(first + last, shape[: len(first)] + shape[len(first) + len(between) :], strict=True):
        if axis != size and (isinstance(axis, int) or letters.get(axis, new.setdefault(axis, size)) != size):
            return False
    if many is not None and shapes.get(many, (False, between)) != (False, between):
        return instance_by_jaxtyping(hint, value)
    letters.update(new)
    if many is not None:
        shapes[many] = (False, between)
    return True


def install() -> None:
    """Replace the decorator of jaxtyping and its check of shapes; the library is imported later."""
    jaxtyping.jaxtyped = jaxtyped
    arrays._MetaAbstractArray.__instancecheck__ = is_instance
