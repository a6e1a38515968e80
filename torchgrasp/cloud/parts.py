"""The parts of a cloud: one object on a support, and bodies that lie apart."""

import contextlib
import dataclasses
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.cloud.check import MIN_POINTS, first_of_each
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import NoSupport, TooFewPoints
from torchgrasp.foundation.lazy import spatial
from torchgrasp.foundation.rules import Range
from torchgrasp.geometry.linalg import Points, Vector, norm, number_cells, number_components
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.support_planes import SUPPORTS, SupportPlane
from torchgrasp.geometry.support_search import find_supports
from torchgrasp.values.planning import PointCloud


@dataclasses.dataclass(frozen=True)
class PartNumbers:
    """Bounds by which points belong to the support of a scene, or to one body."""

    layer: float = 0.004
    """Least half thickness [m] of a support's layer: a depth camera's noise at half a metre."""
    near: float = 0.02
    """Distance [m] from the support within which points show its noise."""
    noises: float = 5.0
    """Half thickness of the support's layer, in multiples of a median distance from the support.
    It is that of the points within `near`.
    """
    gap: float = 0.04
    """Least distance [m] between two bodies; a bent or hidden surface leaves smaller gaps."""
    spacings: float = 4.0
    """Least distance between two bodies in spacings of the points, for sparse clouds."""
    share: float = 0.1
    """Least share of the points in a second body. Fewer points are the rest of a body that was cut
    away.
    """
    lowest: float = 0.02
    """Share of the points of a body that may be lower than its foot: outliers."""
    foot: float = 0.015
    """Height [m] of a body's foot above the lowest point of all, below which the body stands on the
    ground.
    """
    around: float = 0.5
    """Greatest distance [m] of an object's points from a given place on or near it."""
    exact: float = 2e-5
    """Greatest median height [m] of a table's points above it in a cloud without noise."""
    thin: float = 0.0005
    """Half thickness [m] of the layer that is a table without noise."""
    fewest: int = 50
    """Least number of points of a table without noise."""


PARTS = PartNumbers()


def label_bodies(points: Points, gap: float = PARTS.gap) -> Int[Tensor, "n"]:
    """Return the number of the body to which each of n points belongs; body 0 has the most points.

    A body is a group of points with steps of at most `gap` [m] from one to the next. The points
    (n, 3) are in metres.
    """
    device = points.device
    points = points.cpu()
    # One point of each cell of a quarter of the gap, so that dense clouds have few pairs.
    group = number_cells(points - points.amin(0), gap / 4)
    first = first_of_each(group)
    pairs = spatial.KDTree(points[first].numpy()).query_pairs(gap, output_type="ndarray")
    label = number_components(pairs, len(first))[group.numpy()]
    order = np.argsort(np.argsort(-np.bincount(label), kind="stable"), kind="stable")
    return torch.from_numpy(order[label]).to(device)


def find_second_body(points: Points, up: Vector, spacing: float) -> Bool[Tensor, "n"] | None:
    """Return a mask of the points of a second body on the same ground; None if there is none.

    Bodies are more than 40 mm (`PARTS.gap`) and more than 4 times the `spacing` [m] of neighbouring
    points apart. The second one holds at least 10 % of the points (`PARTS.share`). Both bodies
    stand at most 15 mm (`PARTS.foot`) above the lowest point. The points (n, 3) are in metres, and
    `up` is the unit vector that points up.
    """
    label = label_bodies(points, max(PARTS.gap, PARTS.spacings * spacing))
    height = points @ up
    ground = height.min()

    def stands(body: Bool[Tensor, "n"]) -> bool:
        return float(height[body].quantile(PARTS.lowest) - ground) < PARTS.foot

    if not stands(label == 0):
        return None
    for k in range(1, int(label.max()) + 1):
        body = label == k
        if float(body.double().mean()) >= PARTS.share and stands(body):
            return body
    return None


