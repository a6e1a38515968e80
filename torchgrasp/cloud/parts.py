"""The parts of a cloud: one object on a support, and bodies that lie apart."""

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
from torchgrasp.geometry.linalg import number_components
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.support_planes import SupportPlane, find_supports
from torchgrasp.values.planning import PointCloud

# least half thickness [m] of a support's layer, for the noise of a depth camera at half a metre
LAYER = 0.004
# least distance [m] between bodies; a bent or hidden surface of one body leaves smaller gaps
GAP = 0.04


def label_bodies(points: Float[Tensor, "n 3"], gap: float = GAP) -> Int[Tensor, "n"]:
    """Return the group number of each point; groups are more than `gap` [m] apart, and group 0 is
    the largest.
    """
    device = points.device
    points = points.cpu()
    # One point of each cell of a quarter of the gap, so that dense clouds have few pairs.
    cells = torch.floor((points - points.amin(0)) / (gap / 4)).long()
    size = cells.amax(0) + 1
    _, group = torch.unique(
        (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2], return_inverse=True
    )
    first = first_of_each(group)
    pairs = spatial.KDTree(points[first].numpy()).query_pairs(gap, output_type="ndarray")
    label = number_components(pairs, len(first))[group.numpy()]
    order = np.argsort(np.argsort(-np.bincount(label), kind="stable"), kind="stable")
    return torch.from_numpy(order[label]).to(device)


def find_second_body(
    points: Float[Tensor, "n 3"], up: Float[Tensor, "3"], spacing: float
) -> Bool[Tensor, "n"] | None:
    """Return a mask of the points of a second body that stands apart on the same ground; None if
    there is none.
    """
    label = label_bodies(points, max(GAP, 4 * spacing))
    height = points @ up
    for k in range(1, int(label.max()) + 1):
        body = label == k
        low = (
            height[body].quantile(0.02) - height.min(),
            height[label == 0].quantile(0.02) - height.min(),
        )
        if float(body.double().mean()) >= 0.1 and max(float(x) for x in low) < 0.015:
            return body
    return None


@checked
def cut_object(
    cloud: PointCloud,
    up: Float[Tensor, "3"],
    point: Float[Tensor, "3"] | None = None,
    box: Float[Tensor, "2 3"] | None = None,
    gap: Annotated[float, Range(0.001, 1.0)] = GAP,
) -> tuple[PointCloud, Plane | None]:
    """Return the points of one object that stands on a support, and the support's plane if one was
    found.

    Args:
        cloud: points [m] of a scene.
        up: unit vector that points up.
        point: place on or near the object [m]; points over 0.5 m away are left out. None for the
            largest object.
        box: two opposite corners [m] of a box along the axes; points outside are left out first.
        gap: least distance [m] between objects.

    Raises `TooFewPoints` for fewer than 4 points in the box, near the point or of the object.

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
        keep &= torch.linalg.vector_norm(points - point, dim=-1) < 0.5
    cloud = _select(cloud, keep, "points in the box and near the point")
    support = _find_support(cloud, up)
    if support is not None:
        height = support.plane.height(cloud.points.double())
        spread = float(
            height[height.abs() < 0.02].abs().median().nan_to_num()
        )  # of the noise of the support
        cloud = _select(cloud, height > max(LAYER, 5 * spread), "points above the plane")
    points = cloud.points.double()
    label = label_bodies(points, gap)
    if point is not None:
        wanted = int(label[torch.linalg.vector_norm(points - point, dim=-1).argmin()])
    else:
        over = label if support is None else label[support.covers(points)]
        wanted = int((over if len(over) else label).mode().values)
    return _select(
        cloud, label == wanted, "points of the object"
    ), None if support is None else support.plane


def _find_support(cloud: PointCloud, up: Float[Tensor, "3"]) -> SupportPlane | None:
    """Return the plane on which a scene's objects stand: nearly level, else any that the camera
    looks down on.
    """
    eye = (
        cloud.viewpoint
        if cloud.viewpoint is None or cloud.viewpoint.ndim == 1
        else cloud.viewpoint.mean(0)
    )
    for sky in (up, *([None] if eye is not None else [])):
        try:
            return find_supports(cloud.points, eye, sky)[0]
        except NoSupport:
            continue
    return None


def _select(cloud: PointCloud, keep: Bool[Tensor, "n"], what: str) -> PointCloud:
    """Return the cloud's points in the mask `keep`; raise `TooFewPoints` if there are fewer than 4
    (named `what`).
    """
    if int(keep.sum()) < MIN_POINTS:
        raise TooFewPoints("cloud", f"{int(keep.sum())} {what}", f"at least {MIN_POINTS} {what}")
    return cloud.select(keep)
