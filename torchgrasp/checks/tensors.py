"""Tensors at the border: their shape by the letters of an annotation, their dtype, and finite numbers."""

import dataclasses
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.checks.ranges import RIGID
from torchgrasp.errors import BadArgument

DTYPES = {
    "Float": (torch.float32, torch.float64),
    "Int": (torch.int64, torch.int32),
    "Bool": (torch.bool,),
}
"""The dtypes that each kind of annotation allows. Half precision is no length: at 0.3 m it rounds to 0.1 mm."""
DTYPES["Shaped"] = tuple(dtype for dtypes in DTYPES.values() for dtype in dtypes)


@dataclasses.dataclass
class Call:
    """What the tensors of one call, or of one value, share.

    `deep` looks into values; from inside, they were looked into where they were made. `strict` asks for finite numbers
    in fields that need none, too. `sizes` are the lengths bound to letters so far;
    `found` are tensors whose numbers must be finite, by name, and `rigid` those that must be rigid transforms.
    """

    gradients: bool
    deep: bool = True
    strict: bool = False
    sizes: dict[str, Any] = dataclasses.field(default_factory=dict[str, Any])
    found: dict[str, Tensor] = dataclasses.field(default_factory=dict[str, Tensor])
    rigid: dict[str, Tensor] = dataclasses.field(default_factory=dict[str, Tensor])

    def inner(self, strict: bool = False) -> "Call":
        """Return the same for the fields of a value: their letters are their own."""
        return Call(self.gradients, self.deep, self.strict or strict, {}, self.found, self.rigid)

    def check_numbers(self) -> None:
        """Refuse NaN, infinity and transforms that are not rigid, with one wait for each device."""
        good = {(name, "finite numbers"): torch.isfinite(x) for name, x in self.found.items()}
        good |= {(name, RIGID): is_rigid(x) for name, x in self.rigid.items()}
        by_device: dict[torch.device, list[tuple[str, str]]] = {}
        for key, flags in good.items():
            by_device.setdefault(flags.device, []).append(key)
        for keys in by_device.values():
            if bool(torch.stack([good[key].all() for key in keys]).all()):
                continue
            name, allowed = next(key for key in keys if not bool(good[key].all()))
            first = tuple(torch.nonzero(~good[name, allowed])[0].tolist())
            value = (self.rigid if allowed == RIGID else self.found)[name][first]
            place = f" at index {list(first)}" if first else ""
            found = value.item() if value.ndim == 0 else value.tolist()
            raise BadArgument(name, f"{found}{place}", allowed)


SHOWN = 60
"""Letters of a wrong value that an error shows."""


def show(value: Any) -> str:
    """Describe a wrong value: numbers and texts as they are, tensors by shape, others by their type.

    >>> show("x" * 100)[-6:], show([1]), show(None)
    ('xxx...', 'list', 'None')
    """
    if isinstance(value, Tensor):
        return f"a tensor of shape {tuple(value.shape)} and {value.dtype}"
    if value is None or isinstance(value, str | int | float):
        text = repr(value) if not isinstance(value, int) or -(10**SHOWN) < value < 10**SHOWN else "a huge number"
        return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."
    return type(value).__name__


class TensorHint:
    """What a jaxtyping annotation allows, such as `Float[Tensor, "n 3"]`."""

    def __init__(self, kind: str, letters: str) -> None:
        """Read the letters once."""
        self.dtypes = DTYPES[kind]
        self.axes = letters.split()
        self.text = " x ".join(axis.lstrip("*#") if axis[0] not in "*." else "..." for axis in self.axes)

    def read(self, name: str, value: Any, call: Call) -> None:
        """Refuse a tensor of another shape or dtype; bind the letters. Raises `BadArgument`."""
        if not isinstance(value, Tensor):
            raise BadArgument(name, show(value), f"a torch tensor of shape {self.text}")
        check_dense(name, value)
        shape, sizes = tuple(value.shape), dict(call.sizes)
        if not _bind(self.axes, shape, sizes):
            known = [f"{a} = {call.sizes[a]}" for a in dict.fromkeys(self.axes) if a in call.sizes]
            raise BadArgument(name, f"shape {shape}", f"shape {', '.join([self.text or '()', *known])}")
        if value.dtype not in self.dtypes:
            raise BadArgument(name, str(value.dtype), " or ".join(map(str, self.dtypes)))
        call.sizes = sizes
        if value.requires_grad and not call.gradients:
            raise BadArgument(name, "a tensor that requires a gradient", f"a tensor without one: {name}.detach()")


