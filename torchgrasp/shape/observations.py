"""Observations of a surface: signed distances and normals, each with its own noise."""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Batch


@dataclasses.dataclass(frozen=True)
class Observations(Batch):
    """Signed distances at points, and normals where `has_normal`; all is normalised.

    The noises are standard deviations. Other points ignore their normal.

    >>> some, outward = torch.ones(3), torch.eye(3)
    >>> oriented = torch.tensor([False, True, True])
    >>> seen = Observations(outward, 0 * some, outward, oriented, 0.01 * some, 0.05 * some)
    >>> values, variances = seen.rows()
    >>> len(values), seen.with_normals_first().has_normal
    (9, tensor([ True,  True, False]))
    """

    x: Float[Tensor, "n 3"]
    distance: Float[Tensor, "n"]
    normal: Float[Tensor, "n 3"]
    has_normal: Bool[Tensor, "n"]
    distance_noise: Float[Tensor, "n"]
    normal_noise: Float[Tensor, "n"]

    def rows(self) -> tuple[Float[Tensor, "rows"], Float[Tensor, "rows"]]:
        """Return the observed numbers and their noise variances, distances first, then normals by component."""
        y = torch.cat([self.distance, self.normal[self.has_normal].T.reshape(-1)])
        noise = torch.cat([self.distance_noise, self.normal_noise[self.has_normal].repeat(3)])
        return y, noise * noise

    @property
    def least_noise(self) -> float:
        """The least standard deviation of all observed numbers."""
        return float(torch.cat([self.distance_noise, self.normal_noise[self.has_normal]]).min())

    def with_normals_first(self) -> "Observations":
        """Return the observations, those with normals first."""
        return self[torch.argsort(~self.has_normal, stable=True)]


def on_surface(
    x: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], noise: Float[Tensor, "n"], normal_noise: float
) -> Observations:
    """Return observations of points on the surface with their normals."""
    yes = torch.ones(len(x), dtype=torch.bool, device=x.device)
    return Observations(x, torch.zeros_like(noise), normals, yes, noise, torch.full_like(noise, normal_noise))


def off_surface(x: Float[Tensor, "n 3"], distance: Float[Tensor, "n"], noise: float) -> Observations:
    """Return observations of points off the surface, without normals."""
    no = torch.zeros(len(x), dtype=torch.bool, device=x.device)
    sigma = torch.full_like(distance, noise)
    return Observations(x, distance, torch.zeros_like(x), no, sigma, sigma)
