"""Argument validation: public functions and values check their arguments by annotations, with
jaxtyping and beartype.

`checked` decorates a public function or the class of a value. A call from outside the library is
compared with the signature: type, shape, dtype, finite numbers, range. Calls that the library makes
itself are not checked again.
"""

import collections.abc
import contextlib
import dataclasses
import difflib
import functools
import inspect
import threading
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from numbers import Integral, Real
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar, overload

import numpy as np
import torch
from beartype.door import is_bearable
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import (
    ANY,
    DTYPES,
    FINITE,
    MOST,
    NUMBERS,
    RIGID,
    Range,
    Rows,
    Taken,
    check_dense,
    check_path,
    check_plain,
    check_unmasked,
    describe,
    fits,
    is_known,
    is_rigid,
    is_tensor,
    nearest_rotation,
    show,
)
from torchgrasp.foundation.settings import DEVICES, in_autocast, usual_settings
from torchgrasp.foundation.threads import each_within

Checked = TypeVar("Checked", bound=Callable[..., Any])
_thread = threading.local()  # `inside` is True while this thread is in a checked function


@dataclasses.dataclass
class _Call:
    """The state while the arguments of one call are checked.

    Args:
        gradients: whether tensors may require a gradient.
        deep: whether the fields of values are checked.
        strict: whether numbers must be finite also in fields annotated `ANY`.
        sizes: the sizes of axes found so far, by their letters.
        finite: tensors whose numbers must be finite, by the argument's name.
        rigid: tensors that must be rigid transforms, by the argument's name.
        arguments: all arguments of the call, by their names.
    """

    gradients: bool
    deep: bool = True
    strict: bool = False
    sizes: dict[str, Any] = dataclasses.field(default_factory=dict[str, Any])
    finite: dict[str, Tensor] = dataclasses.field(default_factory=dict[str, Tensor])
    rigid: dict[str, Tensor] = dataclasses.field(default_factory=dict[str, Tensor])
    arguments: dict[str, Any] = dataclasses.field(default_factory=dict[str, Any])

    def check_numbers(self) -> None:
        """Raise `BadArgument` if a tensor in `finite` has NaN or infinity, or one in `rigid` is no
        rigid transform.
        """
        for tensors, test, allowed in (
            (self.finite, torch.isfinite, "finite numbers"),
            (self.rigid, is_rigid, RIGID),
        ):
            for name, x in tensors.items():
                if is_known(x) and not bool((good := test(x)).all()):
                    first = tuple(torch.nonzero(~good)[0].tolist())
                    place = f" at index {list(first)}" if first else ""
                    if allowed == RIGID:
                        angle = nearest_rotation(x[first][:3, :3])[1]
                        place += f", {angle:.2g} degrees from the nearest rotation"
                    raise BadArgument(name, f"{x[first].tolist()}{place}", allowed)


@overload
def checked(thing: Checked) -> Checked: ...
@overload
def checked(*, gradients: bool) -> Callable[[Checked], Checked]: ...
def checked(thing: Any = None, *, gradients: bool = False) -> Any:
    """Return the function or dataclass `thing` with a check of its arguments against their
    annotations. A wrong argument raises `BadArgument`.

    It is used as a decorator, `@checked` or `@checked(gradients=True)`; for the latter `thing` is
    None. Type, shape, dtype and range are checked, and that numbers are finite. NumPy numbers
    become Python numbers. A class checks its fields when an object is made. If an argument is a
    `Value`, its fields are checked again. In a method, a letter in a shape has the same size as in
    the fields of the object.

    Calls from within another checked function are not checked. Only a dataclass is, if it has a
    `__post_init__` or no tensor among its fields.

    With `gradients` True, the function is differentiable. It then takes tensors that require a
    gradient, dual tensors and tensors inside a transform of torch.func. Other functions refuse
    them. Numbers inside torch.vmap and arguments inside torch.compile are not checked.
    """
    if thing is None:
        return functools.partial(checked, gradients=gradients)
    if not isinstance(thing, type):
        return _guard(thing, thing, gradients, lambda: False)
    setattr(thing, "__init__", _guard(thing.__init__, thing, True, lambda: _always(thing)))  # noqa: B010
    setattr(thing, "__checked__", True)  # noqa: B010
    return thing


