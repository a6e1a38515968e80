"""Bodies of revolution: the upright axis that the normals of most of a cloud meet, and the points that belong to it."""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

LEVEL = 0.3
"""Normals with less than this level part say nothing of an upright axis."""
MISS = 0.004
"""Distance [m] from the axis at which a normal counts half in the fit."""
ROUNDS = 30
"""Rounds of the reweighted fit."""
ASIDE = 0.2
"""A normal meets the axis if it passes within this share of its point's radius."""
LEAST_RADIUS = 0.01
"""Radius [m] below which it counts as that there."""
SLICE, THICK = 0.004, 0.004
"""Points of the body have the radius [m] of the others within a slice of that height, to this much."""
STRAY = 0.075
"""Greatest RMS of those shares over the body: on a free form that seems to be of revolution they spread evenly."""
ONE_WAY = 0.95
"""Length of the mean of the body's level normals from which on they point one way, as those of a flat side."""
MOST = 0.6
"""Share of the cloud from which on it counts as a body of revolution with something attached."""


@dataclasses.dataclass(frozen=True)
class Revolution:
    """A body of revolution in a cloud: its upright axis at `center` [m], and which points are of it."""

    center: Float[Tensor, "2"]
    body: Bool[Tensor, "n"]


def find_revolution(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Revolution | None:
    """Return the body of revolution about a vertical axis that most points are of, or none.

    The normals of a surface of revolution meet its axis. The fit by least squares of the distances at which they pass
    it is reweighted, so that a handle does not draw the axis.
    """
    slope = torch.linalg.vector_norm(normals[:, :2], dim=1)
    steep = slope > LEVEL
    across = torch.stack([-normals[:, 1], normals[:, 0]], 1) / slope.clamp_min(1e-9)[:, None]
    height = (across * points[:, :2]).sum(1)
    weight = torch.where(steep, slope, 0.0)
    miss = torch.zeros_like(height)
    center = points[:, :2].mean(0)
    for _ in range(ROUNDS):
        pull = weight / (1.0 + (miss / MISS) ** 2)
        matrix = across.T @ (pull[:, None] * across)
        center = torch.linalg.solve(matrix, across.T @ (pull * height))
        miss = height - across @ center
    radius = torch.linalg.vector_norm(points[:, :2] - center, dim=1)
    meets = steep & (miss.abs() < ASIDE * radius.clamp_min(LEAST_RADIUS))
    z = points[:, 2]
    near = ((z[:, None] - z).abs() < SLICE) & meets
    typical = torch.where(near, radius, torch.nan).nanmedian(1).values
    body = torch.where(steep, meets & ((radius - typical).abs() < THICK), radius < typical + THICK)
    told = body & steep
    stray = (miss / radius.clamp_min(LEAST_RADIUS))[told].square().mean().sqrt()
    level = (normals[:, :2] / slope.clamp_min(1e-9)[:, None])[told].mean(0)
    if float(body.double().mean()) < MOST or float(stray) > STRAY or float(torch.linalg.vector_norm(level)) > ONE_WAY:
        return None
    return Revolution(center, body)
