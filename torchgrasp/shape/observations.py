"""Observations of a surface: signed distances, and normals where there are any, each with its own noise."""

import dataclasses

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.base import Value


@dataclasses.dataclass(frozen=True)
class Observations(Value):
    """What is known of the surface at points: signed distances, and normals where `has_normal`.

    All is normalised: positions and distances are divided by the shape's scale. `normal` is ignored elsewhere.
    """

    x: Float[Tensor, "n 3"]
    distance: Float[Tensor, "n"]
    normal: Float[Tensor, "n 3"]
    has_normal: Bool[Tensor, "n"]
    distance_noise: Float[Tensor, "n"]
    normal_noise: Float[Tensor, "n"]

    def rows(self) -> tuple[Float[Tensor, "rows"], Float[Tensor, "rows"]]:
        """Return the observed numbers and the noise variances in the order of `covariance`'s rows."""
        y = torch.cat([self.distance, self.normal[self.has_normal].T.reshape(-1)])
        noise = torch.cat([self.distance_noise, self.normal_noise[self.has_normal].repeat(3)])
        return y, noise * noise

    @property
    def least_noise(self) -> float:
        """Return the least standard deviation of anything observed."""
        return float(torch.cat([self.distance_noise, self.normal_noise[self.has_normal]]).min())

    def select(self, rows: Int[Tensor, "m"]) -> "Observations":
        """Return some of the observations, in the order of `rows`."""
        return Observations(**{f.name: getattr(self, f.name)[rows] for f in dataclasses.fields(self)})

    def with_normals_first(self) -> "Observations":
        """Return the observations with the points that have normals before the others, else in their order."""
        return self.select(torch.argsort(~self.has_normal, stable=True))


def on_surface(
    x: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], noise: Float[Tensor, "n"], normal_noise: float
) -> Observations:
    """Return observations of points on the surface with their normals."""
    yes = torch.ones(len(x), dtype=torch.bool, device=x.device)
    return Observations(x, torch.zeros_like(noise), normals, yes, noise, torch.full_like(noise, normal_noise))


def off_surface(x: Float[Tensor, "n 3"], distance: Float[Tensor, "n"], noise: float) -> Observations:
    """Return observations of points off the surface, where no normal is defined."""
    no = torch.zeros(len(x), dtype=torch.bool, device=x.device)
    sigma = torch.full_like(distance, noise)
    return Observations(x, distance, torch.zeros_like(x), no, sigma, sigma)


def join(*parts: Observations) -> Observations:
    """Concatenate observations."""
    names = (f.name for f in dataclasses.fields(Observations))
    return Observations(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})
