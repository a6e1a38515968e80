"""Bodies of revolution: a vertical axis that the normals of most points meet."""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.geometry.linalg import solve_least_squares

STEEP = 0.3
"""Length of a normal's level part from which on it helps to find a vertical axis."""
HALF_WEIGHT = 0.004
"""Distance [m] of a normal's line from the axis at which it has half the weight in the fit."""
ITERATIONS = 30
"""Fits with new weights: the axis then rests to the last bit."""
MISS, LEAST_RADIUS = 0.2, 0.01
"""A normal meets the axis if its line passes it within this share of the point's radius, at least of this one [m]."""
SLICE, THICKNESS = 0.004, 0.004
"""Points of the body have the median radius of the slice this far [m] above and below, to this much [m]."""
BODY_SHARE = 0.6
"""Share of the cloud from which on points around an axis are the body, and others an attached part."""
MAX_SPREAD = 0.075
"""Greatest RMS of the relative misses of the body's normals: bodies of revolution stay below it (docs/shape.md)."""
ONE_WAY = 0.95
"""Length of the mean of the body's level normals from which on they belong to a flat side."""


@dataclasses.dataclass(frozen=True)
class Revolution:
    """A body of revolution about the vertical axis at `center` [m]; `body` masks its points."""

    center: Float[Tensor, "2"]
    body: Bool[Tensor, "n"]


def find_revolution(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Revolution | None:
    """Return the body of revolution that most points belong to; None: there is none.

    The axis is fitted to the lines along the normals. Reweighted least squares (Cauchy) ignore a handle.

    >>> angle = torch.linspace(-1.5, 1.5, 200).double()
    >>> level = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], 1)
    >>> find_revolution(0.03 * level + torch.tensor([0.1, 0.2, 0.0]).double(), level).center
    tensor([0.1000, 0.2000], dtype=torch.float64)
    """
    lines = lines_from_above(points, normals)
    center = _fit_to_lines(points, lines)
    body = split_body(points, lines, center)
    spread = (body.miss / body.radius.clamp_min(LEAST_RADIUS))[body.side].square().mean().sqrt()
    fits = bool((body.mask.double().mean() > BODY_SHARE) & (spread < MAX_SPREAD) & (body.one_way < ONE_WAY))
    return Revolution(center, body.mask) if fits else None


def fit_axis(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "2"]:
    """Return the vertical axis [m] that most lines along the normals meet."""
    return _fit_to_lines(points, lines_from_above(points, normals))


@dataclasses.dataclass(frozen=True)
class Lines:
    """The lines across . x = offset along normals: their level part `slope` is steep, and of unit length `level`."""

    slope: Float[Tensor, "n"]
    steep: Bool[Tensor, "n"]
    level: Float[Tensor, "n 2"]
    across: Float[Tensor, "n 2"]
    offset: Float[Tensor, "n"]


def lines_from_above(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Lines:
    """Return the lines along the normals, seen from above."""
    slope = torch.linalg.vector_norm(normals[:, :2], dim=1)
    steep = slope > STEEP
    level = torch.where(steep[:, None], normals[:, :2] / slope[:, None], 0.0)
    across = torch.stack([-level[:, 1], level[:, 0]], 1)
    return Lines(slope, steep, level, across, (across * points[:, :2]).sum(1))


@dataclasses.dataclass(frozen=True)
class Body:
    """What a cloud has about a vertical axis: `mask` of all its points, `side` of those with steep normals.

    Each point has the distance [m] by which its normal's line misses the axis, its radius, and that of its slice; mean
    level normals of the side have the length `one_way`.
    """

    mask: Bool[Tensor, "n"]
    side: Bool[Tensor, "n"]
    miss: Float[Tensor, "n"]
    radius: Float[Tensor, "n"]
    typical: Float[Tensor, "n"]
    one_way: Float[Tensor, ""]


def split_body(points: Float[Tensor, "n 3"], lines: Lines, center: Float[Tensor, "2"]) -> Body:
    """Return the points whose normals meet the vertical axis at `center`, and whose radius is that of their slice."""
    miss = lines.offset - lines.across @ center
    radius = torch.linalg.vector_norm(points[:, :2] - center, dim=1)
    meets = lines.steep & (miss.abs() / radius.clamp_min(LEAST_RADIUS) < MISS)
    slices = ((points[:, 2:] - points[:, 2]).abs() < SLICE) & meets
    typical = torch.where(slices, radius, torch.nan).nanmedian(1).values
    near = (radius - typical).abs() < THICKNESS
    mask = torch.where(lines.steep, meets & near, radius < typical + THICKNESS)
    side = mask & lines.steep
    return Body(mask, side, miss, radius, typical, torch.linalg.vector_norm(lines.level[side].mean(0)))


def _fit_to_lines(points: Float[Tensor, "n 3"], lines: Lines) -> Float[Tensor, "2"]:
    """Return the point that most lines meet; reweighted least squares (Cauchy)."""
    miss, center = torch.zeros_like(lines.offset), points[:, :2].mean(0)
    for _ in range(ITERATIONS):
        weight = lines.slope / (1.0 + (miss / HALF_WEIGHT) ** 2)
        center = solve_least_squares(weight[:, None].sqrt() * lines.across, weight.sqrt() * lines.offset)
        miss = lines.offset - lines.across @ center
    return center
