"""Where planning starts: points on a sphere as in the paper, or triples surveyed on the surface, or given points."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import check_tensor
from torchgrasp.errors import BadArgument
from torchgrasp.linalg import unit
from torchgrasp.plan.flat import bend
from torchgrasp.plan.problem import ContactProblem, Shape, triple_jet
from torchgrasp.plan.wrench import closed_exact
from torchgrasp.specs import ContactSpec

SURVEY = 700
"""Triples of surface points that are surveyed for certain and flat places: 2100 points cover a hand-sized object in
steps of about 4 mm."""

DRAWS, ROUNDS = 20, 8
"""Triples drawn for each start that is wanted, in each of at most so many rounds; of those on certain and flat
surface 2 to 10 % are closed."""

LONGEST_MOVE = 0.3
"""A Newton step onto the surface is at most this long, in normalised units."""


def project(shape: Shape, points: Float[Tensor, "b 3 3"], steps: int) -> Float[Tensor, "b 3 3"]:
    """Move normalised points along the gradient onto f_d = 0 by Newton steps."""
    for _ in range(steps):
        jet = triple_jet(shape, points)
        squared = (jet.gradient * jet.gradient).sum(-1, keepdim=True)
        move = -jet.distance[..., None] / squared * jet.gradient
        length = torch.linalg.vector_norm(move, dim=-1, keepdim=True)
        points = points + move * (LONGEST_MOVE / length).clamp(max=1.0)
    return points


def is_surveyed(spec: ContactSpec, starts: int | Tensor) -> bool:
    """Tell whether starts are drawn from a survey of the surface."""
    return spec.flatness is not None and not isinstance(starts, Tensor)


def check_starts(shape: Shape, spec: ContactSpec, starts: int | Tensor, seed: int) -> None:
    """Refuse starts that are no positive number, of a wrong shape, or outside the shape's domain, by `BadArgument`.

    What is no shape, specification or seed is refused, too.
    """
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
            raise BadArgument(
                "starts",
                f"a point {farthest * float(shape.scale):.4g} m from the shape's centre",
                f"at most {float(shape.domain_radius) * float(shape.scale):.4g} m, where the shape is known",
            )
    elif isinstance(starts, bool) or not isinstance(starts, int) or starts < 1:
        raise BadArgument("starts", repr(starts), "a positive number, or starting points of shape b x 3 x 3 [m]")
    elif spec.start_radius > shape.domain_radius:
        raise BadArgument("spec.start_radius", spec.start_radius, f"at most {float(shape.domain_radius):.4g}")


def start_points(
    shape: Shape, spec: ContactSpec, starts: int | Float[Tensor, "b 3 3"], seed: int
) -> Float[Tensor, "b 3 3"]:
    """Return normalised starts on the surface: from the given points [m], or from as many as `starts` says.

    Without `spec.flatness` each is three points of the sphere of `spec.start_radius`, moved onto the surface
    (Sec. 6.2). With it the sphere's points are surveyed first: starts are triples of those that are certain, flat,
    inside and above the table, and closed ones come first. The centre of a flat grasp may lie 30 mm from the
    object's, and a descent from the paper's starts rarely finds its way there.
    """
    device = getattr(shape, "device", torch.device("cpu"))  # a stand-in without one lives on the CPU
    if isinstance(starts, Tensor):
        return project(shape, shape.normalise(starts.detach().to(device, torch.float64)), steps=6)
    generator = torch.Generator().manual_seed(seed)
    surveyed = is_surveyed(spec, starts)
    count = SURVEY if surveyed else starts
    drawn = torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
    points = project(shape, (spec.start_radius * unit(drawn)).to(device), steps=6)
    return survey(shape, spec, points, starts, generator) if surveyed else points


def survey(
    shape: Shape, spec: ContactSpec, points: Float[Tensor, "s 3 3"], starts: int, generator: torch.Generator
) -> Float[Tensor, "b 3 3"]:
    """Return triples of the good ones among surface points, closed and separate ones first."""
    problem = ContactProblem.of(shape, spec)
    jet = triple_jet(shape, points)
    good = (jet.distance.abs() < 1e-4) & (jet.variance >= 0) & (jet.variance < spec.max_variance)
    good &= torch.linalg.vector_norm(points, dim=-1) < problem.domain_radius
    if problem.lowest is not None:
        good &= points[..., 2] > problem.lowest
    if spec.flatness is not None:
        good &= bend(shape, points, jet.normals) < 0.9 * spec.flatness  # the ring of another triple is turned
    places, normals = points[good], jet.normals[good]
    if len(places) < 3:  # nothing to choose from: descend from the survey's own triples
        return points.repeat(starts // len(points) + 1, 1, 1)[:starts]
    # The certificate's cones have edges; those of a round cone of this friction fit inside them.
    friction = problem.friction * math.cos(math.pi / problem.edges)
    found, wanted = [], starts
    for _ in range(ROUNDS):
        choice = torch.randint(len(places), (DRAWS * starts, 3), generator=generator).to(places.device)
        triple = places[choice]
        choice = choice[torch.linalg.vector_norm(triple - triple.roll(1, 1), dim=-1).amin(-1) > problem.separation]
        closed = choice[closed_exact(places[choice], normals[choice], friction)][:wanted]
        found.append(places[closed])
        wanted -= len(closed)
        if wanted == 0:
            break
    # Too few are closed: the rest descend from triples that are not.
    found.append(places[torch.randint(len(places), (wanted, 3), generator=generator).to(places.device)])
    return torch.cat(found)
