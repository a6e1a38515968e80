"""Hostile arguments of public functions, made from their signatures; beartype says which are wrong."""

import dataclasses
import importlib
import inspect
import pkgutil
import types
import typing
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from beartype.door import is_bearable
from jaxtyping import AbstractArray, jaxtyped
from torch import Tensor

import torchgrasp
from tests.hostile.samples import Lengths, hints_of, sample, sample_tensor
from torchgrasp.foundation.checks import _lengths
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.rules import ANY, RIGID, Range, Taken

NAN = float("nan")
INF = float("inf")


class Odd:
    """An object of no type that is known."""

    def __repr__(self) -> str:
        return "Odd()"


HOSTILE = [
    None,
    "x",
    "",
    "a" * 5000,
    "a\0b",
    b"x",
    True,
    False,
    -1,
    0,
    1,
    1.5,
    -0.5,
    NAN,
    INF,
    -INF,
    2**63,
    -(2**63) - 1,
    2**64,
    10**400,
    1 + 1j,
    [],
    [1],
    [None],
    {},
    {"a": 1},
    (),
    (1,),
    {1},
    Odd(),
    Odd,
    int,
    len,
    np.float64("nan"),
    np.int64(-7),
    np.zeros(3),
    np.array(["x"]),
    np.array([None, 1]),
    torch.tensor(1),
    torch.tensor([1.0, 2.0]),
    torch.zeros(0),
    torch.zeros(2, 3, 4, 5),
    torch.zeros(3, dtype=torch.complex64),
    Path("x"),
    range(3),
    iter(()),
    Status.OK,
    torch.device("cpu"),
    torch.float16,
    trimesh.Trimesh(),
]
"""What people and programs pass by mistake."""


NO_PATHS = ["a" * 5000, "b" * 256, "c/" * 2500, "a\0b", "\ud800"]
"""Texts that no file can be called; as paths, too, they are refused the same way."""
NO_PATHS += [Path(text) for text in NO_PATHS]
NO_NUMBERS = "meta", "sparse", "negative bit", "half", "bfloat16"
"""Tensors that no annotation forbids, and the library does."""


def broken(valid: Tensor) -> dict[str, Tensor]:
    """Return tensors that no function takes, made from one that it takes."""
    out = {
        "meta": valid.to("meta"),
        "complex": valid.to(torch.complex64),
        "numpy": valid.numpy(),
        "list": valid.tolist(),
        "deeper": valid[None, None, None, None],
    }
    if valid.ndim:
        out["sparse"] = valid.to_sparse()
    if valid.is_floating_point():
        out |= {
            "half": valid.half(),
            "bfloat16": valid.bfloat16(),
            "int": valid.long(),
            "bool": valid > 0,
        }
        out |= {
            "negative bit": torch._neg_view(-valid),
            "quantised": torch.quantize_per_tensor(valid.float(), 0.1, 0, torch.qint8),
        }
    elif valid.dtype == torch.int64:
        out |= {"float": valid.double(), "uint8": valid.to(torch.uint8), "bool": valid > 0}
    else:
        out |= {"float": valid.double(), "int": valid.long()}
    return out


def longer(valid: Tensor, hint: Any, own: Lengths) -> list[Tensor]:
    """Return tensors that are too long along an axis whose length is given."""
    axes = hint.dim_str.split()
    given = len(valid.shape)
    places = [
        k for k, axis in enumerate(axes[::-1]) if axis.isdigit() or axis in own
    ]  # variable axes are first
    return [torch.cat([valid, valid.narrow(-1 - k, 0, 1)], -1 - k) for k in places if k < given]


def spoilt(valid: Tensor) -> dict[str, Tensor]:
    """Return tensors with one number that is none."""
    if not valid.is_floating_point() or not valid.numel():
        return {}
    last = torch.arange(valid.numel()).reshape(valid.shape) == valid.numel() - 1
    return {
        str(x): torch.where(last, torch.tensor(x, dtype=valid.dtype), valid)
        for x in (NAN, INF, -INF)
    }


def crooked(valid: Tensor) -> list[Tensor]:
    """Return transforms that scale, mirror or shear, and one of zeros."""
    return [
        3 * valid,
        torch.diag(torch.tensor([-1.0, 1, 1, 1])).to(valid) @ valid,
        valid.cumsum(-1),
        0 * valid,
    ]


def is_wrong(value: Any, hint: Any) -> bool:
    """Tell by beartype whether a value breaks an annotation; whole numbers and NumPy's are numbers,
    too.
    """
    hints = [hint]
    while hints:
        one = hints.pop()
        origin = typing.get_origin(one)
        inside = typing.get_args(one)
        if origin in (typing.Union, types.UnionType):
            hints += inside
        elif origin is typing.Annotated and isinstance(inside[1], Range):
            huge = isinstance(value, int) and abs(value) >= 2**1024  # no floating number
            if (
                is_number(value, inside[0])
                and inside[1].low <= value <= inside[1].high
                and not huge
            ):
                return False
        elif origin is typing.Annotated and inside == (float, ANY):
            if is_number(value, float) and (not abs(value) >= 1e308 or isinstance(value, float)):
                return False
        elif one in (int, float):
            if is_number(value, one) and abs(value) < (2**63 if one is int else 1e308):
                return False
        elif origin is typing.Annotated and isinstance(inside[1], Taken):
            hints.append(inside[0])
        else:
            with jaxtyped("context"):
                if (
                    not isinstance(value, Tensor) or tensors_in(one) or one is Tensor
                ):  # beartype asks for their length
                    if is_bearable(value, one) or is_bearable(floated(value), one):
                        return False
    return True


