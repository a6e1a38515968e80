"""The simulator's frame: its pose in the frame of a grasp, and grasps, tables and meshes in it."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.lazy import trimesh
from torchgrasp.geometry.frames import inverse, rigid, rotate
from torchgrasp.geometry.linalg import norm, unit
from torchgrasp.geometry.plane import FINE, Plane, to_upright
from torchgrasp.values.planning import Grasps

DECIMALS = 9  # decimals to which the offset [m] of a table is rounded


def world_frame(table: Plane, obj_from_hand: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """Return the pose (4, 4) [m] of the simulator's frame in the frame of the grasp.

    In the simulator's frame the table is at z = 0 and its normal along z. The hand's root link is
    above the origin. The x axis is the level part of the hand's x axis. If the hand's x axis is
    steeper than 60 degrees, the hand's y axis takes its place. The arguments, the `table` and the
    hand's pose `obj_from_hand` [m], are in the frame of the grasp.
    """
    z = unit(table.normal.double())
    origin = obj_from_hand[:3, 3]
    level = [axis - (axis @ z) * z for axis in obj_from_hand[:3, :2].unbind(-1)]
    x = unit(level[0] if norm(level[0]) > 0.5 else level[1])
    axes = torch.stack([x, torch.linalg.cross(z, x), z], -1)
    return rigid(axes, origin - table.height(origin) * z)


def to_frame(grasp: Grasps, obj_from_frame: Float[Tensor, "4 4"]) -> Grasps:
    """Return a grasp with its contacts, hand pose and approach in the coordinates of another frame.

    `obj_from_frame` [m] is the pose of that frame in the grasp's present frame. Other fields, such
    as the certificate, are not converted. Contact points are rounded to multiples of about 1 um
    (`GRID`). All other converted numbers are rounded to multiples of about 1e-9 (`FINE`).
    """
    frame_from_obj = inverse(obj_from_frame)

    def turn(vectors: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        return rounded(rotate(frame_from_obj, vectors))

    contacts = dataclasses.replace(
        grasp.contacts,
        points=to_upright(grasp.contacts.points, obj_from_frame),
        normals=turn(grasp.contacts.normals),
    )
    pose = rounded(frame_from_obj @ grasp.obj_from_hand)
    approach = turn(grasp.approach)
    return dataclasses.replace(grasp, contacts=contacts, obj_from_hand=pose, approach=approach)


def rounded(numbers: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Return the `numbers` (*b,), each rounded to a multiple of about 1e-9 (`FINE`). They are of a
    size of about 1, such as components of unit vectors.
    """
    return torch.round(numbers / FINE) * FINE


def rounded_table(table: Plane) -> Plane:
    """Return the `table` with its numbers rounded: its normal to multiples of about 1e-9, its
    offset to 1e-9 m. The plane of its edge, if any, is rounded likewise.
    """
    edge = None if table.edge is None else rounded_table(table.edge)
    return Plane(rounded(table.normal), round(table.offset, DECIMALS), edge)


def moved_mesh(mesh: "trimesh.Trimesh", obj_from_world: Float[Tensor, "4 4"]) -> "trimesh.Trimesh":
    """Return a mesh [m] of the grasp's frame in the coordinates of the simulator's frame.
    `obj_from_world` (4, 4) [m] is the pose of the simulator's frame in the grasp's frame.

    The vertices are rounded to multiples of about 1 um (`GRID`).
    """
    vertices = torch.from_numpy(np.array(mesh.vertices, dtype=np.float64))
    moved = to_upright(vertices, obj_from_world).numpy()
    return trimesh.Trimesh(moved, mesh.faces, process=False)
