"""The contact planning problem, Eqs. (10)-(14), for a batch of contact triples: rows and their analytic Jacobian.

Unknowns of a triple are its points (3, 3) in normalised units and the logits z (3, e) of its coefficients
phi = floor + (1 - 3 e floor) softmax(z): their sum is 1 and every one is positive, exactly, as Eq. (13) wants.
Normals are not unknowns: Eq. (11) defines them by the points. Every inequality is written as a row <= 0.
"""

import dataclasses
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Batch
from torchgrasp.frames import skew
from torchgrasp.linalg import unit
from torchgrasp.plan.wrench import cone_edges
from torchgrasp.specs import ContactSpec

UNIFORM_SHARE = 0.05
"""Least coefficient of a plan as a share of the uniform 1 / (3 e): the least margin of its certificate. Without it the
smallest coefficient ends near 1e-10, closure in name only."""

INSIDE = 0.99
"""Inequalities are solved to this share of their bound, so that the last steps onto the surface stay inside."""


@runtime_checkable
class Jet(Protocol):
    """The shape's mean and variance at query points with their derivatives, in normalised units."""

    @property
    def distance(self) -> Tensor: ...  # noqa: D102
    @property
    def gradient(self) -> Tensor: ...  # noqa: D102
    @property
    def hessian(self) -> Tensor: ...  # noqa: D102
    @property
    def variance(self) -> Tensor: ...  # noqa: D102
    @property
    def variance_gradient(self) -> Tensor: ...  # noqa: D102


@runtime_checkable
class Shape(Protocol):
    """What the planner asks of a shape: a `ShapeGP`, or any other implicit surface with an uncertainty."""

    @property
    def scale(self) -> float: ...  # noqa: D102
    @property
    def domain_radius(self) -> float: ...  # noqa: D102
    @property
    def std_factor(self) -> float: ...  # noqa: D102
    def jet(self, x: Float[Tensor, "q 3"]) -> Jet: ...  # noqa: D102
    def normalise(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]: ...  # noqa: D102
    def metres(self, x: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]: ...  # noqa: D102


@dataclasses.dataclass(frozen=True)
class TripleJet(Batch):
    """The shape at the three points of each triple."""

    distance: Float[Tensor, "b 3"]
    gradient: Float[Tensor, "b 3 3"]
    hessian: Float[Tensor, "b 3 3 3"]
    variance: Float[Tensor, "b 3"]
    variance_gradient: Float[Tensor, "b 3 3"]

    @property
    def normals(self) -> Float[Tensor, "b 3 3"]:
        """The outward unit normals, Eq. (11): the posterior gradient is not of length 1 and is normalised."""
        return unit(self.gradient)


def triple_jet(shape: Shape, points: Float[Tensor, "b 3 3"]) -> TripleJet:
    """Evaluate the shape at all points of all triples."""
    jet = shape.jet(points.flatten(0, 1))
    fields = (jet.distance, jet.gradient, jet.hessian, jet.variance, jet.variance_gradient)
    return TripleJet(*(f.unflatten(0, points.shape[:2]) for f in fields))


@dataclasses.dataclass(frozen=True)
class Rows(Batch):
    """Values and Jacobians of the problem's rows at a batch of triples, linear in the step of the points and z."""

    surface: Float[Tensor, "b 3"]
    closure: Float[Tensor, "b 6"]
    centre: Float[Tensor, "b 3"]
    bounds: Float[Tensor, "b k"]
    surface_by_points: Float[Tensor, "b 3 9"]
    closure_by_points: Float[Tensor, "b 6 9"]
    closure_by_z: Float[Tensor, "b 6 m"]
    centre_by_points: Float[Tensor, "b 3 9"]
    bounds_by_points: Float[Tensor, "b k 9"]


