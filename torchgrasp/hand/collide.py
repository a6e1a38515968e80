"""Distances for collision: segments, boxes, and a signed distance field of an object's surface."""

import torch
from jaxtyping import Float
from torch import Tensor

TINY = 1e-18
"""Squared length [m2] below which a segment is a point (1e-9 m), and the floor under square roots."""


def segment_closest(
    a: Float[Tensor, "*b 3"], b: Float[Tensor, "*b 3"], c: Float[Tensor, "*b 3"], d: Float[Tensor, "*b 3"]
) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b 3"]]:
    """Return the closest points of the segments ab and cd, degenerate ones included.

    The closest points of the two lines are clamped to the segments (Ericson, Real-Time Collision Detection, 5.1.9).
    """
    s, t = _closest_fractions(a, b, c, d)
    return a + s[..., None] * (b - a), c + t[..., None] * (d - c)


def segment_distance(
    a: Float[Tensor, "*b 3"], b: Float[Tensor, "*b 3"], c: Float[Tensor, "*b 3"], d: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b"]:
    """Return the least distance between the segments ab and cd, degenerate ones included.

    First derivatives are exact (the closest points are held fixed: moving them along changes nothing); second are not.

    >>> o, x, y = torch.zeros(3), torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0])
    >>> segment_distance(x, x + x, y, y + y)
    tensor(1.4142)
    """
    s, t = _closest_fractions(a, b, c, d)
    squared = torch.zeros_like(s)
    for ai, bi, ci, di in zip(a.unbind(-1), b.unbind(-1), c.unbind(-1), d.unbind(-1), strict=True):
        gap = torch.lerp(ai, bi, s) - torch.lerp(ci, di, t)
        squared = torch.addcmul(squared, gap, gap)
    return torch.sqrt(squared.clamp_min(TINY))


@torch.no_grad()
def _closest_fractions(
    a: Float[Tensor, "*b 3"], b: Float[Tensor, "*b 3"], c: Float[Tensor, "*b 3"], d: Float[Tensor, "*b 3"]
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """Return how far along ab and cd (0 to 1) their closest points are."""
    u, v, w = (b - a).unbind(-1), (d - c).unbind(-1), (a - c).unbind(-1)
    uu, vv, uv, uw, vw = _dot(u, u), _dot(v, v), _dot(u, v), _dot(u, w), _dot(v, w)
    # parallel segments have no unique closest points: any s will do, since t and s follow from it
    span = torch.addcmul(uu * vv, uv, uv, value=-1).clamp_min(TINY * TINY)
    s = (torch.addcmul(uv * vw, vv, uw, value=-1) / span).clamp(0, 1)
    t = (torch.addcmul(vw, uv, s) / vv.clamp_min(TINY)).clamp(0, 1)
    return (torch.addcmul(-uw, uv, t) / uu.clamp_min(TINY)).clamp(0, 1), t


def _dot(u: tuple[Tensor, ...], v: tuple[Tensor, ...]) -> Tensor:
    """Return u . v, coordinate by coordinate: a sum over a last axis of length 3 is many times slower."""
    return torch.addcmul(torch.addcmul(u[0] * v[0], u[1], v[1]), u[2], v[2])


def box_distance(points: Float[Tensor, "*b 3"], half: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """Return the signed distance of points from boxes about the origin with half sizes `half`; negative inside.

    >>> box_distance(torch.tensor([[2.0, 0, 0], [0.0, 0, 0.5]]), torch.ones(2, 3))
    tensor([ 1.0000, -0.5000])
    """
    ox, oy, oz = (points.abs() - half).unbind(-1)
    px, py, pz = ox.clamp_min(0), oy.clamp_min(0), oz.clamp_min(0)
    squared = px * px + py * py + pz * pz
    # the root's derivative is infinite at 0: there the inner branch, by the largest coordinate, is the distance
    away = squared > 0
    inside = torch.maximum(torch.maximum(ox, oy), oz)
    return torch.where(away, torch.sqrt(torch.where(away, squared, 1.0)), inside)
