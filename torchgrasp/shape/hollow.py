"""An open vessel: an outer body, and the space within its inner wall cut out of it."""

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.checks import Pose, checked
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.joint_posterior import JointEstimate
from torchgrasp.shape.observations import Observations
from torchgrasp.shape.posterior import MeanJet, SurfaceJet
from torchgrasp.values import PointCloud


@dataclasses.dataclass(frozen=True)
class HollowShape(ShapeGP):
    """The material within two surfaces, each with a posterior of its own: the distance is the greater one.

    No single smooth field turns its sign twice within a thin wall. At every point the surface with the greater mean
    gives distance, normal and covariance; errors of different surfaces are independent.

    Args:
        lining: the inner wall, positive inside the vessel and negative all around.

    >>> import trimesh
    >>> from torchgrasp import fit_shape
    >>> from torchgrasp.cloud import look_at, partial_view
    >>> outline = [[0, 0], [0.04, 0], [0.04, 0.09], [0.034, 0.09], [0.034, 0.006], [0, 0.006]]
    >>> cup = trimesh.creation.revolve(outline)  # radius and height [m]
    >>> shape = fit_shape(partial_view(cup, look_at(0.0, 35.0, target=cup)), table=0.0)
    >>> shape.predict(torch.tensor([[0.0, 0.0, 0.06], [0.037, 0.0, 0.06]]).double()).distance > 0
    tensor([ True, False])
    >>> HollowShape.join(shape.outer, shape.lining, shape.cloud).kind
    'vessel'
    """

    lining: ShapeGP

    @classmethod
    @checked
    def join(cls, outer: ShapeGP, lining: ShapeGP, cloud: PointCloud) -> "HollowShape":
        """Return the vessel of two walls in the same normalised frame; `cloud` is what was seen of both."""
        fields = {f.name: getattr(outer, f.name) for f in dataclasses.fields(ShapeGP)}
        fields |= {"cloud": cloud, "domain_radius": min(outer.domain_radius, lining.domain_radius)}
        return cls(**fields, lining=lining)

    @cached_property
    def outer(self) -> ShapeGP:
        """The outer wall alone: the body as if it were full."""
        return ShapeGP(**{f.name: getattr(self, f.name) for f in dataclasses.fields(ShapeGP)})

    @property
    def walls(self) -> tuple[ShapeGP, ...]:
        """The outer and the inner wall."""
        return self.outer, self.lining

    @checked(gradients=True)
    def wall_at(self, x: Float[Tensor, "q 3"]) -> Bool[Tensor, "q walls"]:
        """Tell which wall is the surface at normalised points."""
        inner = self.lining.mean(x) > self.outer.mean(x)
        return torch.stack([~inner, inner], 1)

    @checked(gradients=True)
    def mean(self, x: Float[Tensor, "q 3"]) -> Float[Tensor, "q"]:
        """Return the mean signed distance at normalised points."""
        return torch.maximum(self.outer.mean(x), self.lining.mean(x))

    @checked(gradients=True)
    def mean_and_gradient(self, x: Float[Tensor, "q 3"]) -> tuple[Float[Tensor, "q"], Float[Tensor, "q 3"]]:
        """Return the mean signed distance and its gradient at normalised points."""
        (a, slope_a), (b, slope_b) = (wall.mean_and_gradient(x) for wall in self.walls)
        return torch.maximum(a, b), torch.where((b > a)[:, None], slope_b, slope_a)

    @checked(gradients=True)
    def estimate(self, x: Float[Tensor, "q 3"]) -> tuple[Float[Tensor, "q 4"], Float[Tensor, "q 4 4"]]:
        """Return the mean and the covariance of (d, w) at normalised points."""
        return self._by_wall(x, lambda wall, own: wall.estimate(own))  # pyright: ignore[reportReturnType]

    @checked(gradients=True)
    def jet(self, x: Float[Tensor, "q 3"]) -> SurfaceJet:
        """Return mean and variance with derivatives at normalised points."""
        return SurfaceJet(*self._by_wall(x, lambda wall, own: _fields(wall.jet(own))))

    @checked(gradients=True)
    def mean_jet(self, x: Float[Tensor, "q 3"]) -> MeanJet:
        """Return the mean with its derivatives at normalised points."""
        return MeanJet(*self._by_wall(x, lambda wall, own: _fields(wall.mean_jet(own))))

    @checked(gradients=True)
    def joint_at(self, x: Float[Tensor, "k 3"]) -> JointEstimate:
        """Return the joint posterior of (d, w) at normalised points."""
        parts, owner = [wall.joint_at(x) for wall in self.walls], self.wall_at(x)
        mean = torch.where(owner[:, 1:], parts[1].mean, parts[0].mean)
        covariance = torch.zeros_like(parts[0].covariance)
        for part, own in zip(parts, owner.repeat_interleave(4, 0).T, strict=True):
            covariance += part.covariance * (own[:, None] & own)
        return JointEstimate(mean, covariance)

    @checked
    def append(self, new: Observations) -> "HollowShape":
        """Return the shape given further observations, normalised, each of the wall at its point."""
        outer, inner = self.wall_at(new.x).T
        return self.join(self.outer.append(new[outer]), self.lining.append(new[inner]), self.cloud)

    @checked
    def moved(self, b_from_a: Pose) -> "HollowShape":
        """Return the shape in frame b [m]; it is given in frame a."""
        outer = self.outer.moved(b_from_a)
        return self.join(outer, self.lining.moved(b_from_a), outer.cloud)

    def _by_wall(
        self, x: Float[Tensor, "q 3"], evaluate: Callable[[ShapeGP, Tensor], tuple[Any, ...]]
    ) -> tuple[Tensor, ...]:
        """Evaluate each wall where it is the surface."""
        owner = self.wall_at(x)
        found: tuple[Tensor, ...] = ()
        for wall, own in zip(self.walls, owner.T, strict=True):
            part = evaluate(wall, x[own])
            found = found or tuple(p.new_empty(len(x), *p.shape[1:]) for p in part)
            for whole, rows in zip(found, part, strict=True):
                whole[own] = rows
        return found


def _fields(jet: MeanJet) -> tuple[Tensor, ...]:
    """Return the fields in their order."""
    return tuple(getattr(jet, f.name) for f in dataclasses.fields(jet))