@dataclasses.dataclass(frozen=True)
class ContactProblem:
    """Eqs. (10)-(14) and the margins of `ContactSpec`, in the normalised units of one shape.

    `lowest` is the least z coordinate of a contact, or None without a table; `separation` 0 means none.
    """

    friction: float
    edges: int
    max_variance: float
    domain_radius: float
    separation: float
    lowest: float | None

    @classmethod
    def of(cls, shape: Shape, spec: ContactSpec) -> "ContactProblem":
        """Return the problem of a shape and a specification."""
        lowest = None
        if spec.table is not None:
            level = torch.tensor([0.0, 0.0, spec.table + spec.contact_height], dtype=torch.float64)
            lowest = float(shape.normalise(level)[2])
        return cls(
            friction=spec.planned_friction,
            edges=spec.edges,
            max_variance=spec.max_variance,
            domain_radius=float(shape.domain_radius),
            separation=spec.separation / float(shape.scale),
            lowest=lowest,
        )

    @property
    def floor(self) -> float:
        """The least coefficient."""
        return UNIFORM_SHARE / (3 * self.edges)

    def coefficients(self, z: Float[Tensor, "b 3 e"]) -> Float[Tensor, "b 3 e"]:
        """Return phi of the logits: at least `floor`, of sum 1."""
        soft = torch.softmax(z.flatten(1), -1).unflatten(1, z.shape[1:])
        return self.floor + (1 - UNIFORM_SHARE) * soft

    def rows(
        self,
        points: Float[Tensor, "b 3 3"],
        z: Float[Tensor, "b 3 e"],
        tangent: Float[Tensor, "b 3 3"],
        jet: TripleJet,
    ) -> Rows:
        """Evaluate all rows and their Jacobians.

        Args:
            points: contacts, normalised.
            z: logits of the coefficients.
            tangent: a tangent at each contact; it is made perpendicular to the normal, and carried along (parallel
                transport) by the Jacobian, so that no seam of a frame field enters the derivatives.
            jet: the shape at the points.
        """
        b = len(points)
        normals = jet.normals
        first = carry(tangent, normals)
        edge = cone_edges(normals, first, self.friction, self.edges)  # (b, 3, e, 3)
        phi = self.coefficients(z)
        wrench = torch.cat([edge, torch.linalg.cross(points[:, :, None].expand_as(edge), edge)], -1).flatten(1, 2)
        force = (phi[..., None] * edge).sum(2)  # (b, 3, 3)
        torque = torch.linalg.cross(points, force)
        closure = torch.cat([force, torque], -1).sum(1)

        # Each force turns with its normal: dF = (push I - n lean^T) dn, for push along n and the tangential lean.
        push = (force * normals).sum(-1)
        lean = force - push[..., None] * normals
        identity = torch.eye(3, dtype=points.dtype, device=points.device)
        by_normal = push[..., None, None] * identity - normals[..., :, None] * lean[..., None, :]
        length = torch.linalg.vector_norm(jet.gradient, dim=-1)[..., None, None]
        turn = (identity - normals[..., :, None] * normals[..., None, :]) @ jet.hessian / length
        force_by_point = by_normal @ turn
        torque_by_point = skew(points) @ force_by_point - skew(force)
        closure_by_points = torch.cat([force_by_point, torque_by_point], 2).permute(0, 2, 1, 3).reshape(b, 6, 9)

        soft = torch.softmax(z.flatten(1), -1)
        mean = (soft[..., None] * wrench).sum(1, keepdim=True)
        closure_by_z = (1 - UNIFORM_SHARE) * (soft[..., None] * (wrench - mean)).mT

        bounds, bounds_by_points = self._bounds(points, jet)
        return Rows(
            surface=jet.distance,
            closure=closure,
            centre=points.mean(1),
            bounds=bounds,
            surface_by_points=_one_point_each(jet.gradient),
            closure_by_points=closure_by_points,
            closure_by_z=closure_by_z,
            centre_by_points=identity.repeat(1, 3).expand(b, 3, 9) / 3,
            bounds_by_points=bounds_by_points,
        )

    def _bounds(
        self, points: Float[Tensor, "b 3 3"], jet: TripleJet
    ) -> tuple[Float[Tensor, "b k"], Float[Tensor, "b k 9"]]:
        """Return the inequality rows, each scaled to a length near its bound: variance, ball, separation, table."""
        threshold, ball = self.max_variance * INSIDE, self.domain_radius * INSIDE
        half_slope = 2 * threshold**0.5  # the slope of variance at the threshold, for a deviation that grows linearly
        values = [(jet.variance - threshold) / half_slope, ((points * points).sum(-1) - ball**2) / (2 * ball)]
        slopes = [_one_point_each(jet.variance_gradient / half_slope), _one_point_each(points / ball)]
        if self.separation > 0:
            wanted = self.separation / INSIDE
            after = points.roll(-1, 1)
            apart = points - after
            values.append((wanted**2 - (apart * apart).sum(-1)) / (2 * wanted))
            blocks = _one_point_each(-apart / wanted)
            slopes.append(blocks - blocks.unflatten(2, (3, 3)).roll(1, 2).flatten(2))
        if self.lowest is not None:
            values.append(self.lowest - points[..., 2] + (1 - INSIDE) * 0.1)
            down = torch.zeros_like(points)
            down[..., 2] = -1.0
            slopes.append(_one_point_each(down))
        return torch.cat(values, 1), torch.cat(slopes, 1)


def carry(tangent: Float[Tensor, "b 3 3"], normals: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b 3 3"]:
    """Carry tangents to turned normals without spin (parallel transport for small turns)."""
    return unit(tangent - (tangent * normals).sum(-1, keepdim=True) * normals)


def _one_point_each(slope: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b 3 9"]:
    """Lay out the Jacobian of three rows of which row i depends on point i alone."""
    identity = torch.eye(3, dtype=slope.dtype, device=slope.device)
    return torch.einsum("bij,ik->bikj", slope, identity).flatten(2)
