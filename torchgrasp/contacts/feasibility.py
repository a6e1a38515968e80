"""Constraint checks of planned contacts: flatness of the surface around each contact, and all other
constraints.
"""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.contacts.descent import project
from torchgrasp.contacts.form_closure import (
    BALANCED,
    MIN_MARGIN,
    MIN_RANK_RATIO,
    Vectors,
    cone_edges,
    rank_ratio,
    residual_of,
    solve_closure_lp,
    tangents,
    wrenches,
)
from torchgrasp.contacts.problem import (
    ContactProblem,
    PerRow,
    ShapeLike,
    rows_of,
    triple_jet,
    triple_mean_jet,
    walls_at,
)
from torchgrasp.foundation.base import Batch, flatnonzero, spread
from torchgrasp.foundation.errors import Status
from torchgrasp.geometry.frames import degenerate
from torchgrasp.geometry.linalg import dot, eye_like, matvec, norm, unit
from torchgrasp.shape.estimate import surface_deviation
from torchgrasp.values.planning import ContactPlan, Contacts

# points of the ring on which a plan is judged, and fewer that guide a solver
JUDGED_POINTS = 8
GUIDING_POINTS = 4
# share of the largest variation that guiding points allow: the judged points lie between them
INSIDE = 0.95
BORDER = -1e-9  # signed distance (normalised) inside of which a point is in a region: rounding
ON_SURFACE = 1e-6  # largest |f_d| of a contact on the surface, normalised: far above rounding


def ring_directions(normals: Vectors, points: Vectors, n: int) -> Float[Tensor, "b f n 3"]:
    """Return n unit tangents (b, f, n, 3) of the surface at each contact, at equal angles around
    its normal.

    They rotate with the contact set. `points` (b, f, 3) are the contacts, `normals` (b, f, 3) the
    outward unit normals.
    """
    return cone_edges(normals, tangents(points, normals), 1.0, n) + normals[:, :, None]


def normal_variation(
    shape: ShapeLike,
    points: Vectors,
    normals: Vectors,
    radius: PerRow,
    among: Bool[Tensor, "b f"] | None = None,
) -> Float[Tensor, "b f"]:
    """Return for each contact the largest angle [rad] between its normal and the normals on a ring
    around it.

    `points` (b, f, 3) are normalised contacts, `normals` (b, f, 3) their outward unit normals. The
    ring has eight points on the surface. It has the normalised `radius`, one number, or one for
    each contact set. Contacts outside the mask `among` have infinite angles; by default all are
    measured.
    """
    variation = torch.full_like(points[..., 0], math.inf)
    among = torch.ones_like(variation, dtype=torch.bool) if among is None else among
    directions = ring_directions(normals, points, JUDGED_POINTS)
    ring = points[:, :, None] + spread(radius, directions) * directions
    for wall, own in walls_at(shape, points):
        own = torch.nonzero(own & among).unbind(1)
        surface = rows_of(wall, own[0])
        around = project(surface, ring[own], steps=1)
        _, gradient = surface.mean_and_gradient(around.flatten(0, 1))
        there = unit(gradient).view_as(around)
        here = normals[own][:, None].expand_as(there)
        sine = norm(torch.linalg.cross(here, there))
        variation[own] = torch.atan2(sine, dot(here, there)).amax(-1)
    return variation


@dataclasses.dataclass(frozen=True)
class FlatnessConstraint(Batch):
    """A linear model of k constraint values that are <= 0 where the surface is flat around the
    contacts.

    `value` (normalised lengths) are the values at the normalised contact points `at` (b, f, 3).
    `by_points` (no unit) holds their derivatives by the x = 3 f coordinates of a contact set. To
    build this model costs as much as several solver steps, so build it rarely.
    """

    value: Float[Tensor, "b k"]
    by_points: Float[Tensor, "b k x"]
    at: Vectors

    def values(self, points: Vectors) -> Float[Tensor, "b k"]:
        """Return the k constraint values (normalised lengths) of each contact set at other
        `points`, by the linear model.

        `points` (b, f, 3) are normalised contacts. The model is good near those at which it was
        built (`at`). A value <= 0 means that the surface is flat enough.
        """
        return self.value + matvec(self.by_points, (points - self.at).flatten(1))


def flatness_constraint(
    shape: ShapeLike, points: Vectors, flatness: float, radius: PerRow
) -> FlatnessConstraint:
    """Return a linear model of how far the normals around each contact differ from the contact's
    normal.

    A value is |n - n_k| less the chord of the angle `flatness` [rad]. Here n is the normal at a
    contact, and n_k are those on a ring around it. The value is multiplied by the ring's `radius`,
    and so is a normalised length. `points` (b, f, 3) are the normalised contacts at which the model
    is built.
    """
    (first, _), *others = walls_at(shape, points)
    found = _wall_constraint(first, points, flatness, radius)
    for wall, own in others:
        other = _wall_constraint(wall, points, flatness, radius)
        own = own.repeat(1, GUIDING_POINTS)
        slope = torch.where(own[..., None], other.by_points, found.by_points)
        found = FlatnessConstraint(torch.where(own, other.value, found.value), slope, points)
    return found


