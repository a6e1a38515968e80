"""Bodies of revolution: their axis is the line that most surface normals meet.

The lines along the normals of a surface of revolution meet its axis. They lie in a linear line
complex of pitch 0 (Pottmann and Wallner, Computational Line Geometry, 2001). A normal's line misses
the axis by a distance. It is the moment of the normal about a point of the axis times the axis
direction. It is linear in either factor.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.base import flatnonzero
from torchgrasp.geometry.frames import apply, inverse, rigid, rotate
from torchgrasp.geometry.linalg import (
    Points,
    across,
    fibonacci_sphere,
    norm,
    solve_least_squares,
    unit,
)
from torchgrasp.geometry.plane import LEAST_TILT
from torchgrasp.shape.completion.silhouette import Outlines, pick_apart
from torchgrasp.shape.completion.symmetry import SYMMETRY, SymmetryScorer


@dataclasses.dataclass(frozen=True)
class AxisNumbers:
    """Parameters of the fits of a body's axis of revolution to the normals of its cloud."""

    half_weight: float = 0.004
    """Distance [m] of a normal's line from the axis at which the line has half the weight."""
    first_half_weight: float = 0.02
    """The distance `half_weight` [m] in the first step of the fit of a tilted axis."""
    narrowing: float = 0.6
    """Factor by which the excess of `first_half_weight` over `half_weight` shrinks from step to
    step.
    """
    steep: float = 0.3
    """Least length of the horizontal part of the unit normals that fit a vertical axis."""
    rounds: int = 30
    """Number of rounds of the fit of a vertical axis; each has new weights."""
    starts: int = 12
    """Number of directions, over half a sphere, from which the fit of a tilted axis starts."""
    steps: int = 12
    """Number of Gauss-Newton steps of the fit of a tilted axis."""
    damping: float = 1e-6
    """Share of the diagonal of the normal equations that is added to it. A ball does not determine
    the axis's direction, and a prism not its position along a side.
    """
    least_diagonal: float = 1e-9
    """Least value of the diagonal of which the share `damping` is taken."""
    turn: float = 0.3
    """Greatest rotation [rad] of the axis in a step. The lines' distances are linear only in small
    rotations.
    """
    cost: float = 1.0
    """Greatest mean of log(1 + (distance / half_weight)^2) of the normals' lines from the axis."""


AXIS_FIT = AxisNumbers()


@dataclasses.dataclass(frozen=True)
class RoundNumbers:
    """Bounds within which a body counts as a body of revolution."""

    miss: float = 0.2
    """Greatest distance from the axis of a normal's line that meets it, over the radius of its
    point.
    """
    least_radius: float = 0.01
    """Least radius [m] by which the distance of a normal's line from the axis is divided."""
    roundness: float = 0.055
    """Part of a bound that grows with the radius r of the body. The RMS distance of the normals'
    lines from a tilted axis may be at most sqrt((`roundness` r)^2 + `error`^2).
    """
    error: float = 0.0018
    """Part [m] of the bound of the RMS distance (`roundness`) that is the same for all radii."""
    spread: float = 0.075
    """Greatest RMS distance of the normals' lines from the axis of an upright body, over its
    radius.
    """
    body_share: float = 0.6
    """Least share of the cloud that is on the body; other points are an attached part."""
    near: float = 0.004
    """Greatest difference [m] of height between points of one slice of the body. It is also the
    greatest distance [m] of a point's radius from the median of its slice.
    """
    one_way: float = 0.95
    """Greatest length of the mean of the horizontal unit normals: one flat side gives a longer
    mean.
    """
    turns: int = 12
    """Number of parts of a full circle by which the body is rotated, to compare it with free space.
    """
    inside: float = 0.003
    """Depth [m] in free space or in the table beyond which a rotated point is not on the object."""
    free: float = 0.12
    """Greatest share of the points of the rotated body that are not on the object (`inside`)."""


ROUND = RoundNumbers()


@dataclasses.dataclass(frozen=True)
class Revolution:
    """A body of revolution about an axis along z, found among n points.

    Args:
        center: position (x, y) [m] of the axis, in the frame of the points.
        body: mask of the points on the body.
    """

    center: Float[Tensor, "2"]
    body: Bool[Tensor, "n"]


