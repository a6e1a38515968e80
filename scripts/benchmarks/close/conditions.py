"""Conditions of closing trials: errors of the object, its shape, the controller and the tactile
sensors.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import torch
import trimesh
from scipy.interpolate import RBFInterpolator

from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.linalg import farthest_points
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.posterior import combined_covariance, symmetric_root
from torchgrasp.shape.surface import extract_surface
from torchgrasp.values.closing import NO_OPTIONS, ClosingOptions, SensorModel
from torchgrasp.values.planning import Grasps


class Condition(NamedTuple):
    """What is wrong: how far [m] the object is from where it was seen, and how far it turned [rad].

    `unknown` things weigh what they weigh, and have a friction between 0.3 and 1. `afloat` they are
    pulled at. `drawn` ones have a shape of the posterior's (`draw_solid`): the deviations are what
    they say.
    """

    distance: float = 0.0
    angle: float = 0.0
    unknown: bool = False
    afloat: str = ""
    simulator: str = "sapien"
    drawn: bool = False


IN_MUJOCO = ", MuJoCo"
"""What the name of a condition ends with whose trials run in MuJoCo."""

CONDITIONS = {
    "in place": Condition(),
    "5 mm": Condition(0.005),
    "10 mm": Condition(0.01),
    "20 mm": Condition(0.02),
    "5 degrees": Condition(angle=math.radians(5)),
    "10 degrees": Condition(angle=math.radians(10)),
    "drawn": Condition(drawn=True),
    "drawn, 10 mm": Condition(0.01, drawn=True),
    "10 mm, real mass, friction unknown": Condition(0.01, unknown=True),
    f"in place{IN_MUJOCO}": Condition(simulator="mujoco"),
    f"10 mm{IN_MUJOCO}": Condition(0.01, simulator="mujoco"),
    f"20 mm{IN_MUJOCO}": Condition(0.02, simulator="mujoco"),
    "afloat, in place": Condition(afloat="dexgraspbench"),
    "afloat, friction 0.3": Condition(afloat="dexgraspbench-hard"),
    "afloat, 10 mm": Condition(0.01, afloat="dexgraspbench"),
}
"""By name. On a table the object is moved along it and turns about the vertical; afloat in any
direction.
"""

BARS = {"5 mm": (0.97, 2.0), "10 mm": (0.92, 4.0), "20 mm": (0.80, 8.0)}
"""Least share held, and largest median motion [mm] of the object before the lift: the project's
own.
"""


class Law(NamedTuple):
    """How the hand closes; `swapped` exchanges the deviations of the most and the least certain
    finger.

    `dead` are the fingers, in grasp order, whose sensor is.
    """

    trial: dict[str, Any]
    swapped: bool = False
    dead: tuple[int, ...] = ()


DEFAULT = "uncertainty"
"""The law that the others are compared with."""

WAIT_ALONE = dataclasses.replace(NO_OPTIONS, wait=True)
"""No component but the waiting."""

LAWS = {
    DEFAULT: Law({}),
    "uncertainty, deviations swapped": Law({}, swapped=True),
    "uncertainty without retry": Law({"options": ClosingOptions(attempts=1)}),
    "uncertainty without guard": Law({"options": ClosingOptions(stops=0)}),
    "uncertainty without palm": Law({"options": ClosingOptions(palm_reach=0.0, stops=0)}),
    "uncertainty without place": Law({"options": WAIT_ALONE}),
    "uncertainty without wait": Law({"options": ClosingOptions(wait=False)}),
    "fixed": Law({"closing": "fixed"}),
    "fixed without place": Law({"closing": "fixed", "options": WAIT_ALONE}),
    "position": Law({"closing": "position"}),
    "paper_position": Law({"closing": "paper_position"}),
    "open_loop": Law({"closing": "open_loop"}),
}
"""By name; all hold by "force", but for the open loop, which keeps its squeeze."""

SENSED = {
    "readings 20 ms old": Law({"sensor": SensorModel(delay=0.02)}),
    "readings 40 ms old": Law({"sensor": SensorModel(delay=0.04)}),
    "three times the noise": Law({"sensor": SensorModel(noise=3.0)}),
    "joint torques": Law({"sensor": SensorModel("torque")}),
    "binary": Law({"sensor": SensorModel("binary")}),
    "binary, 40 ms old": Law({"sensor": SensorModel("binary", delay=0.04)}),
    "first finger dead": Law({}, dead=(0,)),
    "thumb dead": Law({}, dead=(-1,)),
}
"""`DEFAULT` with poorer fingertips, by name."""

FRAGILE = {
    "2 N": Law({"force": 2.0}),
    "2 N, at most": Law({"force": 2.0, "max_force": 2.0}),
    "grip, at most 2 N": Law({"max_force": 2.0, "holding": "grip"}),
}
"""`DEFAULT` with a light grip, and with an object that bears no more of a fingertip, by name."""

LAWS_OF_SENSORS = (DEFAULT, *SENSED, "open_loop")
"""What is compared to tell the worth of sensors."""


def swap_deviations(grasp: Grasps) -> Grasps:
    """Return a grasp whose most certain finger is the least certain finger: max + min - std_m."""
    std_m = grasp.contacts.require_std()
    swapped = std_m.amax(-1, keepdim=True) + std_m.amin(-1, keepdim=True) - std_m
    return dataclasses.replace(grasp, contacts=dataclasses.replace(grasp.contacts, std_m=swapped))


ANCHORS = 600
"""Vertices whose displacements are drawn jointly; about 8 mm lie between them on a thing of 15 cm.
"""
NEIGHBOURS = 12
"""Anchors from which the displacement of a vertex is interpolated."""
GROUND = 0.01
"""Height [m] above its lowest point up to which a thing keeps its foot: it has to stand."""


def draw_solid(shape: ShapeGP, seed: int) -> trimesh.Trimesh:
    """Return a closed mesh whose surface deviates from the mean as the posterior says, with its
    correlations.

    Vertices move along their normals by a joint sample with deviations `std_m`.

    Raises:
        BadArgument: a shape of several walls, or whose surface is open.
    """
    surface = extract_surface(shape)
    mesh = surface.mesh()
    if len(shape.walls) > 1 or not mesh.is_watertight:
        raise BadArgument("shape", "several walls, or an open surface", "one closed wall")
    anchors = farthest_points(surface.vertices, min(ANCHORS, len(surface.vertices)))
    x = shape.normalise(surface.vertices[anchors])[None, :, None]
    covariance = combined_covariance(shape, x, x.new_ones(1, 1, 1, 1))[0]
    prior = float(shape.prior_block()[0, 0])
    root = symmetric_root(covariance, prior, "anchors within the domain")
    draw = root @ torch.randn(
        len(anchors), generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    moved = surface.std_m[anchors] * draw / covariance.diagonal().sqrt()
    field = RBFInterpolator(
        surface.vertices[anchors].numpy(), moved.numpy(), NEIGHBOURS, kernel="linear"
    )
    height = surface.vertices[:, 2] - surface.vertices[:, 2].min()
    length = torch.from_numpy(field(surface.vertices.numpy())) * (height / GROUND).clamp(max=1.0)
    mesh.vertices = (surface.vertices + length[:, None] * surface.normals).numpy()
    return mesh
