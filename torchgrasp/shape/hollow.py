"""The shape of an open vessel: an outer body without the cavity inside its inner surface."""

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.base import flatnonzero, map_tensors
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.rules import Pose
from torchgrasp.shape.completion.silhouette import pick_apart
from torchgrasp.shape.estimate import (
    JointEstimate,
    MeanAndGradient,
    MeanJet,
    Moments,
    Observations,
    SurfaceJet,
    off_surface,
)
from torchgrasp.shape.extra_observations import Middle
from torchgrasp.shape.gp import ShapeGP, common_fields
from torchgrasp.shape.kernel import Queries
from torchgrasp.values.planning import PointCloud

Found = TypeVar("Found")


@dataclasses.dataclass(frozen=True)
class TieNumbers:
    """Parameters of the observations that give the wall of an open vessel its known thickness."""

    rounds: int = 3
    """Greatest number of rounds. Each observes the points with the greatest error of the wall's
    thickness.
    """
    points: int = 24
    """Greatest number of points that are observed in a round."""
    off: float = 0.0005
    """Greatest error [m] of the wall's thickness that is not corrected."""
    noise: float = 0.0007
    """Standard deviation [m] of a distance that is observed because of the thickness."""


TIE_WALLS = TieNumbers()


@dataclasses.dataclass(frozen=True)
class HollowShape(ShapeGP):
    """The shape of an open vessel: the material between an outer and an inner surface.

    `fit_shape` returns it for an upright open vessel seen from above on a `table`. It has all
    methods of `ShapeGP`. Each surface is a Gaussian process of its own. The reason is that one
    smooth field cannot change its sign twice within a thin wall. Both share one normalised frame,
    with one unit of `scale` [m].

    At each point one surface applies: the surface with the greater mean signed distance. Distance,
    normal and covariance are those of this surface. The errors of the two surfaces are independent.

    The attributes of `ShapeGP` describe the outer surface. But `cloud` holds the points of both
    surfaces. `domain_radius` is the smaller of the radii of their domains, the balls in which they
    are valid.

    Attributes:
        inner: the inner surface; its signed distance is positive in the cavity and negative around
            the cavity.

    >>> import trimesh
    >>> from torchgrasp import fit_shape
    >>> from torchgrasp.cloud import look_at, partial_view
    >>> outer = [[0, 0], [0.04, 0], [0.04, 0.09]]
    >>> cup = trimesh.creation.revolve([*outer, [0.034, 0.09], [0.034, 0.006], [0, 0.006]])
    >>> type(fit_shape(partial_view(cup, look_at(0.0, 35.0, target=cup)), table=0.0)).__name__
    'HollowShape'
    """

    inner: ShapeGP

    @classmethod
    @checked(gradients=True)
    def join(cls, outer: ShapeGP, inner: ShapeGP, cloud: PointCloud) -> "HollowShape":
        """Return the vessel of two surfaces with the same `center` and `scale`.

        Args:
            outer: the outer surface; its signed distance is positive outside.
            inner: the inner surface; its signed distance is positive in the cavity.
            cloud: the seen points [m] of both surfaces, in the frame of `center`.
        """
        fields = common_fields(outer, ShapeGP)
        fields["cloud"] = cloud
        fields["domain_radius"] = min(outer.domain_radius, inner.domain_radius)
        return cls(**fields, inner=inner)

    @cached_property
    def outer(self) -> ShapeGP:
        """The outer surface alone, as if the vessel were solid."""
        return ShapeGP(**common_fields(self, ShapeGP))

    @property
    def walls(self) -> tuple[ShapeGP, ...]:
        """The two surfaces of the vessel: (outer, inner)."""
        return self.outer, self.inner

    @checked(gradients=True)
    def wall_at(self, x: Queries) -> Bool[Tensor, "q walls"]:
        """Return which surface determines the signed distance at each of q points `x` (q, 3) that
        `normalise` returned.

        The result is a mask (q, 2) with the columns outer and inner. Each row has one True: the
        surface with the greater mean signed distance. The outer distance is positive outside the
        vessel, and the inner one in its cavity. So the greater of both is that of the material.
        """
        inner = self.inner.mean(x) > self.outer.mean(x)
        return torch.stack([~inner, inner], 1)

    @checked(gradients=True)
    def mean(self, x: Queries) -> Float[Tensor, "q"]:
        """Return the mean signed distance (q,) at q points `x` (q, 3) that `normalise` returned.

        It is the greater of two signed distances, from the outer and from the `inner` surface. So
        it is positive outside the vessel and in its cavity, and negative in the wall. It is
        normalised: one unit is `scale` [m].
        """
        return torch.maximum(self.outer.mean(x), self.inner.mean(x))

    @checked(gradients=True)
    def mean_and_gradient(self, x: Queries) -> MeanAndGradient:
        """Return (distance, gradient): the mean signed distance (q,) and its gradient (q, 3).

        They are at q points `x` (q, 3) that `normalise` returned. The distance is normalised: one
        unit is `scale` [m]. The gradient is with respect to normalised coordinates (no unit).
        """
        a, slope_a = self.outer.mean_and_gradient(x)
        b, slope_b = self.inner.mean_and_gradient(x)
        slope = torch.where((b > a)[:, None], slope_b, slope_a)
        return torch.maximum(a, b), slope

    @checked(gradients=True)
    def estimate(self, x: Queries) -> Moments:
        """Return (mean, covariance) of signed distance and gradient (d, w) at each of q points `x`.

        The points `x` (q, 3) are those that `normalise` returned. The mean is (q, 4) and the
        covariance (q, 4, 4), both normalised: one unit is `scale` [m]. They are those of the
        surface that applies at each point (`wall_at`).
        """
        parts, merge = self._by_wall(x, lambda wall, own: wall.estimate(own))
        return tuple(map(merge, *parts))  # pyright: ignore[reportReturnType]

    @checked(gradients=True)
    def variance(self, x: Queries) -> Float[Tensor, "q"]:
        """Return the variance (q,) of the signed distance at q points `x` (q, 3) that `normalise`
        returned.

        The variance is that of the surface that applies at each point (`wall_at`). It is in squared
        normalised units: one unit is `scale` [m]. It is not calibrated; `predict(...).std_m` is.
        """
        parts, merge = self._by_wall(x, lambda wall, own: wall.variance(own))
        return merge(*parts)

    @checked(gradients=True)
    def jet(self, x: Queries) -> SurfaceJet:
        """Return mean and variance of the signed distance with derivatives, at q points `x` (q, 3).

        The points are those that `normalise` returned. The mean has first and second derivatives,
        the variance the first. All are normalised: one unit is `scale` [m]. The fields of the
        `SurfaceJet` are `distance` (q,), `gradient` (q, 3), `hessian` (q, 3, 3), `variance` (q,)
        and `variance_gradient` (q, 3).
        """
        parts, merge = self._by_wall(x, lambda wall, own: wall.jet(own))
        return map_tensors(merge, *parts)

    @checked(gradients=True)
    def mean_jet(self, x: Queries) -> MeanJet:
        """Return the mean signed distance with first and second derivatives, at q points `x`
        (q, 3).

        The points are those that `normalise` returned. The result is normalised: one unit is
        `scale` [m]. The fields of the `MeanJet` are `distance` (q,), `gradient` (q, 3) and
        `hessian` (q, 3, 3).
        """
        parts, merge = self._by_wall(x, lambda wall, own: wall.mean_jet(own))
        return map_tensors(merge, *parts)

    @checked(gradients=True)
    def joint_at(self, x: Float[Tensor, "k 3"]) -> JointEstimate:
        """Return the joint posterior of signed distance and gradient (d, w) at k points `x` (k, 3).

        The points are those that `normalise` returned. The result is normalised: one unit is
        `scale` [m]. Points at which different surfaces apply have covariance 0. `joint` does the
        same for points [m]. But it limits their number, and refuses points outside the domain, the
        ball in which the shape is valid.
        """
        outer = self.outer.joint_at(x)
        inner = self.inner.joint_at(x)
        owner = self.wall_at(x)
        mean = torch.where(owner[:, 1:], inner.mean, outer.mean)
        # points of different surfaces have independent errors
        own = [rows[:, None] & rows for rows in owner.repeat_interleave(4, 0).T]
        return JointEstimate(mean, outer.covariance * own[0] + inner.covariance * own[1])

    def _scale_deviations(self, factor: float) -> "HollowShape":
        """Return the shape with all standard deviations of both surfaces times a factor."""
        inner = dataclasses.replace(self.inner, std_factor=factor * self.inner.std_factor)
        return dataclasses.replace(self, std_factor=factor * self.std_factor, inner=inner)

    @checked
    def append(self, new: Observations) -> "HollowShape":
        """Return the vessel given further observations, in addition to all earlier ones.

        They are in the vessel's normalised frame: one unit is `scale` [m]. Each observation changes
        one surface, outer or inner: the one that applies at its point (`wall_at`). The observed
        distance is the signed distance from this surface, positive outside the vessel and in its
        cavity. The observed normal points there, too, away from the material. `cloud` and the
        domain, the ball in which the posterior is valid, do not change.

        Raises `BadArgument` for an observed normal that is no unit vector. Raises
        `IndefiniteCovariance` if the covariance of the observations is not positive definite. It
        may be so for observations far outside the domain.
        """
        outer, inner = self.wall_at(new.x).T
        new_outer = self.outer.append(new[outer])
        new_inner = self.inner.append(new[inner])
        return self.join(new_outer, new_inner, self.cloud)

    @checked
    def moved(self, b_from_a: Pose) -> "HollowShape":
        """Return the vessel in frame b, given the rigid transform `b_from_a` (4, 4) [m].

        Frame a is that of this shape's `cloud`; a point p of frame a is `b_from_a` p in frame b.

        Raises `BadArgument` for a transform that is not rigid.
        """
        outer = self.outer.moved(b_from_a)
        return self.join(outer, self.inner.moved(b_from_a), outer.cloud)

    def _by_wall(
        self,
        x: Queries,
        evaluate: Callable[[ShapeGP, Tensor], Found],
    ) -> tuple[list[Found], Callable[..., Tensor]]:
        """Evaluate each wall at the points where it applies; also return a function that merges
        results in order.
        """
        if not (self._is_plain(x) and self.inner._is_plain(x)):
            inner = self.wall_at(x)[:, 1]
            walls = [evaluate(wall, x) for wall in self.walls]
            return walls, lambda a, b: torch.where(inner.reshape(-1, *[1] * (a.ndim - 1)), b, a)
        rows = [flatnonzero(own) for own in self.wall_at(x).T]
        back = torch.argsort(torch.cat(rows))
        walls = [evaluate(wall, x[own]) for wall, own in zip(self.walls, rows, strict=True)]
        return walls, lambda *parts: torch.cat(parts)[back]


