"""Annotations of the first calls in each test are checked as jaxtyping does, but without binding of
arguments.

Binding takes most of jaxtyping's time. The later steps of a solver have the shapes of the first
ones. A function gets its check at its first call, and nested functions share one check.
"""

import dataclasses
import functools
import inspect
import typing
from collections.abc import Callable
from types import CodeType, FunctionType, SimpleNamespace
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype
from jaxtyping._storage import pop_shape_memo, push_shape_memo

by_jaxtyping = jaxtyping.jaxtyped
CHECKS: dict[CodeType, FunctionType] = {}
"""A function with a check, by the code of the function."""
CALLS = 3  # of a function that are checked in each test
LEFT: dict[CodeType, list[int]] = {}
"""Number of calls that are still to be checked in this test, by the code of the function."""
BEGUN: list[list[int]] = []
"""Those numbers of `LEFT` that are less than `CALLS`."""


def check_anew() -> None:
    """Check annotations of the first calls of the next test, too."""
    for left in BEGUN:
        left[0] = CALLS
    BEGUN.clear()


def jaxtyped(thing: Any = None, **options: Any) -> Any:
    """Check the annotations of a function or dataclass, as the decorator of jaxtyping does."""
    if "typechecker" not in options:
        return by_jaxtyping(thing, **options)
    if thing is None:
        return functools.partial(jaxtyped, **options)
    if isinstance(thing, type):
        if (
            dataclasses.is_dataclass(thing)
            and getattr(thing.__init__, "__globals__", None) is not globals()
        ):
            setattr(thing, "__init__", jaxtyped(thing.__init__, **options))  # noqa: B010
        return thing
    if inspect.isgeneratorfunction(thing):
        return first_calls(thing, by_jaxtyping(thing, **options))
    return with_check(thing) if thing.__annotations__ else thing


def first_calls(thing: FunctionType, checked: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function whose first calls are those of another, which checks them."""
    left = LEFT.setdefault(thing.__code__, [CALLS])

    @functools.wraps(thing)
    def call(*args: Any, **kwargs: Any) -> Any:
        if not left[0]:
            return thing(*args, **kwargs)
        if left[0] == CALLS:
            BEGUN.append(left)
        left[0] -= 1
        return checked(*args, **kwargs)

    return call


def with_check(thing: FunctionType) -> Callable[..., Any]:
    """Return a function whose first calls are checked; each call binds the letters of its shapes
    anew.
    """
    checked = None
    left = LEFT.setdefault(thing.__code__, [CALLS])  # a code is slow to look up at each call
    if not left[0]:  # of a nested function, which is made anew
        return thing

    @functools.wraps(thing)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal checked
        if not left[0] or push_shape_memo is None:  # the second: the process ends
            return thing(*args, **kwargs)
        if left[0] == CALLS:
            BEGUN.append(left)
        left[0] -= 1
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
        hints = {
            name: resolved(hint, thing.__globals__) for name, hint in thing.__annotations__.items()
        }
        CHECKS[thing.__code__] = beartype(conf=BeartypeConf(violation_type=TypeError))(
            copied(thing, thing, hints)
        )
    check = CHECKS[thing.__code__]
    if "__beartype_func" not in (check.__kwdefaults__ or {}):  # nothing of it can be checked
        return thing
    return copied(check, check, check.__annotations__, __beartype_func=thing)


def copied(
    code: FunctionType, names: FunctionType, hints: dict[str, Any], **defaults: Any
) -> FunctionType:
    """Return a copy of a function with other annotations and with other defaults of keywords."""
    copy = FunctionType(
        code.__code__, code.__globals__, names.__name__, code.__defaults__, code.__closure__
    )
    copy.__kwdefaults__ = {**(code.__kwdefaults__ or {}), **defaults}
    copy.__qualname__ = names.__qualname__
    copy.__module__ = names.__module__
    copy.__annotations__ = hints
    return copy


def resolved(hint: Any, names: dict[str, Any]) -> Any:
    """Return an annotation without texts; `Any` where a text names what is not defined."""
    try:
        return typing.get_type_hints(
            SimpleNamespace(__annotations__={"it": hint}), names, include_extras=True
        )["it"]
    except NameError:
        return Any


def install() -> None:
    """Replace the decorator of jaxtyping; the library is imported later."""
    jaxtyping.jaxtyped = jaxtyped
