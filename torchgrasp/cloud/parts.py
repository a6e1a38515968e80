"""The parts of a cloud: the support that an object stands on, and bodies that lie apart."""

import math
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.checks import Range, checked
from torchgrasp.cloud.check import MIN_POINTS, first_of_each
from torchgrasp.cloud.neighbours import draw_rows, fit_planes
from torchgrasp.errors import TooFewPoints
from torchgrasp.geometry.plane import Plane
from torchgrasp.values import PointCloud

LAYER = 0.004  # half thickness [m] of a support's layer, for the noise of a depth camera at half a metre
LEVEL = math.cos(math.radians(15))  # least cosine between the vertical and the normal of a level plane
MIN_SUPPORT, STRAYS = 0.15, 0.02
"""Least share of the points in a support's layer; share of stray points, of which more lie above it and fewer below."""
MIN_WIDTH = 0.05  # least width [m] of a support; the side of a pen is narrower
GAP = 0.04  # least distance [m] between bodies; a bent or hidden surface of one body leaves smaller gaps


def find_support(
    points: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    up: Float[Tensor, "3"],
    viewpoint: Float[Tensor, "3"] | None,
    spread: float = 1.3,
) -> tuple[Plane, float] | None:
    """Return the largest plane on which the other points seem to stand, and its share of the points, if any.

    Args:
        points: of a view [m].
        normals: of unit length and any sign.
        up: the vertical, of unit length.
        viewpoint: the camera [m], which sees the upper side; None: only level planes are found.
        spread: least area of the support over the area above it; the bottom of a bowl is smaller than its rim.
    """
    rows = torch.linspace(0, len(points) - 1, min(200, len(points))).long()  # planes through points with normals
    normal, foot = normals[rows], points[rows]
    turned = math.cos(math.radians(25))  # noise turns normals
    for _ in range(3):
        side = up.expand_as(foot) if viewpoint is None else viewpoint - foot
        normal = torch.where(((normal * side).sum(-1) < 0)[:, None], -normal, normal)
        height = points @ normal.T - (normal * foot).sum(-1)
        layer = (height.abs() < LAYER) & ((normals @ normal.T).abs() > turned)
        share = layer.double().mean(0)
        order = share.argsort(descending=True)[:40]
        fitted = [_fit(points[layer[:, k]]) for k in order.tolist() if int(layer[:, k].sum()) >= 3]
        if not fitted:
            return None
        found = (share >= MIN_SUPPORT) & ((height < -2 * LAYER).double().mean(0) <= STRAYS)
        found &= (height > 2 * LAYER).double().mean(0) >= STRAYS
        if viewpoint is None:
            found &= normal @ up > LEVEL
        for k in order.tolist():
            if bool(found[k]):
                area, width = _measure(points[layer[:, k]], normal[k])
                aloft, _ = _measure(points[height[:, k] > 2 * LAYER], normal[k])
                if area > spread * aloft and width > MIN_WIDTH:
                    return Plane(normal[k], float(normal[k] @ foot[k])), float(share[k])
        foot, normal = torch.stack([f for f, _ in fitted]), torch.stack([n for _, n in fitted])
    return None


def _measure(points: Float[Tensor, "n 3"], normal: Float[Tensor, "3"]) -> tuple[float, float]:
    """Return the area [m2] of the convex hull of points, seen along a normal, and its smaller width [m]."""
    from scipy.spatial import ConvexHull, QhullError

    flat = points @ torch.linalg.svd(normal[None]).Vh[1:].T
    try:
        hull = ConvexHull(flat.numpy())
    except (QhullError, ValueError):  # fewer than three points, or all on a line
        return 0.0, 0.0
    width = math.sqrt(12.0 * float(torch.linalg.eigvalsh(torch.cov(flat.T, correction=0))[0]))  # as of a rectangle
    return float(hull.volume), width  # of two dimensions the area


