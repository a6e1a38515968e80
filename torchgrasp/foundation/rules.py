"""Rules that type annotations carry, such as ranges, and helpers of argument validation
(`torchgrasp.foundation.checks`).
"""

import collections.abc
import math
import os
import sys
import types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import AbstractArray, Bool, Float
from torch import Tensor
from torch._C import _functorch as functorch  # pyright: ignore[reportAttributeAccessIssue]
from torch.autograd import forward_ad

from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.limits import NAME_BYTES, PATH_BYTES, SHOWN_LETTERS


class Range(NamedTuple):
    """A rule in an annotation: a number must lie in [`low`, `high`].

    `words` describe the range in errors; if they are empty, the two bounds do.
    """

    low: float
    high: float
    words: str = ""


class Rows(NamedTuple):
    """A rule in an annotation: a field holds a batch of as many rows as the other fields.

    A row is one index of the first axis. The number of rows is the size of the axis `letter` in the
    shapes of the other fields.
    """

    letter: str


class Taken(NamedTuple):
    """A rule in an annotation: an argument of several types is converted to a value of one type.

    Args:
        alias: name of the annotation.
        kind: type of the converted value.
        words: description of the allowed arguments for errors.
        read: function that returns the converted value, given the argument and its name.
    """

    alias: str
    kind: Any
    words: str
    read: Callable[[Any, str], Any]


ANY = "any number, NaN and infinity too"
FINITE = "finite numbers in every field"
"""Rules in annotations. Tensors must be finite unless annotated `ANY`; `FINITE` demands it of all
fields of a value.
"""
ROUNDING = 1e-4  # largest error of a rotation matrix: above rounding in float32
RIGID = "a rigid transform: a right-handed rotation, and the row 0 0 0 1"
"""The rule for transforms: a matrix that scales or mirrors would give wrong results without an
error.
"""
# least positive and largest finite number
LEAST = sys.float_info.min
MOST = sys.float_info.max
# a seed of random draws
Seed = Annotated[int, Range(0, 2**63 - 1, "a whole number from 0 to 2**63 - 1")]
Count = Annotated[int, Range(1, 1_000_000)]  # a number of objects that are kept in memory
Positive = Annotated[float, Range(LEAST, MOST, "a positive number")]  # a number above zero
Fraction = Annotated[float, Range(0.0, 1.0)]  # a share or a probability
Measured = Annotated[float, ANY]  # a number that is NaN if nothing was measured
Pose = Annotated[Float[Tensor, "4 4"], RIGID]  # a rigid transform
Poses = Annotated[Float[Tensor, "g 4 4"], RIGID]  # a rigid transform for each row
Force = Annotated[float, Range(0.01, 100.0)]  # a normal force [N] of a finger
Length = Annotated[float, Range(0.0, 10.0)]  # a length [m] within reach
# greatest length [m] of the size of a fingertip: one of some millimetres, given as 3, is refused
SMALL = 0.1
SmallLength = Annotated[float, Range(0.0, SMALL)]
# a displacement [m] of an object of a hand's size; one in millimetres or centimetres is refused
Displacement = Annotated[float, Range(0.0, 0.5)]
DTYPES = {
    "Float": (torch.float32, torch.float64),
    "Int": (torch.int64, torch.int32),
    "Bool": (torch.bool,),
}
"""The dtypes that each kind of annotation allows."""
NUMBERS = {
    int: Range(-(2**63), 2**63 - 1, "a whole number"),
    float: Range(-MOST, MOST, "a finite number"),
}
"""The ranges of numbers whose annotation gives no range."""


def describe(hint: Any) -> str:
    """Return a text, for error messages, that says which arguments the type annotation `hint`
    allows.
    """
    origin = typing.get_origin(hint)
    inside = typing.get_args(hint)
    if origin is Annotated and isinstance(inside[1], Range):
        kind = "a whole number" if inside[0] is int else "a number"
        (low, high, words) = inside[1]
        return words or f"{kind} in [{low:.12g}, {high:.12g}]"
    if origin is Annotated:
        return inside[1].words if isinstance(inside[1], Taken) else describe(inside[0])
    if origin in (typing.Union, types.UnionType):
        return " or ".join(
            dict.fromkeys(describe(x) for x in inside if x is not int or float not in inside)
        )
    if origin is typing.Literal:
        return "one of " * (len(inside) > 1) + ", ".join(map(repr, inside))
    if is_tensor(hint):
        axes = (
            axis.lstrip("*#") if axis[0] not in "*." else "..." for axis in hint.dim_str.split()
        )
        return f"a tensor of shape {' x '.join(axes)}"
    if hint in NUMBERS:
        return NUMBERS[hint].words
    named = {
        bool: "True or False",
        type(None): "None",
        str: "a text",
        collections.abc.Callable: "a function",
    }
    name = getattr(origin or hint, "__name__", "value")
    return named.get(origin or hint, f"a {name if origin is None else name.lower()}")


