"""Starts of the planner: on the paper's sphere, from candidate contacts, or given."""

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import check_tensor
from torchgrasp.errors import BadArgument
from torchgrasp.linalg import unit
from torchgrasp.plan.flatness import normal_variation
from torchgrasp.plan.problem import ContactProblem, Shape, device_of, triple_jet
from torchgrasp.plan.solver import project
from torchgrasp.plan.wrench import Triples, closed_exact
from torchgrasp.specs import ContactSpec

CANDIDATE_TRIPLES = 700
"""Triples of surface points among which candidates are found: 2100 points are 4 mm apart on a hand-sized object."""
CANDIDATE_FLATNESS = 0.9
"""Share of the largest normal variation that a candidate may have: its ring turns with the triple it joins."""
FAR = 0.1
"""A start with a point farther than this from the surface (normalised signed distance) is no guess of contacts."""
NEAR_CENTRE = 0.1
"""Normalised distance from the centre to which such a start is drawn in: the paper's radius of starts."""
TRIPLES_PER_START, ROUNDS = 20, 8
"""Triples drawn for each start in one round, and most rounds: 2 to 10 % of the candidates' triples are closed."""
STARTS_PER_CHUNK = 500
"""Starts planned at once: memory is bounded, and a plan from fewer starts begins one from more."""


def check_starts(shape: Shape, spec: ContactSpec, starts: int | Tensor, seed: int) -> None:
    """Raise `BadArgument` for wrong arguments of `plan_contacts`."""
    if not isinstance(shape, Shape):
        raise BadArgument("shape", type(shape).__name__, "a ShapeGP, or an implicit surface with the same methods")
    if not isinstance(seed, int) or not 0 <= seed < 2**63:
        raise BadArgument("seed", seed, "an integer from 0")
    if not isinstance(spec, ContactSpec):
        raise BadArgument("spec", type(spec).__name__, "a ContactSpec")
    if isinstance(starts, Tensor):
        points = shape.normalise(check_tensor("starts", starts, (None, 3, 3)))
        farthest = float(torch.linalg.vector_norm(points, dim=-1).max()) if len(points) else 0.0
        if farthest > shape.domain_radius:
            found = f"a point {farthest * float(shape.scale):.4g} m from the shape's centre"
            allowed = f"at most {float(shape.domain_radius) * float(shape.scale):.4g} m, where the shape is known"
            raise BadArgument("starts", found, allowed)
    elif isinstance(starts, bool) or not isinstance(starts, int) or starts < 1:
        raise BadArgument("starts", repr(starts), "a positive number, or starting points of shape b x 3 x 3 [m]")
    elif spec.start_radius > shape.domain_radius:
        raise BadArgument("spec.start_radius", spec.start_radius, f"at most {float(shape.domain_radius):.4g}")


def given_starts(shape: Shape, starts: Triples) -> Iterator[Float[Tensor, "_ 3 3"]]:
    """Yield normalised starts on the surface from given points [m]."""
    for points in starts.detach().to(device_of(shape), torch.float64).split(STARTS_PER_CHUNK):
        yield project(shape, draw_in(shape, shape.normalise(points)), steps=6)


def drawn_starts(shape: Shape, spec: ContactSpec, starts: int, seed: int) -> Iterator[Float[Tensor, "_ 3 3"]]:
    """Yield normalised starts on the surface.

    Without `spec.flatness` they are the paper's: points of the sphere of `spec.start_radius`, moved onto the surface
    (Sec. 6.2). With it they are triples of `candidate_contacts`. The centre of a flat grasp may lie 30 mm from the
    object's, where the paper's starts rarely end.
    """
    generator = torch.Generator().manual_seed(seed)

    def draw(count: int) -> Float[Tensor, "_ 3 3"]:
        points = unit(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
        return (spec.start_radius * points).to(device_of(shape))

    candidates = None
    if spec.flatness is not None:
        candidates = candidate_contacts(shape, spec, project(shape, draw(CANDIDATE_TRIPLES), steps=6))
    for begin in range(0, starts, STARTS_PER_CHUNK):
        count = min(STARTS_PER_CHUNK, starts - begin)
        if candidates is None:
            yield project(shape, draw_in(shape, draw(count)), steps=6)
        else:
            yield candidate_triples(ContactProblem.of(shape, spec), *candidates, count, generator)


def draw_in(shape: Shape, points: Triples) -> Triples:
    """Return normalised starts, those off the surface drawn in around the centre.

    A point off the surface is only a direction. From far away it ends on the nearest surface, uncertain or not. From
    near the centre the three spread over the surface that faces them, centred as Eq. (14) wants.
    """
    distance, _ = shape.mean_and_gradient(points.flatten(0, 1))
    far = distance.view(points.shape[:2]).abs().amax(-1) > FAR
    shifted = points - points.mean(1, keepdim=True)
    longest = torch.linalg.vector_norm(shifted, dim=-1).amax(-1)
    drawn = shifted * (NEAR_CENTRE / longest).clamp(max=1.0)[:, None, None]
    return torch.where(far[:, None, None], drawn, points)


def candidate_contacts(
    shape: Shape, spec: ContactSpec, points: Triples
) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 3"]]:
    """Return the surface points that are certain, flat, inside and above the table, with normals.

    Where fewer than three qualify, all are returned.
    """
    problem = ContactProblem.of(shape, spec)
    jet = triple_jet(shape, points)
    good = (jet.distance.abs() < 1e-4) & (jet.variance >= 0) & (jet.variance < spec.max_variance)
    good &= torch.linalg.vector_norm(points, dim=-1) < problem.domain_radius
    good &= problem.room(points, jet.normals) > 0
    if spec.flatness is not None:
        good &= normal_variation(shape, points, jet.normals) < CANDIDATE_FLATNESS * spec.flatness
    if int(good.sum()) < 3:
        good = torch.ones_like(good)
    return points[good], jet.normals[good]


def candidate_triples(
    problem: ContactProblem,
    points: Float[Tensor, "p 3"],
    normals: Float[Tensor, "p 3"],
    starts: int,
    generator: torch.Generator,
) -> Triples:
    """Return random triples of candidates, closed and separate as far as there are enough."""
    triples, missing = [], starts
    for _ in range(ROUNDS):
        choice = torch.randint(len(points), (TRIPLES_PER_START * starts, 3), generator=generator).to(points.device)
        corners = points[choice]
        choice = choice[torch.linalg.vector_norm(corners - corners.roll(1, 1), dim=-1).amin(-1) > problem.separation]
        closed = choice[closed_exact(points[choice], normals[choice], problem.friction)][:missing]
        triples.append(points[closed])
        missing -= len(closed)
        if missing == 0:
            break
    triples.append(points[torch.randint(len(points), (missing, 3), generator=generator).to(points.device)])
    return torch.cat(triples)