def _guard(function: Any, owner: Any, gradients: bool, always: Callable[[], bool]) -> Any:
    """Return `function` with a check of its arguments; `always()` tells whether to check calls by
    the library, too.
    """
    signature = inspect.signature(function)
    is_method = next(iter(signature.parameters), "") == "self" and not isinstance(owner, type)
    several = {p.kind: p.name for p in signature.parameters.values()}
    rest = several.get(inspect.Parameter.VAR_POSITIONAL)
    options = several.get(inspect.Parameter.VAR_KEYWORD)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        # a compiler traces the function, not the checks
        if gradients and torch.compiler.is_compiling():
            if not in_autocast():
                return function(*args, **kwargs)
            with (
                torch.autocast(DEVICES[0], enabled=False),
                torch.autocast(DEVICES[-1], enabled=False),
            ):
                return function(*args, **kwargs)
        inside = getattr(_thread, "inside", False)
        if inside and not always():
            return function(*args, **kwargs)
        if inside:
            return run(args, kwargs, inside)
        with usual_settings():
            return run(args, kwargs, inside)

    def run(args: tuple[Any, ...], kwargs: dict[str, Any], inside: bool) -> Any:
        if options is None and not kwargs.keys() <= signature.parameters.keys():
            _check_options(signature, kwargs, owner)
        bound = signature.bind(*args, **kwargs)
        arguments = bound.arguments
        shared = _Call(gradients, deep=not inside, arguments=arguments)
        hints = _hints(owner)
        if is_method:
            shared.sizes.update(_lengths(arguments["self"]))
        for name, value in arguments.items():
            if name not in hints:
                continue
            hint = hints[name]
            if name == options:
                arguments[name] = {k: _read(k, x, hint, shared) for k, x in value.items()}
            elif name == rest:
                arguments[name] = tuple(
                    _read(f"{name}[{i}]", x, hint, shared) for i, x in enumerate(value)
                )
            else:
                arguments[name] = _read(name, value, hint, shared)
        shared.check_numbers()
        _thread.inside = True
        try:
            result = function(*bound.args, **bound.kwargs)
        finally:
            _thread.inside = inside
        if not inside and inspect.isgenerator(result):
            return each_within(result, _unchecked)
        return result

    setattr(call, "__checked__", True)  # noqa: B010
    return call


class _Form(NamedTuple):
    """What is read of an annotation once. It is its type with brackets or None, the types in the
    brackets, and what kind of annotation it is.
    """

    hint: Any
    origin: Any
    inside: tuple[Any, ...]
    is_number: bool
    is_tensor: bool
    is_container: bool


_forms = dict[int, _Form]()
"""Forms by the `id` of the annotation, which each of them keeps."""


def _form(hint: Any) -> _Form:
    """Return what is read of an annotation."""
    found = _forms.get(id(hint))
    if found is None:
        origin = typing.get_origin(hint)
        container = isinstance(origin, type) and origin not in (type, collections.abc.Callable)
        number = hint in (int, float, bool)
        found = _Form(hint, origin, typing.get_args(hint), number, is_tensor(hint), container)
        _forms[id(hint)] = found
    return found


@contextlib.contextmanager
def _unchecked() -> Iterator[None]:
    """Within the context, calls of this thread are the library's own, in its settings of torch."""
    inside = getattr(_thread, "inside", False)
    _thread.inside = True
    try:
        with usual_settings():
            yield
    finally:
        _thread.inside = inside


