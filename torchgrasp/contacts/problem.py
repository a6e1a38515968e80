"""The contact planning problem, Eqs. (10)-(14) of the paper, for a batch of contact sets.

Unknowns x of a contact set are its f normalised points (f, 3) and p tensions. There is a tension
for each pair of points. The two points of a pair pull each other with the force tension times
distance. A jet is the value of a function at points, together with its derivatives. Eq. (11)
defines the normals. Eq. (13) asks for balanced forces in the friction cones. Three forces balance
if and only if each force is the sum of two pulls. They are along the two sides at its contact [1].
At four or five contacts, pulls between all pairs balance too. They give every balance unless the
contacts lie in one plane. So W phi = 0 in Eq. (13) holds for all tensions, and one inequality for
each friction cone is left. Every inequality has the form: value <= 0.

[1] Yoshikawa and Nagai, IEEE Trans. Robotics and Automation 7, 1991.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import NamedTuple, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.contacts.form_closure import Vectors
from torchgrasp.foundation.base import FINGERTIPS, Batch, map_tensors, spread
from torchgrasp.geometry.linalg import dot, eye_like, norm
from torchgrasp.geometry.plane import Plane, faces_of
from torchgrasp.shape.batch import ShapeBatch
from torchgrasp.shape.estimate import MeanJet, SurfaceJet
from torchgrasp.values.specs import ContactSpec

# inequalities are solved to this share of their bound: the last steps onto the surface stay inside
# it
INSIDE = 0.99
ROOM = 0.1  # bound (normalised) whose share keeps contacts above the table and inside a region
DIFFERENCE = 1e-4  # step (normalised) of differences: far below any region, far above rounding
# the cosine between force and inward normal exceeds that of the cone by this much
CONE_MARGIN = 0.02
# least distance of two tip centres, normalised: wrenches of coincident tips lack rank
LEAST_SIDE = 0.05


Tensions = Float[Tensor, "b p"]  # of all p pairs of contacts in each of b contact sets
PerRow = float | Float[Tensor, "b"]
"""One number for all contact sets of a batch, or one number for each of them."""


@runtime_checkable
class ShapeLike(Protocol):
    """The interface of a shape with uncertainty: a `ShapeGP`, or another implicit surface.

    `plan_contacts` takes any object with these methods. Normalised points are points of the cloud's
    frame, shifted and divided by `scale` [m]. Signed distances are negative inside the object.

    >>> from torchgrasp import fit_shape, load_object
    >>> shape = fit_shape(load_object("jug").view)
    >>> isinstance(shape, ShapeLike), shape.metres(shape.normalise(shape.cloud.points[:2])).shape
    (True, torch.Size([2, 3]))
    """

    @property
    def scale(self) -> PerRow:
        """The length [m] of one normalised unit: a number, or for a batch of shapes one for each
        (b,).
        """
        ...

    @property
    def domain_radius(self) -> PerRow:
        """The radius, normalised, of the ball about the normalised origin in which the shape is
        known: a number, or for a batch of shapes one for each (b,). One normalised unit is `scale`
        [m].
        """
        ...

    @property
    def std_factor(self) -> PerRow:
        """The factor (no unit) on the posterior's standard deviations that gives those of the true
        surface. It is a number, or for a batch of shapes one for each (b,).
        """
        ...

    def jet(self, x: Float[Tensor, "q 3"]) -> SurfaceJet:
        """Return mean and variance of the signed distance with their derivatives, at q normalised
        points `x` (q, 3).

        Results are normalised: one unit is `scale` [m]. The fields of the
        `torchgrasp.shape.SurfaceJet` are `distance` (q,), `gradient` (q, 3), `hessian` (q, 3, 3),
        `variance` (q,) and `variance_gradient` (q, 3).
        """
        ...

    def mean_and_gradient(
        self, x: Float[Tensor, "q 3"]
    ) -> tuple[Float[Tensor, "q"], Float[Tensor, "q 3"]]:
        """Return the mean signed distance (q,) at q normalised points `x` (q, 3), and its gradient
        (q, 3).

        The distance is normalised: one unit is `scale` [m]. The gradient has no unit.
        """
        ...

    def normalise(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Return points (*b, 3) [m] of the cloud's frame as normalised points (*b, 3), without
        unit.

        They are shifted to the normalised origin, then divided by `scale` [m]. The origin is the
        centre of the ball of `domain_radius` in which the shape is known. b stands for any batch
        axes.
        """
        ...

    def metres(self, x: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Return normalised points `x` (*b, 3) as points (*b, 3) [m] of the cloud's frame.

        b stands for any batch axes.
        """
        ...


AnyShape = TypeVar("AnyShape", bound=ShapeLike)


def device_of(shape: ShapeLike) -> torch.device:
    """Return the device of a shape; the CPU if the shape has no attribute `device`."""
    return getattr(shape, "device", torch.device("cpu"))


def rows_of(shape: AnyShape, rows: Int[Tensor, "k"]) -> AnyShape:
    """Return the shapes of some entries of a batch of shapes: those with the indices `rows` (k,).

    A single shape, which belongs to all entries of a batch, is returned as it is.
    """
    return shape.rows(rows) if isinstance(shape, ShapeBatch) else shape  # pyright: ignore[reportReturnType]


def walls_of(shape: AnyShape) -> tuple[AnyShape, ...]:
    """Return the surfaces of a shape, each as a shape.

    They are the outer and the inner wall of an open vessel, else the shape itself.
    """
    return getattr(shape, "walls", (shape,))


def walls_at(shape: AnyShape, points: Vectors) -> list[tuple[AnyShape, Bool[Tensor, "b f"]]]:
    """Return each surface (wall) of a shape, with a mask of the contacts that lie on it.

    `points` (b, f, 3) are normalised contacts.
    """
    walls = walls_of(shape)
    if len(walls) == 1:
        return [(walls[0], points.new_ones(points.shape[:2], dtype=torch.bool))]
    owner = getattr(shape, "wall_at")(points.flatten(0, 1))  # noqa: B009
    masks = owner.unflatten(0, points.shape[:2]).unbind(-1)
    return list(zip(walls, masks, strict=True))


def triple_jet(shape: ShapeLike, points: Vectors) -> SurfaceJet:
    """Return mean and variance of the signed distance at each contact, with their derivatives by
    the contact's position.

    `points` (b, f, 3) and the results are normalised: one unit is `shape.scale` [m]. The fields of
    the result have the leading axes (b, f).
    """
    jet = shape.jet(points.flatten(0, 1))
    return map_tensors(lambda x: x.unflatten(0, points.shape[:2]), jet)


def variance_at(shape: ShapeLike, x: Float[Tensor, "q 3"]) -> Float[Tensor, "q"]:
    """Return the variance (q,) of the signed distance at q normalised points, in squared normalised
    units.

    A shape with a method `variance` computes it without its derivatives.
    """
    variance = getattr(shape, "variance", None)
    return shape.jet(x).variance if variance is None else variance(x)


def triple_mean_jet(shape: ShapeLike, points: Vectors) -> MeanJet:
    """Return the mean signed distance at each contact, with its gradient and Hessian by the
    contact's position.

    `points` (b, f, 3) and the results are normalised: one unit is `shape.scale` [m]. The fields of
    the result have the leading axes (b, f). A shape with a method `mean_jet` does not compute the
    variance.
    """
    jet = getattr(shape, "mean_jet", shape.jet)(points.flatten(0, 1))
    values = jet.distance, jet.gradient, jet.hessian
    return MeanJet(*(x.unflatten(0, points.shape[:2]) for x in values))


@functools.cache
def contact_pairs(fingertips: int, device: torch.device) -> Int[Tensor, "2 p"]:
    """Return the indices (2, p) of the two contacts of each pair of f contacts, on a `device`.

    f is the number of `fingertips`, and p = f (f - 1) / 2 that of the pairs. The first row holds
    the first contact of each pair, the second row the second one. Neighbours (i, i + 1) come first,
    then (i, i + 2), both modulo f.
    """
    order = [
        (i, (i + gap) % fingertips)
        for gap in range(1, fingertips // 2 + 1)
        for i in range(fingertips)
    ]
    return torch.tensor(order[: fingertips * (fingertips - 1) // 2], device=device).T


@functools.cache
def pull_signs(fingertips: int, device: torch.device) -> Float[Tensor, "f p"]:
    """Return the signed incidence matrix (f, p) of f contacts and their p pairs, on a `device`.

    Entry (i, k) is 1 where contact i is the first of pair k, -1 where it is the second, else 0. The
    pairs are in the order of `contact_pairs`, and f is the number of `fingertips`.
    """
    pairs = contact_pairs(fingertips, device)
    at = torch.arange(fingertips, device=device)[:, None]
    return (at == pairs[0]).double() - (at == pairs[1]).double()


def split_unknowns(x: Float[Tensor, "b u"]) -> tuple[Vectors, Tensions]:
    """Return the contact points (b, f, 3), then the tensions (b, p) of the pairs of contacts.

    Both are views of `x`. Each of its b vectors of unknowns holds 3 f coordinates, then p tensions;
    f follows from the length u.
    """
    # the unknowns of the possible numbers of fingertips
    counts = {3 * f + f * (f - 1) // 2: f for f in range(FINGERTIPS[0], FINGERTIPS[1] + 1)}
    fingertips = counts[x.shape[1]]
    return x[:, : 3 * fingertips].unflatten(1, (fingertips, 3)), x[:, 3 * fingertips :]


@dataclasses.dataclass(frozen=True)
class Constraints(Batch):
    """Values of all constraints on b contact sets, and their Jacobians with respect to the u
    unknowns of a set.

    The unknowns are the 3 f coordinates of the f contacts, then p tensions, one for each pair of
    contacts. With the force tension times distance, the two contacts of a pair pull each other.
    `centre` (normalised) is the centroid of the contacts, and `surface` (normalised) their signed
    distances from the surface. Both should be 0. The k numbers in `bounds` should be <= 0. They
    are, in this order:

    * f friction cones: by how much each force is outside its cone, as a difference of cosines;
    * f variances: the excess over the limit, divided by twice the standard deviation at the limit;
    * f limits of the domain, the ball in which the shape is known: how far a contact is outside;
    * p distances: by how much the fingertips of a pair are too close;
    * with a table, f depths of the fingertips below it;
    * with a region, f signed distances of the contacts from it, positive outside.

    All but the cones are normalised lengths. Small margins make them a little stricter than the
    constraints of the user. `centre_by_x`, `surface_by_x` and `bounds_by_x` are the Jacobians of
    the three.
    """

    centre: Float[Tensor, "b 3"]
    surface: Float[Tensor, "b f"]
    bounds: Float[Tensor, "b k"]
    centre_by_x: Float[Tensor, "b 3 u"]
    surface_by_x: Float[Tensor, "b f u"]
    bounds_by_x: Float[Tensor, "b k u"]

    @property
    def values(self) -> Float[Tensor, "b r"]:
        """The values of all r = 3 + f + k constraints in one vector: `centre`, `surface` and
        `bounds`.
        """
        return torch.cat([self.centre, self.surface, self.bounds], 1)

    @property
    def jacobian(self) -> Float[Tensor, "b r u"]:
        """The Jacobian of the r constraint `values` with respect to the u unknowns."""
        return torch.cat([self.centre_by_x, self.surface_by_x, self.bounds_by_x], 1)


def forces_from_tensions(
    points: Vectors, tension: Tensions
) -> tuple[Vectors, Float[Tensor, "b p 3"]]:
    """Return the forces (b, f, 3) on the object at f contacts, and the vector (b, p, 3) of each
    pair of contacts.

    All p = f (f - 1) / 2 pairs count, in the order of `contact_pairs`. The vector of a pair leads
    from its first to its second contact. The force on the first contact is tension times vector,
    that on the second is opposite. Each contact gets the sum over its pairs. `points` have the
    shape (b, f, 3), and `tension` (b, p).
    """
    first, second = contact_pairs(points.shape[1], points.device)
    sides = points[:, second] - points[:, first]
    signs = pull_signs(points.shape[1], points.device).to(points)
    return signs @ (tension[..., None] * sides), sides


# values that should be <= 0, with Jacobian
Bounds = tuple[Float[Tensor, "b k"], Float[Tensor, "b k u"]]


class Face(NamedTuple):
    """A plane at which a table ends, its top or its side, in normalised units."""

    outward: Float[Tensor, "3"]  # unit normal (3,), away from the table
    offset: PerRow  # distance of the plane from the normalised origin along this normal

    @classmethod
    def of(cls, plane: Plane, shape: ShapeLike) -> "Face":
        """Return the face of a `plane` [m] in the normalised units of a shape; `shape` may be a
        batch.
        """
        outward = plane.normal.to(device_of(shape))
        foot = plane.offset * plane.normal
        scale = shape.scale
        if isinstance(scale, Tensor):
            feet = shape.normalise(foot.to(scale).expand(len(scale), 3))
            return cls(outward, feet @ outward)
        return cls(outward, float(shape.normalise(foot) @ plane.normal))

    def rows(self, index: Int[Tensor, "k"]) -> "Face":
        """Return the face for some contact sets of a batch, in the units of their shapes: those
        with the indices `index` (k,).
        """
        offset = self.offset
        return Face(self.outward, offset[index]) if isinstance(offset, Tensor) else self

    def room(
        self, points: Float[Tensor, "*b 3"], normals: Float[Tensor, "*b 3"], tip_radius: PerRow
    ) -> Float[Tensor, "*b"]:
        """Return the distance (*b), normalised, of the round fingertip on each contact from the
        face.

        It is negative where the fingertip reaches through the face. `points` are normalised
        contacts, `normals` their outward unit normals. `tip_radius` is normalised. `*b` stands for
        any leading axes.
        """
        away = self.outward.to(points)
        height = points @ away
        slant = 1 - normals @ away
        return height - spread(self.offset, height) - spread(tip_radius, slant) * slant


@dataclasses.dataclass(frozen=True)
class ContactProblem:
    """The contact planning problem, Eqs. (10)-(14) of the paper, in normalised units.

    The units are those of one shape, or of one shape for each contact set. `spec` holds the
    constraints in metres; all else is normalised. `friction` is the coefficient of the largest
    round cone inside the friction cone with flat sides that `certify` uses. `domain_radius` is that
    of the shape. `separation` is the least distance of two fingertip centres, and `tip_radius` the
    radius of the fingertips. `ring` is the radius around a contact within which the surface must be
    flat. `table` holds the top of the table, then its side if it has an edge. It is empty without
    a table. `beyond` returns the signed distance (q,) of normalised points (q, 3) from the region
    where contacts may be, negative inside.
    """

    spec: ContactSpec
    friction: float
    domain_radius: PerRow
    separation: PerRow
    tip_radius: PerRow
    ring: PerRow
    table: tuple[Face, ...]
    beyond: Callable[[Tensor], Tensor] | None = None

    @classmethod
    def of(
        cls, shape: ShapeLike, spec: ContactSpec, ring_radius: PerRow | None = None
    ) -> "ContactProblem":
        """Return the problem of finding contacts on a `shape` under the constraints `spec`, in the
        shape's normalised units.

        `ring_radius` [m] is the radius around a contact within which the surface must be flat. None
        means that of the spec.
        """
        sizes = shape.scale, shape.domain_radius
        scale, radius = (x if isinstance(x, Tensor) else float(x) for x in sizes)
        separation = spec.least_separation / scale
        if isinstance(separation, Tensor):
            separation = separation.clamp_min(LEAST_SIDE)
        else:
            separation = max(separation, LEAST_SIDE)
        ring = (spec.ring_radius if ring_radius is None else ring_radius) / scale
        friction = spec.planned_friction * math.cos(math.pi / spec.edges)
        region = spec.region
        beyond = None if region is None else lambda x: region(shape.metres(x)) / scale
        return cls(
            spec,
            friction,
            radius,
            separation,
            spec.fingertip_radius / scale,
            ring,
            tuple(Face.of(plane, shape) for plane in faces_of(spec.plane)),
            beyond,
        )

    def rows(self, index: Int[Tensor, "k"]) -> "ContactProblem":
        """Return the problem of some contact sets of a batch: those with the indices `index` (k,).

        A problem of one shape for all contact sets is returned as it is.
        """
        names = "domain_radius", "separation", "tip_radius", "ring"
        own = {name: x[index] for name in names if isinstance(x := getattr(self, name), Tensor)}
        if not own:  # of one shape for all contact sets
            return self
        table = tuple(face.rows(index) for face in self.table)
        return dataclasses.replace(self, table=table, **own)

    def room(
        self, points: Float[Tensor, "*b 3"], normals: Float[Tensor, "*b 3"]
    ) -> Float[Tensor, "*b"]:
        """Return how far (*b), normalised, each contact is above the height at which its round
        fingertip touches the table.

        It is negative where the fingertip would be in the table. Without a table it is infinite. A
        fingertip beyond the table's edge may be lower: then the result is how far it is beyond the
        edge. `points` are normalised, `normals` outward unit normals.
        """
        rooms = [face.room(points, normals, self.tip_radius) for face in self.table]
        if not rooms:
            return torch.full_like(points[..., 0], math.inf)
        return functools.reduce(torch.maximum, rooms)

    def _room_and_slope(
        self, points: Vectors, normals: Vectors, centre_by_point: Float[Tensor, "b f 3 3"]
    ) -> tuple[Float[Tensor, "b f"], Vectors]:
        """Return the `room` of each contact, and its derivatives by the contact's point.

        `centre_by_point` are those of its fingertip's centre. There must be a table.
        """
        (room, slope), *others = [
            (
                face.room(points, normals, self.tip_radius),
                face.outward.to(points) @ centre_by_point,
            )
            for face in self.table
        ]
        for beyond, sideways in others:
            slope = torch.where((beyond > room)[..., None], sideways, slope)
            room = torch.maximum(room, beyond)
        return room, slope

    def sides(
        self, points: Float[Tensor, "*b f 3"], normals: Float[Tensor, "*b f 3"]
    ) -> Float[Tensor, "*b p 3"]:
        """Return the vectors (*b, p, 3), normalised, from the first to the second fingertip centre
        of each pair of contacts.

        The p pairs are in the order of `contact_pairs`. `points` are normalised contacts, `normals`
        their outward unit normals.
        """
        centres = points + spread(self.tip_radius, normals) * normals
        first, second = contact_pairs(points.shape[-2], points.device)
        return centres.index_select(-2, second) - centres.index_select(-2, first)

    def constraints(self, points: Vectors, tension: Tensions, jet: SurfaceJet) -> Constraints:
        """Return the values of all constraints and their Jacobians for b contact sets.

        `points` (b, f, 3) are the normalised contacts, and `tension` (b, p) is that of each pair of
        contacts. `jet` holds signed distance and variance with their derivatives at the points.
        """
        b, f = points.shape[:2]
        unknowns = 3 * f + tension.shape[1]
        own = functools.partial(_by_own_point, unknowns=unknowns)
        identity = eye_like(3, points)
        threshold = self.spec.max_variance * INSIDE
        ball = self.domain_radius * INSIDE
        edge = spread(ball, tension)
        # slope of the variance at the threshold, for a linear standard deviation
        half_slope = 2 * threshold**0.5
        tilt = jet.normal_jacobian
        centre_by_point = identity + spread(self.tip_radius, tilt) * tilt
        cones, cones_by_x = self._cones(points, tension, jet)
        distances, distances_by_x = self._distances(points, jet.normals, centre_by_point)
        beyond = (dot(points, points) - edge**2) / (2 * edge)
        beyond_by_x = own(points / spread(ball, points))
        values = [cones, (jet.variance - threshold) / half_slope, beyond, distances]
        jacobians = [
            cones_by_x,
            own(jet.variance_gradient / half_slope),
            beyond_by_x,
            distances_by_x,
        ]
        if self.table:
            room, slope = self._room_and_slope(points, jet.normals, centre_by_point)
            values.append((1 - INSIDE) * ROOM - room)
            jacobians.append(own(-slope))
        if self.beyond is not None:
            value, slope = self._outside(points)
            values.append((1 - INSIDE) * ROOM + value)
            jacobians.append(own(slope))
        centre_by_x = torch.cat(
            [identity.repeat(1, f) / f, identity.new_zeros(3, tension.shape[1])], 1
        )
        slopes = centre_by_x.expand(b, 3, unknowns), own(jet.gradient), torch.cat(jacobians, 1)
        return Constraints(points.mean(1), jet.distance, torch.cat(values, 1), *slopes)

    def _outside(self, points: Vectors) -> tuple[Float[Tensor, "b f"], Vectors]:
        """Return the distance (normalised) of contacts from where they may be, and its central
        differences.
        """
        assert self.beyond is not None
        step = DIFFERENCE
        sides = step * torch.cat([torch.eye(3), -torch.eye(3), torch.zeros(1, 3)]).to(points)
        found = self.beyond((points[:, :, None] + sides).flatten(0, 2))
        ahead, behind, here = found.view(*points.shape[:2], 7).split([3, 3, 1], -1)
        return here[..., 0], (ahead - behind) / (2 * step)

    def _distances(
        self, points: Vectors, normals: Vectors, centre_by_point: Float[Tensor, "b f 3 3"]
    ) -> Bounds:
        """Return by how much each pair of fingertip centres is too close (normalised; negative if
        far enough), and the derivatives.
        """
        sides = self.sides(points, normals)
        length = norm(sides)
        along = (sides / length[..., None])[..., None, :]
        first, second = contact_pairs(points.shape[1], points.device)
        pair = torch.arange(len(first), device=points.device)
        blocks = points.new_zeros(len(points), len(pair), points.shape[1], 3)
        blocks[:, pair, first] = (along @ centre_by_point[:, first])[..., 0, :]
        blocks[:, pair, second] = -(along @ centre_by_point[:, second])[..., 0, :]
        by_tension = points.new_zeros(len(points), len(pair), len(pair))
        short = spread(self.separation / INSIDE, length) - length
        return short, torch.cat([blocks.flatten(2), by_tension], 2)

    def _cones(self, points: Vectors, tension: Tensions, jet: SurfaceJet) -> Bounds:
        """Return by how much each force is outside its friction cone, as a difference of cosines,
        and the derivatives.
        """
        # With u = f / |f| the bound is n.u + cosine. It changes by (1 - u u^T) n / |f| with f, and
        # by u with n.
        normals = jet.normals
        at = torch.arange(points.shape[1], device=points.device)
        force, sides = forces_from_tensions(points, tension)
        size = norm(force, keepdim=True)
        direction = force / size
        outward = dot(normals, direction, keepdim=True)
        by_force = (normals - outward * direction) / size
        steep = norm(jet.gradient, keepdim=True)
        # (1 - n n^T) u / |g|, which the Hessian carries to the point
        across = (direction - outward * normals) / steep
        by_point = (across[..., None, :] @ jet.hessian)[..., 0, :]
        first, second = contact_pairs(len(at), points.device)
        # the tension between two contacts
        between = tension.new_zeros(len(points), len(at), len(at))
        between[:, first, second] = between[:, second, first] = tension
        blocks = between[..., None] * by_force[:, :, None]
        blocks[:, at, at] = by_point - between.sum(2, keepdim=True) * by_force
        along = dot(by_force[:, :, None], sides[:, None])
        by_tension = along * pull_signs(len(at), points.device).to(points)
        cosine = 1 / math.sqrt(1 + self.friction**2)
        excess = outward[..., 0] + cosine + CONE_MARGIN
        return excess, torch.cat([blocks.flatten(2), by_tension], 2)


def _by_own_point(slope: Vectors, unknowns: int) -> Float[Tensor, "b f u"]:
    """Return the Jacobian of f values with respect to all u unknowns. Each value depends only on
    its own contact.

    `slope` (b, f, 3) holds the derivatives with respect to the coordinates of the contact.
    """
    b, f = slope.shape[:2]
    jacobian = slope.new_zeros(b, f, unknowns)
    at = torch.arange(f, device=slope.device)
    jacobian[:, :, : 3 * f].unflatten(2, (f, 3))[:, at, at] = slope
    return jacobian
