"""How far two boxes, or a point and a box, are apart: signed, batched, differentiable."""

import torch
from jaxtyping import Float
from torch import Tensor

PARALLEL = 1e-10
"""Squared sine below which two edges count as parallel: then the faces' normals tell all that their product would."""


def box_separation(
    a: Float[Tensor, "3 3 k"],
    b: Float[Tensor, "3 3 k"],
    gap: Float[Tensor, "3 k"],
    half_a: Float[Tensor, "3 k"],
    half_b: Float[Tensor, "3 k"],
) -> Float[Tensor, " k"]:
    """Return the largest separation of two boxes along the 15 axes that can part them (Gottschalk et al., 1996).

    It is negative where the boxes overlap, and then the least translation that parts them. Where they are apart it is
    the distance between a face and what it faces, or between two crossing edges, and below the distance otherwise.

    Every tensor has the pairs of boxes last.

    Args:
        a: rotation of the first box; column i, `a[:, i]`, is its axis i.
        b: rotation of the second.
        gap: from the centre of the first to that of the second [m].
        half_a: half sizes of the first [m].
        half_b: half sizes of the second [m].

    >>> still, x = torch.eye(3)[..., None], torch.tensor([[3.0], [0.0], [0.0]])
    >>> box_separation(still, still, x, torch.ones(3, 1), torch.ones(3, 1))
    tensor([1.])
    """
    turn = a[0, :, None] * b[0] + a[1, :, None] * b[1] + a[2, :, None] * b[2]  # b's axes in the frame of a
    t, u = (x[0] * gap[0] + x[1] * gap[1] + x[2] * gap[2] for x in (a, b))
    size, square = turn.abs(), turn * turn
    by_a = t.abs() - half_a - (size[:, 0] * half_b[0] + size[:, 1] * half_b[1] + size[:, 2] * half_b[2])
    by_b = u.abs() - half_b - (size[0] * half_a[0, None] + size[1] * half_a[1, None] + size[2] * half_a[2, None])
    # axis i of a cross axis j of b; the other two axes of a box follow in turn
    next_t, last_t, next_a, last_a = (x.roll(k, 0)[:, None] for x in (t, half_a) for k in (-1, 1))
    along = last_t * turn.roll(-1, 0) - next_t * turn.roll(1, 0)
    reach = next_a * size.roll(1, 0) + last_a * size.roll(-1, 0)
    reach = reach + half_b.roll(-1, 0) * size.roll(1, 1) + half_b.roll(1, 0) * size.roll(-1, 1)
    sine = square.roll(-1, 1) + square.roll(1, 1)
    crossing = sine > PARALLEL
    by_edges = (along.abs() - reach) * torch.rsqrt(torch.where(crossing, sine, 1.0))
    by_edges = torch.where(crossing, by_edges, -torch.inf)
    return torch.maximum(torch.maximum(by_a, by_b).amax(0), by_edges.amax((0, 1)))


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
