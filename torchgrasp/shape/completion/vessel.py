"""Open vessels: an outer and an inner wall about one vertical axis, the inner one seen through the mouth."""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.geometry.linalg import solve_least_squares, unit
from torchgrasp.shape.completion.revolution import fit_axis

WALL = 0.5
"""Length of a normal's level part from which on it belongs to a wall; below it are rim, floor and noise."""
DEGREE = 3
"""Degree of the polynomial of the wall's radius in the height: a bowl bends once, a foot or a lip once more."""
NOISE, START = 0.006, 4.0
"""Miss [m] of half the weight in the last fit, and how much more the first allows: 3 mm give cups' walls 40 % worse."""
ITERATIONS = 30
"""Fits with new weights: the miss then counts by `NOISE` to 0.5 %."""
FITS = 0.002
"""A point belongs to the body if its radius misses the fit by less [m]: twice a camera's noise."""
BODY_SHARE = 0.65
"""Share of the walls' points on the body: 0.75 to 1.0 of 21 views of open vessels, at most 0.4 of loops and straps."""
INNER_SHARE, OUTER_SHARE = 0.09, 0.07
"""Least shares of the cloud on the inner and the outer wall: without both nothing tells the thickness. Views of open
vessels have 0.12 and 0.09. Of 201 other views those with a body have 0.06 and 0.09, or 0.82 and 0.05, at most."""
DEPTH = 0.012
"""Depth [m] below the rim to which the inside must be seen: the recess of a lid is no cavity."""
MIN_THICKNESS, MAX_THICKNESS = 0.0003, 0.012
"""Thickness [m] of a wall: beyond it a body with a hollow needs no two surfaces."""
USUAL, SPREAD, THICKNESS_ERROR = 0.0035, 0.0015, 0.0012
"""Assumed thickness [m] of household vessels and its standard deviation; that of one fit, rms on 40 noisy views of
authored cups. A wall is their mean by weight. Authored cups are within 2 mm on 94 instead of 86 %, tuning cups on 79
instead of 81 % (docs/shape.md)."""
RIM_QUANTILE = 0.98
"""Share of the body below its rim: noise lifts some points over it."""
RIM, EDGE = 0.003, 0.002
"""Points so near [m] below the rim's height belong to no wall when they are completed and when walls are fitted: their
normals know both walls, which makes walls 0.8 mm too thin."""
FLAT = 0.7
"""Upward part of a normal from which on a point inside the mouth belongs to the floor."""


@dataclasses.dataclass(frozen=True)
class Vessel(Value):
    """An open vessel with a vertical axis; lengths in metres.

    Args:
        center: of the axis.
        thickness: of the wall, across it; what was seen, weighted with what is usual.
        radius: outer radius of the mouth.
        rim: height of the mouth.
        inner: points seen through the mouth.
        body: points on either wall, without ears, handles, rim and floor.
    """

    center: Float[Tensor, "2"]
    thickness: float
    radius: float
    rim: float
    inner: Bool[Tensor, "n"]
    body: Bool[Tensor, "n"]


def find_vessel(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Vessel | None:
    """Return the open vessel that the cloud shows; None: there is none.

    Normals of an inner wall point to the axis. Both walls are fitted at once: the radius is a polynomial in the
    height, less thickness / slope of the normal inside. Reweighted least squares (Cauchy) ignore ears and handles.

    >>> angle, height = torch.rand(2, 900, generator=torch.Generator().manual_seed(0)).double()
    >>> level = torch.stack([(6.3 * angle).cos(), (6.3 * angle).sin(), torch.zeros_like(angle)], 1)
    >>> sign = torch.where(torch.arange(900) % 2 == 0, 1.0, -1.0).double()[:, None]
    >>> points = (0.035 + 0.002 * sign) * level + height[:, None] * torch.tensor([0.0, 0.0, 0.07]).double()
    >>> round(find_vessel(points, sign * level).thickness, 4)
    0.0038
    """
    slope = torch.linalg.vector_norm(normals[:, :2], dim=1)
    level = normals[:, :2] / slope[:, None].clamp_min(1e-9)
    middle, spread = points[:, 2].mean(), points[:, 2].std().clamp_min(1e-6)
    powers = ((points[:, 2:] - middle) / spread) ** torch.arange(DEGREE + 1).to(points)
    below = points[:, 2] < points[:, 2].quantile(RIM_QUANTILE) - EDGE
    center = fit_axis(points, normals)
    miss, found, radius, facing = torch.zeros_like(slope), torch.zeros_like(slope), slope, slope
    for k in range(ITERATIONS):
        arm = points[:, :2] - center
        radius, out = torch.linalg.vector_norm(arm, dim=1), unit(arm)
        facing = (out * level).sum(1)
        wall = below & (slope > WALL) & (facing.abs() > WALL)
        scale = NOISE * (1.0 + START * 0.8**k)
        weight = (wall / (1.0 + (miss / scale) ** 2)).sqrt()[:, None]
        inside = (facing < 0) / slope.clamp_min(WALL)
        terms = torch.cat([powers, -inside[:, None], out], 1)  # the last two columns move the axis
        if not bool((weight > 0).sum() > 2 * terms.shape[1]):
            return None
        found = solve_least_squares(weight * terms, weight[:, 0] * radius)
        miss, center = radius - terms @ found, center + found[-2:]
    thickness = float(found[DEGREE + 1])

    wall = (slope > WALL) & (facing.abs() > WALL)
    body = wall & (miss.abs() < FITS)
    within = (points[:, :2].amin(0) < center) & (center < points[:, :2].amax(0))
    if not bool(within.all() & body.any()) or not MIN_THICKNESS < thickness < MAX_THICKNESS:
        return None
    rim = float(points[body, 2].quantile(RIM_QUANTILE))
    mouth = float(((rim - middle) / spread) ** torch.arange(DEGREE + 1).to(points) @ found[: DEGREE + 1])
    towards = ((facing < 0) & (slope > 1.0 - FLAT)) | (normals[:, 2] > FLAT)
    inner = towards & (radius < mouth) & (points[:, 2] < rim - RIM)
    shares = ((body & inner).double().mean(), (body & ~inner).double().mean(), body.sum() / wall.sum())
    enough = all(float(s) > least for s, least in zip(shares, (INNER_SHARE, OUTER_SHARE, BODY_SHARE), strict=True))
    if not enough or not math.isfinite(mouth) or float(rim - points[inner, 2].min()) < DEPTH:
        return None
    usual = 1.0 / (1.0 + (SPREAD / THICKNESS_ERROR) ** 2)
    thickness = usual * USUAL + (1.0 - usual) * thickness
    return Vessel(center, thickness, mouth, rim, inner, body & (points[:, 2] < rim - RIM))
