"""Bodies of revolution: their axis is the line that most surface normals meet.

The lines along the normals of a surface of revolution meet its axis: they lie in a linear line complex of pitch 0
(Pottmann and Wallner, Computational Line Geometry, 2001). The miss, moment times direction, is linear in either factor.
"""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.geometry.frames import apply, inverse, rigid, rotate
from torchgrasp.geometry.linalg import farthest_points, fibonacci_sphere, solve_least_squares, unit
from torchgrasp.geometry.plane import LEAST_TILT
from torchgrasp.shape.completion.silhouette import TIE, Outlines
from torchgrasp.shape.completion.symmetry import PROBES, SymmetryScorer

HALF_WEIGHT = 0.004  # distance [m] of a normal's line from the axis at which it has half the weight in the fit
STEEP = 0.3  # least length of the level part of the normals that fit a vertical axis
MISS, LEAST_RADIUS = 0.2, 0.01
"""A normal meets the axis if its line passes it within this share of the point's radius, at least of this one [m]."""
ROUNDNESS, ROUND_ERROR = 0.055, 0.0018  # usual miss of a body's normals: a share of the radius and an error [m]
MAX_SPREAD = 0.075  # greatest RMS of the relative misses of an upright body's normals
BODY_SHARE = 0.6  # least share of the cloud on the body; other points are an attached part
MAX_COST = 1.0  # greatest mean of log(1 + (miss / HALF_WEIGHT)^2) of an axis
MAX_FREE = 0.12  # greatest share of the rotated body in free space


@dataclasses.dataclass(frozen=True)
class Revolution:
    """A body of revolution about the vertical axis at `center` [m]; `body` masks its points."""

    center: Float[Tensor, "2"]
    body: Bool[Tensor, "n"]


def find_axis(scorer: SymmetryScorer) -> tuple[Float[Tensor, "4 4"], Revolution] | None:
    """Return the frame of an axis of revolution, and the body about its z axis; None: there is no axis.

    The frame is `axis_from_cloud`; its x axis points towards the cameras. The axis is fitted to the scorer's probe
    points. The body, rotated about the axis, must stay out of free space and above the table.
    """
    center, direction, cost = _fit_axis(scorer.probes, scorer.probe_normals)
    if not cost < MAX_COST:
        return None
    axis_from_cloud = _frame(center, direction, scorer.outline)
    points = apply(axis_from_cloud, scorer.points)
    lines = _lines_from_above(points, rotate(axis_from_cloud, scorer.normals))
    origin = torch.zeros(2, dtype=torch.float64)
    body = _split_body(points, lines, origin)
    allowed = torch.hypot(ROUNDNESS * body.typical, torch.full_like(body.typical, ROUND_ERROR))
    rms = (body.miss / allowed)[body.side].square().mean().sqrt()
    if not body.is_round(rms < 1.0):
        return None
    spread = farthest_points(points[body.mask], PROBES, tie=TIE)
    turned = apply(inverse(axis_from_cloud), _turn(points[body.mask][spread]))
    excluded = scorer.outline.violation(turned) > 0.003
    if scorer.table is not None:
        excluded |= scorer.table.height(turned) < -0.003
    return (axis_from_cloud, Revolution(origin, body.mask)) if excluded.double().mean() < MAX_FREE else None


