"""Where planning starts: points on a sphere as in the paper, or triples surveyed on the surface, or given points."""

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import check_tensor
from torchgrasp.errors import BadArgument
from torchgrasp.linalg import unit
from torchgrasp.plan.normal_variation import normal_variation
from torchgrasp.plan.problem import ContactProblem, Shape, triple_jet
from torchgrasp.plan.solver import project
from torchgrasp.plan.wrench import closed_exact
from torchgrasp.specs import ContactSpec

SURVEY = 700
"""Triples of surface points that are surveyed for certain and flat places: 2100 points cover a hand-sized object in
steps of about 4 mm."""

FAR = 0.1
"""A start with a point further than this from the surface (normalised signed distance) is no guess of contacts."""

NEAR_CENTRE = 0.1
"""Such a start is drawn in to this distance from the centre (the paper's radius), about which it is shifted."""

DRAWS, ROUNDS = 20, 8
"""Triples drawn for each start that is wanted, in each of at most so many rounds; of those on certain and flat
surface 2 to 10 % are closed."""


CHUNK = 500
"""Starts that are planned at once: memory is bounded, and results come early."""


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


def given_starts(shape: Shape, starts: Float[Tensor, "b 3 3"]) -> Iterator[Float[Tensor, "_ 3 3"]]:
    """Yield normalised starts on the surface from given points [m], chunk by chunk."""
    device = getattr(shape, "device", torch.device("cpu"))  # a stand-in without one lives on the CPU
    for points in starts.detach().to(device, torch.float64).split(CHUNK):
        yield project(shape, draw_in(shape, shape.normalise(points)), steps=6)


def drawn_starts(shape: Shape, spec: ContactSpec, starts: int, seed: int) -> Iterator[Float[Tensor, "_ 3 3"]]:
    """Yield as many normalised starts on the surface as `starts` says, chunk by chunk.

    Without `spec.flatness` each is three points of the sphere of `spec.start_radius`, moved onto the surface
    (Sec. 6.2). With it such points are surveyed first: starts are triples of those
    that are certain, flat, inside and above the table, and closed ones come first in each chunk. The centre of a flat
    grasp may lie 30 mm from the object's, and a descent from the paper's starts rarely finds its way there.
    """
    device = getattr(shape, "device", torch.device("cpu"))
    generator = torch.Generator().manual_seed(seed)

    def draw(count: int) -> Float[Tensor, "_ 3 3"]:
        drawn = spec.start_radius * unit(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
        return drawn.to(device)

    places = None
    if spec.flatness is not None:
        places = survey(shape, spec, project(shape, draw(SURVEY), steps=6))
    for begin in range(0, starts, CHUNK):
        count = min(CHUNK, starts - begin)
        if places is None:
            yield project(shape, draw_in(shape, draw(count)), steps=6)
        else:
            yield surveyed_triples(shape, spec, *places, count, generator)


def draw_in(shape: Shape, points: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b 3 3"]:
    """Return normalised starts of which those off the surface are shifted to the centre and drawn in towards it.

    A point off the surface is only a direction to look in. From far away each contact ends on the part of the surface
    that is nearest to it, uncertain or not; from near the centre the three spread over what faces them, and their
    own centre, Eq. (14), begins where it should end. Starts on the surface are guesses of contacts and stay.
    """
    distance, _ = shape.mean_and_gradient(points.flatten(0, 1))
    far = distance.view(points.shape[:2]).abs().amax(-1) > FAR
    shifted = points - points.mean(1, keepdim=True)
    longest = torch.linalg.vector_norm(shifted, dim=-1).amax(-1)
    drawn = shifted * (NEAR_CENTRE / longest).clamp(max=1.0)[:, None, None]
    return torch.where(far[:, None, None], drawn, points)


def survey(
    shape: Shape, spec: ContactSpec, points: Float[Tensor, "s 3 3"]
) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 3"]]:
    """Return the good places among surface points, with their normals; all of them where there are less than three."""
    problem = ContactProblem.of(shape, spec)
    jet = triple_jet(shape, points)
    good = (jet.distance.abs() < 1e-4) & (jet.variance >= 0) & (jet.variance < spec.max_variance)
    good &= torch.linalg.vector_norm(points, dim=-1) < problem.domain_radius
    good &= points[..., 2] > problem.least_height(jet.normals)
    if spec.flatness is not None:
        good &= (
            normal_variation(shape, points, jet.normals) < 0.9 * spec.flatness
        )  # the ring of another triple is turned
    if int(good.sum()) < 3:  # nothing to choose from
        good = torch.ones_like(good)
    return points[good], jet.normals[good]


def surveyed_triples(
    shape: Shape,
    spec: ContactSpec,
    places: Float[Tensor, "p 3"],
    normals: Float[Tensor, "p 3"],
    starts: int,
    generator: torch.Generator,
) -> Float[Tensor, "b 3 3"]:
    """Return triples of places, closed and separate ones first."""
    problem = ContactProblem.of(shape, spec)
    found, wanted = [], starts
    for _ in range(ROUNDS):
        choice = torch.randint(len(places), (DRAWS * starts, 3), generator=generator).to(places.device)
        triple = places[choice]
        choice = choice[torch.linalg.vector_norm(triple - triple.roll(1, 1), dim=-1).amin(-1) > problem.separation]
        closed = choice[closed_exact(places[choice], normals[choice], problem.friction)][:wanted]
        found.append(places[closed])
        wanted -= len(closed)
        if wanted == 0:
            break
    # Too few are closed: the rest descend from triples that are not.
    found.append(places[torch.randint(len(places), (wanted, 3), generator=generator).to(places.device)])
    return torch.cat(found)
