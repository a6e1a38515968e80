"""Local fits to a cloud: a plane about each point for the side and the spread, a quadric for the surface itself."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.filter import nearest
from torchgrasp.linalg import unit

PLANE_NEIGHBOURS = 25
"""Neighbours, the point itself included, that fix a local plane."""
QUADRIC_NEIGHBOURS = 30
"""Neighbours that fix a local quadric, which has twice the unknowns."""
FLATNESS = 1e-3
"""Weight of the plane against the points in the fit of a quadric, their spread taken as 1: few points stay flat."""


def fit_planes(
    points: Float[Tensor, "n 3"],
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Return unit normals of unknown sign, the points' offsets from their planes, and the planes' weighted rms [m].

    Weights of the 25 nearest points are exp(-(d / 0.7 d_25)^2).
    """
    near, weight = _neighbourhood(points, PLANE_NEIGHBOURS)
    centre, values, axes = _planes(near, weight)
    normals = axes[..., 0]
    return normals, ((points - centre) * normals).sum(-1), values[:, 0].clamp_min(0).sqrt()


def fit_quadrics(
    points: Float[Tensor, "n 3"],
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n"]]:
    """Return the feet of the points on local quadrics, the unit normals there, and the quadrics' weighted rms [m].

    Over the plane of the 30 nearest points the height is fitted as a polynomial of degree 2 by weighted least
    squares. A point's foot is the quadric's height below it. A plane would cut the bulge of a curved surface off: the
    points of a ball of radius r would move inward by about s^2 / 2r, s being the neighbours' spread.
    """
    near, weight = _neighbourhood(points, QUADRIC_NEIGHBOURS)
    _, _, axes = _planes(near, weight)
    height, u, v = ((near - points[:, None]) @ axes).unbind(-1)
    size = torch.stack([u, v], -1).norm(dim=-1).amax(-1, keepdim=True)
    u, v = u / size, v / size
    terms = torch.stack([torch.ones_like(u), u, v, u * u, u * v, v * v], -1)
    weighted = weight[..., None] * terms
    flat = FLATNESS * torch.tensor([0.0, 1.0, 1.0, 1.0, 1.0, 1.0]).to(points)
    moments = weighted.transpose(-1, -2) @ terms + torch.diag_embed(flat)
    found = torch.linalg.solve(moments, (weighted * height[..., None]).sum(-2))
    residual = height - (terms * found[:, None]).sum(-1)
    slope = torch.stack([torch.ones_like(size[:, 0]), -found[:, 1] / size[:, 0], -found[:, 2] / size[:, 0]], -1)
    feet = points + found[:, :1] * axes[..., 0]
    return feet, unit((axes @ slope[..., None])[..., 0]), (weight * residual**2).sum(-1).sqrt()


def _neighbourhood(points: Float[Tensor, "n 3"], k: int) -> tuple[Float[Tensor, "n k 3"], Float[Tensor, "n k"]]:
    """Return the k nearest points of each and their weights, whose sum is 1."""
    distance, index = nearest(points, k)
    weight = torch.exp(-((distance / (0.7 * distance[:, -1:])) ** 2))
    return points[index], weight / weight.sum(-1, keepdim=True)


def _planes(
    near: Float[Tensor, "n k 3"], weight: Float[Tensor, "n k"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Return centres, mean squares along the axes, least first, and the axes as columns."""
    centre = (weight[..., None] * near).sum(1)
    difference = near - centre[:, None]
    scatter = (weight[..., None] * difference).transpose(-1, -2) @ difference
    values, axes = torch.linalg.eigh(scatter)
    return centre, values, axes