def arguments_beside() -> Mapping[str, Any]:
    """Return all arguments of the call of which one is converted now (`Taken.read`), by their
    names. Outside of a conversion there are none.
    """
    return getattr(_thread, "arguments", {})


def _read(name: str, value: Any, hint: Any, call: _Call) -> Any:
    """Return an argument if it satisfies its annotation, a number as a Python number; else raise
    `BadArgument`.
    """
    _, origin, inside, is_number, of_tensor, is_container = _form(hint)
    if isinstance(value, np.ndarray):
        check_unmasked(name, value)
        # torch takes no array that is read backwards, such as a reversed pixel
        value = value.copy() if min(value.strides, default=0) < 0 else value
    if of_tensor:
        return _read_tensor(name, value, hint, call)
    if origin is Annotated:
        return _read_marked(name, value, inside[0], inside[1], call)
    if origin in (typing.Union, types.UnionType):
        return _read_union(name, value, hint, inside, call)
    if is_number:
        return read_number(name, value, hint, NUMBERS.get(hint))
    if is_container:
        return _read_container(name, value, origin, inside, call)
    if not is_bearable(value, hint):
        raise BadArgument(name, show(value), describe(hint))
    if hint is Path:
        check_path(name, value)
    elif isinstance(value, Tensor) and hint not in (object, Any):
        check_dense(name, value, call.gradients)
    elif call.deep and hasattr(type(value), "__checked__") and dataclasses.is_dataclass(value):
        inner = dataclasses.replace(call, sizes={})  # the letters of a value are its own
        for field, of_field in _fields(type(value)).items():
            _read(f"{name}.{field}", getattr(value, field), of_field, inner)
    elif call.deep and not call.gradients and dataclasses.is_dataclass(value):
        _refuse_gradients(name, value)
    return value


def _refuse_gradients(name: str, value: Any) -> None:
    """Raise `BadArgument` if derivatives are taken with respect to a tensor of a value whose fields
    are not checked.
    """
    for field, x in vars(value).items():
        if isinstance(x, Tensor):
            check_dense(f"{name}.{field}", x, gradients=False)
        elif dataclasses.is_dataclass(x):
            _refuse_gradients(f"{name}.{field}", x)


def read_number(name: str, value: Any, kind: Any, allowed: Range | None) -> Any:
    """Return `value`, a Python or NumPy number, as a Python number of the type `kind`: int, float
    or bool.

    Raises `BadArgument` if the value is of another type or outside the range `allowed`; None allows
    every number. A whole number also counts as a float. Errors call the value by `name`.
    """
    # A comparison of float32 with the ends of a range would overflow.
    number: Any = value.item() if isinstance(value, np.generic) else value
    if kind is bool:
        good = isinstance(value, bool | np.bool_)
    else:
        good = isinstance(value, Integral if kind is int else Real) and not isinstance(value, bool)
    if good and allowed is not None:  # huge whole numbers are compared as they are
        good = allowed.low <= number <= allowed.high and (
            abs(number) <= MOST or isinstance(number, float)
        )
    if not good:
        raise BadArgument(
            name, show(number), describe(Annotated[kind, allowed] if allowed else kind)
        )
    return kind(number)


def _read_marked(name: str, value: Any, hint: Any, mark: Any, call: _Call) -> Any:
    """Return an argument if it satisfies the rule in its annotation, such as a range; else raise
    `BadArgument`.
    """
    if isinstance(mark, Range):
        return read_number(name, value, hint, mark)
    if isinstance(mark, Taken):
        _thread.arguments = call.arguments
        try:
            converted = mark.read(value, name)
        finally:
            _thread.arguments = {}
        return _read(name, converted, mark.kind, call)
    if mark == ANY and hint is float and isinstance(value, float):
        return value
    if mark == ANY and not call.strict:
        call = dataclasses.replace(call, finite={})
    inner = dataclasses.replace(call, strict=True) if mark == FINITE else call
    result = _read(name, value, hint, inner)
    if mark == RIGID:
        call.rigid[name] = result
    if isinstance(mark, Rows):
        wanted = call.sizes.setdefault(mark.letter, len(result))
        if len(result) != wanted:
            allowed = f"{wanted} rows, as many as the others have"
            raise BadArgument(name, f"{len(result)} rows", allowed)
    return result


