"""Observations of a surface: signed distances, and normals where there are any, each with its own noise."""

import dataclasses

import torch
from jaxtyping import Bool, Float
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

    def with_normals_first(self) -> "Observations":
        """Return the observations with the points that have normals before the others, else in their order."""
        order = torch.argsort(~self.has_normal, stable=True)
        return Observations(**{f.name: getattr(self, f.name)[order] for f in dataclasses.fields(self)})
