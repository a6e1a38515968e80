"""The table plane, and the upright frame in which the library computes.

Results must not depend on the frame of the camera or the robot. So public functions transform their
arguments into a frame that only scene and camera determine, and transform the results back.
"""

import dataclasses
import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.base import SomeValue, Value, map_tensors
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.limits import MAX_EXTENT
from torchgrasp.foundation.rules import Pose
from torchgrasp.geometry.frames import apply, inverse, real, rigid, rotate
from torchgrasp.geometry.linalg import norm, unit

GRID = 2.0**-20  # step [m] of rounded points: far above the rounding errors of a transform
FINE = GRID**1.5  # step of rounded numbers (no unit) of about size 1: a billionth
POINTS = ("points", "viewpoint", "vertices")
DIRECTIONS = ("normals", "approach", "witness", "frustum", "task_load", "task_twist", "task_forces")
POSES = ("obj_from_hand", "obj_from_vf")
"""Names of the fields that hold poses (4, 4), which a change of the coordinate frame transforms.
`POINTS` names those of points, `DIRECTIONS` those of directions; all other fields are invariant.
"""
# least sine of the camera's angle to the vertical at which its horizontal direction is used
LEAST_TILT = 0.05
UNIT_ERROR = 1e-4  # greatest error of a unit normal's length
# most height [m] of a table above the median height of a cloud: several calibration errors
MOST_ABOVE = 0.01