def find_revolution(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Revolution | None:
    """Return the upright body of revolution to which most points belong; None: there is none."""
    lines = _lines_from_above(points, normals)
    center = _fit_to_lines(points, lines)
    body = _split_body(points, lines, center)
    spread = (body.miss / body.radius.clamp_min(LEAST_RADIUS))[body.side].square().mean().sqrt()
    return Revolution(center, body.mask) if body.is_round(spread < MAX_SPREAD) else None


def fit_axis(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "2"]:
    """Return the vertical axis, as a point (2,) [m], that most lines along the normals meet."""
    return _fit_to_lines(points, _lines_from_above(points, normals))


@dataclasses.dataclass(frozen=True)
class _Lines:
    """Lines along normals, seen from above: the points x with across . x = offset.

    `slope` is the length of a normal's horizontal part, `level` its unit direction, `steep` whether it is long enough.
    """

    slope: Float[Tensor, "n"]
    steep: Bool[Tensor, "n"]
    level: Float[Tensor, "n 2"]
    across: Float[Tensor, "n 2"]
    offset: Float[Tensor, "n"]


def _lines_from_above(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> _Lines:
    """Return the lines along the normals of points, seen from above."""
    slope = torch.linalg.vector_norm(normals[:, :2], dim=1)
    steep = slope > STEEP
    level = torch.where(steep[:, None], normals[:, :2] / slope[:, None], 0.0)
    across = torch.stack([-level[:, 1], level[:, 0]], 1)
    return _Lines(slope, steep, level, across, (across * points[:, :2]).sum(1))


def _fit_to_lines(points: Float[Tensor, "n 3"], lines: _Lines) -> Float[Tensor, "2"]:
    """Return the point (2,) that most lines meet, by reweighted least squares (Cauchy)."""
    miss, center = torch.zeros_like(lines.offset), points[:, :2].mean(0)
    for _ in range(30):
        weight = lines.slope / (1.0 + (miss / HALF_WEIGHT) ** 2)
        center = solve_least_squares(weight[:, None].sqrt() * lines.across, weight.sqrt() * lines.offset)
        miss = lines.offset - lines.across @ center
    return center


@dataclasses.dataclass(frozen=True)
class _Body:
    """The part of a cloud that is a body about a vertical axis: `mask` of all its points, `side` of those on its side.

    For each point: `miss` [m] of its normal's line from the axis, its `radius`, and the `typical` radius at its height.
    `one_way` is the length of the side's mean horizontal normal.
    """

    mask: Bool[Tensor, "n"]
    side: Bool[Tensor, "n"]
    miss: Float[Tensor, "n"]
    radius: Float[Tensor, "n"]
    typical: Float[Tensor, "n"]
    one_way: Float[Tensor, ""]

    def is_round(self, fits: Bool[Tensor, ""]) -> bool:
        """Return whether the body is most of the cloud, fits a surface of revolution, and is not a flat side."""
        return bool((self.mask.double().mean() > BODY_SHARE) & fits & (self.one_way < 0.95))


def _split_body(points: Float[Tensor, "n 3"], lines: _Lines, center: Float[Tensor, "2"]) -> _Body:
    """Return the body about a vertical axis: points whose normals meet the axis and whose radius fits their height."""
    miss = lines.offset - lines.across @ center
    radius = torch.linalg.vector_norm(points[:, :2] - center, dim=1)
    meets = lines.steep & (miss.abs() / radius.clamp_min(LEAST_RADIUS) < MISS)
    near = 0.004  # [m], of a point's slice in height and of its median in radius
    slices = ((points[:, 2:] - points[:, 2]).abs() < near) & meets
    typical = torch.where(slices, radius, torch.nan).nanmedian(1).values
    mask = torch.where(lines.steep, meets & ((radius - typical).abs() < near), radius < typical + near)
    side = mask & lines.steep
    return _Body(mask, side, miss, radius, typical, torch.linalg.vector_norm(lines.level[side].mean(0)))


def _fit_axis(
    points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"], float]:
    """Return a point [m] of the axis that most lines along the normals meet, the axis direction, and the cost.

    Gauss-Newton steps with robust weights (Cauchy) from several directions at once; each step narrows the weights.
    """
    starts = 12
    direction = fibonacci_sphere(2 * starts)[:starts]
    center, cost = points.mean(0).expand_as(direction), torch.zeros(starts, dtype=torch.float64)
    for step in range(12):
        across = torch.stack(_across(direction), 1)
        arm = points - center[:, None]
        moment = torch.linalg.cross(arm, normals.expand_as(arm))
        miss = (moment * direction[:, None]).sum(-1)
        lever = torch.linalg.cross(direction[:, None].expand_as(arm), normals.expand_as(arm))
        slope = torch.cat([lever @ across.mT, moment @ across.mT], 2)
        scale = HALF_WEIGHT + (0.02 - HALF_WEIGHT) * 0.6**step
        weighted = slope / (1.0 + (miss / scale) ** 2)[..., None]
        system = slope.mT @ weighted
        # Damping: a ball leaves the direction free, and a prism the place along a side.
        system = system + 1e-6 * torch.diag_embed(system.diagonal(dim1=1, dim2=2).clamp_min(1e-9))
        found = -torch.linalg.solve(system, (weighted * miss[..., None]).sum(1))
        length = torch.linalg.vector_norm(found[:, 2:], dim=1, keepdim=True)
        turn = found[:, 2:] * (0.3 / length.clamp_min(0.3))  # [rad], misses are linear in small turns only
        center = center + (found[:, None, :2] @ across)[:, 0]
        direction = unit(direction + (turn[:, None] @ across)[:, 0])
        center = center + ((points.mean(0) - center) * direction).sum(1, keepdim=True) * direction
        cost = torch.log1p((miss / HALF_WEIGHT) ** 2).mean(1)
    best = int(cost.argmin())
    return center[best], direction[best], float(cost[best])


def _across(direction: Float[Tensor, "*b 3"]) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b 3"]]:
    """Return two unit vectors perpendicular to each direction and to each other."""
    helper = torch.zeros_like(direction).scatter(-1, direction.abs().argmin(-1, keepdim=True), 1.0)
    first = unit(torch.linalg.cross(direction, helper))
    return first, torch.linalg.cross(direction, first)


def _frame(center: Float[Tensor, "3"], direction: Float[Tensor, "3"], outline: Outlines) -> Float[Tensor, "4 4"]:
    """Return `axis_from_cloud`, with x towards the cameras unless they look along the axis."""
    eye = torch.stack([view.viewpoint for view in outline.views]).mean(0) - center
    level = eye - (eye @ direction) * direction
    length = torch.linalg.vector_norm(level)
    x = level / length if length > LEAST_TILT * torch.linalg.vector_norm(eye) else _across(direction)[0]
    rotation = torch.stack([x, torch.linalg.cross(direction, x), direction])
    return rigid(rotation, -rotation @ center)


def _turn(points: Float[Tensor, "n 3"]) -> Float[Tensor, "m 3"]:
    """Return the points rotated about z by all multiples of 30 degrees."""
    angle = 2 * math.pi / 12 * torch.arange(1, 12, dtype=torch.float64)
    x, y, z = points.unbind(1)
    cos, sin = angle.cos()[:, None], angle.sin()[:, None]
    return torch.stack([cos * x - sin * y, sin * x + cos * y, z.expand(len(angle), -1)], -1).reshape(-1, 3)
