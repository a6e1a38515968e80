"""The contact planning problem, Eqs. (10)-(14), for a batch of triples.

Unknowns x of a triple are its normalised points (3, 3) and the tensions (3) of its triangle's sides. Eq. (11) defines
the normals. Eq. (13) asks for balanced forces in the friction cones. Three forces balance if and only if each is the
sum of the pulls along the two sides at its contact [1]. So W phi = 0 holds whatever the tensions; one inequality for
each cone is left. Every inequality is a bound <= 0.

[1] Yoshikawa and Nagai, IEEE Trans. Robotics and Automation 7, 1991.
"""

import dataclasses
import math
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Batch, map_tensors
from torchgrasp.plan.wrench import Vectors
from torchgrasp.plane import Plane
from torchgrasp.shape.posterior import SurfaceJet
from torchgrasp.specs import ContactSpec

INSIDE = 0.99
"""Inequalities are solved to this share of their bound: the last steps onto the surface stay inside it."""
CONE_MARGIN = 0.02
"""The cosine between force and inward normal exceeds that of the cone by this much: strictly inside, as phi > 0."""
LEAST_SIDE = 0.05
"""Least distance of two tip centres, normalised: coincident ones balance, but their wrenches lack rank."""


@runtime_checkable
class Shape(Protocol):
    """A `ShapeGP`, or another implicit surface with an uncertainty."""

    @property
    def scale(self) -> float: ...  # noqa: D102
    @property
    def domain_radius(self) -> float: ...  # noqa: D102
    @property
    def std_factor(self) -> float: ...  # noqa: D102
    def jet(self, x: Float[Tensor, "q 3"]) -> SurfaceJet: ...  # noqa: D102
    def mean_and_gradient(self, x: Float[Tensor, "q 3"]) -> tuple[Float[Tensor, "q"], Float[Tensor, "q 3"]]: ...  # noqa: D102
    def normalise(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]: ...  # noqa: D102
    def metres(self, x: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]: ...  # noqa: D102


def device_of(shape: Shape) -> torch.device:
    """Return the device of a shape, by default the CPU."""
    return getattr(shape, "device", torch.device("cpu"))


def walls_of(shape: Shape) -> tuple[Shape, ...]:
    """Return the surfaces of a shape, each as a shape: two of an open vessel, else the shape itself."""
    return getattr(shape, "walls", (shape,))


def triple_jet(shape: Shape, points: Vectors) -> SurfaceJet:
    """Evaluate the shape at all points of all triples."""
    return map_tensors(lambda x: x.unflatten(0, points.shape[:2]), shape.jet(points.flatten(0, 1)))


@dataclasses.dataclass(frozen=True)
class Constraints(Batch):
    """Values of the constraints, and Jacobians by nine coordinates and three tensions.

    `bounds` are three each: cones, variances, domain, sides, and with a table heights.
    """

    centre: Float[Tensor, "b 3"]
    surface: Float[Tensor, "b 3"]
    bounds: Float[Tensor, "b k"]
    centre_by_x: Float[Tensor, "b 3 12"]
    surface_by_x: Float[Tensor, "b 3 12"]
    bounds_by_x: Float[Tensor, "b k 12"]

    @property
    def values(self) -> Float[Tensor, "b r"]:
        """Centre, surface and bounds, one after the other."""
        return torch.cat([self.centre, self.surface, self.bounds], 1)

    @property
    def jacobian(self) -> Float[Tensor, "b r 12"]:
        """The derivatives of `values`."""
        return torch.cat([self.centre_by_x, self.surface_by_x, self.bounds_by_x], 1)


def forces_from_tensions(points: Vectors, tension: Float[Tensor, "b 3"]) -> tuple[Vectors, Vectors]:
    """Return the forces on the object at the contacts, and the sides from each contact to the next.

    A tension pulls the ends of its side together, in proportion to its length.
    """
    sides = points.roll(-1, 1) - points
    pull = tension[..., None] * sides
    return pull - pull.roll(1, 1), sides


