"""Where a solver starts from: the learned model's seeds against nearest postures, with the same solver and triples."""

import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.common import Row
from benchmarks.ground_truth import read_views
from torchgrasp import (
    ContactSpec,
    Hand,
    Status,
    certify,
    fit_shape,
    list_objects,
    load_hand,
    load_mixture,
    load_object,
    plan_contacts,
)
from torchgrasp.geometry.signed_distance import field_from_surface
from torchgrasp.ik.attempts import rank_seeds
from torchgrasp.ik.candidates import GraspProblem
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.joint import solve_joint
from torchgrasp.ik.ranking import lexical_order
from torchgrasp.ik.seeds import PostureLibrary, nearest_postures, query_mixture
from torchgrasp.shape.surface import extract_surface
from torchgrasp.values import IKSeeds

SPEC = ContactSpec(table=0.0)
"""Of the planned contacts."""
KEPT = 8
"""Seeds of each triple, as `nearest_postures` gives them by default."""


def bench_seeds(objects: Path | None, starts: int, seed: int) -> list[Row]:
    """Solve the same certified triples from both kinds of seeds, on the given objects or the library's own.

    Every kind gives at most `KEPT` seeds of a triple. The time is the processor's, of seeds and solver.
    """
    if objects is None:
        views = {name: load_object(name).view for name in list_objects()}
    else:
        views = {name: cloud for name, _, cloud, _ in reversed(list(read_views(objects)))}
    found: dict[tuple[str, str], list[tuple[int, int, float]]] = {}
    for cloud in views.values():
        shape = fit_shape(cloud, seed=seed, table=SPEC.table)
        surface = extract_surface(shape)
        world = CollisionWorld(field_from_surface(surface.vertices, surface.faces), SPEC.plane)
        plan = plan_contacts(shape, SPEC, starts, seed)
        certificate = certify(plan.contacts, SPEC)
        closed = (plan.status == Status.OK) & certificate.closed
        for name in ("allegro", "barrett"):
            hand = load_hand(name)
            contacts = plan.contacts[closed]
            problem = GraspProblem(hand, contacts, certificate[closed], world, surface.vertices.mean(0))
            for what, source in _sources(hand, problem, seed).items():
                began = time.process_time()
                grasps = solve_joint(problem, source(), shape, SPEC)
                spent = time.process_time() - began
                good = int((grasps.status == Status.OK).sum())
                found.setdefault((name, what), []).append((len(contacts), good, spent))
    return [_row(name, what, counts) for (name, what), counts in found.items()]


def _sources(hand: Hand, problem: GraspProblem, seed: int) -> dict[str, Callable[[], IKSeeds]]:
    """Return the kinds of seeds by name."""
    contacts, world = problem.contacts, problem.world
    library, mixture = PostureLibrary.of(hand, seed=seed), load_mixture(hand.name)

    def clear_first() -> IKSeeds:
        seeds = query_mixture(hand, contacts, mixture)
        rank = rank_seeds(problem, seeds)
        best, rank = seeds[rank < KEPT], rank[rank < KEPT]
        return best[lexical_order(best.row, rank)]

    return {
        "nearest postures": lambda: nearest_postures(library, contacts, world, KEPT),
        "the learned model, clear ones first": clear_first,
    }


def _row(name: str, what: str, counts: list[tuple[int, int, float]]) -> Row:
    """Return the row of one hand and kind of seeds."""
    triples, good, spent = (sum(x[k] for x in counts) for k in range(3))
    return Row(
        f"{name}: {what}, {len(counts)} objects, contacts and hand solved together",
        "none",
        f"{good} of {triples} certified triples executable ({good / max(triples, 1):.3f}); "
        f"{1e3 * spent / max(good, 1):.1f} ms each",
        None,
        {"triples": triples, "executable": good, "seconds": spent},
    )