def _wall_constraint(
    shape: ShapeLike, points: Vectors, flatness: float, radius: PerRow
) -> FlatnessConstraint:
    """Return the linear flatness constraint for contacts on one surface of the shape, such as a
    vessel's outer wall.
    """
    jet = triple_mean_jet(shape, points)
    identity = eye_like(3, points)
    around = ring_directions(jet.normals, points, GUIDING_POINTS).transpose(1, 2)
    normal = jet.normals[:, None]
    normal_jacobian = jet.normal_jacobian[:, None]
    ring = points[:, None] + spread(radius, around) * around  # (b, k, f, 3)
    # The ring turns with the normal at its centre.
    turned = around[..., None, :] @ normal_jacobian
    ring_by_point = identity - spread(radius, turned) * normal[..., :, None] * turned
    there = triple_mean_jet(shape, ring.flatten(0, 1))
    difference = there.normals.view_as(ring) - normal
    chord = norm(difference)
    direction = difference / torch.where(chord == 0, 1.0, chord)[..., None]
    change = there.normal_jacobian.view(*ring.shape, 3) @ ring_by_point - normal_jacobian
    slope = (direction[..., None, :] @ change)[..., 0, :]
    own = eye_like(points.shape[1], points)
    slope = spread(radius, slope) * slope
    by_points = torch.einsum("bkij,il->bkilj", slope, own)
    by_points = by_points.flatten(3).flatten(1, 2)  # (b, k f, 3 f)
    over = chord - 2 * math.sin(INSIDE * flatness / 2)
    value = spread(radius, points[:, 0]) * over.flatten(1)
    return FlatnessConstraint(value, by_points, points)


def check_feasibility(shape: ShapeLike, problem: ContactProblem, points: Vectors) -> ContactPlan:
    """Return contact sets at normalised `points` (b, f, 3) as a plan, after a check of all
    constraints.

    The `status` of a set is that of the first constraint of `problem` which it violates, else
    `Status.OK`.
    """
    spec = problem.spec
    scale = shape.scale
    jet = triple_jet(shape, points)
    normals = jet.normals
    metres = shape.metres(points)
    wrench = wrenches(points, normals, spec.planned_friction, spec.edges)
    finite = torch.isfinite(wrench).flatten(1).all(1)
    wrench = torch.where(finite[:, None, None, None], wrench, 0.0)
    flat = wrench.flatten(1, 2)
    coefficients, _ = solve_closure_lp(flat)
    closed = finite & (residual_of(flat, coefficients) <= BALANCED)
    closed &= coefficients.amin(-1) >= MIN_MARGIN
    closed &= rank_ratio(wrench) >= MIN_RANK_RATIO  # 0 / 0 of a row that is not finite is False

    apart = norm(problem.sides(points, normals)).amin(-1) * scale
    room = problem.room(points, normals)
    sure = (jet.variance >= 0) & (jet.variance < spec.max_variance)
    good = {
        Status.OUT_OF_DOMAIN: norm(points).amax(-1) <= shape.domain_radius,
        Status.OFF_SURFACE: (jet.distance.abs() <= ON_SURFACE).all(-1),
        Status.OUTSIDE: within(problem, points).all(-1),
        Status.TOO_UNCERTAIN: sure.all(-1),
        Status.BELOW_TABLE: (room >= 0).all(-1),
        Status.TOO_CLOSE: apart >= spec.least_separation,
        Status.DEGENERATE: ~degenerate(points),
    }
    if spec.flatness is not None:
        # A ring costs eight evaluations a contact, so it is measured only where nothing has failed
        # before.
        rows = flatnonzero(torch.stack(list(good.values())).all(0))
        ring = problem.rows(rows).ring
        variation = normal_variation(rows_of(shape, rows), points[rows], normals[rows], ring)
        is_flat = variation.amax(-1) <= spec.flatness
        good[Status.NOT_FLAT] = torch.ones_like(closed).index_put((rows,), is_flat)
    good[Status.NOT_CLOSED] = closed
    deviation = surface_deviation(jet.variance, jet.gradient)
    std_m = spread(shape.std_factor * scale, deviation) * deviation
    contacts = Contacts(metres, normals, jet.variance, std_m)
    phi = coefficients.unflatten(1, wrench.shape[1:3])
    quality = norm(points.mean(1)) * scale
    return ContactPlan(contacts, phi, quality, first_violation(good))


def within(problem: ContactProblem, points: Float[Tensor, "*b 3"]) -> Bool[Tensor, "*b"]:
    """Return a mask (*b) of the normalised `points` that lie inside the region where contacts may
    be.

    `problem.beyond` is the signed distance from the region. Points within rounding (`BORDER`) of
    its surface are not inside. Without a region all points are inside.
    """
    if problem.beyond is None:
        return torch.ones_like(points[..., 0], dtype=torch.bool)
    inside = problem.beyond(points.flatten(0, -2)) < BORDER
    return inside.view(points.shape[:-1])


def first_violation(good: dict[Status, Bool[Tensor, "b"]]) -> Int[Tensor, "b"]:
    """Return for each contact set the first status, in the dictionary's order, whose condition is
    false.

    `good` holds a mask of the sets that meet the condition of each status. A set that meets all has
    `Status.OK`.
    """
    met = torch.stack(list(good.values()))
    codes = torch.tensor([*good, Status.OK], device=met.device)
    first = (~met).to(torch.uint8).argmax(0)
    return codes[torch.where(met.all(0), len(good), first)]
