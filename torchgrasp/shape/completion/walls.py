"""The hidden parts of an open vessel's two walls: turned about its axis, and as far apart as the wall is thick."""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Batch, Value, join
from torchgrasp.geometry.linalg import farthest_points
from torchgrasp.shape.completion.complete import FRONT_MARGIN, HULL_MARGIN, NEW, SPACING
from torchgrasp.shape.completion.silhouette import TIE, Outlines
from torchgrasp.shape.completion.vessel import RIM, THICKNESS_ERROR, Vessel
from torchgrasp.values import PointCloud

TURNS, TURNED = 24, 80
"""Angles by which a wall is turned about the axis, and points of it that are turned: a point each 5 to 10 mm."""
BUDGET = 50
"""Hidden points of a wall: as many as a solid's mirrored ones."""
CENTER_ERROR = 0.0006
"""Standard deviation [m] of the axis along x or y: rms on 40 noisy views of authored cups."""
FORM_ERROR = 0.001
"""Standard deviation [m] of real walls about a surface of revolution."""
FLOOR_ERROR = 0.003
"""Standard deviation [m] of a floor that was not seen, about one as thick as the wall."""
LIDS = ((0.0, 1), (0.5, 6))
"""Rings of points on the outer body's lid: radius over the mouth's, and number."""
FLOORS = ((0.0, 1), (0.4, 5), (0.75, 8))
"""Rings of points on a floor that was not seen."""


@dataclasses.dataclass(frozen=True)
class HiddenWall(Batch):
    """Points of a wall that the camera did not see [m], with outward normals.

    Args:
        shared: errors [m] for one standard deviation of axis (two), thickness and floor.
    """

    points: Float[Tensor, "m 3"]
    normals: Float[Tensor, "m 3"]
    shared: Float[Tensor, "m 4"]


@dataclasses.dataclass(frozen=True)
class Wall(Value):
    """One wall of a vessel: what was seen of it, and what follows from that.

    Args:
        seen: rows of the cloud.
        hidden: other points.
    """

    seen: Bool[Tensor, "n"]
    hidden: HiddenWall


def complete_walls(cloud: PointCloud, vessel: Vessel, outline: Outlines, table: float) -> tuple[Wall, Wall]:
    """Return the outer and the inner wall of a vessel that stands on a table of this height [m].

    The other side of a seen wall is a thickness away. What no side shows comes from turning about the axis.
    """
    points, normals = cloud.points, cloud.normals
    assert normals is not None
    none = torch.zeros(len(points), 4, dtype=points.dtype)
    every = HiddenWall(points, normals, none)
    outside, inside = every[vessel.body & ~vessel.inner], every[vessel.body & vessel.inner]
    seen_floor = vessel.inner & (normals[:, 2] > 0.9)
    floor = float(points[seen_floor, 2].median()) if int(seen_floor.sum()) > 10 else table + vessel.thickness

    outer = _merge(points[~vessel.inner], outline, [_across(inside, vessel), _turn(outside, vessel)], vessel, table)
    lining = [_across(outside, vessel), _turn(inside, vessel), _across(_turn(outside, vessel), vessel)]
    if int(seen_floor.sum()) <= 10:
        radius = float(torch.linalg.vector_norm(points[vessel.inner, :2] - vessel.center, dim=1).min())
        lining.append(_disc(vessel, floor, radius, FLOORS))
    inner = _merge(points[vessel.inner], outline, lining, vessel, floor)
    return Wall(~vessel.inner, outer), Wall(vessel.inner, inner)


def lid(vessel: Vessel) -> HiddenWall:
    """Return points of the flat lid that closes the outer body at the rim."""
    return _disc(vessel, vessel.rim, vessel.radius, LIDS)


def _across(wall: HiddenWall, vessel: Vessel) -> HiddenWall:
    """Return the other side of a wall."""
    shared = wall.shared.clone()
    shared[:, 2] += THICKNESS_ERROR
    return HiddenWall(wall.points - vessel.thickness * wall.normals, -wall.normals, shared)


def _turn(wall: HiddenWall, vessel: Vessel) -> HiddenWall:
    """Return a wall turned about the axis by all angles, with the errors of the axis."""
    wall = wall[farthest_points(wall.points, TURNED, tie=TIE)]
    angle = torch.arange(1, TURNS, dtype=torch.float64) * (2 * math.pi / TURNS)
    turn = torch.zeros(TURNS - 1, 3, 3, dtype=torch.float64)
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = angle.cos(), -angle.sin(), angle.sin(), angle.cos()
    turn[:, 2, 2] = 1.0
    axis = torch.cat([vessel.center, torch.zeros(1, dtype=torch.float64)])
    points = (wall.points - axis) @ turn.mT + axis
    normals = wall.normals @ turn.mT
    moved = (torch.eye(3, dtype=torch.float64) - turn)[:, None] * CENTER_ERROR  # of a turned point with the axis
    shared = wall.shared.expand(TURNS - 1, -1, -1).clone()
    shared[..., :2] += (normals[..., None, :] @ moved)[..., 0, :2]
    return HiddenWall(points.flatten(0, 1), normals.flatten(0, 1), shared.flatten(0, 1))


def _disc(vessel: Vessel, height: float, radius: float, rings: tuple[tuple[float, int], ...]) -> HiddenWall:
    """Return level points on rings about the axis, with normals up."""
    places = []
    for share, count in rings:
        angle = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
        places.append(share * radius * torch.stack([angle.cos(), angle.sin()], 1) + vessel.center)
    level = torch.cat(places)
    points = torch.cat([level, torch.full_like(level[:, :1], height)], 1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(points)
    shared = torch.zeros(len(points), 4, dtype=torch.float64)
    shared[:, 3] = FLOOR_ERROR
    return HiddenWall(points, up, shared)


def _merge(
    seen: Float[Tensor, "n 3"], outline: Outlines, parts: list[HiddenWall], vessel: Vessel, least: float
) -> HiddenWall:
    """Return points of the parts, the first parts first, that are new, hidden, below the rim and above `least`."""
    from scipy.spatial import KDTree

    tree, merged = KDTree(seen.numpy()), parts[0][:0]
    for part in parts:
        part = part[(part.points[:, 2] < vessel.rim - RIM) & (part.points[:, 2] >= least)]
        allowed = (outline.hull_distance(part.points) < HULL_MARGIN) & (outline.violation(part.points) < FRONT_MARGIN)
        new = part[allowed & torch.from_numpy(tree.query(part.points.numpy())[0] > NEW)]
        if len(merged) and len(new):
            new = new[torch.from_numpy(KDTree(merged.points.numpy()).query(new.points.numpy())[0] > SPACING)]
        merged = join([merged, new[farthest_points(new.points, 4 * BUDGET, tie=TIE)]]) if len(new) else merged
    return merged[farthest_points(merged.points, BUDGET, tie=TIE)]
