"""The kernels of the chain, each with the sizes at which it is timed."""

import dataclasses
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import torch

from benchmarks.common import random_view
from torchgrasp import (
    Contacts,
    ContactSpec,
    Hand,
    ShapeGP,
    Status,
    certify,
    closure_probability,
    fit_shape,
    load_hand,
    load_object,
    plan_contacts,
    plan_grasps,
    sample_configurations,
)
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.signed_distance import field_from_surface
from torchgrasp.ik.attempts import assign
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.refine import refine
from torchgrasp.ik.seeds import PostureLibrary, nearest_postures
from torchgrasp.posture_model.em import DataRows, expectation, maximisation, start_components
from torchgrasp.shape.estimate import Normalisation, on_surface
from torchgrasp.shape.fit import condition
from torchgrasp.shape.surface import extract_surface
from torchgrasp.testing import random_joints
from torchgrasp.values.planning import PointCloud


@dataclasses.dataclass(frozen=True)
class Kernel:
    """A function of arguments that `prepare` makes on the CPU for a size, in units of `what`.

    `tolerance` bounds the relative error of its result, or with `agree` what that returns of both
    results.
    """

    name: str
    what: str
    sizes: tuple[int, ...]
    prepare: Callable[[int], tuple[Callable[..., Any], tuple[Any, ...]]]
    tolerance: float
    agree: Callable[[Any, Any], float] | None = None


SPEC = ContactSpec(table=0.0)
COMPONENTS = 41
"""The paper's number of Gaussians for the Allegro hand."""
Prepared = tuple[Any, tuple[Any, ...]]


@cache
def jug() -> ShapeGP:
    """Return the shape of the jug from one view."""
    return fit_shape(load_object("jug").view, table=0.0)


@cache
def allegro() -> Hand:
    """Return the hand of all kernels."""
    return load_hand("allegro")


@cache
def triples(count: int) -> Contacts:
    """Return planned triples, repeated up to a number."""
    plan = plan_contacts(jug(), SPEC, 200)
    good = plan[plan.status == Status.OK].contacts
    return good[torch.arange(count) % len(good)]


@cache
def standardised(rows: int) -> torch.Tensor:
    """Return standardised free postures with their codes."""
    x = sample_configurations(allegro(), rows).rows().double()
    return (x - x.mean(0)) / x.std(0, correction=0)


def prepare_condition(n: int) -> Prepared:
    """Condition on n points with normals: a Cholesky factor of 4 n rows."""
    x, normals = random_view(n, torch.Generator().manual_seed(0))
    seen = on_surface(x, normals, torch.full_like(x[:, 0], 0.01), 0.05)
    return condition, (
        seen,
        Normalisation(torch.zeros(3, dtype=torch.float64), 1.0),
        PointCloud(x, normals),
    )