def is_tensor(hint: Any) -> bool:
    """Return whether an annotation is a tensor type such as `Float[Tensor, "n 3"]`."""
    is_array = (
        typing.get_origin(hint) is None
        and isinstance(hint, type)
        and issubclass(hint, AbstractArray)
    )
    return is_array and hint.array_type is Tensor


def fits(axes: list[str], shape: tuple[int, ...], sizes: dict[str, Any]) -> bool:
    """Return whether a shape matches the axes of a jaxtyping annotation.

    `axes` are the words of the annotation, such as ["*b", "3"]. `sizes` holds the known size of
    each axis by its letter; new letters are added.
    """
    for k in [k for k, axis in enumerate(axes) if axis[0] in "*."]:
        letter = axes[k].lstrip("*#")
        end = len(shape) - (len(axes) - k - 1)
        if end < k:
            return False
        middle = shape[k:end]
        known = middle if axes[k] == "..." else sizes.get(letter, middle)
        try:
            # that of torch imports SymPy
            sizes[letter] = np.broadcast_shapes(known, middle) if "#" in axes[k] else middle
        except ValueError:
            return False
        if "#" not in axes[k] and known != middle:
            return False
        axes = axes[:k] + axes[k + 1 :]
        shape = shape[:k] + shape[end:]
    if len(axes) != len(shape):
        return False
    for axis, n in zip(axes, shape, strict=True):
        letter = axis.lstrip("#")
        if letter == "_" or (axis != letter and n == 1):
            continue
        if n != (int(letter) if letter.isdigit() else sizes.setdefault(letter, n)):
            return False
    return True


def check_dense(name: str, value: Tensor, gradients: bool) -> None:
    """Raise `BadArgument` if the tensor `value` is sparse, nested or meta, or has the negative bit.

    Without `gradients` also a tensor that requires a gradient, or is inside torch.vmap, is refused.
    Errors call the tensor by `name`.
    """
    if value.layout is not torch.strided or value.is_nested or value.is_meta:
        found = "no numbers (meta)" if value.is_meta else f"a layout of {value.layout}"
        raise BadArgument(name, found, "a dense tensor with numbers")
    if value.is_neg():
        raise BadArgument(
            name, "a tensor with the negative bit", f"one without: {name}.resolve_neg()"
        )
    if not gradients:
        check_plain(name, value)


def check_plain(name: str, value: Tensor) -> None:
    """Raise `BadArgument` if a tensor requires a gradient or is inside torch.vmap. `name` is the
    tensor's name in the error.
    """
    if not functorch.is_functorch_wrapped_tensor(value) and not is_tracked(value):
        return
    if is_tracked(value):
        raise BadArgument(
            name, "a tensor that requires a gradient", f"a tensor without one: {name}.detach()"
        )
    if any(map(functorch.is_batchedtensor, _levels(value))):
        raise BadArgument(
            name, "a tensor inside torch.vmap", "a plain tensor: the function is not differentiable"
        )


def check_unmasked(name: str, value: Any) -> None:
    """Raise `BadArgument` if a value is a masked array of NumPy with masked numbers, which would
    count like the others. `name` is the value's name in the error.
    """
    if not isinstance(value, np.ma.MaskedArray):
        return
    masked = int(np.ma.getmaskarray(value).sum())
    if masked:
        found = f"a masked array, with {masked} of {value.size} numbers masked"
        allowed = "a plain array: what was not measured is NaN, as by .astype(float).filled(nan)"
        raise BadArgument(name, found, allowed)


def _levels(value: Tensor) -> list[Tensor]:
    """Return a tensor and the tensors that it wraps, one for each transform of torch.func around
    the call.
    """
    levels = [value]
    while functorch.is_functorch_wrapped_tensor(levels[-1]):
        levels.append(functorch.get_unwrapped(levels[-1]))
    return levels


def is_tracked(value: Tensor) -> bool:
    """Return whether torch computes derivatives with respect to a tensor: by autograd, in forward
    mode, or by torch.func.
    """
    if not functorch.is_functorch_wrapped_tensor(value):
        return value.requires_grad or forward_ad.unpack_dual(value).tangent is not None
    if any(x.requires_grad or functorch.is_gradtrackingtensor(x) for x in _levels(value)):
        return True
    return (
        not functorch.is_batchedtensor(value) and forward_ad.unpack_dual(value).tangent is not None
    )