@checked
def cut_object(
    cloud: PointCloud,
    up: Vector,
    point: Vector | None = None,
    box: Float[Tensor, "2 3"] | None = None,
    gap: Annotated[float, Range(0.001, 1.0)] = PARTS.gap,
) -> tuple[PointCloud, Plane | None]:
    """Return (object, support): the points of one object of a scene, and the plane it stands on.

    The plane is a `Plane` in the frame of the cloud; None if no plane was found. Points below the
    plane, or up to 4 mm (`PARTS.layer`) above it, are left out. In a noisy cloud more are left out.

    Args:
        cloud: points [m] of a scene.
        up: unit vector (3,) that points up, in the frame of the cloud.
        point: position (3,) [m] on or near the object, in the frame of the cloud. Points more than
            0.5 m away (`PARTS.around`) are left out first. None means the object with the most
            points above the supporting area of the plane.
        box: two opposite corners (2, 3) [m] of a box along the axes of the cloud's frame. Points
            outside are left out first. None means no box.
        gap: distance [m] beyond which points belong to different objects, 0.001 to 1.

    Raises `TooFewPoints` if fewer than 4 points are in the box, near `point`, above the plane, or
    on the object.

    >>> from torchgrasp import load_scene
    >>> seen = PointCloud(load_scene().points.double())
    >>> found, table = cut_object(seen, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    >>> len(seen) > 2 * len(found), abs(table.offset) < 0.002
    (True, True)
    """
    points = cloud.points.double()
    up = up.to(points)
    (point, box) = (None if x is None else x.to(points) for x in (point, box))
    keep = torch.ones(len(points), dtype=torch.bool, device=points.device)
    if box is not None:
        keep &= ((points >= box.amin(0)) & (points <= box.amax(0))).all(1)
    if point is not None:
        keep &= norm(points - point) < PARTS.around
    cloud = _select(cloud, keep, "points in the box and near the point")
    support = find_ground(cloud.points, cloud.viewpoint, up)
    if support is not None:
        height = support.plane.height(cloud.points.double())
        noise = float(height[height.abs() < PARTS.near].abs().median().nan_to_num())
        layer = max(PARTS.layer, PARTS.noises * noise)
        cloud = _select(cloud, height > layer, "points above the plane")
    points = cloud.points.double()
    label = label_bodies(points, gap)
    if point is not None:
        wanted = int(label[norm(points - point).argmin()])
    else:
        over = label if support is None else label[support.covers(points)]
        wanted = int((over if len(over) else label).mode().values)
    object_ = _select(cloud, label == wanted, "points of the object")
    return object_, None if support is None else support.plane


def cut_exact_table(cloud: PointCloud, up: Vector) -> tuple[PointCloud, Plane | None]:
    """Return a cloud without the points of a table that has no noise, and the plane of the table.

    Such a table is that of a simulated cloud [m]. Points below 0.5 mm (`PARTS.thin`) above it are
    left out, so the object's foot stays. If there is no such table, the cloud itself and None are
    returned. `up` is the unit vector that points up. Cloud, plane and `up` are in one frame.
    """
    points = cloud.points.double()
    support = find_ground(points, cloud.viewpoint, up.to(points))
    if support is None:
        return cloud, None
    height = support.plane.height(points)
    near = height[height.abs() < PARTS.layer].abs()
    if len(near) < PARTS.fewest or float(near.median()) > PARTS.exact:
        return cloud, None
    rest = height > PARTS.thin
    if int(rest.sum()) < MIN_POINTS:
        return cloud, None
    return cloud.select(rest), support.plane


def find_ground(
    points: Points,
    eye: Float[Tensor, "*views 3"] | None,
    up: Vector,
    level_width: float = SUPPORTS.least_width,
) -> SupportPlane | None:
    """Return the plane on which objects stand, found among `points`; None if there is none.

    A nearly level plane at least `level_width` [m] wide is sought first. If there is none, and the
    cameras are known, any plane counts on whose upper side they are. All are in one frame. The
    points (n, 3) are in metres. `eye` holds the camera's position [m], or that of each point; None
    if it is unknown. `up` is the unit vector that points up.
    """
    middle = None if eye is None else eye.reshape(-1, 3).mean(0)
    kinds = (
        [(up, level_width)] if middle is None else [(up, level_width), (None, SUPPORTS.least_width)]
    )
    for sky, width in kinds:
        with contextlib.suppress(NoSupport):
            return find_supports(points, middle, sky, width)[0]
    return None


def _select(cloud: PointCloud, keep: Bool[Tensor, "n"], what: str) -> PointCloud:
    """Return the cloud's points in the mask `keep`; raise `TooFewPoints` if there are fewer than 4
    (named `what`).
    """
    if int(keep.sum()) < MIN_POINTS:
        raise TooFewPoints("cloud", f"{int(keep.sum())} {what}", f"at least {MIN_POINTS} {what}")
    return cloud.select(keep)