def prepare_predict(n: int) -> Prepared:
    """Predict mean, normal and covariance at n points near the surface."""
    view = load_object("jug").view.points.double()
    points = view[torch.arange(n) % len(view)]
    noise = 0.002 * torch.randn(
        n, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    return lambda shape, x: shape.predict(x), (jug(), points + noise)


def prepare_certify(n: int) -> Prepared:
    """Certify random triples."""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(n, 3, 3, generator=generator, dtype=torch.float64)
    normals = unit(
        unit(points) + 0.4 * torch.randn(n, 3, 3, generator=generator, dtype=torch.float64)
    )
    return lambda contacts: certify(contacts, SPEC).margin, (Contacts(0.04 * points, normals),)


def seeds_of(count: int) -> Prepared:
    """Return hands near planned contacts, the contacts, and the world."""
    surface = extract_surface(jug())
    world = CollisionWorld(field_from_surface(surface.vertices, surface.faces), SPEC.plane)
    contacts = triples(max(count // 4, 1))
    seeds = nearest_postures(PostureLibrary.of(allegro()), contacts, world, 4)[:count]
    start = Configuration(seeds.joints, seeds.obj_from_hand)
    return refine, (allegro(), start, assign(contacts, seeds), world)


def prepare_em(rows: int) -> Prepared:
    """One step of expectation-maximisation."""
    x = standardised(rows)
    start = start_components(DataRows(x), COMPONENTS, 0, 1e-6)

    def step(x: torch.Tensor, start: Any) -> Any:
        sums, log_likelihood = expectation(DataRows(x), start.components)
        return maximisation(sums, len(x), 1e-6, start.reseeded)[0], log_likelihood

    return step, (x, start)


def share_apart(one: Any, other: Any) -> float:
    """Return the difference of the shares of successful rows: single rows of a descent may part by
    rounding.
    """
    return abs(
        float((one.status == Status.OK).double().mean())
        - float((other.status == Status.OK).double().mean())
    )


def tips_apart(one: Configuration, other: Configuration) -> float:
    """Return by how much the share of hands that reached their contacts differs: by joints that
    moved 1 mrad apart.
    """
    moved = (one.joints - other.joints.cpu()).abs().amax(1)
    return float((moved > 1e-3).double().mean())


def separate(hand: Hand, joints: torch.Tensor) -> torch.Tensor:
    """Return the least separation of the links, by chunks that suit the device."""
    return hand.self_clearance(joints, chunk=1000 if joints.device.type == "cpu" else len(joints))


def whole_chain(starts: int) -> Prepared:
    """Plan grasps on the jug."""
    return lambda cloud: plan_grasps(cloud, allegro(), SPEC, starts), (load_object("jug").view,)


def kernels(quick: bool) -> list[Kernel]:
    """Return all kernels; `quick` drops the sizes that take longest."""
    hand = allegro()

    def joints_of(n: int) -> torch.Tensor:
        return random_joints(hand, n, 0)

    library = cache(partial(PostureLibrary.of, hand))
    found = [
        Kernel(
            "fit_shape",
            "view of 1000 points",
            (1,),
            lambda _: (
                lambda cloud, points: fit_shape(cloud, table=0.0).predict(points).distance,
                (load_object("jug").view, load_object("jug").view.points[:100]),
            ),
            1e-6,
        ),
        Kernel("condition", "points with normals", (70, 300, 1000, 3000), prepare_condition, 1e-6),
        Kernel("predict", "points", (100, 1000, 10_000, 100_000), prepare_predict, 1e-6),
        Kernel(
            "extract_surface",
            "shape",
            (1,),
            lambda _: (lambda s: extract_surface(s).vertices, (jug(),)),
            1e-4,
        ),
        Kernel(
            "plan_contacts",
            "starts",
            (25, 100, 500, 2000),
            lambda n: (lambda shape: plan_contacts(shape, SPEC, n), (jug(),)),
            0.02,
            share_apart,
        ),
        Kernel("certify", "triples", (100, 1000, 10_000), prepare_certify, 1e-9),
        Kernel(
            "closure_probability",
            "triples",
            (10, 100, 1000),
            lambda n: (
                lambda shape, contacts: closure_probability(shape, contacts, SPEC, 600).probability,
                (jug(), triples(n)),
            ),
            1e-2,
        ),
        Kernel(
            "Hand.fingertips",
            "postures",
            (10, 1000, 100_000, 1_000_000),
            lambda n: (lambda hand, joints: hand.fingertips(joints), (hand, joints_of(n))),
            1e-9,
        ),
        Kernel(
            "Hand.jacobian",
            "postures",
            (10, 1000, 100_000),
            lambda n: (lambda hand, joints: hand.jacobian(joints), (hand, joints_of(n))),
            1e-9,
        ),
        Kernel(
            "Hand.self_clearance",
            "postures",
            (1000, 10_000, 100_000),
            lambda n: (separate, (hand, joints_of(n))),
            1e-9,
        ),
        Kernel(
            "nearest_postures",
            "triples",
            (10, 100, 1000),
            lambda n: (
                lambda library, contacts: (
                    nearest_postures(library, contacts, CollisionWorld()).tip_error
                ),
                (library(), triples(n)),
            ),
            1e-3,
        ),
        Kernel("refine", "seeds", (10, 100, 1000), seeds_of, 0.05, tips_apart),
        Kernel("EM step", "rows", (10_000, 100_000, 400_000), prepare_em, 1e-9),
        Kernel("plan_grasps", "starts", (100, 1000), whole_chain, 0.05, share_apart),
    ]
    if not quick:
        return found
    return [Kernel(k.name, k.what, k.sizes[:2], k.prepare, k.tolerance, k.agree) for k in found]