def _fit(points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Return a point and the normal of the plane through points."""
    centre = points.mean(0)
    return centre, torch.linalg.eigh((points - centre).T @ (points - centre)).eigenvectors[:, 0]


def label_bodies(points: Float[Tensor, "n 3"], gap: float = GAP) -> Int[Tensor, "n"]:
    """Number the groups of points [m] that a gap [m] separates, the largest first."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    device, points = points.device, points.cpu()
    # One point of each cell of a quarter of the gap, so that dense clouds have few pairs.
    cells = torch.floor((points - points.amin(0)) / (gap / 4)).long()
    size = cells.amax(0) + 1
    _, group = torch.unique((cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2], return_inverse=True)
    first = first_of_each(group)
    pairs = KDTree(points[first].numpy()).query_pairs(gap, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(first), len(first)))
    label = connected_components(links, directed=False)[1][group.numpy()]
    order = np.argsort(np.argsort(-np.bincount(label), kind="stable"), kind="stable")
    return torch.from_numpy(order[label]).to(device)


def find_second_body(points: Float[Tensor, "n 3"], up: Float[Tensor, "3"], spacing: float) -> Bool[Tensor, "n"] | None:
    """Mark the points [m] of a second body that stands apart on the same ground, if there is one."""
    label = label_bodies(points, max(GAP, 4 * spacing))
    height = points @ up
    for k in range(1, int(label.max()) + 1):
        body = label == k
        low = height[body].quantile(0.02) - height.min(), height[label == 0].quantile(0.02) - height.min()
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
    """Return the points of one object that stands on a plane, and the plane if one was found.

    Args:
        cloud: points [m] of a scene.
        up: the vertical, of unit length.
        point: on or near the object [m]; points farther than 0.5 m from it are left out. None: the largest object.
        box: two corners [m]; points outside are left out first.
        gap: least distance [m] between objects.

    Raises:
        TooFewPoints: fewer than 4 points in the box, near the point or of the object.

    >>> from torchgrasp import load_scene
    >>> seen = PointCloud(load_scene().points.double())
    >>> found, table = cut_object(seen, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    >>> len(seen) > 2 * len(found), abs(table.offset) < 0.002
    (True, True)
    """
    points = cloud.points.double()
    up, (point, box) = up.to(points), (None if x is None else x.to(points) for x in (point, box))
    keep = torch.ones(len(points), dtype=torch.bool, device=points.device)
    if box is not None:
        keep &= ((points >= box.amin(0)) & (points <= box.amax(0))).all(1)
    if point is not None:
        keep &= torch.linalg.vector_norm(points - point, dim=-1) < 0.5
    cloud = _select(cloud, keep, "points in the box and near the point")
    points = cloud.points.double()
    rows = draw_rows(len(points), 5000)
    eye = cloud.viewpoint if cloud.viewpoint is None or cloud.viewpoint.ndim == 1 else cloud.viewpoint.mean(0)
    some = points[rows]
    normals = fit_planes(some)[0]
    support = find_support(some, normals, up, None, spread=0.0)
    if support is None and eye is not None:
        support = find_support(some, normals, up, eye.double(), spread=0.0)
    plane = None if support is None else support[0]
    if plane is not None:
        cloud = _select(cloud, plane.height(points) > LAYER, "points above the plane")
        points = cloud.points.double()
    label = label_bodies(points, gap)
    wanted = 0 if point is None else int(label[torch.linalg.vector_norm(points - point, dim=-1).argmin()])
    return _select(cloud, label == wanted, "points of the object"), plane


def _select(cloud: PointCloud, keep: Bool[Tensor, "n"], what: str) -> PointCloud:
    """Select points; refuse too few."""
    if int(keep.sum()) < MIN_POINTS:
        raise TooFewPoints("cloud", f"{int(keep.sum())} {what}", f"at least {MIN_POINTS} {what}")
    return cloud.select(keep)
