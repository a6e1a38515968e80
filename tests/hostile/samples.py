"""Valid arguments of public functions, and valid values, made from annotations."""

import collections.abc
import dataclasses
import functools
import tempfile
import types
import typing
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import AbstractArray
from torch import Tensor

import torchgrasp
from tests.arm.ur5e import ur5e
from tests.make import see
from torchgrasp import (
    ClosingReference,
    GraspController,
    GraspMixture,
    PointCloud,
    fit_shape,
    load_hand,
    load_object,
)
from torchgrasp.arm import Arm
from torchgrasp.cloud import estimate_normals
from torchgrasp.contacts import ShapeLike
from torchgrasp.control import DragController, GraspTry, no_contact, observe
from torchgrasp.control.paper.closings import Impedance
from torchgrasp.control.paper.stability import NAMES, StabilityModel
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.rules import Range
from torchgrasp.hand.urdf import Urdf, read_urdf
from torchgrasp.ik import GraspProblem, PostureLibrary
from torchgrasp.planner import DragPlan
from torchgrasp.planner.explain import Funnel, Losses
from torchgrasp.posture_model import GaussianMixture, HandSamples, SampleSpec, write_samples
from torchgrasp.posture_model.dataset import SampleFolder
from torchgrasp.posture_model.mixture import CODE_NAMES
from torchgrasp.shape import Kernel, thin_plate_kernel
from torchgrasp.shape.completion.complete import Completion, complete_cloud
from torchgrasp.shape.completion.silhouette import Outlines, Silhouette, silhouettes
from torchgrasp.shape.hollow import HollowShape
from torchgrasp.shape.posterior import Posterior
from torchgrasp.sim.simulated_hand import SimulatedHand
from torchgrasp.sim.simulated_scene import SimulatedScene
from torchgrasp.values.planning import Certificate, Contacts, Grasps

LENGTHS = {"b": 1, "n": 6, "g": 1, "f": 3, "t": 4, "k": 2, "v": 5, "q": 6, "c": 3}
"""Lengths of the letters in samples; others are 4."""
Lengths = collections.abc.Mapping[str, int]
NONE: Lengths = types.MappingProxyType({})


def hints_of(thing: Any) -> dict[str, Any]:
    """Return the annotations of a function or dataclass with their marks."""
    hints = typing.get_type_hints(thing, include_extras=True)
    return {name: hint for name, hint in hints.items() if name != "return"}


@functools.cache
def special(kind: type) -> Any:
    """Return a valid object of a class whose fields depend on each other."""
    half = torch.full((1, 7), 0.5, dtype=torch.float64)
    mixture = (
        torch.ones(1, dtype=torch.float64),
        half,
        torch.eye(7, dtype=torch.float64)[None],
        ("j", *CODE_NAMES),
    )
    nine = GaussianMixture(torch.ones(1), torch.zeros(1, 9), torch.eye(9)[None], NAMES)
    made = {
        torchgrasp.Hand: lambda: load_hand("barrett"),
        torchgrasp.Scene: lambda: see((0.0, 0.0, 0.06, 0.1)),
        torchgrasp.data.GraspObject: lambda: load_object("cylinder"),
        PointCloud: few_points,
        Grasps: lambda: load_shipped_grasp("jug", "barrett"),
        Contacts: lambda: special(Grasps).contacts,
        Certificate: lambda: special(Grasps).certificate,
        ClosingReference: lambda: ClosingReference.from_grasp(
            special(torchgrasp.Hand), special(Grasps)
        ),
        Arm: lambda: ur5e(special(torchgrasp.Hand)),
        GraspController: lambda: GraspController(special(ClosingReference)),
        GraspTry: lambda: GraspTry(special(Grasps), lambda _: special(GraspController)),
        GraspProblem: grasp_problem,
        PostureLibrary: lambda: PostureLibrary.of(special(torchgrasp.Hand), 100),
        Impedance: impedance,
        Urdf: lambda: read_urdf(special(torchgrasp.Hand).urdf_path),
        Funnel: lambda: Funnel((Losses("contacts", "starts", 50, {Status.NOT_CLOSED: 10}),)),
        SampleFolder: lambda: write_samples(
            special(torchgrasp.Hand), SampleSpec(20), tempfile.mkdtemp()
        ),
        HandSamples: hand_samples,
        Completion: lambda: complete_cloud(estimate_normals(special(PointCloud))),
        Outlines: lambda: silhouettes(special(PointCloud)),
        Silhouette: lambda: special(Outlines).views[0],
        Posterior: lambda: special(torchgrasp.ShapeGP),
        HollowShape: lambda: HollowShape.join(
            *[special(torchgrasp.ShapeGP)] * 2, special(PointCloud)
        ),
        SimulatedScene: type(
            "Nowhere",
            (SimulatedScene,),
            {name: nothing for name in ("__init__", *SimulatedScene.__abstractmethods__)},
        ),
        SimulatedHand: simulated_hand,
        DragController: lambda: DragController(pressing_drag(), special(torchgrasp.Hand)),
        torchgrasp.Plane: lambda: torchgrasp.Plane.horizontal(0.0),
        torchgrasp.Distribution: lambda: torchgrasp.Distribution.between(0.1, 1.0),
        torchgrasp.ShapeGP: lambda: fit_shape(special(PointCloud), budget=30),
        ShapeLike: lambda: special(torchgrasp.ShapeGP),
        Kernel: lambda: thin_plate_kernel(2.0),
        GaussianMixture: lambda: GaussianMixture(*mixture),
        GraspMixture: lambda: GraspMixture(*mixture),
        StabilityModel: lambda: StabilityModel(nine, nine, 0.5),
        trimesh.Trimesh: lambda: trimesh.creation.box([0.05, 0.05, 0.1]),
        torch.Generator: lambda: torch.Generator().manual_seed(0),
    }
    of_hand = {
        type(part): part
        for part in vars(load_hand("barrett")).values()
        if dataclasses.is_dataclass(part)
    }
    return made[kind]() if kind in made else of_hand.get(kind)