def find_axis(scorer: SymmetryScorer) -> tuple[Float[Tensor, "4 4"], Revolution] | None:
    """Return (axis_from_cloud, body): the body of revolution in a cloud, and the transform to its
    axis.

    `axis_from_cloud` is the rigid transform [m] to a frame whose z axis is the axis of revolution.
    `body` holds the axis position (0, 0) in this frame, and the mask of its points. The result is
    None if there is no such body. The axis is fitted to the probes of the scorer, which are points
    of the cloud. The body, rotated about the axis, must stay out of the table. It must also stay
    out of the space that the cameras saw to be empty.
    """
    center, direction, cost = _fit_axis(*scorer.probes)
    if not cost < AXIS_FIT.cost:
        return None
    axis_from_cloud = _frame(center, direction, scorer.outline)
    points = apply(axis_from_cloud, scorer.points)
    lines = _lines_from_above(points, rotate(axis_from_cloud, scorer.normals))
    origin = points.new_zeros(2)
    error = points.new_tensor(ROUND.error)

    def allowed(_: Tensor, typical: Tensor) -> Tensor:
        return torch.hypot(ROUND.roundness * typical, error)

    mask = _round_body(points, lines, origin, allowed)
    if mask is None:
        return None
    body = points[mask]
    body = body[pick_apart(body, SYMMETRY.probes)]
    turned = (body @ rotations_about_z(ROUND.turns).mT).flatten(0, 1)
    turned = apply(inverse(axis_from_cloud), turned)
    excluded = scorer.outline.violation(turned) > ROUND.inside
    if scorer.table is not None:
        excluded |= scorer.table.height(turned) < -ROUND.inside
    if not excluded.double().mean() < ROUND.free:
        return None
    return axis_from_cloud, Revolution(origin, mask)


def find_revolution(points: Points, normals: Points) -> Revolution | None:
    """Return the body of revolution about a vertical axis to which most points belong; None if
    there is none.

    `points` (n, 3) [m] and outward unit `normals` (n, 3) are in a frame with z up. At least 60 % of
    the points (`ROUND.body_share`) must be on the body.
    """
    lines = _lines_from_above(points, normals)
    center = _fit_to_lines(points, lines)

    def allowed(radius: Tensor, _: Tensor) -> Tensor:
        return ROUND.spread * radius.clamp_min(ROUND.least_radius)

    mask = _round_body(points, lines, center, allowed)
    return None if mask is None else Revolution(center, mask)


def fit_axis(points: Points, normals: Points) -> Float[Tensor, "2"]:
    """Return the position (x, y) [m] of the vertical axis that most of the normals' lines meet.

    `points` (n, 3) [m] and unit `normals` (n, 3) are in a frame with z up.
    """
    return _fit_to_lines(points, _lines_from_above(points, normals))


class _Lines(NamedTuple):
    """Lines along n surface normals, seen from above.

    A line consists of the points x (2,) [m] with across . x = offset.
    """

    slope: Float[Tensor, "n"]  # length of a normal's horizontal part
    steep: Bool[Tensor, "n"]  # whether this part is long enough for a fit
    level: Float[Tensor, "n 2"]  # direction of this part
    across: Float[Tensor, "n 2"]  # horizontal unit vector perpendicular to the line
    offset: Float[Tensor, "n"]  # [m]


def _lines_from_above(points: Points, normals: Points) -> _Lines:
    """Return the lines through points along their normals, projected onto the horizontal plane."""
    slope = norm(normals[:, :2])
    steep = slope > AXIS_FIT.steep
    level = normals[:, :2] / slope[:, None]
    level = torch.where(steep[:, None], level, 0.0)
    across = torch.stack([-level[:, 1], level[:, 0]], 1)
    return _Lines(slope, steep, level, across, (across * points[:, :2]).sum(1))


