"""The shape of an open vessel: an outer body from which the space inside the inner surface is cut out."""

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value, join, map_tensors
from torchgrasp.checks import Pose, checked
from torchgrasp.geometry.linalg import farthest_points, fibonacci_sphere
from torchgrasp.shape.completion.complete import LEAST_NOISE, correlated_errors
from torchgrasp.shape.completion.silhouette import TIE, Outlines
from torchgrasp.shape.completion.vessel import FORM_ERROR, RIM, HiddenWall, Vessel, Wall, complete_walls, lid
from torchgrasp.shape.gp import ShapeGP, common_fields
from torchgrasp.shape.support import (
    HIDDEN_NORMAL_NOISE,
    NORMAL_NOISE,
    OUTER_POINTS,
    OUTER_RADIUS,
    RIM_NOISE,
    STD_FACTORS,
    Part,
    Support,
    frame_around,
    free_space,
    observe,
)
from torchgrasp.shape.values import JointEstimate, MeanJet, Normalisation, Observations, SurfaceJet, off_surface
from torchgrasp.values import PointCloud

Found = TypeVar("Found")


@dataclasses.dataclass(frozen=True)
class HollowShape(ShapeGP):
    """The shape of an open vessel: the material between an outer and an inner surface, each a Gaussian process.

    A single smooth field cannot change its sign twice within a thin wall. At every point the surface with the greater
    mean distance gives distance, normal and covariance. Errors of the two surfaces are independent.

    Args:
        inner: the inner surface, positive inside the vessel and negative around it.

    >>> import trimesh
    >>> from torchgrasp import fit_shape
    >>> from torchgrasp.cloud import look_at, partial_view
    >>> outline = [[0, 0], [0.04, 0], [0.04, 0.09], [0.034, 0.09], [0.034, 0.006], [0, 0.006]]
    >>> cup = trimesh.creation.revolve(outline)  # radius and height [m]
    >>> shape = fit_shape(partial_view(cup, look_at(0.0, 35.0, target=cup)), table=0.0)
    >>> shape.predict(torch.tensor([[0.0, 0.0, 0.06], [0.037, 0.0, 0.06]]).double()).distance > 0
    tensor([ True, False])
    """

    inner: ShapeGP

    @classmethod
    @checked
    def join(cls, outer: ShapeGP, inner: ShapeGP, cloud: PointCloud) -> "HollowShape":
        """Return the vessel with two surfaces in the same normalised frame; `cloud` holds the seen points of both."""
        radius = min(outer.domain_radius, inner.domain_radius)
        return cls(**common_fields(outer, ShapeGP) | {"cloud": cloud, "domain_radius": radius}, inner=inner)

    @cached_property
    def outer(self) -> ShapeGP:
        """The outer surface alone, as if the vessel were solid."""
        return ShapeGP(**common_fields(self, ShapeGP))

    @property
    def walls(self) -> tuple[ShapeGP, ...]:
        """The outer and the inner surface."""
        return self.outer, self.inner

    @checked(gradients=True)
    def wall_at(self, x: Float[Tensor, "q 3"]) -> Bool[Tensor, "q walls"]:
        """Return whether the outer or the inner surface applies at normalised points."""
        inner = self.inner.mean(x) > self.outer.mean(x)
        return torch.stack([~inner, inner], 1)

    @checked(gradients=True)
    def mean(self, x: Float[Tensor, "q 3"]) -> Float[Tensor, "q"]:
        """Return the mean signed distance at normalised points."""
        return torch.maximum(self.outer.mean(x), self.inner.mean(x))

    @checked(gradients=True)
    def mean_and_gradient(self, x: Float[Tensor, "q 3"]) -> tuple[Float[Tensor, "q"], Float[Tensor, "q 3"]]:
        """Return the mean signed distance and its gradient at normalised points."""
        (a, slope_a), (b, slope_b) = (wall.mean_and_gradient(x) for wall in self.walls)
        return torch.maximum(a, b), torch.where((b > a)[:, None], slope_b, slope_a)

    @checked
    def estimate(self, x: Float[Tensor, "q 3"]) -> tuple[Float[Tensor, "q 4"], Float[Tensor, "q 4 4"]]:
        """Return mean and covariance of distance and gradient (d, w) at normalised points."""
        parts, merge = self._by_wall(x, lambda wall, own: wall.estimate(own))
        return tuple(map(merge, *parts))  # pyright: ignore[reportReturnType]

    @checked
    def jet(self, x: Float[Tensor, "q 3"]) -> SurfaceJet:
        """Return mean and variance of the distance with derivatives, at normalised points."""
        parts, merge = self._by_wall(x, lambda wall, own: wall.jet(own))
        return map_tensors(merge, *parts)

    @checked
    def mean_jet(self, x: Float[Tensor, "q 3"]) -> MeanJet:
        """Return the mean distance with derivatives, at normalised points."""
        parts, merge = self._by_wall(x, lambda wall, own: wall.mean_jet(own))
        return map_tensors(merge, *parts)

    @checked
    def joint_at(self, x: Float[Tensor, "k 3"]) -> JointEstimate:
        """Return the joint posterior of distance and gradient (d, w) at normalised points."""
        parts, owner = [wall.joint_at(x) for wall in self.walls], self.wall_at(x)
        mean = torch.where(owner[:, 1:], parts[1].mean, parts[0].mean)
        covariance = torch.zeros_like(parts[0].covariance)
        for part, own in zip(parts, owner.repeat_interleave(4, 0).T, strict=True):
            covariance += part.covariance * (own[:, None] & own)
        return JointEstimate(mean, covariance)

    @checked
    def append(self, new: Observations) -> "HollowShape":
        """Return the shape given further normalised observations; each belongs to the wall at its point."""
        outer, inner = self.wall_at(new.x).T
        return self.join(self.outer.append(new[outer]), self.inner.append(new[inner]), self.cloud)

    @checked
    def moved(self, b_from_a: Pose) -> "HollowShape":
        """Return the shape transformed from frame a to frame b [m]."""
        outer = self.outer.moved(b_from_a)
        return self.join(outer, self.inner.moved(b_from_a), outer.cloud)

    def _by_wall(
        self, x: Float[Tensor, "q 3"], evaluate: Callable[[ShapeGP, Tensor], Found]
    ) -> tuple[list[Found], Callable[..., Tensor]]:
        """Evaluate each wall at the points where it is the surface; also return the function that merges the rows."""
        rows = [torch.nonzero(own)[:, 0] for own in self.wall_at(x).T]
        back = torch.argsort(torch.cat(rows))
        return [evaluate(w, x[own]) for w, own in zip(self.walls, rows, strict=True)], lambda *y: torch.cat(y)[back]


