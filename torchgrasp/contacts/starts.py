"""Initial guesses of the contact planner: on the paper's sphere, from candidate contacts, or given
by the caller.

f counts the contacts of a set.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.contacts.descent import project
from torchgrasp.contacts.feasibility import normal_variation, within
from torchgrasp.contacts.form_closure import Vectors, closed_exact
from torchgrasp.contacts.problem import ContactProblem, ShapeLike, device_of, variance_at, walls_of
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.linalg import Points, norm, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.values.specs import FLAT_RADII, ContactSpec

CANDIDATE_TRIPLES = 350  # triples of surface points among which candidates are found
CANDIDATE_FLATNESS = 0.9  # share of the largest normal variation that a candidate may have
NEAR_SURFACE = 1e-4  # largest distance (normalised) of a point on the surface
FAR = 0.1  # a start farther than this from the surface (normalised) is no guess of contacts
# normalised distance from the centre to which such a start is drawn in: the paper's radius of
# starts
NEAR_CENTRE = 0.1
# rows drawn for each start in one round, and most rounds: few rows are closed
DRAWN_PER_START = 20
ROUNDS = 8
LEAST_PORTION = 4000  # sets judged at once: a few take as long, as each operation has its cost
# share of starts, and of how many, that must be closed: contacts can be so flat
ENOUGH_CLOSED = 0.1
SURVEYED = 250
# share of drawn sets of candidates that is closed, at or below which level candidates are drawn,
# too: of 1000 starts, at most 16 would be closed
RARE = 1e-4
LEVEL_SURVEY = 8  # so many times more points are drawn to find them
# largest angle [deg] by which a level candidate's normal may rise beyond the half angle of the
# friction cone: with one that rises less, a contact can push up or along the table
LEVEL = 5.0
# starts planned at once: memory is bounded, and a plan from fewer starts begins one from more
STARTS_PER_CHUNK = 500


def check_starts(shape: ShapeLike, spec: ContactSpec, starts: int | Tensor) -> None:
    """Raise `BadArgument` for initial guesses with a wrong number of contacts, or outside the
    shape's domain.

    The domain is the ball in which the shape is known. `starts` is a number of random guesses, or
    contact points (b, f, 3) [m].
    """
    if isinstance(starts, Tensor):
        if starts.ndim == 3 and starts.shape[1] != spec.fingertips:
            allowed = f"as many as spec.fingertips: {spec.fingertips}"
            raise BadArgument("starts", f"{starts.shape[1]} contacts a row", allowed)
        points = shape.normalise(starts)
        farthest = float(norm(points).max()) if len(points) else 0.0
        if farthest > shape.domain_radius:
            found = f"a point {farthest * float(shape.scale):.4g} m from the shape's centre"
            allowed = (
                f"at most {float(shape.domain_radius) * float(shape.scale):.4g} m, where the "
                "shape is known"
            )
            raise BadArgument("starts", found, allowed)
    elif spec.start_radius > shape.domain_radius:
        raise BadArgument(
            "spec.start_radius", spec.start_radius, f"at most {float(shape.domain_radius):.4g}"
        )


def given_starts(shape: ShapeLike, starts: Vectors) -> Iterator[Float[Tensor, "_ f 3"]]:
    """Yield the caller's initial contact points in chunks of at most 500 sets, moved onto the
    surface, in normalised units.

    `starts` (b, f, 3) [m] are in the frame of the shape's cloud.
    """
    for points in starts.detach().to(device_of(shape), torch.float64).split(STARTS_PER_CHUNK):
        yield project(shape, draw_in(shape, shape.normalise(points)), steps=6)


def start_chunks(starts: int) -> list[int]:
    """Return the sizes of the chunks in which a number `starts` of initial guesses is planned.

    Each is 500 but the last, which has what is left.
    """
    return [min(STARTS_PER_CHUNK, starts - begin) for begin in range(0, starts, STARTS_PER_CHUNK)]


class SurfacePoints(NamedTuple):
    """Normalised points (p, 3) on a surface, and the outward unit normals (p, 3) there."""

    points: Points
    normals: Points


class FlatCandidates(NamedTuple):
    """Constraints with a known `flat_radius`, and candidate contacts where the surface is flat.

    The `flat_radius` [m] is the radius around a contact within which it must be flat. `spec` holds
    the constraints. The `candidates` are None if the surface need not be flat.

    `level` are further candidates, for a low object on a table. Its contacts must be high, as a
    fingertip is above the table. Most of them lie on its top, and hardly any set of them has force
    closure. The normals of level candidates rise so little that a contact can push up or along the
    table. They are None where sets with force closure are not rare (`RARE`).
    """

    spec: ContactSpec
    candidates: SurfacePoints | None
    level: SurfacePoints | None = None

    @property
    def groups(self) -> list[SurfacePoints]:
        """The candidates, then the level ones, without those that are None."""
        return [group for group in (self.candidates, self.level) if group is not None]


def drawn_starts(
    shape: ShapeLike, settled: FlatCandidates, sizes: Iterable[int], seed: int
) -> Iterator[Float[Tensor, "_ f 3"]]:
    """Yield random initial guesses on the surface in normalised units, `sizes[k]` contact sets at a
    time.

    If the spec of `settled` demands no flat surface, the guesses are drawn as in the paper (Sec.
    6.2): on a sphere, then moved onto the surface. Otherwise they are sets of the candidate
    contacts of `settled`, whose centroid may lie far from the object's centre. `seed` draws them.
    """
    spec = settled.spec
    candidates = settled.candidates
    generator = torch.Generator().manual_seed(seed)
    if candidates is not None:
        # the rows are drawn after the candidates
        draw(shape, spec, (CANDIDATE_TRIPLES, 3), generator)
    problem = ContactProblem.of(shape, spec)
    for count in sizes:
        if candidates is None:
            drawn = draw(shape, spec, (count, spec.fingertips), generator)
            yield project(shape, draw_in(shape, drawn), steps=6)
        else:
            yield candidate_rows(problem, settled.groups, count, generator)


def settle_flatness(shape: ShapeLike, spec: ContactSpec, seed: int) -> FlatCandidates:
    """Return the constraints with a known `flat_radius`, and candidate contacts.

    If `spec.flat_radius` is None, one of 8, 6, 4 and 3 mm (`FLAT_RADII`) is chosen. It is the
    largest with which at least 25 sets of candidates with force closure are found, else 3 mm. The
    candidates are random surface points at which the surface is flat. If fewer points than
    fingertips are flat, the candidates are all drawn points. They are None if `spec` demands no
    flatness. With a table, level candidates are found, too, where hardly any set has force closure.
    `seed` draws the points.
    """
    if spec.flatness is None:
        return FlatCandidates(spec, None)
    problem = ContactProblem.of(shape, spec)
    points = survey(shape, spec, torch.Generator().manual_seed(seed))
    good, normals = qualify(shape, spec, points)
    settled = spec
    flat = good
    for radius in FLAT_RADII if spec.flat_radius is None else (spec.flat_radius,):
        settled = dataclasses.replace(spec, flat_radius=radius)
        ring = radius / float(shape.scale)
        variation = normal_variation(shape, points, normals, ring, good)
        flat = variation < CANDIDATE_FLATNESS * spec.flatness
        if int(flat.sum()) >= spec.fingertips and radius not in (spec.flat_radius, FLAT_RADII[-1]):
            generator = torch.Generator().manual_seed(seed)
            closed = good_sets(problem, points[flat], normals[flat], SURVEYED, generator)
            counts = itertools.accumulate(len(sets) for sets in closed)
            if any(count >= ENOUGH_CLOSED * SURVEYED for count in counts):
                break
    few = int(flat.sum()) < spec.fingertips
    level = None
    if spec.plane is not None and settled.flat_radius in (spec.flat_radius, FLAT_RADII[-1]):
        if few or _are_rare(problem, points[flat], normals[flat], seed):
            level = _find_level(shape, settled, spec.plane, seed)
    if few:
        flat = torch.ones_like(flat)
    return FlatCandidates(settled, SurfacePoints(points[flat], normals[flat]), level)


def _are_rare(problem: ContactProblem, points: Points, normals: Points, seed: int) -> bool:
    """Return whether hardly any random sets of the candidates have force closure (`RARE`)."""
    generator = torch.Generator().manual_seed(seed)
    closed = good_sets(problem, points, normals, SURVEYED, generator)
    counts = itertools.accumulate(len(sets) for sets in closed)
    most = RARE * ROUNDS * DRAWN_PER_START * SURVEYED
    return not any(count > most for count in counts)


def _find_level(
    shape: ShapeLike, spec: ContactSpec, plane: Plane, seed: int
) -> SurfacePoints | None:
    """Return the level candidates of an object on a table (`FlatCandidates`).

    The result is None if there are fewer than fingertips.
    """
    assert spec.flatness is not None
    generator = torch.Generator().manual_seed(seed)
    points = survey(shape, spec, generator, LEVEL_SURVEY)
    good, normals = qualify(shape, spec, points)
    problem = ContactProblem.of(shape, spec)
    steepest = math.atan(problem.friction) + math.radians(LEVEL)
    rise = normals @ plane.normal.to(normals)
    good &= rise < math.sin(min(steepest, math.pi / 2))
    variation = normal_variation(shape, points, normals, problem.ring, good)
    good &= variation < CANDIDATE_FLATNESS * spec.flatness
    if int(good.sum()) < spec.fingertips:
        return None
    return SurfacePoints(points[good], normals[good])


def draw(
    shape: ShapeLike, spec: ContactSpec, size: tuple[int, int], generator: torch.Generator
) -> Float[Tensor, "_ f 3"]:
    """Return random contact sets on a sphere about the normalised origin, with the normalised
    radius `spec.start_radius`.

    `size` holds the number of contact sets and the number of contacts in each. `generator` draws
    the points.
    """
    points = unit(torch.randn(*size, 3, generator=generator, dtype=torch.float64, device="cpu"))
    return (spec.start_radius * points).to(device_of(shape))


def survey(
    shape: ShapeLike, spec: ContactSpec, generator: torch.Generator, times: int = 1
) -> Float[Tensor, "_ f 3"]:
    """Return random points (normalised) all over the surface, from which candidate contacts are
    chosen.

    They come in sets of f = 3 points. For a vessel, half of them are on each wall. `generator`
    draws them, `times` as many as by default.
    """
    walls = walls_of(shape)
    if spec.region is not None:
        times = max(times, 4)  # few of them lie in a region
    triples = times * CANDIDATE_TRIPLES
    drawn = draw(shape, spec, (triples, 3), generator).tensor_split(len(walls))
    return torch.cat(
        [project(wall, points, steps=6) for wall, points in zip(walls, drawn, strict=True)]
    )


def draw_in(shape: ShapeLike, points: Vectors) -> Vectors:
    """Return contact sets as initial guesses; sets with a point far from the surface are moved to
    the origin.

    `points` (b, f, 3) are normalised. Far is farther than 0.1 (`FAR`). A moved set has its centroid
    at the origin, and is shrunk to a radius of at most 0.1 (`NEAR_CENTRE`). Projected from there,
    its points spread over the surface; from afar all would end on the nearest surface.
    """
    distance, _ = shape.mean_and_gradient(points.flatten(0, 1))
    far = distance.view(points.shape[:2]).abs().amax(-1) > FAR
    shifted = points - points.mean(1, keepdim=True)
    longest = norm(shifted).amax(-1)
    drawn = shifted * (NEAR_CENTRE / longest).clamp(max=1.0)[:, None, None]
    return torch.where(far[:, None, None], drawn, points)


def qualify(
    shape: ShapeLike, spec: ContactSpec, points: Vectors
) -> tuple[Bool[Tensor, "b f"], Vectors]:
    """Return a mask of the points at which a contact may lie, and the surface's normals at all
    points.

    `points` (b, f, 3) are normalised; the normals are outward unit vectors. A point must meet five
    conditions. It is on the surface (to 1e-4), and inside the ball in which the shape is known. The
    variance there is below `spec.max_variance`. It is in the region of `spec`, and its fingertip is
    above the table.
    """
    problem = ContactProblem.of(shape, spec)
    distance, gradient = (
        x.unflatten(0, points.shape[:2]) for x in shape.mean_and_gradient(points.flatten(0, 1))
    )
    normals = unit(gradient)
    radius = norm(points)
    good = (distance.abs() < NEAR_SURFACE) & (radius < problem.domain_radius)
    good &= (problem.room(points, normals) > 0) & within(problem, points)
    variance = variance_at(shape, points[good])  # it costs more than all else
    good[good.clone()] = (variance >= 0) & (variance < spec.max_variance)
    return good, normals


def candidate_rows(
    problem: ContactProblem,
    groups: Sequence[SurfacePoints],
    starts: int,
    generator: torch.Generator,
) -> Vectors:
    """Return b = `starts` random sets (b, f, 3) of candidate contacts, normalised, as initial
    guesses.

    They have force closure, and contacts far enough from each other, as `problem` demands. Each
    set is drawn from one group of candidates. The first of the `groups` comes first, the next one
    if too few drawn sets are like this. If there are still too few, the others are random sets of
    the first group. `generator` draws the sets.
    """
    rows = []
    missing = starts
    for points, normals in groups:
        if missing == 0:
            break
        for good in good_sets(problem, points, normals, starts, generator):
            rows.append(points[good[:missing]])
            missing -= len(rows[-1])
            if missing == 0:
                break
    points, _ = groups[0]
    others = draw_sets(len(points), missing, problem.spec.fingertips, generator)
    return torch.cat([*rows, points[others.to(points.device)]])


def good_sets(
    problem: ContactProblem,
    points: Points,
    normals: Points,
    starts: int,
    generator: torch.Generator,
) -> Iterator[Int[Tensor, "_ f"]]:
    """Yield good random sets of contacts, as indices of the candidates, in portions that are
    computed on demand.

    Good sets have force closure, and contacts far enough from each other, as `problem` demands.
    `points` (p, 3) are the normalised candidates, `normals` (p, 3) their outward unit normals.
    `starts` is the number of sets that the caller wants. In each of 8 rounds (`ROUNDS`),
    `generator` draws 20 times as many (`DRAWN_PER_START`). All good ones among them are yielded,
    which may be fewer or more than `starts`. A portion may be empty.
    """
    for _ in range(ROUNDS):
        drawn = draw_sets(len(points), DRAWN_PER_START * starts, problem.spec.fingertips, generator)
        # a GPU would wait for each portion
        portion = max(starts, LEAST_PORTION) if points.device.type == "cpu" else len(drawn)
        for choice in drawn.to(points.device).split(portion):
            at, outward = (_take(x, choice) for x in (points, normals))
            apart = norm(problem.sides(at, outward)).amin(-1) > problem.separation
            closed = closed_exact(at[apart], outward[apart], problem.friction)
            yield choice[apart][closed]


def draw_sets(
    candidates: int, sets: int, fingertips: int, generator: torch.Generator
) -> Int[Tensor, "s f"]:
    """Return random indices from 0 to `candidates` - 1, on the CPU, for s `sets` of f contacts.

    f is the number of `fingertips`. A set may hold a candidate twice.
    """
    return torch.randint(candidates, (sets, fingertips), generator=generator, device="cpu")


def _take(points: Points, rows: Int[Tensor, "s f"]) -> Float[Tensor, "s f 3"]:
    """Return the points with some indices; `points[rows]` takes twice as long."""
    return points.index_select(0, rows.flatten()).view(*rows.shape, 3)