def _fit_to_lines(points: Points, lines: _Lines) -> Float[Tensor, "2"]:
    """Return the point (x, y) [m] that most lines meet, by reweighted least squares (Cauchy)."""
    miss = torch.zeros_like(lines.offset)
    center = points[:, :2].mean(0)
    for _ in range(AXIS_FIT.rounds):
        weight = (lines.slope / (1.0 + (miss / AXIS_FIT.half_weight) ** 2)).sqrt()
        center = solve_least_squares(weight[:, None] * lines.across, weight * lines.offset)
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
    returns the RMS [m] by which normals may miss the axis. It is given the radius of each point and
    the typical radius at its height.
    """
    miss = lines.offset - lines.across @ center
    radius = norm(points[:, :2] - center)
    meets = lines.steep & (miss.abs() / radius.clamp_min(ROUND.least_radius) < ROUND.miss)
    # no other point can be on the body
    if not (meets | ~lines.steep).double().mean() > ROUND.body_share:
        return None
    typical = _typical_radius(points[:, 2], radius, meets)
    # a wall has the typical radius; a flat end may lie anywhere within it
    wall = meets & ((radius - typical).abs() < ROUND.near)
    mask = torch.where(lines.steep, wall, radius < typical + ROUND.near)
    side = mask & lines.steep
    spread = (miss / allowed(radius, typical))[side].square().mean().sqrt()
    one_way = norm(lines.level[side].mean(0))
    enough = mask.double().mean() > ROUND.body_share
    return mask if bool(enough & (spread < 1.0) & (one_way < ROUND.one_way)) else None


def _typical_radius(
    height: Float[Tensor, "n"],
    radius: Float[Tensor, "n"],
    meets: Bool[Tensor, "n"],
) -> Float[Tensor, "n"]:
    """Return for each point the lower median radius [m] of the points near its height [m] whose
    normals meet the axis. It is NaN where there are none.
    """
    order = flatnonzero(meets)
    order = order[torch.argsort(radius[order])]
    slices = (height[:, None] - height[order]).abs() < ROUND.near  # (n, m), by radius
    count = slices.sum(1)
    # places of all members of all slices, one slice after the other; torch takes twice as long
    members = torch.from_numpy(np.flatnonzero(slices.numpy()))
    middle = count.cumsum(0) - count + (count - 1) // 2
    some = count > 0
    typical = torch.full_like(radius, torch.nan)
    typical[some] = radius[order[members[middle[some]] % len(order)]]
    return typical


def _fit_axis(
    points: Points,
    normals: Points,
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"], float]:
    """Return a point [m] and the direction of the axis that most lines along the normals meet, and
    the fit's cost.
    """
    # Gauss-Newton steps with robust weights (Cauchy) from many directions; each narrows the weights
    starts = AXIS_FIT.starts
    direction = fibonacci_sphere(2 * starts)[:starts]  # (s, 3)
    center = points.mean(0).expand_as(direction)
    cost = direction.new_zeros(starts)
    for step in range(AXIS_FIT.steps):
        axes = torch.stack(across(direction), 1)  # (s, 2, 3)
        arm = points - center[:, None]  # (s, n, 3)
        own = normals.expand_as(arm)
        moment = torch.linalg.cross(arm, own)
        miss = (moment * direction[:, None]).sum(-1)  # (s, n)
        lever = torch.linalg.cross(direction[:, None].expand_as(arm), own)
        slope = torch.cat([lever @ axes.mT, moment @ axes.mT], 2)  # (s, n, 4)
        wider = AXIS_FIT.first_half_weight - AXIS_FIT.half_weight
        scale = AXIS_FIT.half_weight + wider * AXIS_FIT.narrowing**step
        weighted = slope / (1.0 + (miss / scale) ** 2)[..., None]
        system = slope.mT @ weighted
        diagonal = system.diagonal(dim1=1, dim2=2).clamp_min(AXIS_FIT.least_diagonal)
        system = system + AXIS_FIT.damping * torch.diag_embed(diagonal)
        found = -torch.linalg.solve(system, (weighted * miss[..., None]).sum(1))
        turn = found[:, 2:]
        length = norm(turn, keepdim=True)
        turn = turn * (AXIS_FIT.turn / length.clamp_min(AXIS_FIT.turn))
        center = center + (found[:, None, :2] @ axes)[:, 0]
        direction = unit(direction + (turn[:, None] @ axes)[:, 0])
        # of all points of the axis, the one beside the cloud's middle
        center = center + ((points.mean(0) - center) * direction).sum(1, keepdim=True) * direction
        cost = torch.log1p((miss / AXIS_FIT.half_weight) ** 2).mean(1)
    best = int(cost.argmin())
    return center[best], direction[best], float(cost[best])


def _frame(
    center: Float[Tensor, "3"],
    direction: Float[Tensor, "3"],
    outline: Outlines,
) -> Float[Tensor, "4 4"]:
    """Return the transform to a frame at `center` with z along the axis and, if possible, x towards
    the cameras.
    """
    eye = torch.stack([view.viewpoint for view in outline.views]).mean(0) - center
    level = eye - (eye @ direction) * direction
    length = norm(level)
    tilted = length > LEAST_TILT * norm(eye)
    x = level / length if tilted else across(direction)[0]
    rotation = torch.stack([x, torch.linalg.cross(direction, x), direction])
    return rigid(rotation, -rotation @ center)


def rotations_about_z(n: int) -> Float[Tensor, "m 3 3"]:
    """Return the m = n - 1 rotation matrices about z by the multiples of 1 / n of a circle.

    The first is by 1 / n; that by a full circle is left out.
    """
    angle = torch.arange(1, n, dtype=torch.float64, device="cpu") * (2 * math.pi / n)
    turn = angle.new_zeros(n - 1, 3, 3)
    turn[:, 0, 0] = angle.cos()
    turn[:, 0, 1] = -angle.sin()
    turn[:, 1, 0] = angle.sin()
    turn[:, 1, 1] = angle.cos()
    turn[:, 2, 2] = 1.0
    return turn