def _read_union(name: str, value: Any, hint: Any, options: tuple[Any, ...], call: _Call) -> Any:
    """Return an argument if it satisfies one type of a union; otherwise raise the error of the
    closest type.
    """
    errors: list[BadArgument] = []
    for option in (x for x in options if x is not int or float not in options):
        try:
            result = _read(name, value, option, call)
        except BadArgument as error:
            errors.append(error)
            continue
        if option is str and Path in options:
            check_path(name, result)
        return result
    near = [x for x in errors if x.argument != name or x.found != show(value)]
    shapes = [x for x in near if str(x.found).startswith("shape")]
    if near and len(near) == len(shapes):
        raise BadArgument(near[0].argument, near[0].found, " or ".join(x.allowed for x in near))
    if near:
        raise next(x for x in near if x not in shapes)
    raise BadArgument(name, show(value), describe(hint))


def _read_tensor(name: str, value: Any, hint: Any, call: _Call) -> Tensor:
    """Return a tensor if it has the annotated shape and dtype; record the sizes of the axes that
    are letters.
    """
    axes, dtypes = _shape(hint)
    sizes = dict(call.sizes)
    if not isinstance(value, Tensor):
        raise BadArgument(name, show(value), f"a torch {describe(hint)[2:]}")
    check_dense(name, value, gradients=True)
    if not fits(axes, tuple(value.shape), sizes):
        known = [
            f"{axis} = {call.sizes[axis]}" for axis in dict.fromkeys(axes) if axis in call.sizes
        ]
        allowed = ", ".join(
            [describe(hint).removeprefix("a tensor of ") if axes else "shape ()", *known]
        )
        raise BadArgument(name, f"shape {tuple(value.shape)}", allowed)
    if value.dtype not in dtypes:
        raise BadArgument(name, str(value.dtype), " or ".join(map(str, dtypes)))
    if not call.gradients:
        check_plain(name, value)
    call.sizes.update(sizes)
    if value.is_inference():  # torch refuses it where derivatives are taken
        value = value.clone()
    if hint.dtype.__name__ == "Float":
        call.finite[name] = value
    return value


@functools.cache
def _shape(hint: Any) -> tuple[list[str], tuple[torch.dtype, ...]]:
    """Return the axes of an annotated tensor, and the dtypes of its kind."""
    return hint.dim_str.split(), DTYPES.get(hint.dtype.__name__) or sum(DTYPES.values(), ())


def _read_container(
    name: str, value: Any, origin: type, inside: tuple[Any, ...], call: _Call
) -> Any:
    """Return a tuple, sequence or mapping after a check of its items; items of an iterator are
    checked when drawn.
    """
    fixed = origin is tuple and inside[-1:] != (...,)
    wrong = not isinstance(value, origin) or isinstance(value, str | bytes | Tensor | np.ndarray)
    if wrong or (fixed and len(value) != len(inside)):
        raise BadArgument(
            name,
            show(value),
            f"a tuple of {len(inside)}" if fixed else f"a {origin.__name__.lower()}",
        )
    if isinstance(value, collections.abc.Mapping):
        items = {
            _read(name, k, inside[0], call): _read(f"{name}[{k!r}]", x, inside[1], call)
            for k, x in value.items()
        }
        return items if type(value) is dict else value
    if not inside or not isinstance(value, collections.abc.Iterable):
        return value
    parts = (_read(f"{name}[{i}]", x, inside[i if fixed else 0], call) for i, x in enumerate(value))
    if not isinstance(value, collections.abc.Sized):
        return parts
    read = list(parts)
    if not isinstance(value, collections.abc.Sequence):
        return value
    return read if isinstance(value, list) else tuple(read)


