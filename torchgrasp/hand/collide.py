"""Distances for collision: segments, boxes, and a signed distance field of an object's surface."""

import torch
from jaxtyping import Float
from torch import Tensor

TINY = 1e-18
"""Squared length [m2] below which a segment is a point (1e-9 m), and the floor under square roots."""


def segment_distance(
    a: Float[Tensor, "*b 3"], b: Float[Tensor, "*b 3"], c: Float[Tensor, "*b 3"], d: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b"]:
    """Return the least distance between the segments ab and cd, degenerate ones included.

    The closest points of the two lines are clamped to the segments (Ericson, Real-Time Collision Detection, 5.1.9).

    >>> o, x, y = torch.zeros(3), torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0])
    >>> segment_distance(x, x + x, y, y + y)
    tensor(1.4142)
    """
    u, v, w = b - a, d - c, a - c
    uu, vv, uv = (u * u).sum(-1), (v * v).sum(-1), (u * v).sum(-1)
    uw, vw = (u * w).sum(-1), (v * w).sum(-1)
    # parallel segments have no unique closest points: any s will do, and 0 is taken
    span = uu * vv - uv * uv
    s = ((uv * vw - vv * uw) / span.clamp_min(TINY * TINY)).clamp(0, 1)
    s = torch.where(span > 1e-10 * uu * vv, s, 0.0)
    t = ((uv * s + vw) / vv.clamp_min(TINY)).clamp(0, 1)
    s = ((uv * t - uw) / uu.clamp_min(TINY)).clamp(0, 1)
    gap = w + s[..., None] * u - t[..., None] * v
    return torch.sqrt((gap * gap).sum(-1).clamp_min(TINY))


def box_distance(points: Float[Tensor, "*b 3"], half: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """Return the signed distance of points from boxes about the origin with half sizes `half`; negative inside.

    >>> box_distance(torch.tensor([[2.0, 0, 0], [0.0, 0, 0.5]]), torch.ones(2, 3))
    tensor([ 1.0000, -0.5000])
    """
    outside = points.abs() - half
    positive = outside.clamp_min(0)
    squared = (positive * positive).sum(-1)
    # the root's derivative is infinite at 0: there the inner branch, by the largest coordinate, is the distance
    away = squared > 0
    return torch.where(away, torch.sqrt(torch.where(away, squared, 1.0)), outside.amax(-1))
