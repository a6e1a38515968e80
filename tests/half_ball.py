"""A half-seen ball whose surface is drawn, and contacts on it."""

import torch

from torchgrasp.geometry.linalg import unit
from torchgrasp.plan.round_cones import closed_exact
from torchgrasp.shape.condition import condition
from torchgrasp.shape.gp import Normalisation, ShapeGP
from torchgrasp.shape.observations import Observations
from torchgrasp.values import Contacts, PointCloud

RADIUS = 0.04


def ball(seen_from: float, std_factor: float, noise: float = 0.02) -> ShapeGP:
    """A ball of which the part above `seen_from` (in radii) was seen."""
    generator = torch.Generator().manual_seed(0)
    n = unit(torch.randn(120, 3, generator=generator, dtype=torch.float64))
    n = n[n[:, 2] > seen_from]
    x = torch.cat(
        [n, torch.zeros(1, 3, dtype=torch.float64), 1.2 * unit(torch.randn(40, 3, generator=generator)).double()]
    )
    distance = torch.cat([torch.zeros(len(n)), torch.tensor([-1.0]), torch.full((40,), 0.2)]).double()
    oriented = torch.arange(len(x)) < len(n)
    sigma = torch.full_like(distance, noise)
    observations = Observations(x, distance, torch.cat([n, torch.zeros_like(x[len(n) :])]), oriented, sigma, sigma)
    return condition(
        observations,
        Normalisation(torch.zeros(3, dtype=torch.float64), RADIUS),
        PointCloud(RADIUS * n, n),
        std_factor=std_factor,
    )


def contacts_on(shape: ShapeGP, generator: torch.Generator, count: int, fingertips: int = 3) -> Contacts:
    """Random contacts on the mean surface whose normals are the mean's, closed there at friction 0.8."""
    x = unit(torch.randn(20 * count, fingertips, 3, generator=generator, dtype=torch.float64))
    for _ in range(8):
        distance, slope = (t.unflatten(0, (len(x), -1)) for t in shape.mean_and_gradient(x.flatten(0, 1)))
        x = x - (distance / (slope * slope).sum(-1))[..., None] * slope
    normals = unit(shape.mean_and_gradient(x.flatten(0, 1))[1]).unflatten(0, (len(x), -1))
    good = closed_exact(x, normals, 0.8) & (torch.linalg.vector_norm(x - x.roll(1, 1), dim=-1).amin(-1) > 0.3)
    x, normals = x[good][:count], normals[good][:count]
    return Contacts(shape.metres(x), normals)
