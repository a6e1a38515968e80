"""The plane that things stand on, and the upright frame in which everything is computed.

A stage that knew the camera's or the robot's frame would give other grasps in another frame. So public functions bring
what they are given into a frame that only scene and camera determine, and their results back.
"""

import dataclasses
import functools
import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import SomeValue, Value, map_tensors
from torchgrasp.checks import Pose, checked
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.frames import apply, inverse, rigid, rotate
from torchgrasp.geometry.linalg import unit
from torchgrasp.values import PointCloud

GRID = 2.0**-20
"""Spacing [m] to which points are rounded in an upright frame: a micrometre. Rounding errors of a transform, some
1e-16 m, then leave no trace."""
PHASE = 1 / math.pi
"""Phase of the rounding: numbers from a file of float32 would often lie halfway between two multiples of `GRID`."""
POINTS, DIRECTIONS, POSES = (
    ("points", "viewpoint", "vertices"),
    ("normals", "approach", "witness", "frustum"),
    ("obj_from_hand", "obj_from_vf"),
)
"""Fields of values that change with the frame; the other fields do not."""
DEPTH = 0.01
"""Depth [m] under the table at which a cloud's middle point contradicts the table: several errors of calibration."""
LEAST_TILT = 0.05
"""Least sine of the angle between the vertical and the direction to the camera: steeper views have no azimuth."""


@checked
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
        """Check the length once, where the value is made."""
        length = float(torch.linalg.vector_norm(self.normal))
        if not abs(length - 1) < 1e-4:
            raise BadArgument("normal", f"a length of {length:g}", "a unit vector")

    @classmethod
    @checked
    def horizontal(cls, height: float) -> "Plane":
        """Return the plane z = height [m]."""
        return cls(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), float(height))

    @functools.cached_property
    def components(self) -> tuple[float, float, float]:
        """The normal as numbers, read from its device once."""
        x, y, z = self.normal.tolist()
        return x, y, z

    @checked(gradients=True)
    def height(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Return the heights [m] of points above the plane."""
        return points @ self.normal.to(points) - self.offset

    @checked
    def moved(self, b_from_a: Pose) -> "Plane":
        """Return the plane in frame b; it is given in frame a.

        >>> raised = torch.eye(4)
        >>> raised[2, 3] = 0.5  # the table's frame stands 0.5 m above the floor
        >>> Plane.horizontal(0.1).moved(raised).offset
        0.6
        """
        normal = b_from_a[:3, :3].double() @ self.normal.double()
        return Plane(unit(normal), self.offset + float(normal @ b_from_a[:3, 3].double()))

    def describe(self) -> str:
        """Return the numbers as text.

        >>> Plane.horizontal(0.1).describe()
        'normal 0 0 1, offset 0.1'
        """
        x, y, z = self.normal.tolist()
        return f"normal {x:.9g} {y:.9g} {z:.9g}, offset {self.offset:.9g}"


def as_plane(table: Plane | float | None) -> Plane | None:
    """Return the plane of a table that is given as a plane, as a height [m] along z, or not at all."""
    if table is None or isinstance(table, Plane):
        return table
    if isinstance(table, bool) or not isinstance(table, int | float) or not math.isfinite(table):
        raise BadArgument("table", repr(table), "a Plane, a height in metres, or None")
    return Plane.horizontal(table)


def upright_frame(cloud: PointCloud, table: Plane | None = None) -> Float[Tensor, "4 4"]:
    """Return `obj_from_upright`, a frame that moves with cloud, camera and table.

    Its z axis is the table's normal, else the direction to the camera, else the points' least principal axis. Its x
    axis points level towards the camera, else to the point farthest from the vertical through the points' centre,
    where the origin lies: on the table, if there is one.

    Raises:
        BadArgument: a table with most points more than `DEPTH` under it.
    """
    points, viewpoint = cloud.points.detach().cpu().double(), cloud.viewpoint
    centre = points.mean(0)
    offset = points - centre
    eye = None if viewpoint is None else viewpoint.detach().cpu().double().reshape(-1, 3).mean(0) - centre
    if table is not None:
        middle = float(table.height(points).median())
        if middle < -DEPTH:
            raise BadArgument("table", f"a plane {-middle:.3g} m above the middle of the cloud", "one under the object")
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
    return _round(apply(inverse(obj_from_upright).to(points.device), points.double().reshape(-1, 3))).reshape_as(points)


def _round(x: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Round to multiples of `GRID`; rounded numbers stay."""
    return torch.round(x / GRID + PHASE) * GRID


def cloud_to_upright(cloud: PointCloud, obj_from_upright: Float[Tensor, "4 4"]) -> PointCloud:
    """Return a cloud in the upright frame, in float64 and rounded to `GRID`."""
    return map_tensors(_round, move(cloud.to(torch.float64), inverse(obj_from_upright)))


def move(value: SomeValue, b_from_a: Float[Tensor, "4 4"]) -> SomeValue:
    """Return a value of `torchgrasp.values` in frame b [m]; it is given in frame a.

    >>> up = torch.eye(4).index_put((torch.tensor(2), torch.tensor(3)), torch.tensor(1.0))
    >>> move(PointCloud(torch.zeros(4, 3)), up).points[0]
    tensor([0., 0., 1.])
    """

    def moved(name: str, x: Any) -> Any:
        if isinstance(x, Value):
            return move(x, b_from_a)
        if not isinstance(x, Tensor) or name not in (*POINTS, *DIRECTIONS, *POSES):
            return x
        pose = b_from_a.to(x)
        if name in POSES:
            return pose @ x
        vectors = x.reshape(-1, 3)  # a wrench is a force and a torque
        return (apply if name in POINTS else rotate)(pose, vectors).reshape(x.shape)

    names = [field.name for field in dataclasses.fields(value)]  # pyright: ignore[reportArgumentType]
    return type(value)(**{name: moved(name, getattr(value, name)) for name in names})