def floated(value: Any) -> Any:
    """Return a container with its whole numbers as floating ones, which any container of those may
    hold.
    """
    if isinstance(value, dict):
        return {key: float(x) if is_number(x, int) else x for key, x in value.items()}
    if isinstance(value, list | tuple | range) and not isinstance(value, str):
        parts = [float(x) if is_number(x, int) else x for x in value]
        return tuple(parts) if isinstance(value, tuple) else parts
    return value


def is_number(value: Any, kind: type) -> bool:
    """Tell whether a value is a whole or a real number; a truth value is none."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    return whole or (kind is float and isinstance(value, float | np.floating))


def tensors_in(hint: Any) -> list[Any]:
    """Return the annotations of tensors that an argument may be, of which one alone."""
    origin = typing.get_origin(hint)
    inside = typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return [x for part in inside for x in tensors_in(part)]
    if origin is typing.Annotated:
        found = tensors_in(inside[0])
        return found if isinstance(inside[1], Taken) else [hint] * bool(found)
    return (
        [hint]
        if isinstance(hint, type) and issubclass(hint, AbstractArray) and hint.array_type is Tensor
        else []
    )


def public() -> dict[str, Any]:
    found: dict[str, Any] = {}
    inner = [m.name for m in pkgutil.walk_packages(torchgrasp.__path__, "torchgrasp.") if m.ispkg]
    for package in [torchgrasp, *map(importlib.import_module, inner)]:
        for name in getattr(package, "__all__", ()):
            thing = getattr(package, name)
            if inspect.isfunction(thing) or inspect.isclass(thing):
                found.setdefault(f"{thing.__module__}.{thing.__qualname__}", thing)
    return found


def behind(thing: Any) -> bool:
    return hasattr(thing, "__checked__")


def methods_of(kind: type) -> dict[str, tuple[Any, Any]]:
    """Return the public methods of a class that take arguments, as they are found in it, and as
    functions.

    Those of the library alone, inherited ones, too; what is abstract is for others to write.
    """
    found: dict[str, tuple[Any, Any]] = {}
    for key in dir(kind):
        method = inspect.getattr_static(kind, key)
        function = method.__func__ if isinstance(method, classmethod | staticmethod) else method
        own = inspect.isfunction(function) and function.__module__.startswith("torchgrasp")
        open_to_all = getattr(function, "__isabstractmethod__", False) or getattr(
            kind, "_is_protocol", False
        )
        if own and not key.startswith("_") and not open_to_all:
            if len(inspect.signature(function).parameters) > (not isinstance(method, staticmethod)):
                found[key] = method, function
    return found


def checked_things() -> dict[str, tuple[Callable[[], Any], Any]]:
    """Return what gives each function, value and method of a value to call, and what has its
    annotations, by name.
    """
    found: dict[str, tuple[Callable[[], Any], Any]] = {}
    for name, thing in public().items():
        if inspect.isfunction(thing) and behind(thing):
            found[name] = partial(_itself, thing), thing
        elif inspect.isclass(thing):
            if behind(thing.__init__) and dataclasses.is_dataclass(thing):
                found[name] = partial(_itself, thing), thing
            for key, (method, function) in methods_of(thing).items():
                if behind(function):
                    still = isinstance(method, classmethod | staticmethod)
                    found[f"{name}.{key}"] = partial(_method, thing, key, still), function
    return found


def _itself(thing: Any) -> Any:
    return thing


def _method(thing: type, key: str, still: bool) -> Any:
    return getattr(thing if still else sample(thing, Path("x")), key)


def required(thing: Any, call: Any, path: Path) -> dict[str, Any]:
    hints = hints_of(thing)
    parameters = inspect.signature(call).parameters
    return {
        key: sample(hints[key], path, own_lengths(call))
        for key, p in parameters.items()
        if p.default is p.empty and p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)
    }


def wrong_arguments(thing: Any, call: Any) -> Iterator[tuple[str, Any]]:
    """Yield each parameter with each value that it must not have."""
    hints = hints_of(thing)
    for key, parameter in inspect.signature(call).parameters.items():
        if key in hints and parameter.kind not in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
            for value in wrong_values(hints[key], own_lengths(call)):
                yield key, value


def own_lengths(call: Any) -> dict[str, int]:
    """Return the lengths that the letters of a method have in its value."""
    return _lengths(getattr(call, "__self__", None))


def wrong_values(hint: Any, own: Lengths) -> list[Any]:
    """Return values that an annotation does not allow."""
    values = [value for value in HOSTILE if is_wrong(value, hint)]
    if Path in (hint, *typing.get_args(hint)):
        values += NO_PATHS
    for tensor in tensors_in(hint):
        bare = getattr(tensor, "__origin__", tensor)
        valid = sample_tensor(bare, own)
        values += [x for x in longer(valid, bare, own) if bare is hint or is_wrong(x, hint)]
        values += [
            value
            for how, value in broken(valid).items()
            if how in NO_NUMBERS or is_wrong(value, hint)
        ]
        if getattr(tensor, "__metadata__", ())[:1] == (RIGID,):
            values += crooked(valid)
        if getattr(tensor, "__metadata__", ())[:1] != (ANY,):
            values += spoilt(valid).values()
    return values