@checked
@dataclasses.dataclass(frozen=True)
class Plane(Value):
    """The plane of a table: the points p [m] with normal . p = offset. The normal points up, to the
    objects. All vectors are in one frame, such as that of a cloud.

    A table with an `edge` ends there. It fills the points below its own plane and behind the plane
    of the edge. Fingers may then reach under what lies over the edge.

    Args:
        normal: unit normal (3,).
        offset: distance [m] of the plane from the origin along the normal; negative if the plane is
            below the origin.
        edge: vertical plane through the table's edge, whose normal points away from the table. None
            means that the table does not end. `ending` makes a table with an edge.

    Raises `BadArgument` if the normal is not of unit length, or a number is not finite. It is also
    raised for an edge that is not vertical on the table, or has an edge itself.

    >>> plane = Plane.horizontal(0.1)
    >>> plane.describe(), plane.height(torch.tensor([0.0, 0.0, 0.3]))
    ('normal 0 0 1, offset 0.1', tensor(0.2000))
    """

    normal: Float[Tensor, "3"]
    offset: float
    edge: "Plane | None" = None

    def __post_init__(self) -> None:
        length = float(norm(self.normal))
        if not abs(length - 1) < UNIT_ERROR:
            raise BadArgument("normal", f"a vector of length {length:g}", "a unit vector")
        if self.edge is None:
            return
        if self.edge.edge is not None:
            raise BadArgument("edge", "a plane with an edge of its own", "a plane without an edge")
        cosine = float(self.normal.double() @ self.edge.normal.to(self.normal).double())
        if abs(cosine) > UNIT_ERROR:
            found = f"a plane at {math.degrees(math.acos(min(abs(cosine), 1.0))):.3g} degrees"
            raise BadArgument("edge", found, "a plane at 90 degrees to the table")

    @classmethod
    @checked
    def horizontal(cls, height: float) -> "Plane":
        """Return the plane z = `height` [m], with the normal (0, 0, 1) in float64."""
        return cls(real([0.0, 0.0, 1.0]), float(height))

    @checked(gradients=True)
    def height(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Return the heights (*b,) [m] of points (*b, 3) [m] above the plane, negative below it.

        The points are in the frame of the plane. b stands for any batch axes.
        """
        return points @ self.normal.to(points) - self.offset

    @checked
    def ending(self, point: Float[Tensor, "3"], outward: Float[Tensor, "3"]) -> "Plane":
        """Return the same table with a straight `edge`, beyond which there is no table.

        Args:
            point: any point (3,) [m] on the edge, in the frame of the plane.
            outward: direction (3,) away from the table, of any length. Its part along the table
                counts.

        Raises `BadArgument` for a direction less than 3 degrees from the table's normal
        (`LEAST_TILT`).

        >>> table = Plane.horizontal(0.0).ending(torch.tensor([0.3, 0, 0]), torch.tensor([1.0, 0, 0]))
        >>> table.clearance(torch.tensor([[0.2, 0.0, -0.1], [0.35, 0.0, -0.1]]))
        tensor([-0.1000,  0.0500])
        """
        normal = self.normal.double()
        along = outward.to(normal)
        along = along - (along @ normal) * normal
        if not float(norm(along)) > LEAST_TILT * float(norm(outward.double())):
            raise BadArgument("outward", "a direction off the table's plane", "one along the table")
        along = unit(along)
        return dataclasses.replace(self, edge=Plane(along, float(along @ point.to(along))))

    @checked
    def clearance(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Return lower bounds (*b,) [m] of the distances of points (*b, 3) [m] from the table.

        A point of a table without an edge has its height as bound. With an edge, the bound is the
        larger of the height and of the distance beyond the edge. Bounds are negative for points
        inside the table, and only for them. The points are in the frame of the plane. Here b stands
        for any batch axes.
        """
        height = self.height(points)
        return height if self.edge is None else torch.maximum(height, self.edge.height(points))

    @checked
    def moved(self, b_from_a: Pose) -> "Plane":
        """Return the same plane in another frame b, in float64.

        `b_from_a` is the rigid transform (4, 4) [m] from the plane's present frame a to b. Raises
        `BadArgument` for a transform that is not rigid.
        """
        normal = b_from_a[:3, :3].double() @ self.normal.double()
        edge = None if self.edge is None else self.edge.moved(b_from_a)
        return Plane(unit(normal), self.offset + float(normal @ b_from_a[:3, 3].double()), edge)

    def describe(self) -> str:
        """Return the normal and the offset [m] as text, such as "normal 0 0 1, offset 0.1".

        If the plane has an `edge`, the text goes on with "; edge", and normal and offset of the
        edge.
        """
        x, y, z = self.normal.tolist()
        text = f"normal {x:.9g} {y:.9g} {z:.9g}, offset {self.offset:.9g}"
        return text if self.edge is None else f"{text}; edge {self.edge.describe()}"


def read_plane(text: str) -> Plane:
    """Return the plane that a text describes, such as "normal 0 0 1, offset 0.1"
    (`Plane.describe`).

    The offset is in metres, and the plane is in float64. Raises `BadArgument` for any
    other text, or a normal that is not of unit length.
    """
    own, *edges = text.split("; edge ")
    try:
        first, *normal, last, offset = own.replace(",", "").split()
        x, y, z = map(float, normal)
        offset = float(offset)
        if (first, last) != ("normal", "offset"):
            raise ValueError
        edge = [read_plane(part) for part in edges]
        (beyond,) = edge or [None]
    except ValueError:
        raise BadArgument("table", repr(text), "'normal X Y Z, offset D'") from None
    return Plane(torch.tensor([x, y, z], dtype=torch.float64), offset, beyond)


def as_plane(table: Plane | float | None) -> Plane | None:
    """Return the `Plane` of a table, which is given as such, or as its height [m] along z.

    None means no table, and is returned. Raises `BadArgument` for another type or a height that is
    not finite.
    """
    if table is None or isinstance(table, Plane):
        return table
    if isinstance(table, bool) or not isinstance(table, int | float) or not math.isfinite(table):
        raise BadArgument("table", repr(table), "a Plane, a height in metres, or None")
    return Plane.horizontal(table)


def faces_of(table: Plane | None) -> tuple[Plane, ...]:
    """Return the planes that bound a table: its top and, with an edge, the vertical plane through
    it.

    None means no table, and gives an empty tuple.
    """
    if table is None:
        return ()
    return (table,) if table.edge is None else (table, table.edge)


def upright_frame(
    points: Float[Tensor, "n 3"],
    viewpoint: Float[Tensor, "*v 3"] | None = None,
    table: Plane | None = None,
) -> Float[Tensor, "4 4"]:
    """Return `obj_from_upright`, the pose [m] of an upright frame that points, camera and table
    define.

    All arguments and the pose are in one frame `obj`. The upright frame moves with the arguments.
    Its z axis is the table's normal. Without a table, z points to the camera; without both, z is
    the direction in which the points spread least. The x axis is horizontal and points towards the
    camera. If the camera is unknown or straight above, x points to the point farthest from the
    vertical through the centroid. The origin is on this vertical, on the table if there is one.
    `viewpoint` [m] is the camera's position, or several, whose mean is taken. Raises `BadArgument`
    for a table above a camera, or more than 10 mm (`MOST_ABOVE`) above most points. Raises it also
    for a table more than 2 m (`MAX_EXTENT`) below the highest point.
    """
    points = points.detach().cpu().double()
    centre = points.mean(0)
    offset = points - centre
    eyes = None if viewpoint is None else viewpoint.detach().cpu().double()
    eye = None if eyes is None else eyes.reshape(-1, 3).mean(0) - centre
    # z is up
    if table is not None:
        _check_under(table, points, eyes)
        z = unit(table.normal.detach().cpu().double())
        centre = centre - table.height(centre) * z
    elif eye is not None and eye.any():
        z = unit(eye)
        eye = None
    else:
        z = torch.linalg.svd(offset, full_matrices=False).Vh[2]
        z = z if float((offset @ z).pow(3).sum()) >= 0 else -z
    # x points towards the camera, or to where the points reach farthest
    ahead = None
    if eye is not None:
        level = eye - (eye @ z) * z
        ahead = level if norm(level) > LEAST_TILT * norm(eye) else None
    if ahead is None:
        level = offset - (offset @ z)[:, None] * z
        ahead = level[norm(level).argmax()]
    x = unit(ahead - (ahead @ z) * z)
    return rigid(torch.stack([x, torch.linalg.cross(z, x), z], -1), centre)


def _check_under(
    table: Plane, points: Float[Tensor, "n 3"], eyes: Float[Tensor, "*v 3"] | None
) -> None:
    """Raise `BadArgument` for a table above most points, above a camera, or far below all points."""
    heights = table.height(points)
    middle = float(heights.median())
    if middle < -MOST_ABOVE:
        found = f"a plane {-middle:.3g} m above the middle of the cloud"
        raise BadArgument("table", found, "one under the object")
    top = float(heights.max())
    if top > MAX_EXTENT:  # the object would be as high
        found = f"a plane {top:.3g} m below the object's top"
        raise BadArgument("table", found, f"one at most {MAX_EXTENT:g} m below it, in metres")
    if eyes is None:
        return
    above = float(table.height(eyes).min())
    if above <= 0:
        raise BadArgument(
            "table", f"the camera {-above:.3g} m below it", "a table below the camera"
        )


def upright_table(
    table: Plane | None, obj_from_upright: Float[Tensor, "4 4"]
) -> Plane | float | None:
    """Return a table in the upright frame: its height 0 or, if it has an edge, a plane.

    None means no table, and is returned. The given table is in the frame `obj` of the points.
    `obj_from_upright` is the pose [m] that `upright_frame` returned with this table. The numbers of
    an edge are rounded to multiples of 2^-20 (`GRID`), in metres or without unit.
    """
    if table is None or table.edge is None:
        return None if table is None else 0.0
    edge = table.edge.moved(inverse(obj_from_upright))
    outward = _round(edge.normal)
    outward[2] = 0.0  # the edge is vertical on the table
    offset = float(_round(real([edge.offset])))
    return dataclasses.replace(Plane.horizontal(0.0), edge=Plane(unit(outward), offset))


def to_upright(
    points: Float[Tensor, "*b 3"], obj_from_upright: Float[Tensor, "4 4"]
) -> Float[Tensor, "*b 3"]:
    """Return points (*b, 3) [m] of the frame `obj` in the upright frame, in float64.

    They are rounded to multiples of 2^-20 m (`GRID`), a micrometre. `obj_from_upright` (4, 4) is
    the pose [m] of the upright frame in `obj`, as `upright_frame` returns it. b stands for any
    batch axes.
    """
    upright_from_obj = inverse(obj_from_upright).to(points.device)
    moved = apply(upright_from_obj, points.double().reshape(-1, 3))
    return _round(moved).reshape_as(points)


def round_upright(value: SomeValue, obj_from_upright: Float[Tensor, "4 4"]) -> SomeValue:
    """Return a copy of a value, such as a cloud, in the upright frame, in float64 and rounded.

    Every number of its tensors is rounded to a multiple of 2^-20 (`GRID`), in its own unit.
    `obj_from_upright` (4, 4) is the upright frame's pose [m] in the present frame of the value.
    """
    return map_tensors(_round, move(value.to(torch.float64), inverse(obj_from_upright)))


def _round(x: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Round to multiples of `GRID`, after adding a constant that keeps common float32 numbers off
    the midpoints.
    """
    return torch.round(x / GRID + 1 / math.pi) * GRID


def move(value: SomeValue, b_from_a: Float[Tensor, "4 4"]) -> SomeValue:
    """Return a copy of a value, such as a cloud or grasps, transformed from frame a to frame b.

    `b_from_a` (4, 4) is the rigid transform [m]. Which fields change follows from their names, also
    in values within the value. Points (`POINTS`, such as `vertices`) and poses (`POSES`, such as
    `obj_from_hand`) are transformed. Directions (`DIRECTIONS`, such as `normals`) are rotated.
    Other fields stay as they are.
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
