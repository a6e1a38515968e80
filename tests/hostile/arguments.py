"""Valid and hostile arguments of public functions, both made from their signatures; beartype says which are wrong."""

import collections.abc
import dataclasses
import functools
import importlib
import inspect
import pkgutil
import types
import typing
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from beartype.door import is_bearable
from jaxtyping import AbstractArray, jaxtyped
from torch import Tensor

import torchgrasp
from torchgrasp import PointCloud, fit_shape, load_hand, load_object, load_scene
from torchgrasp.border import ANY, Range
from torchgrasp.control import ClosingReference, ControlRecorder, GraspController
from torchgrasp.control.adaptive.belief import Belief
from torchgrasp.control.adaptive.stability import NAMES, StabilityModel
from torchgrasp.errors import Status
from torchgrasp.ik import GraspProblem, PostureLibrary
from torchgrasp.objects import load_shipped_grasp
from torchgrasp.plan import Shape
from torchgrasp.posture_model import GaussianMixture, GraspMixture
from torchgrasp.posture_model.encoding import CODE_NAMES
from torchgrasp.shape import Kernel, thin_plate_kernel
from torchgrasp.values import Certificate, Contacts, Grasps

NAN, INF = float("nan"), float("inf")
LENGTHS = {"b": 1, "n": 6, "g": 1, "f": 3, "t": 4, "k": 2, "v": 5, "q": 6, "c": 3}
"""Lengths of the letters in samples; others are 4."""


class Odd:
    """An object of no type that is known."""

    def __repr__(self) -> str:
        return "Odd()"


HOSTILE = [
    None, "x", "", "a" * 5000, "a\0b", b"x", True, False, -1, 0, 1, 1.5, -0.5, NAN, INF, -INF, 2**63, -(2**63) - 1,
    2**64, 10**400, 1 + 1j, [], [1], [None], {}, {"a": 1}, (), (1,), {1}, Odd(), Odd, int, len, np.float64("nan"),
    np.int64(-7), np.zeros(3), np.array(["x"]), np.array([None, 1]), torch.tensor(1), torch.tensor([1.0, 2.0]),
    torch.zeros(0), torch.zeros(2, 3, 4, 5), torch.zeros(3, dtype=torch.complex64), Path("x"), range(3), iter(()),
    Status.OK, torch.device("cpu"), torch.float16, trimesh.Trimesh(),
]  # fmt: skip
"""What people and programs pass by mistake."""


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
        out |= {"half": valid.half(), "bfloat16": valid.bfloat16(), "int": valid.long(), "bool": valid > 0}
        out |= {
            "negative bit": torch._neg_view(-valid),
            "quantised": torch.quantize_per_tensor(valid.float(), 0.1, 0, torch.qint8),
        }
    elif valid.dtype == torch.int64:
        out |= {"float": valid.double(), "uint8": valid.to(torch.uint8), "bool": valid > 0}
    else:
        out |= {"float": valid.double(), "int": valid.long()}
    return out


def spoilt(valid: Tensor) -> dict[str, Tensor]:
    """Return tensors with one number that is none."""
    if not valid.is_floating_point() or not valid.numel():
        return {}
    last = torch.arange(valid.numel()).reshape(valid.shape) == valid.numel() - 1
    return {str(x): torch.where(last, torch.tensor(x, dtype=valid.dtype), valid) for x in (NAN, INF, -INF)}


def crooked(valid: Tensor) -> list[Tensor]:
    """Return transforms that scale, mirror or shear, and one of zeros."""
    return [3 * valid, torch.diag(torch.tensor([-1.0, 1, 1, 1])).to(valid) @ valid, valid.cumsum(-1), 0 * valid]


def hints_of(thing: Any) -> dict[str, Any]:
    """Return the annotations of a function or dataclass with their marks."""
    late = {"trimesh": trimesh, "StabilityModel": StabilityModel}
    hints = typing.get_type_hints(thing, localns=late, include_extras=True)
    return {name: hint for name, hint in hints.items() if name != "return"}


@functools.cache
def special(kind: type) -> Any:
    """Return a valid object of a class whose fields depend on each other."""
    half = torch.full((1, 7), 0.5, dtype=torch.float64)
    mixture = (torch.ones(1, dtype=torch.float64), half, torch.eye(7, dtype=torch.float64)[None], ("j", *CODE_NAMES))
    nine = GaussianMixture(torch.ones(1), torch.zeros(1, 9), torch.eye(9)[None], NAMES)
    made = {
        torchgrasp.Hand: lambda: load_hand("barrett"),
        torchgrasp.Scene: load_scene,
        torchgrasp.GraspObject: lambda: load_object("cylinder"),
        PointCloud: few_points,
        Grasps: lambda: load_shipped_grasp("jug", "barrett"),
        Contacts: lambda: special(Grasps).contacts,
        Certificate: lambda: special(Grasps).certificate,
        ClosingReference: lambda: ClosingReference.from_grasp(special(torchgrasp.Hand), special(Grasps)),
        GraspController: lambda: GraspController(special(ClosingReference)),
        ControlRecorder: ControlRecorder,
        Belief: lambda: Belief(special(torchgrasp.ShapeGP), torch.eye(4, dtype=torch.float64)),
        GraspProblem: grasp_problem,
        PostureLibrary: lambda: PostureLibrary.of(special(torchgrasp.Hand), 100),
        torchgrasp.Plane: lambda: torchgrasp.Plane.horizontal(0.0),
        torchgrasp.ShapeGP: lambda: fit_shape(special(PointCloud), budget=30),
        Kernel: lambda: thin_plate_kernel(2.0),
        GaussianMixture: lambda: GaussianMixture(*mixture),
        GraspMixture: lambda: GraspMixture(*mixture),
        StabilityModel: lambda: StabilityModel(nine, nine, 0.5),
        trimesh.Trimesh: lambda: trimesh.creation.box([0.05, 0.05, 0.1]),
        torch.Generator: lambda: torch.Generator().manual_seed(0),
    }  # fmt: skip
    return made[kind]() if kind in made else None


