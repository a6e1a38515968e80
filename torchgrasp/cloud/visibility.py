"""Whether a camera can have seen points."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.geometry.linalg import unit

MAX_EDGE_ON = 0.15
"""Largest share of a view's points on surfaces that the camera sees edge-on: 222 views have .10 at most."""
MAX_BEHIND = 0.2
"""Largest share of a view's points behind others: 222 views have .14 at most. Wrong cameras exceed one of the two in
.85 of all cases."""
EDGE = 0.17
"""Cosine of 80 degrees between ray and normal: depth cameras lose surfaces between 72 and 87 degrees."""
DEEPER = 0.1
"""A point lies behind another when it is deeper by this share of the cloud's radius than a slope explains."""


def share_unseen(
    points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], viewpoint: Float[Tensor, "3"]
) -> tuple[float, float]:
    """Return the shares of points that a camera would see edge-on, and of those behind others or the camera.

    Args:
        points: without outliers [m].
        normals: of unit length and any sign.
        viewpoint: the camera [m].
    """
    from scipy.spatial import KDTree

    ray = unit(points - viewpoint)
    edge_on = float(((ray * normals).sum(-1).abs() < EDGE).double().mean())
    middle = (points.amax(0) + points.amin(0)) / 2
    forward = middle - viewpoint
    if not bool(forward.any()) or bool(((points - viewpoint) @ forward <= 0).any()):
        return edge_on, 1.0  # within the cloud, or beside it
    axes = torch.linalg.svd(unit(forward)[None]).Vh  # forward, or backward, and two axes across
    local = (points - viewpoint) @ axes.T
    depth = local[:, 0].abs()
    pixels = local[:, 1:] / depth[:, None]
    apart, index = KDTree(pixels.numpy()).query(pixels.numpy(), k=min(6, len(pixels)))
    step = (depth[:, None] - depth[torch.from_numpy(index)]).abs() - 2 * torch.from_numpy(apart) * depth[:, None]
    radius = torch.linalg.vector_norm(points - middle, dim=-1).max()
    return edge_on, float((step.amax(1) > DEEPER * radius).double().mean())
