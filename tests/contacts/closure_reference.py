"""Closure on surfaces drawn anew at many points, without interpolation: the reference of the
probability of closure.

Each surface is a sample of the posterior on a fine grid along the line of every finger, with six
neighbours a footprint away from each point. The finger stops where the drawn distance turns
negative, at the place nearest to the planned contact. The normal is that of the mean's gradient
there, plus the deviation over the footprint.
"""

import torch
from torch import Tensor

from torchgrasp import Contacts, ShapeGP
from torchgrasp.contacts.closure_probability import FOOTPRINT
from torchgrasp.contacts.form_closure import closed_exact, tangents
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.posterior import combined_covariance

GRID_POINTS = 37
"""Points of a line, over 12 standard deviations to either side: the deviations grow away from what
was seen.
"""


def redrawn_closure(
    shape: ShapeGP, contacts: Contacts, friction: float, n: int, seed: int
) -> Tensor:
    """Return for each row the share of n drawn surfaces on which its fingers close."""
    return torch.stack([_closed_share(shape, row, friction, n, seed) for row in contacts])


def _closed_share(shape: ShapeGP, contacts: Contacts, friction: float, n: int, seed: int) -> Tensor:
    """Return the share of one row."""
    points = shape.normalise(contacts.points[0].double())
    normals = contacts.normals[0].double()
    tangent = tangents(points[None], normals[None])[0]
    binormal = torch.linalg.cross(normals, tangent)
    deviation = shape.std_factor * shape.jet(points).variance.sqrt()
    grid = torch.linspace(12.0, -12.0, GRID_POINTS, dtype=torch.float64)  # from outside in
    at = deviation[:, None] * grid  # (contact, point)
    places = points[:, None] + at[..., None] * normals[:, None]
    width = FOOTPRINT / shape.scale
    axes = torch.stack([normals, tangent, binormal], 1)
    across = torch.cat([torch.zeros_like(axes[:, :1]), axes, -axes], 1) * width
    asked = (places[:, :, None] + across[:, None]).reshape(-1, 3)

    values = (
        combined_covariance(shape, asked[None, :, None], asked.new_ones(1, 1, 1, 1))[0]
        * shape.std_factor**2
    )
    eigenvalues, vectors = torch.linalg.eigh(values)
    root = (vectors * eigenvalues.clamp(min=0.0).sqrt()) @ vectors.T
    generator = torch.Generator().manual_seed(seed)
    drawn = (torch.randn(n, len(root), dtype=torch.float64, generator=generator) @ root).reshape(
        n, -1, GRID_POINTS, 7
    )
    mean, slope = shape.mean_and_gradient(places.reshape(-1, 3))
    distance = mean.reshape(-1, GRID_POINTS) + drawn[..., 0]
    deviations = (drawn[..., 1:4] - drawn[..., 4:]) / (2 * width)
    gradient = slope.reshape(-1, GRID_POINTS, 3) + deviations @ axes

    crosses = (distance[..., :-1] > 0) & (distance[..., 1:] <= 0)
    far = torch.where(crosses, grid[:-1].abs().expand_as(crosses), torch.inf)
    first = far.argmin(-1, keepdim=True)
    before = distance.gather(-1, first)
    after = distance.gather(-1, first + 1)
    share = before / (before - after)

    def interpolate(nodes: Tensor) -> Tensor:
        index = first[..., None].expand(-1, -1, -1, nodes.shape[-1])
        low = nodes.gather(2, index)[:, :, 0]
        high = nodes.gather(2, index + 1)[:, :, 0]
        return low + share * (high - low)

    touched = interpolate(places.expand(n, -1, -1, -1))
    closed = closed_exact(touched, unit(interpolate(gradient)), friction)
    return (closed & crosses.any(-1).all(-1)).double().mean()