@dataclasses.dataclass(frozen=True)
class ContactProblem:
    """Eqs. (10)-(14) and the margins of `ContactSpec`, in the normalised units of one shape.

    `friction` is that of the round cone inside the cone with edges. `separation` is at least `LEAST_SIDE`.
    """

    friction: float
    max_variance: float
    domain_radius: float
    separation: float
    table: Plane | None
    tip_radius: float

    @classmethod
    def of(cls, shape: Shape, spec: ContactSpec) -> "ContactProblem":
        """Return the problem of a shape and a specification."""
        table, scale = spec.plane, float(shape.scale)
        if table is not None:
            foot = table.offset * table.normal
            table = Plane(table.normal, float(shape.normalise(foot) @ table.normal)).to(device_of(shape))
        return cls(
            friction=spec.planned_friction * math.cos(math.pi / spec.edges),
            max_variance=spec.max_variance,
            domain_radius=float(shape.domain_radius),
            separation=max(spec.least_separation / scale, LEAST_SIDE),
            table=table,
            tip_radius=spec.fingertip_radius / scale,
        )

    def room(self, points: Float[Tensor, "*b 3"], normals: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Return how much higher contacts are than they must be: at 0 a round fingertip rests on the table."""
        if self.table is None:
            return torch.full_like(points[..., 0], math.inf)
        slant = 1 - normals @ self.table.normal.to(normals)
        return self.table.height(points) - self.tip_radius * slant

    def sides(self, points: Float[Tensor, "*b 3 3"], normals: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3 3"]:
        """Return the sides of the triangle of the tips' centres, from each to the next."""
        centres = points + self.tip_radius * normals
        return centres.roll(-1, -2) - centres

    def constraints(self, points: Vectors, tension: Float[Tensor, "b 3"], jet: SurfaceJet) -> Constraints:
        """Evaluate all constraints and their Jacobians; `jet` is the shape at the points."""
        b, identity = len(points), torch.eye(3, dtype=points.dtype, device=points.device)
        threshold, ball = self.max_variance * INSIDE, self.domain_radius * INSIDE
        half_slope = 2 * threshold**0.5  # slope of the variance at the threshold, for a linear standard deviation
        sides = self.sides(points, jet.normals)
        length = torch.linalg.vector_norm(sides, dim=-1)
        cones, cones_by_x = self._cones(points, tension, jet)
        values = [
            cones,
            (jet.variance - threshold) / half_slope,
            ((points * points).sum(-1) - ball**2) / (2 * ball),
            self.separation / INSIDE - length,
        ]
        along, centre_by_point = (
            (sides / length[..., None])[..., None, :],
            identity + self.tip_radius * jet.normal_jacobian,
        )
        one, other = (_by_own_point((along @ x)[..., 0, :]) for x in (centre_by_point, centre_by_point.roll(-1, 1)))
        points_part, tension_part = other.split([9, 3], 2)
        sides_by_x = one - torch.cat([points_part.roll(3, 2), tension_part], 2)  # a side's other end
        jacobians = [
            cones_by_x,
            _by_own_point(jet.variance_gradient / half_slope),
            _by_own_point(points / ball),
            sides_by_x,
        ]
        if self.table is not None:
            up = self.table.normal.to(points)
            values.append((1 - INSIDE) * 0.1 - self.room(points, jet.normals))
            jacobians.append(_by_own_point(-(up @ centre_by_point)))
        return Constraints(
            centre=points.mean(1),
            surface=jet.distance,
            bounds=torch.cat(values, 1),
            centre_by_x=torch.cat([identity.repeat(1, 3) / 3, torch.zeros_like(identity)], 1).expand(b, 3, 12),
            surface_by_x=_by_own_point(jet.gradient),
            bounds_by_x=torch.cat(jacobians, 1),
        )

    def _cones(
        self, points: Vectors, tension: Float[Tensor, "b 3"], jet: SurfaceJet
    ) -> tuple[Float[Tensor, "b 3"], Float[Tensor, "b 3 12"]]:
        """Return by how much each force leaves its cone, as a cosine.

        With u = f / |f| the bound is n.u + cosine. Its derivatives are (1 - u u^T) n / |f| by the force, and u by the
        normal, which turns with its point.
        """
        normals = jet.normals
        force, sides = forces_from_tensions(points, tension)
        size = torch.linalg.vector_norm(force, dim=-1, keepdim=True)
        direction = force / size
        outward = (normals * direction).sum(-1, keepdim=True)
        by_force = (normals - outward * direction) / size
        steep = torch.linalg.vector_norm(jet.gradient, dim=-1, keepdim=True)
        across = (direction - outward * normals) / steep  # (1 - n n^T) u / |g|, which the Hessian carries to the point
        by_point = (across[..., None, :] @ jet.hessian)[..., 0, :]
        before = tension.roll(1, 1)
        blocks = by_force.new_zeros(len(points), 3, 4, 3)
        for i in range(3):
            after, other = (i + 1) % 3, (i + 2) % 3
            blocks[:, i, i] = by_point[:, i] - (tension[:, i] + before[:, i])[:, None] * by_force[:, i]
            blocks[:, i, after] = tension[:, i, None] * by_force[:, i]
            blocks[:, i, other] = before[:, i, None] * by_force[:, i]
            blocks[:, i, 3, i] = (by_force[:, i] * sides[:, i]).sum(-1)
            blocks[:, i, 3, other] = -(by_force[:, i] * sides[:, other]).sum(-1)
        cosine = 1 / math.sqrt(1 + self.friction**2)
        return outward[..., 0] + cosine + CONE_MARGIN, blocks.flatten(2)


def _by_own_point(slope: Vectors) -> Float[Tensor, "b 3 12"]:
    """Return the Jacobian of three values, each of its own point alone."""
    jacobian = slope.new_zeros(len(slope), 3, 12)
    for i in range(3):
        jacobian[:, i, 3 * i : 3 * i + 3] = slope[:, i]
    return jacobian
