"""Rigid transforms, and the virtual frame of three contacts, Eqs. (15)-(17) of the paper.

A transform `a_from_b` maps coordinates of frame b into frame a. Products therefore chain adjacent
names: `obj_from_hand = obj_from_vf @ vf_from_hand`, Eq. (24) of the paper, with the virtual frame
vf.
"""

import itertools
import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.errors import DegenerateContacts
from torchgrasp.foundation.rules import is_known
from torchgrasp.geometry.linalg import eye_like, norm, unit

FLAT = 1e-3
"""Least height of a contact triangle over its longest side. In a flatter one, noise decides the
direction of the virtual frame.
"""


def to_array(value: Float[Tensor, "*b"]) -> np.ndarray:
    """Return a tensor of any shape and device as a NumPy array in float64, without its gradient."""
    return value.detach().cpu().double().numpy()


def rigid(
    rotation: Float[Tensor, "*b 3 3"], translation: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 4 4"]:
    """Return the homogeneous transforms (*b, 4, 4) with given rotation matrices and translations
    [m].
    """
    top = torch.cat([rotation, translation[..., None]], dim=-1)
    bottom = eye_like(4, top)[3]
    return torch.cat([top, bottom.expand(*top.shape[:-2], 1, 4)], dim=-2)


def turned_about(
    rotation: Float[Tensor, "*b 3 3"], point: Float[Tensor, "3"], shift: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 4 4"]:
    """Return the transform that rotates about a `point` (3,) [m], and then translates by `shift`
    [m].

    The `rotation` (*b, 3, 3) is a matrix, and the result is rigid. b stands for any batch axes.
    """
    return rigid(rotation, point + shift - rotation @ point)


def inverse(a_from_b: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """Return the inverse `b_from_a` of a rigid transform `a_from_b`; translations are in metres."""
    rotation = a_from_b[..., :3, :3].mT
    return rigid(rotation, -(rotation @ a_from_b[..., :3, 3:])[..., 0])


def apply(
    a_from_b: Float[Tensor, "*#b 4 4"], points: Float[Tensor, "*#b n 3"]
) -> Float[Tensor, "*#b n 3"]:
    """Return points (*b, n, 3) [m] of frame b in frame a, by the rigid transform `a_from_b`."""
    return points @ a_from_b[..., :3, :3].mT + a_from_b[..., None, :3, 3]


def rotate(
    a_from_b: Float[Tensor, "*#b 4 4"], directions: Float[Tensor, "*#b n 3"]
) -> Float[Tensor, "*#b n 3"]:
    """Return directions (*b, n, 3), vectors of any unit, of frame b in frame a.

    The translation of the rigid transform `a_from_b` is ignored.
    """
    return directions @ a_from_b[..., :3, :3].mT


def skew(v: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Return the skew-symmetric matrix of the cross product with v: `skew(v) @ w == v x w`."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    rows = ((o, -z, y), (z, o, -x), (-y, x, o))
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def rotation_from_vector(v: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Return the rotation matrix (*b, 3, 3) of a rotation vector v: by the angle |v| [rad] about v.

    This is the exponential map, which is smooth at v = 0. b stands for any batch axes.
    """
    angle = norm(v)[..., None, None]
    # Rodrigues: sin x / x, and (1 - cos x) / x^2 = half^2 / 2
    turn = skew(v)
    half = torch.sinc(angle / (2 * math.pi))
    return eye_like(3, v) + torch.sinc(angle / math.pi) * turn + half * half / 2 * (turn @ turn)


def real(numbers: Any) -> Tensor:
    """Return numbers, such as nested lists, as a float64 tensor on the CPU.

    The default dtype and device of torch are not used.
    """
    return torch.tensor(numbers, dtype=torch.float64, device="cpu")


def rotation_from_rpy(rpy: tuple[float, float, float]) -> Float[Tensor, "3 3"]:
    """Return the rotation matrix of `rpy`: roll, pitch and yaw [rad] about the fixed axes x, y, z.

    The rotation about x comes first, as in a URDF.
    """
    cr, cp, cy = map(math.cos, rpy)
    sr, sp, sy = map(math.sin, rpy)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return real(rows)


def rotation_angle(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Return the angles (*b,) [rad] of rotation matrices, from 0 to pi, accurate near both ends."""
    axis = (rotation - rotation.mT)[..., [2, 0, 1], [1, 2, 0]]
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.atan2(norm(axis), trace - 1)


def subsets(count: int, size: int, device: torch.device) -> Int[Tensor, "k s"]:
    """Return all k subsets of the indices 0 to `count` - 1 that have s = `size` members.

    Each line of the result (k, s) is one subset, in ascending order. The lines are in lexical
    order, on the `device`.
    """
    if size == count:
        return torch.arange(count, device=device)[None]
    return torch.tensor(list(itertools.combinations(range(count), size)), device=device)


def degenerate(points: Float[Tensor, "*b f 3"]) -> Bool[Tensor, "*b"]:
    """Return a mask (*b,) of the contact sets whose f contact points lie nearly on a line.

    Then twice the area of their largest triangle is at most 0.001 (`FLAT`) times the square of the
    longest side. The points [m] may be in any frame.
    """
    corners = points[..., subsets(points.shape[-2], 3, points.device), :]  # (*b, k, 3, 3)
    sides = corners - corners.roll(1, dims=-2)
    longest = norm(sides).amax((-1, -2))
    normals = torch.linalg.cross(sides[..., 0, :], sides[..., 1, :])
    doubled_area = norm(normals).amax(-1)
    return ~(doubled_area > FLAT * longest**2)


def virtual_frame(points: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 4 4"]:
    """Return the pose `a_from_vf` [m] of the virtual frame of three contacts [m] in frame a.

    Eqs. (15)-(17) of the paper define it. The origin is the centroid of the contact points p1, p2,
    p3 (Eq. 16). The x axis points from p1 to p3. The z axis is along (p2 - p1) x (p3 - p1), normal
    to their plane. Raises `DegenerateContacts` for contacts nearly on a line. Inside torch.vmap,
    where values are unknown, their pose is NaN instead.
    """
    flat = degenerate(points)
    if not is_known(flat):
        points = torch.where(flat[..., None, None], torch.nan, points)
    elif flat.any():
        raise DegenerateContacts(
            f"{int(flat.sum())} of {flat.numel()} contact triples lie on a line or in a point"
        )
    p1, p2, p3 = points.unbind(-2)
    x_axis = unit(p3 - p1)
    z_axis = unit(torch.linalg.cross(p2 - p1, x_axis))
    y_axis = torch.linalg.cross(z_axis, x_axis)
    return rigid(torch.stack([x_axis, y_axis, z_axis], dim=-1), points.mean(-2))