def is_known(value: Tensor) -> bool:
    """Return whether Python can read the numbers of a tensor. Inside torch.vmap or torch.compile it
    cannot.
    """
    if torch.compiler.is_compiling():
        return False
    wrapped = functorch.is_functorch_wrapped_tensor(value)
    return not (wrapped and any(map(functorch.is_batchedtensor, _levels(value))))


def show(value: Any) -> str:
    """Return a short text that shows a wrong argument.

    For a number or a text it is the value itself, shortened if it is long. For a tensor it is the
    shape and dtype, and otherwise the name of the type.
    """
    if isinstance(value, Tensor):
        return f"a tensor of shape {tuple(value.shape)} and {value.dtype}"
    if value is None or isinstance(value, str | int | float):
        huge = isinstance(value, int) and abs(value) >= 10**SHOWN_LETTERS
        text = "a huge number" if huge else repr(value)
        return text if len(text) <= SHOWN_LETTERS else f"{text[:SHOWN_LETTERS]}..."
    return type(value).__name__


def is_rigid(a_from_b: Float[Tensor, "*b 4 4"]) -> Bool[Tensor, "*b"]:
    """Return a mask (*b,) of the matrices (*b, 4, 4) that are rigid transforms.

    Each has a right-handed rotation, up to rounding in float32, and the last row 0 0 0 1.
    """
    x, y, z = a_from_b[..., :3, :3].double().unbind(-2)
    rotation = torch.stack([x, y, z], -2)
    eye = torch.eye(4, dtype=torch.float64, device=a_from_b.device)
    error = (rotation @ rotation.transpose(-1, -2) - eye[:3, :3]).abs().amax((-1, -2))
    right_handed = (torch.linalg.cross(x, y) * z).sum(-1) > 0
    return (error <= ROUNDING) & right_handed & (a_from_b[..., 3, :] == eye[3]).all(-1)


def nearest_rotation(turn: Float[Tensor, "3 3"]) -> tuple[Float[Tensor, "3 3"], float]:
    """Return the rotation nearest to a matrix, and the error of the matrix as an angle [deg].

    The error is the largest distance between a column of the matrix and the same column of the
    rotation. This distance (no unit) is taken for an angle in radians, which holds for small
    angles, and converted to degrees. The error is infinite for numbers that are not finite.
    """
    turn = turn.double()
    if not bool(torch.isfinite(turn).all()):
        return torch.eye(3).to(turn), math.inf
    u, _, vh = torch.linalg.svd(turn)
    # of the two nearest orthogonal matrices, the one that does not mirror
    sign = torch.linalg.det(u @ vh).sign()
    nearest = torch.cat([u[:, :2], sign * u[:, 2:]], -1) @ vh
    distance = torch.linalg.vector_norm(turn - nearest, dim=0).max()
    return nearest, math.degrees(float(distance))


def check_moved(*args: Any, **kwargs: Any) -> None:
    """Raise `BadArgument` for arguments that `Tensor.to` rejects, and for dtypes other than float32
    and float64.
    """
    given = ", ".join([*map(repr, args), *(f"{key}={value!r}" for key, value in kwargs.items())])
    allowed = "a device of this machine and this build of PyTorch, torch.float32 or torch.float64"
    try:
        moved = torch.empty(0, dtype=torch.float32, device="cpu").to(*args, **kwargs)
    except (RuntimeError, TypeError, ValueError, AssertionError) as error:
        raise BadArgument("to", given, allowed) from error
    if moved.is_meta or moved.dtype not in DTYPES["Float"]:
        raise BadArgument("to", given, allowed)


def check_suffix(name: str, path: Path, *suffixes: str) -> None:
    """Raise `BadArgument`, which calls the path `name`, unless it ends in one of the `suffixes`."""
    if path.suffix.lower() not in suffixes:
        raise BadArgument(name, path, f"a file ending in {' or '.join(suffixes)}")


def check_path(name: str, path: Path | str) -> None:
    """Raise `BadArgument` for a path that no file can have. It holds a NUL or half a character (a
    lone surrogate), or is too long: over 4095 bytes, or 255 in one name.

    Errors call the path by `name`.
    """
    try:
        raw = os.fsencode(path)
    except UnicodeEncodeError as error:
        raise BadArgument(
            name, f"{show(str(path))}, with half a character", "a path of whole characters"
        ) from error
    if b"\0" in raw:
        raise BadArgument(name, f"{show(str(path))}, with a NUL", "a path without NUL")
    if len(raw) > PATH_BYTES:
        raise BadArgument(
            name, f"a path of {len(raw)} bytes", f"a path of at most {PATH_BYTES} bytes"
        )
    longest = max(map(len, map(os.fsencode, Path(path).parts)), default=0)
    if longest > NAME_BYTES:
        raise BadArgument(
            name, f"a name of {longest} bytes", f"a path with names of at most {NAME_BYTES} bytes"
        )