def few_points() -> PointCloud:
    """Return some of a shipped view."""
    view = load_object("cylinder").view
    return PointCloud(view.points[:150], None, view.viewpoint)


def grasp_problem() -> GraspProblem:
    """Return a problem of inverse kinematics, whose contacts have a deviation."""
    fields = {name: sample(hint, Path()) for name, hint in hints_of(GraspProblem).items() if name != "reachable"}
    std = torch.full_like(fields["contacts"].points[..., 0], 0.001)
    return GraspProblem(**fields | {"contacts": dataclasses.replace(fields["contacts"], std_m=std)})


def sample(hint: Any, path: Path) -> Any:
    """Return a valid argument for an annotation."""
    origin, inside = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        mark = inside[1]
        if isinstance(mark, Range):
            middle = mark.low if mark.low > 0 else min(mark.high, 1)
            return inside[0](max(middle, min(mark.high, 1)) if inside[0] is float else middle)
        return sample(inside[0], path)
    if origin in (typing.Union, types.UnionType):
        return sample(inside[0], path)
    if origin is typing.Literal:
        return inside[0]
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return sample_tensor(hint)
    if hint is Shape:
        return special(torchgrasp.ShapeGP)
    if hint is torch.Tensor:
        return torch.ones(3, dtype=torch.float64)
    if hint is np.ndarray:
        return np.ones((6, 3))
    simple = {
        int: 1,
        float: 0.5,
        bool: True,
        str: "x",
        bytes: b"x",
        Path: path / "x",
        object: 0,
        Any: 0,
        type(None): None,
    }
    if hint in simple:
        return simple[hint]
    if origin is collections.abc.Callable:
        return lambda *arguments: None
    if origin is tuple:
        return () if inside[-1:] == (...,) else tuple(sample(x, path) for x in inside)
    if isinstance(origin, type) and issubclass(origin, collections.abc.Mapping):
        return {sample(inside[0], path): sample(inside[1], path)}
    if isinstance(origin, type):
        return [sample(inside[0], path)] if inside else []
    if isinstance(hint, typing.TypeVar):
        return 0
    if issubclass(hint, Status):
        return Status.OK
    found = special(hint)
    if found is None and dataclasses.is_dataclass(hint):
        required = [f.name for f in dataclasses.fields(hint) if f.default is f.default_factory is dataclasses.MISSING]
        hints = hints_of(hint)
        found = hint(**{name: sample(hints[name], path) for name in required})
    if found is None and issubclass(hint, tuple):
        found = hint(*(sample(x, path) for x in hints_of(hint).values()))
    assert found is not None, hint
    return found


def sample_tensor(hint: Any) -> Tensor:
    """Return a tensor of a shape that an annotation allows."""
    shape = []
    for axis in hint.dim_str.split():
        name = axis.lstrip("*#")
        if axis[0] != "*" and axis != "...":
            shape.append(int(name) if name.isdigit() else LENGTHS.get(name, 4))
    kind = hint.dtype.__name__
    if kind == "Float":
        if shape[-2:] == [4, 4]:
            return torch.eye(4, dtype=torch.float64).expand(*shape).clone()
        x = torch.rand(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        return x / x.norm(dim=-1, keepdim=True) if shape[-1:] == [3] else x
    return torch.zeros(shape, dtype=torch.int64 if kind == "Int" else torch.bool)


def is_wrong(value: Any, hint: Any) -> bool:
    """Tell by beartype whether a value breaks an annotation; whole numbers and NumPy's are numbers, too."""
    hints = [hint]
    while hints:
        one = hints.pop()
        origin, inside = typing.get_origin(one), typing.get_args(one)
        if origin in (typing.Union, types.UnionType):
            hints += inside
        elif origin is typing.Annotated and isinstance(inside[1], Range):
            huge = isinstance(value, int) and abs(value) >= 2**1024  # no floating number
            if is_number(value, inside[0]) and inside[1].low <= value <= inside[1].high and not huge:
                return False
        elif origin is typing.Annotated and inside == (float, ANY):
            if is_number(value, float) and (not abs(value) >= 1e308 or isinstance(value, float)):
                return False
        elif one in (int, float):
            if is_number(value, one) and abs(value) < (2**63 if one is int else 1e308):
                return False
        else:
            with jaxtyped("context"):
                if not isinstance(value, Tensor) or tensors_in(one) or one is Tensor:  # beartype asks for their length
                    if is_bearable(value, one) or is_bearable(floated(value), one):
                        return False
    return True


def floated(value: Any) -> Any:
    """Return a container with its whole numbers as floating ones, which any container of those may hold."""
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
    origin, inside = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return [x for part in inside for x in tensors_in(part)]
    if origin is typing.Annotated:
        return [hint] if tensors_in(inside[0]) else []
    return [hint] if isinstance(hint, type) and issubclass(hint, AbstractArray) and hint.array_type is Tensor else []


def public() -> dict[str, Any]:
    """Return every public function, method and value by name."""
    found: dict[str, Any] = {}
    inner = [m.name for m in pkgutil.walk_packages(torchgrasp.__path__, "torchgrasp.") if m.ispkg]
    for package in [torchgrasp, *map(importlib.import_module, inner)]:
        for name in getattr(package, "__all__", ()):
            thing = getattr(package, name)
            if package.__name__ != "torchgrasp.border" and (inspect.isfunction(thing) or inspect.isclass(thing)):
                found.setdefault(f"{thing.__module__}.{thing.__qualname__}", thing)
    return found
