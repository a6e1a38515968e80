"""Closure on surfaces drawn anew, without rungs to be linear between: what the probability of closure is held against.

Each surface is a sample of the posterior at a close ladder of points along the line of every finger, with six
neighbours a footprint away from each. The finger stops where the drawn distance turns negative on its way in, at the
place nearest to the planned contact if there are several; the normal is that of the mean's gradient at that place and
of the deviation from it over the footprint there.
"""

import torch
from torch import Tensor

from torchgrasp.linalg import unit
from torchgrasp.plan.line_posterior import FOOTPRINT
from torchgrasp.plan.wrench import closed_exact, tangents
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.joint_posterior import distance_covariance
from torchgrasp.values import Contacts

RUNGS = 37
"""Points of a ladder, over 12 standard deviations to either side: the deviations grow away from what was seen."""


def redrawn_closure(shape: ShapeGP, contacts: Contacts, friction: float, n: int, seed: int) -> Tensor:
    """Return for each row the share of n drawn surfaces on which its fingers close."""
    return torch.stack([_closed_share(shape, row, friction, n, seed) for row in contacts])


def _closed_share(shape: ShapeGP, contacts: Contacts, friction: float, n: int, seed: int) -> Tensor:
    """Return the share of one row."""
    points, normals = shape.normalise(contacts.points[0].double()), contacts.normals[0].double()
    first = tangents(points[None], normals[None])[0]
    second = torch.linalg.cross(normals, first)
    deviation = shape.std_factor * shape.jet(points).variance.sqrt()
    rungs = torch.linspace(12.0, -12.0, RUNGS, dtype=torch.float64)  # from outside in
    at = deviation[:, None] * rungs  # (contact, rung)
    ladder = points[:, None] + at[..., None] * normals[:, None]
    width = FOOTPRINT / shape.scale
    axes = torch.stack([normals, first, second], 1)
    across = torch.cat([torch.zeros_like(axes[:, :1]), axes, -axes], 1) * width
    asked = (ladder[:, :, None] + across[:, None]).reshape(-1, 3)

    values = distance_covariance(shape, asked[None])[0] * shape.std_factor**2
    eigenvalues, vectors = torch.linalg.eigh(values)
    root = (vectors * eigenvalues.clamp(min=0.0).sqrt()) @ vectors.T
    generator = torch.Generator().manual_seed(seed)
    drawn = (torch.randn(n, len(root), dtype=torch.float64, generator=generator) @ root).reshape(n, 3, RUNGS, 7)
    mean, slope = shape.mean_and_gradient(ladder.reshape(-1, 3))
    distance = mean.reshape(3, RUNGS) + drawn[..., 0]
    deviations = (drawn[..., 1:4] - drawn[..., 4:]) / (2 * width)
    gradient = slope.reshape(3, RUNGS, 3) + deviations @ axes

    crosses = (distance[..., :-1] > 0) & (distance[..., 1:] <= 0)
    far = torch.where(crosses, rungs[:-1].abs().expand_as(crosses), torch.inf)
    rung = far.argmin(-1, keepdim=True)
    before, after = distance.gather(-1, rung), distance.gather(-1, rung + 1)
    share = before / (before - after)

    def interpolate(nodes: Tensor) -> Tensor:
        index = rung[..., None].expand(-1, -1, -1, nodes.shape[-1])
        low, high = nodes.gather(2, index)[:, :, 0], nodes.gather(2, index + 1)[:, :, 0]
        return low + share * (high - low)

    touched = interpolate(ladder.expand(n, -1, -1, -1))
    closed = closed_exact(touched, unit(interpolate(gradient)), friction)
    return (closed & crosses.any(-1).all(-1)).double().mean()