@dataclasses.dataclass(frozen=True)
class Middle(Value):
    """Points in the middle of a vessel's wall and its thickness, normalised; the wall is thicker unless `side`."""

    x: Float[Tensor, "n 3"]
    side: Bool[Tensor, "n"]
    thickness: float


def vessel_supports(
    cloud: PointCloud, vessel: Vessel, outline: Outlines, table: float, noise: float
) -> tuple[Support, Support, Middle]:
    """Return observations of a vessel's outer and inner surface besides the seen points, and points amid the wall.

    `noise` is that of an anchor's distance, normalised. Distances of the inner surface are positive around the axis.
    """
    device, cloud = cloud.points.device, cloud.to("cpu")
    frame = frame_around(cloud.points)
    outer, inner = complete_walls(cloud, vessel, outline, table)
    hidden = join([outer.hidden, lid(vessel)])
    axis = torch.cat([vessel.center, torch.zeros(1, dtype=torch.float64)])
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    sphere = frame.metres(OUTER_RADIUS * fibonacci_sphere(OUTER_POINTS))

    def anchors(points: Float[Tensor, "n 3"], distance: Float[Tensor, "n"]) -> Observations:
        return off_surface(frame.normalise(points), distance / frame.scale, noise)

    surface = torch.cat([cloud.points[outer.seen], hidden.points])
    middle = (axis + 0.5 * (table + vessel.rim) * up)[None]
    depth = torch.minimum(torch.cdist(middle, surface).amin(1), middle[:, 2] - table)
    body = anchors(torch.cat([middle, sphere]), torch.cat([-depth, torch.cdist(sphere, surface).amin(1)]))
    rim = observe(frame, outline.rim, outline.rim_normals, RIM_NOISE, 2 * HIDDEN_NORMAL_NOISE)

    surface = torch.cat([cloud.points[inner.seen], inner.hidden.points])
    bottom = float(surface[:, 2].min())
    over = vessel.rim + 0.5 * vessel.radius  # there the inner surface still surrounds free space: it has no lid
    inside = axis + torch.tensor([0.5 * (bottom + vessel.rim), vessel.rim, over]).double()[:, None] * up
    around = sphere[sphere[:, 2] < vessel.rim]
    clear = torch.cat([torch.cdist(inside, surface).amin(1), -torch.cdist(around, surface).amin(1)])
    space = anchors(torch.cat([inside, around]), clear)

    def support(anchors: Observations, parts: list[Part], free: Any, rows: Tensor) -> Support:
        on_device = tuple((part.to(device), None if errors is None else errors.to(device)) for part, errors in parts)
        placed, factor = (frame.to(device), anchors.to(device), NORMAL_NOISE), STD_FACTORS["vessel", True]
        return Support(*placed, factor, on_device, free, rows.to(device), "vessel")

    free = free_space(outline, frame.to(device), table)
    return (
        support(body, [(rim, None), _observe_hidden(frame, hidden)], free, outer.seen),
        support(space, [_observe_hidden(frame, inner.hidden)], None, inner.seen),
        _middle(cloud, vessel, (outer, inner), frame).to(device),
    )


