"""The sides of objects on a table, which lean all alike if the focal length is wrong.

A focal length that is s times too long shortens a view across the optical axis. Planes remain
planes, and a table is found. But what stands upright on it leans towards a camera that looks down,
and away from it for s below 1.
"""

import dataclasses
import math

import torch
from jaxtyping import Int
from torch import Tensor

from torchgrasp.cloud.neighbours import draw_rows, fit_local_planes
from torchgrasp.cloud.pose import Transform
from torchgrasp.foundation.base import flatnonzero
from torchgrasp.geometry.linalg import Points, Vector, dot, norm, unit
from torchgrasp.geometry.plane import Plane


@dataclasses.dataclass(frozen=True)
class LeaningNumbers:
    """Bounds by which the sides of several objects lean alike, as by a wrong focal length. The user
    is then told (`tell_leaning`).
    """

    points: int = 150
    """Least number of points of an object whose sides are looked at."""
    drawn: int = 300
    """Greatest number of points of an object at which planes are fitted."""
    objects: int = 5
    """Greatest number of objects whose sides are looked at, the largest ones."""
    low: float = 0.2
    """Least height of points on a side, as a share of the object's height. Lower points blend into
    the table.
    """
    high: float = 0.8
    """Greatest height of points on a side, as a share of the object's height. Higher ones may be on
    a rounded rim.
    """
    steep: float = 45.0
    """Greatest angle [deg] of a side to the vertical."""
    facing: float = 0.6
    """Least cosine between the normal of a side and the horizontal direction to the camera."""
    share: float = 0.15
    """Least share of an object's points that lie on its side."""
    even: float = 6.5
    """Greatest median deviation [deg] of a side's lean, if it is flat or cylindrical. Round sides
    have more.
    """
    fewest: int = 2
    """Least number of objects with a side whose lean is measured: a single one may be tapered."""
    alike: float = 6.5
    """Greatest difference [deg] of a side's lean from the median one, at which sides lean alike."""
    most: float = 0.66
    """Least share of the sides that are alike."""
    told: float = 12.0
    """Least median lean [deg] of the sides for a note: cups taper by less."""
    top: float = 0.98
    """Quantile of the points' heights that is the height of an object."""


LEANING = LeaningNumbers()


def tell_leaning(
    points: Points, labels: Int[Tensor, "n"], pose: Transform, table: Plane
) -> tuple[str, ...]:
    """Return one note, a sentence, if the sides of several objects lean alike, else none.

    They lean from the vertical by 12 degrees (`LEANING.told`) or more, towards or away from the
    camera. A wrong focal length makes sides lean so. `labels` (n,) holds the object of each of the
    `points` (n, 3) [m], 0 for none. The `pose` (4, 4) [m] leads from the camera's frame to that of
    the points and the `table`.
    """
    eye = pose[:3, 3].double().cpu()
    forward = pose[:3, 2].double().cpu()
    table = table.to("cpu", torch.float64)
    labelled = flatnonzero(labels > 0)
    own = labels[labelled]
    count = torch.bincount(own)
    largest = count.argsort(descending=True)[: LEANING.objects]
    sides = list[float | None]()
    for k in largest[count[largest] >= LEANING.points].tolist():
        rows = labelled[own == k]
        rows = rows[draw_rows(len(rows), LEANING.drawn)]
        sides.append(_side(points[rows].double().cpu(), eye, table))
    found = torch.tensor([side for side in sides if side is not None])
    if len(found) < LEANING.fewest:
        return ()
    middle = float(found.quantile(0.5, interpolation="nearest"))
    alike = (found - middle).abs() <= LEANING.alike
    if abs(middle) < LEANING.told or float(alike.double().mean()) < LEANING.most:
        return ()
    if int(alike.sum()) < LEANING.fewest:
        return ()
    # the vertical and the table's normal, as angles above the image plane
    down = math.atan2(-float(forward @ table.normal), float(norm(_along(forward, table))))
    upright = down - math.radians(middle)
    if not 0 < down < math.pi / 2 or not 0 < upright < math.pi / 2:
        return ()
    ratio = math.sqrt(math.tan(upright) / math.tan(down))
    side = "towards" if middle < 0 else "away from"
    lean = f"lean {side} the camera, by {abs(middle):.0f} degrees"
    cause = f"as if the focal lengths were {ratio:.2g} times the true ones"
    fix = "give the intrinsics of this depth image, not those of another camera"
    return (f"the sides of {int(alike.sum())} objects {lean}, {cause}: {fix}",)


def _side(points: Points, eye: Vector, table: Plane) -> float | None:
    """Return the angle [deg] by which the side of an object leans away from the camera; None if no
    flat or cylindrical side is seen.

    The `points` (n, 3) [m] are those of the object.
    """
    height = table.height(points)
    share = height / height.quantile(LEANING.top)
    normals, _ = fit_local_planes(points)
    away = eye - points
    normals = torch.where(dot(normals, away)[:, None] < 0, -normals, normals)
    rise = normals @ table.normal.to(normals)
    side = (share > LEANING.low) & (share < LEANING.high)
    side &= rise.abs() < math.sin(math.radians(LEANING.steep))
    side &= dot(normals, unit(_along(away, table))) > LEANING.facing
    if float(side.double().mean()) < LEANING.share:
        return None
    lean = torch.rad2deg(torch.asin(rise[side].clamp(-1, 1)))
    middle = lean.median()
    return float(middle) if float((lean - middle).abs().median()) <= LEANING.even else None


def _along(vectors: Tensor, table: Plane) -> Tensor:
    """Return the parts of vectors (*b, 3) along a table."""
    normal = table.normal.to(vectors)
    return vectors - (vectors @ normal)[..., None] * normal
