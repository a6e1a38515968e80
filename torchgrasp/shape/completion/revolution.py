"""Bodies of revolution: the upright axis that the normals of most of a cloud meet, and the points around it."""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

STEEP = 0.3
"""Length of a normal's level part from which on it tells where an upright axis is."""
MISS = 0.004
"""Distance [m] of a normal's line from the axis at which it counts half in the fit."""
ROUNDS = 30
"""Fits with new weights."""
ASIDE, LEAST_RADIUS = 0.2, 0.01
"""A normal meets the axis if its line passes it within this share of the point's radius, at least of that one [m]."""
SLICE, THICKNESS = 0.004, 0.004
"""Points of the body have the median radius of those that are no further above or below, to this much [m]."""
SHARE = 0.6
"""Share of the cloud from which on points around an axis are the body, and others a part that is attached to it."""
STRAY = 0.075
"""Greatest RMS of the shares of the radius by which the body's normals miss the axis: 0.04 to 0.07 of cans, a pitcher
and a jug seen with noise; on free forms the shares spread over all of `ASIDE`."""
ONE_WAY = 0.95
"""Length of the mean of the body's level normals from which on they point one way, as a flat side's do."""


@dataclasses.dataclass(frozen=True)
class Revolution:
    """A body of revolution in a cloud: its upright axis at `center` [m], and the points that are of it."""

    center: Float[Tensor, "2"]
    body: Bool[Tensor, "n"]


def find_revolution(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Revolution | None:
    """Return the body of revolution about a vertical axis that most points belong to; None: there is none.

    The normals of a surface of revolution meet its axis, which is fitted to their lines by least squares, reweighted
    (Cauchy) so that a handle does not draw it.

    >>> angle = torch.linspace(-1.5, 1.5, 200).double()
    >>> level = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], 1)
    >>> found = find_revolution(0.03 * level + torch.tensor([0.1, 0.2, 0.0]).double(), level)
    >>> found.center
    tensor([0.1000, 0.2000], dtype=torch.float64)
    """
    slope = torch.linalg.vector_norm(normals[:, :2], dim=1)
    steep = slope > STEEP
    level = torch.where(steep[:, None], normals[:, :2] / slope[:, None], 0.0)
    across = torch.stack([-level[:, 1], level[:, 0]], 1)  # a line along the normal: across . x = height
    height = (across * points[:, :2]).sum(1)
    miss = torch.zeros_like(height)
    center = points[:, :2].mean(0)
    for _ in range(ROUNDS):
        weight = slope / (1.0 + (miss / MISS) ** 2)
        center = torch.linalg.lstsq(weight[:, None].sqrt() * across, (weight.sqrt() * height)[:, None]).solution[:, 0]
        miss = height - across @ center

    radius = torch.linalg.vector_norm(points[:, :2] - center, dim=1)
    aside = miss.abs() / radius.clamp_min(LEAST_RADIUS)
    meets = steep & (aside < ASIDE)
    slices = ((points[:, 2:] - points[:, 2]).abs() < SLICE) & meets
    typical = torch.where(slices, radius, torch.nan).nanmedian(1).values
    body = torch.where(steep, meets & ((radius - typical).abs() < THICKNESS), radius < typical + THICKNESS)
    told = body & steep
    stray, one_way = aside[told].square().mean().sqrt(), torch.linalg.vector_norm(level[told].mean(0))
    fits = bool((body.double().mean() > SHARE) & (stray < STRAY) & (one_way < ONE_WAY))
    return Revolution(center, body) if fits else None
