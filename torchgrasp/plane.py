"""The plane that things stand on, and the upright frame in which everything is computed.

A stage that knew the camera's or the robot's frame would give other grasps in another frame. So public functions bring
what they are given into a frame that only scene and camera determine, and their results back.
"""

import dataclasses
import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value, check_tensor
from torchgrasp.errors import BadArgument
from torchgrasp.frames import apply, inverse, rigid
from torchgrasp.linalg import unit

GRID = 2.0**-20
"""Spacing [m] to which points are rounded in an upright frame: a micrometre. Rounding errors of a transform, some
1e-16 m, then leave no trace."""
LEAST_TILT = 0.05
"""Least sine of the angle between the vertical and the direction to the camera: steeper views have no azimuth."""


@dataclasses.dataclass(frozen=True)
class Plane(Value):
    """A plane of support: the points p with normal . p = offset; things stand on the side of the normal.

    Args:
        normal: unit vector that points up.
        offset: distance [m] of the plane from the origin along the normal.

    Raises:
        BadArgument: a normal that is not of unit length, or numbers that are not finite.

    >>> Plane.horizontal(0.1).height(torch.tensor([0.0, 0.0, 0.3]))
    tensor(0.2000)
    """

    normal: Float[Tensor, "3"]
    offset: float

    def __post_init__(self) -> None:
        """Check the numbers once, where the value is made."""
        check_tensor("normal", self.normal, (3,))
        length = float(torch.linalg.vector_norm(self.normal))
        if not abs(length - 1) < 1e-4:
            raise BadArgument("normal", f"a length of {length:g}", "a unit vector")
        if not math.isfinite(self.offset):
            raise BadArgument("offset", self.offset, "a finite number of metres")

    @classmethod
    def horizontal(cls, height: float) -> "Plane":
        """Return the plane z = height [m]."""
        return cls(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), float(height))

    def height(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Return the heights [m] of points above the plane."""
        return points @ self.normal.to(points) - self.offset

    def moved(self, b_from_a: Float[Tensor, "4 4"]) -> "Plane":
        """Return the plane in frame b; it is given in frame a."""
        normal = b_from_a[:3, :3].double() @ self.normal.double()
        return Plane(unit(normal), self.offset + float(normal @ b_from_a[:3, 3].double()))


def as_plane(table: Plane | float | None) -> Plane | None:
    """Return the plane of a table that is given as a plane, as a height [m] along z, or not at all."""
    if table is None or isinstance(table, Plane):
        return table
    if isinstance(table, bool) or not isinstance(table, int | float) or not math.isfinite(table):
        raise BadArgument("table", repr(table), "a Plane, a height in metres, or None")
    return Plane.horizontal(table)


def upright_frame(
    points: Float[Tensor, "n 3"], viewpoint: Float[Tensor, "*views 3"] | None, table: Plane | None
) -> Float[Tensor, "4 4"]:
    """Return `obj_from_upright`, a frame that moves with points [m], camera and table.

    Its z axis is the table's normal, else the direction to the camera, else the points' least principal axis. Its x
    axis points level towards the camera, else to the point farthest from the vertical through the points' centre,
    where the origin lies: on the table, if there is one.
    """
    points = points.detach().cpu().double()
    centre = points.mean(0)
    offset = points - centre
    eye = None if viewpoint is None else viewpoint.detach().cpu().double().reshape(-1, 3).mean(0) - centre
    if table is not None:
        z = unit(table.normal.detach().cpu().double())
        centre = centre - table.height(centre) * z
    elif eye is not None and bool(eye.any()):
        z, eye = unit(eye), None
    else:
        z = torch.linalg.svd(offset, full_matrices=False).Vh[2]
        z = z if float((offset @ z).pow(3).sum()) >= 0 else -z
    if eye is not None:
        level = eye - (eye @ z) * z
        eye = level if torch.linalg.vector_norm(level) > LEAST_TILT * torch.linalg.vector_norm(eye) else None
    if eye is None:
        level = offset - (offset @ z)[:, None] * z
        eye = level[torch.linalg.vector_norm(level, dim=1).argmax()]
    x = unit(eye - (eye @ z) * z)
    return rigid(torch.stack([x, torch.linalg.cross(z, x), z], -1), centre)


def to_upright(points: Float[Tensor, "*b 3"], obj_from_upright: Float[Tensor, "4 4"]) -> Float[Tensor, "*b 3"]:
    """Return points [m] in the upright frame, rounded to `GRID`."""
    flat = apply(inverse(obj_from_upright).to(points.device), points.double().reshape(-1, 3))
    return (torch.round(flat / GRID) * GRID).reshape(points.shape)