def check_dense(name: str, value: Tensor) -> None:
    """Refuse a tensor whose numbers are not simply there; raise `BadArgument`."""
    if value.layout is not torch.strided or value.is_nested or value.is_meta:
        found = "no numbers (meta)" if value.is_meta else f"a layout of {value.layout}"
        raise BadArgument(name, found, "a dense tensor with numbers")
    if value.is_neg():
        raise BadArgument(name, "a tensor with the negative bit", f"one without: {name}.resolve_neg()")


def _bind(axes: list[str], shape: tuple[int, ...], sizes: dict[str, Any]) -> bool:
    """Tell whether a shape fits the axes, and bind their letters."""
    spread = next((i for i, axis in enumerate(axes) if axis[0] in "*."), None)
    if spread is None:
        return len(axes) == len(shape) and all(_bind_one(a, n, sizes) for a, n in zip(axes, shape, strict=True))
    after = len(axes) - spread - 1
    if len(shape) < spread + after:
        return False
    middle = shape[spread : len(shape) - after]
    ends = [*zip(axes[:spread], shape[:spread], strict=True)]
    ends += zip(axes[spread + 1 :], shape[len(shape) - after :], strict=True)
    return _bind_many(axes[spread], middle, sizes) and all(_bind_one(a, n, sizes) for a, n in ends)


def _bind_one(axis: str, size: int, sizes: dict[str, Any]) -> bool:
    """Tell whether a length fits an axis: a number, a letter, `_`, or `#` before those where 1 fits, too."""
    letter = axis.lstrip("#")
    if letter == "_" or (size == 1 and axis[0] == "#"):
        return True
    return size == (int(letter) if letter.isdigit() else sizes.setdefault(letter, size))


def _bind_many(axis: str, middle: tuple[int, ...], sizes: dict[str, Any]) -> bool:
    """Tell whether lengths fit a letter for many axes, `*b`, or `*#b` where they are broadcast."""
    if axis == "...":
        return True
    known = sizes.get(axis.lstrip("*#"), middle)
    try:
        both = tuple(torch.broadcast_shapes(known, middle)) if "#" in axis else middle
    except RuntimeError:
        return False
    sizes[axis.lstrip("*#")] = both
    return "#" in axis or known == middle


def is_rigid(a_from_b: Float[Tensor, "*b 4 4"]) -> Bool[Tensor, "*b"]:
    """Tell which matrices are a right-handed rotation and a translation; one with NaN is none.

    >>> is_rigid(torch.stack([torch.eye(4), -torch.eye(4), torch.zeros(4, 4)])).tolist()
    [True, False, False]
    """
    x, y, z = a_from_b[..., :3, :3].double().unbind(-2)
    rotation, eye = torch.stack([x, y, z], -2), torch.eye(4, dtype=torch.float64, device=a_from_b.device)
    error = (rotation @ rotation.transpose(-1, -2) - eye[:3, :3]).abs().amax((-1, -2))
    right_handed = (torch.linalg.cross(x, y) * z).sum(-1) > 0
    return (error <= 1e-4) & right_handed & (a_from_b[..., 3, :] == eye[3]).all(-1)


def check_tensor(name: str, value: Any, shape: tuple[int | None, ...]) -> Tensor:
    """Return `value` if it is a finite floating tensor of `shape` (None: any length); raise `BadArgument` otherwise.

    >>> check_tensor("points", torch.zeros(5, 3), (None, 3)).shape
    torch.Size([5, 3])
    >>> check_tensor("points", torch.zeros(5, 2), (None, 3))
    Traceback (most recent call last):
        ...
    torchgrasp.errors.BadArgument: points: expected shape _ x 3, got shape (5, 2)
    """
    call = Call(gradients=True)
    TensorHint("Float", " ".join("_" if s is None else str(s) for s in shape)).read(name, value, call)
    call.found[name] = value
    call.check_numbers()
    return value


def check_moved(*args: Any, **kwargs: Any) -> None:
    """Refuse what `Tensor.to` cannot do, and types or devices without our numbers; raise `BadArgument`.

    >>> check_moved(torch.float64)
    >>> check_moved(torch.int32)
    Traceback (most recent call last):
        ...
    torchgrasp.errors.BadArgument: to: expected a device, torch.float32 or torch.float64, got torch.int32
    """
    given = ", ".join([*map(repr, args), *(f"{key}={value!r}" for key, value in kwargs.items())])
    allowed = "a device, torch.float32 or torch.float64"
    try:
        moved = torch.empty(0, dtype=torch.float32).to(*args, **kwargs)
    except (RuntimeError, TypeError, ValueError, AssertionError) as error:
        raise BadArgument("to", given, allowed) from error
    if moved.is_meta or moved.dtype not in DTYPES["Float"]:
        raise BadArgument("to", given, allowed)