def tie_walls(shape: HollowShape, middle: Middle) -> HollowShape:
    """Return the vessel after adding observations that give its wall the known thickness.

    Two independent surfaces might touch, which tears holes into the wall. In its middle the two distances must add up
    to minus the thickness; otherwise the more certain surface gives an observation of the other.
    """
    x, thickness, noise = middle.x, middle.thickness, 0.0007 / shape.scale
    for _ in range(3):
        distance = torch.stack([wall.mean(x) for wall in shape.walls])
        short = distance.sum(0) + thickness
        off = torch.where(middle.side, short.abs(), short)
        rows = torch.nonzero(off > 0.0005 / shape.scale)[:, 0]
        if not len(rows):
            break
        rows = rows[torch.argsort(off[rows], descending=True, stable=True)]
        rows = rows[farthest_points(x[rows], 24, tie=TIE)]
        variance = torch.stack([wall.estimate(x[rows])[1][:, 0, 0] for wall in shape.walls])
        walls = []
        for wall, own, other, beyond in zip(shape.walls, variance, variance.flip(0), distance.flip(0), strict=True):
            known = off_surface(x[rows], -thickness - beyond[rows], noise)
            spread = torch.sqrt(shape.std_factor**2 * other + noise**2)
            known = dataclasses.replace(known, distance_noise=spread)[own >= other]
            walls.append(wall.append(known) if len(known) else wall)
        shape = HollowShape.join(walls[0], walls[1], shape.cloud)
    return shape


def _middle(cloud: PointCloud, vessel: Vessel, walls: tuple[Wall, Wall], frame: Normalisation) -> Middle:
    """Return points half a thickness behind both walls, without handles and rim."""
    assert cloud.normals is not None
    points, normals = [], []
    for wall, seen in zip(walls, (vessel.body & ~vessel.inner, vessel.inner), strict=True):
        points += [cloud.points[seen], wall.hidden.points]
        normals += [cloud.normals[seen], wall.hidden.normals]
    at, out = torch.cat(points), torch.cat(normals)
    below = at[:, 2] < vessel.rim - RIM
    at, out = at[below], out[below]
    rows = farthest_points(at, 150, tie=TIE)
    x = frame.normalise(at[rows] - 0.5 * vessel.thickness * out[rows])
    return Middle(x, out[rows, 2].abs() < 0.8, vessel.thickness / frame.scale)  # a floor may be thicker


def _observe_hidden(frame: Normalisation, wall: HiddenWall) -> Part:
    """Return observations of a wall's hidden points, and their correlated errors."""
    errors = correlated_errors(wall.points, wall.shared, FORM_ERROR)
    return observe(frame, wall.points, wall.normals, LEAST_NOISE, HIDDEN_NORMAL_NOISE), errors / frame.scale