def few_points() -> PointCloud:
    view = load_object("cylinder").view
    return PointCloud(view.points[:150], None, view.viewpoint)


def hand_samples() -> HandSamples:
    numbers = torch.rand(60, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return HandSamples(numbers[:, :1], numbers[:, 1:], ("j",))


def impedance() -> Impedance:
    reference = special(ClosingReference)
    seen = observe(reference.hand, reference.joints, no_contact())
    return Impedance(reference, seen, seen.joints)


def nothing(*arguments: Any) -> None:
    """Do nothing."""


def simulated_hand() -> SimulatedHand:
    """Return a hand whose scene has nothing but names: what a border refuses reaches none."""
    reference = special(ClosingReference)
    scene = special(SimulatedScene)
    scene.timestep = 0.002
    scene.joint_names = reference.hand.tree.joint_names
    return SimulatedHand(scene, reference, 50.0, None)


def pressing_drag() -> DragPlan:
    """Return a drag in which all fingertips press, each on a point right below it."""
    hand = special(torchgrasp.Hand).to("cpu", torch.float64)
    drag = sample(DragPlan, Path())
    joints = (hand.lower + hand.upper) / 2
    down = hand.tips.radius[:, None] * drag.table.normal
    return dataclasses.replace(
        drag,
        joints=joints,
        obj_from_hand=torch.eye(4, dtype=torch.float64),
        presses=torch.ones(len(hand.tips), dtype=torch.bool),
        feet=hand.tip_centres(joints) - down,
    )


def grasp_problem() -> GraspProblem:
    """Return a problem of inverse kinematics, whose contacts have a deviation."""
    fields = {
        name: sample(hint, Path())
        for name, hint in hints_of(GraspProblem).items()
        if name != "reachable"
    }
    std = torch.full_like(fields["contacts"].points[..., 0], 0.001)
    return GraspProblem(**fields | {"contacts": dataclasses.replace(fields["contacts"], std_m=std)})


def sample(hint: Any, path: Path, own: Lengths = NONE) -> Any:
    """Return a valid argument for an annotation; `own` are the lengths of some letters."""
    origin = typing.get_origin(hint)
    inside = typing.get_args(hint)
    if origin is typing.Annotated:
        mark = inside[1]
        if isinstance(mark, Range):
            middle = mark.low if mark.low > 0 else min(mark.high, 1)
            return inside[0](max(middle, min(mark.high, 1)) if inside[0] is float else middle)
        return sample(inside[0], path, own)
    if origin in (typing.Union, types.UnionType):
        return sample(inside[0], path, own)
    if origin is typing.Literal:
        return inside[0]
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return sample_tensor(hint, own)
    simple = {
        int: 1,
        float: 0.5,
        bool: True,
        str: "x",
        bytes: b"x",
        Path: path / "x",
        object: 0,
        Any: 0,
    }
    simple |= {
        type(None): None,
        Tensor: torch.ones(3, dtype=torch.float64),
        np.ndarray: np.ones((6, 3)),
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
        required = [
            f.name
            for f in dataclasses.fields(hint)
            if f.default is f.default_factory is dataclasses.MISSING
        ]
        hints = hints_of(hint)
        found = hint(**{name: sample(hints[name], path) for name in required})
    if found is None and issubclass(hint, tuple):
        found = hint(*(sample(x, path) for x in hints_of(hint).values()))
    assert found is not None, hint
    return found


def sample_tensor(hint: Any, own: Lengths = NONE) -> Tensor:
    """Return a tensor of a shape that an annotation allows."""
    shape = []
    for axis in hint.dim_str.split():
        name = axis.lstrip("*#")
        if axis[0] != "*" and axis != "...":
            shape.append(int(name) if name.isdigit() else {**LENGTHS, **own}.get(name, 4))
    kind = hint.dtype.__name__
    if kind == "Float":
        if shape[-2:] == [4, 4]:
            return torch.eye(4, dtype=torch.float64).expand(*shape).clone()
        x = torch.rand(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        return x / x.norm(dim=-1, keepdim=True) if shape[-1:] == [3] else x
    return torch.zeros(shape, dtype=torch.int64 if kind == "Int" else torch.bool)
