"""Bodies of revolution: their axis is the line that most surface normals meet.

The lines along the normals of a surface of revolution meet its axis: they lie in a linear line
complex of pitch 0 (Pottmann and Wallner, Computational Line Geometry, 2001). The distance by which
a normal's line misses the axis is the moment of the normal about a point of the axis times the axis
direction: it is linear in either factor.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.geometry.frames import apply, inverse, rigid, rotate
from torchgrasp.geometry.linalg import (
    Points,
    across,
    farthest_points,
    fibonacci_sphere,
    solve_least_squares,
    unit,
)
from torchgrasp.geometry.plane import LEAST_TILT
from torchgrasp.shape.completion.silhouette import TIE, Outlines
from torchgrasp.shape.completion.symmetry import PROBES, SymmetryScorer

# distance [m] of a normal's line from the axis at which it has half the weight in the fit
HALF_WEIGHT = 0.004
STEEP = 0.3  # least length of the level part of the normals that fit a vertical axis
MISS = 0.2
LEAST_RADIUS = 0.01
"""A normal meets the axis if its line passes within MISS times the point's radius, or LEAST_RADIUS
[m] if greater.
"""
# usual miss of a body's normals: a share of the radius and an error [m]
ROUNDNESS = 0.055
ROUND_ERROR = 0.0018
MAX_SPREAD = 0.075  # greatest RMS of the relative misses of an upright body's normals
BODY_SHARE = 0.6  # least share of the cloud on the body; other points are an attached part
MAX_COST = 1.0  # greatest mean of log(1 + (miss / HALF_WEIGHT)^2) of an axis
MAX_FREE = 0.12  # greatest share of the rotated body in free space


@dataclasses.dataclass(frozen=True)
class Revolution:
    """A body of revolution about the vertical axis at `center` (x, y) [m]; `body` is the mask of
    its cloud points.
    """

    center: Float[Tensor, "2"]
    body: Bool[Tensor, "n"]


def find_axis(scorer: SymmetryScorer) -> tuple[Float[Tensor, "4 4"], Revolution] | None:
    """Return `axis_from_cloud`, the transform to a frame whose z axis is an axis of revolution, and
    the body about it.

    Return None if there is no such body. The axis is fitted to sampled points of the scorer. The
    body, rotated about the axis, must stay out of the table and of the space that the cameras saw
    to be empty.
    """
    center, direction, cost = _fit_axis(*scorer.probes)
    if not cost < MAX_COST:
        return None
    axis_from_cloud = _frame(center, direction, scorer.outline)
    points = apply(axis_from_cloud, scorer.points)
    lines = _lines_from_above(points, rotate(axis_from_cloud, scorer.normals))
    origin = torch.zeros(2, dtype=torch.float64, device="cpu")
    error = torch.tensor(ROUND_ERROR, dtype=torch.float64, device="cpu")
    mask = _round_body(
        points, lines, origin, lambda _, typical: torch.hypot(ROUNDNESS * typical, error)
    )
    if mask is None:
        return None
    spread = points[mask][farthest_points(points[mask], PROBES, tie=TIE)]
    turned = apply(inverse(axis_from_cloud), (spread @ rotations_about_z(12).mT).flatten(0, 1))
    excluded = scorer.outline.violation(turned) > 0.003
    if scorer.table is not None:
        excluded |= scorer.table.height(turned) < -0.003
    return (
        (axis_from_cloud, Revolution(origin, mask)) if excluded.double().mean() < MAX_FREE else None
    )


def find_revolution(points: Points, normals: Points) -> Revolution | None:
    """Return the upright body of revolution to which most points belong, or None if there is none."""
    lines = _lines_from_above(points, normals)
    center = _fit_to_lines(points, lines)
    mask = _round_body(
        points, lines, center, lambda radius, _: MAX_SPREAD * radius.clamp_min(LEAST_RADIUS)
    )
    return None if mask is None else Revolution(center, mask)


def fit_axis(points: Points, normals: Points) -> Float[Tensor, "2"]:
    """Return x and y [m] of the vertical axis that most lines along the surface normals meet."""
    return _fit_to_lines(points, _lines_from_above(points, normals))


class _Lines(NamedTuple):
    """Lines along surface normals, seen from above: each line consists of the points x with across
    . x = offset [m].
    """

    slope: Float[Tensor, "n"]  # length of a normal's horizontal part
    steep: Bool[Tensor, "n"]  # whether this part is long enough for a fit
    level: Float[Tensor, "n 2"]  # direction of this part
    across: Float[Tensor, "n 2"]
    offset: Float[Tensor, "n"]


def _lines_from_above(points: Points, normals: Points) -> _Lines:
    """Return the lines through points along their normals, projected onto the horizontal plane."""
    slope = torch.linalg.vector_norm(normals[:, :2], dim=1)
    steep = slope > STEEP
    level = torch.where(steep[:, None], normals[:, :2] / slope[:, None], 0.0)
    across = torch.stack([-level[:, 1], level[:, 0]], 1)
    return _Lines(slope, steep, level, across, (across * points[:, :2]).sum(1))


def _fit_to_lines(points: Points, lines: _Lines) -> Float[Tensor, "2"]:
    """Return the point (x, y) [m] that most lines meet, by reweighted least squares (Cauchy)."""
    miss = torch.zeros_like(lines.offset)
    center = points[:, :2].mean(0)
    for _ in range(30):
        weight = lines.slope / (1.0 + (miss / HALF_WEIGHT) ** 2)
        center = solve_least_squares(
            weight[:, None].sqrt() * lines.across, weight.sqrt() * lines.offset
        )
        miss = lines.offset - lines.across @ center
    return center


def _round_body(
    points: Points,
    lines: _Lines,
    center: Float[Tensor, "2"],
    allowed: Callable[[Tensor, Tensor], Tensor],
) -> Bool[Tensor, "n"] | None:
    """Return the mask of the points on a body of revolution about a vertical axis at `center`.

    Return None if the body is not round, has too few points, or shows only one flat side. Normals
    on the body meet the axis, and its points have the typical radius of their height. `allowed`
    returns the RMS [m] by which normals may miss the axis, given the radius of each point and the
    typical radius at its height.
    """
    miss = lines.offset - lines.across @ center
    radius = torch.linalg.vector_norm(points[:, :2] - center, dim=1)
    meets = lines.steep & (miss.abs() / radius.clamp_min(LEAST_RADIUS) < MISS)
    near = 0.004  # [m], of a point's slice in height and of its median in radius
    slices = ((points[:, 2:] - points[:, 2]).abs() < near) & meets
    typical = torch.where(slices, radius, torch.nan).nanmedian(1).values
    mask = torch.where(
        lines.steep, meets & ((radius - typical).abs() < near), radius < typical + near
    )
    side = mask & lines.steep
    spread = (miss / allowed(radius, typical))[side].square().mean().sqrt()
    one_way = torch.linalg.vector_norm(lines.level[side].mean(0))
    return (
        mask
        if bool((mask.double().mean() > BODY_SHARE) & (spread < 1.0) & (one_way < 0.95))
        else None
    )


def _fit_axis(
    points: Points, normals: Points
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"], float]:
    """Return a point [m] and the direction of the axis that most lines along the normals meet, and
    the fit's cost.
    """
    # Gauss-Newton steps with robust weights (Cauchy) from so many directions; each narrows the
    # weights
    starts = 12
    direction = fibonacci_sphere(2 * starts)[:starts]
    center = points.mean(0).expand_as(direction)
    cost = torch.zeros(starts, dtype=torch.float64, device="cpu")
    for step in range(12):
        axes = torch.stack(across(direction), 1)
        arm = points - center[:, None]
        moment = torch.linalg.cross(arm, normals.expand_as(arm))
        miss = (moment * direction[:, None]).sum(-1)
        lever = torch.linalg.cross(direction[:, None].expand_as(arm), normals.expand_as(arm))
        slope = torch.cat([lever @ axes.mT, moment @ axes.mT], 2)
        scale = HALF_WEIGHT + (0.02 - HALF_WEIGHT) * 0.6**step
        weighted = slope / (1.0 + (miss / scale) ** 2)[..., None]
        system = slope.mT @ weighted
        # Damping: a ball leaves the direction free, and a prism the place along a side.
        system = system + 1e-6 * torch.diag_embed(system.diagonal(dim1=1, dim2=2).clamp_min(1e-9))
        found = -torch.linalg.solve(system, (weighted * miss[..., None]).sum(1))
        length = torch.linalg.vector_norm(found[:, 2:], dim=1, keepdim=True)
        turn = found[:, 2:] * (
            0.3 / length.clamp_min(0.3)
        )  # [rad], misses are linear in small turns only
        center = center + (found[:, None, :2] @ axes)[:, 0]
        direction = unit(direction + (turn[:, None] @ axes)[:, 0])
        center = center + ((points.mean(0) - center) * direction).sum(1, keepdim=True) * direction
        cost = torch.log1p((miss / HALF_WEIGHT) ** 2).mean(1)
    best = int(cost.argmin())
    return center[best], direction[best], float(cost[best])


def _frame(
    center: Float[Tensor, "3"], direction: Float[Tensor, "3"], outline: Outlines
) -> Float[Tensor, "4 4"]:
    """Return the transform to a frame at `center` with z along the axis and, if possible, x towards
    the cameras.
    """
    eye = torch.stack([view.viewpoint for view in outline.views]).mean(0) - center
    level = eye - (eye @ direction) * direction
    length = torch.linalg.vector_norm(level)
    x = (
        level / length
        if length > LEAST_TILT * torch.linalg.vector_norm(eye)
        else across(direction)[0]
    )
    rotation = torch.stack([x, torch.linalg.cross(direction, x), direction])
    return rigid(rotation, -rotation @ center)


def rotations_about_z(n: int) -> Float[Tensor, "m 3 3"]:
    """Return the rotations about z by k / n of a full circle, for k from 1 to n - 1."""
    angle = torch.arange(1, n, dtype=torch.float64, device="cpu") * (2 * math.pi / n)
    turn = torch.zeros(n - 1, 3, 3, dtype=torch.float64, device="cpu")
    turn[:, 0, 0] = angle.cos()
    turn[:, 0, 1] = -angle.sin()
    turn[:, 1, 0] = angle.sin()
    turn[:, 1, 1] = angle.cos()
    turn[:, 2, 2] = 1.0
    return turn