def _has_tensor(hint: Any) -> bool:
    inner = () if typing.get_origin(hint) is collections.abc.Callable else typing.get_args(hint)
    return hint is Tensor or is_tensor(hint) or any(map(_has_tensor, inner))


@functools.cache
def _always(kind: type) -> bool:
    """Return whether a class of values is checked even if the library makes the value. Its numbers
    may be bad.
    """
    return hasattr(kind, "__post_init__") or not any(map(_has_tensor, _fields(kind).values()))


@functools.cache
def _fields(kind: type) -> dict[str, Any]:
    """Return the type annotation of each field of a dataclass, by name; empty for other types."""
    fields = dataclasses.fields(kind) if dataclasses.is_dataclass(kind) else ()
    return {field.name: _hints(kind)[field.name] for field in fields}


def _lengths(value: Any) -> dict[str, int]:
    """Return the size of each letter in the annotated shapes of a value's tensors, such as {"n":
    100}.
    """
    pairs = (
        pair
        for field, axes in _simple_axes(type(value)).items()
        for pair in zip(axes, getattr(value, field).shape, strict=False)
    )
    return {axis: n for axis, n in pairs if axis.isalpha()}


@functools.cache
def _simple_axes(kind: type) -> dict[str, list[str]]:
    """Return the annotated axes of each field that is a tensor with a fixed number of axes."""
    tensors = {
        field: hint.dim_str.split() for field, hint in _fields(kind).items() if is_tensor(hint)
    }
    return {
        field: axes for field, axes in tensors.items() if not any(axis[0] in "*.#" for axis in axes)
    }


@functools.cache
def _hints(thing: Any) -> dict[str, Any]:
    """Return the annotations of a function or class."""
    return typing.get_type_hints(thing, include_extras=True)


def _check_options(signature: inspect.Signature, given: dict[str, Any], owner: Any) -> None:
    """Raise `TypeError` for a keyword argument that a function lacks, with those that it has.

    It names the nearest argument, or the argument whose value has a field of this name.
    """
    for name in given.keys() - signature.parameters.keys():
        known = [option for option in signature.parameters if option != "self"]
        sentence = f"expected one of {', '.join(known)}{_hint(name, signature, owner)}"
        raise TypeError(f"got an unexpected keyword argument {name!r}: {sentence}")


def _hint(name: str, signature: inspect.Signature, owner: Any) -> str:
    """Return a text on where an unknown keyword argument belongs; empty if that is unknown.

    It may be a field of the value that another, optional argument takes, or a misspelt name.
    """
    hints = _hints(owner)
    for option, parameter in signature.parameters.items():
        if parameter.default is not None or option not in hints:
            continue
        for kind in (hints[option], *typing.get_args(hints[option])):
            if isinstance(kind, type) and name in _fields(kind):
                return f"; {name} is a field: {option}={kind.__name__}({name}=...)"
    near = difflib.get_close_matches(name, list(signature.parameters), 1)
    return f"; did you mean {near[0]}?" if near else ""


def check_value(name: str, value: Any, hint: Any) -> None:
    """Raise `BadArgument`, which calls the value `name`, if it does not satisfy an annotation."""
    call = _Call(gradients=True)
    _read(name, value, hint, call)
    call.check_numbers()


def check_tensor(name: str, value: Any, shape: tuple[int | None, ...]) -> Tensor:
    """Return `value` if it is a finite floating-point tensor of the given shape; else raise
    `BadArgument`.

    A None in `shape` allows any size of this axis. Errors call the tensor by `name`.
    """
    call = _Call(gradients=True)
    axes = " ".join("_" if size is None else str(size) for size in shape)
    _read_tensor(name, value, Float[Tensor, axes], call)
    call.check_numbers()
    return value