def tie_walls(shape: HollowShape, middle: Middle) -> HollowShape:
    """Return the vessel after adding observations that give its wall the thickness
    `middle.thickness`.

    `middle` also holds points in the middle of the wall. Two independent surfaces might touch,
    which tears holes into the wall. In the wall's middle the signed distances from both surfaces
    must sum to minus the thickness. In a floor, which may be thicker, the sum may be less. Where
    they do not, the less certain surface gets an observed distance that follows from the more
    certain one.
    """
    x = middle.x
    thickness = middle.thickness
    noise = TIE_WALLS.noise / shape.scale
    for _ in range(TIE_WALLS.rounds):
        distance = torch.stack([wall.mean(x) for wall in shape.walls])
        short = distance.sum(0) + thickness
        off = torch.where(middle.side, short.abs(), short)
        rows = flatnonzero(off > TIE_WALLS.off / shape.scale)
        if not len(rows):
            break
        rows = rows[torch.argsort(off[rows], descending=True, stable=True)]
        rows = rows[pick_apart(x[rows], TIE_WALLS.points)]
        variance = torch.stack([wall.variance(x[rows]) for wall in shape.walls])
        walls = []
        for wall, own, other, beyond in zip(
            shape.walls, variance, variance.flip(0), distance.flip(0), strict=True
        ):
            known = off_surface(x[rows], -thickness - beyond[rows], noise)
            spread = torch.sqrt(shape.std_factor**2 * other + noise**2)
            known = dataclasses.replace(known, distance_noise=spread)[own >= other]
            walls.append(wall.append(known) if len(known) else wall)
        shape = HollowShape.join(walls[0], walls[1], shape.cloud)
    return shape
