"""The decorator of public functions and of values."""

import dataclasses
import functools
import importlib
import importlib.util
import inspect
import threading
import typing
from collections.abc import Callable
from typing import Any, TypeVar, overload

from jaxtyping import AbstractArray

from torchgrasp.checks.hints import fields_of, has_tensor, is_subclass, reader
from torchgrasp.checks.tensors import Call

Thing = TypeVar("Thing", bound=Callable[..., Any])

_thread = threading.local()
"""`inside` tells whether this thread is in a checked function: the calls that it makes are the library's own."""


@overload
def checked(thing: Thing) -> Thing: ...
@overload
def checked(*, gradients: bool) -> Callable[[Thing], Thing]: ...
def checked(thing: Any = None, *, gradients: bool = False) -> Any:
    """Check the arguments of a function, or of a dataclass where it is made, by their annotations.

    Numbers of NumPy become Python's own. A value is also checked where it is given to a function. A method's letters
    have the lengths that they have in the fields of its value. Calls from inside a checked function pass unread. So do
    values of tensors that it computes, unless they have a `__post_init__`: their numbers may come from files.

    Args:
        thing: a function, a method, or a dataclass.
        gradients: whether tensors may require a gradient: what is computed is differentiable by them.

    Raises:
        BadArgument: when called: an argument of another type, shape, dtype or range, or one that is not finite.

    >>> from torchgrasp.checks.ranges import Count
    >>> @checked
    ... def double(n: Count) -> int:
    ...     return 2 * n
    >>> double(0)
    Traceback (most recent call last):
    torchgrasp.errors.BadArgument: n: expected a whole number in [1, 1000000], got 0
    """
    if thing is None:
        return functools.partial(_checked, gradients=gradients)
    return _checked(thing, gradients)


def _checked(thing: Any, gradients: bool) -> Any:
    """Decorate a function or a dataclass."""
    if not isinstance(thing, type):
        return _guard(thing, thing, gradients, None)
    fields = fields_of(thing, resolve)
    setattr(thing, "__checked_fields__", staticmethod(fields))  # noqa: B010

    @functools.cache
    def always() -> bool:
        return hasattr(thing, "__post_init__") or not any(has_tensor(hint) for hint in fields().values())

    setattr(thing, "__init__", _guard(thing.__init__, thing, True, always))  # noqa: B010
    return thing


def _guard(function: Any, owner: Any, gradients: bool, always: Callable[[], bool] | None) -> Any:
    """Return the function behind its border."""
    signature = inspect.signature(function)
    of_value = next(iter(signature.parameters), "") == "self" and not isinstance(owner, type)

    @functools.cache
    def readers() -> dict[str, Any]:
        hints = resolve(owner)
        kinds = {
            name: (hints[name], parameter.kind) for name, parameter in signature.parameters.items() if name in hints
        }
        return {name: (reader(hint)[0], kind) for name, (hint, kind) in kinds.items()}

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        inside = getattr(_thread, "inside", False)
        if inside and (always is None or not always()):
            return function(*args, **kwargs)
        bound, shared = signature.bind(*args, **kwargs), Call(gradients, deep=not inside)
        if of_value:
            shared.sizes.update(lengths_of(bound.arguments["self"]))
        for name, (read, kind) in readers().items():
            if name in bound.arguments:
                bound.arguments[name] = _read(read, kind, name, bound.arguments[name], shared)
        shared.check_numbers()
        _thread.inside = True
        try:
            return function(*bound.args, **bound.kwargs)
        finally:
            _thread.inside = inside

    setattr(call, "__border__", True)  # noqa: B010
    return call


def _read(read: Any, kind: Any, name: str, value: Any, call: Call) -> Any:
    """Read an argument, or each of several that one name takes."""
    if kind is inspect.Parameter.VAR_POSITIONAL:
        return tuple(read(f"{name}[{i}]", x, call) for i, x in enumerate(value))
    if kind is inspect.Parameter.VAR_KEYWORD:
        return {key: read(key, x, call) for key, x in value.items()}
    return read(name, value, call)


def lengths_of(value: Any) -> dict[str, int]:
    """Return the lengths of the letters in a value's annotations: a method's letters are those of its value."""
    named = ((field, axes, getattr(value, field)) for field, axes in _axes(type(value)).items())
    pairs = ((axis, n) for _, axes, x in named for axis, n in zip(axes, x.shape, strict=False))
    return {axis: n for axis, n in pairs if axis.isalpha()}


@functools.cache
def _axes(kind: type) -> dict[str, list[str]]:
    """Return the axes of a dataclass's tensors, by field; those of any number of axes have no lengths."""
    if not dataclasses.is_dataclass(kind):
        return {}
    hints = fields_of(kind, resolve)()
    axes = {name: hint.dim_str.split() for name, hint in hints.items() if is_subclass(hint, AbstractArray)}
    return {name: found for name, found in axes.items() if not any(axis[0] in "*.#" for axis in found)}


def resolve(thing: Any) -> dict[str, Any]:
    """Return the hints of a function or class; names that are imported for type checkers alone are found now."""
    late: dict[str, Any] = {}
    while True:
        try:
            return typing.get_type_hints(thing, localns=late, include_extras=True)
        except NameError as error:
            late[str(error.name)] = _find(str(error.name))


class _ByName(type):
    """A class of which only the name is known: its objects are those of any class of that name."""

    def __instancecheck__(cls, instance: Any) -> bool:
        """Compare names."""
        return cls.__name__ in {base.__name__ for base in type(instance).__mro__}


def _find(name: str) -> Any:
    """Return a module by its name; else what stands for a class of the library that need not be loaded yet."""
    return importlib.import_module(name) if importlib.util.find_spec(name) else _ByName(name, (), {})
