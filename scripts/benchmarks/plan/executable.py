"""How many starts become grasps that a hand can take, and what one costs, in both modes.

A start is certified when its planned contacts are (default specification with a table, LP margin
and rank). The cost of a grasp is the processor's time of planning, certificates, seeds and solving;
the shape and its distance field are given.
"""

import time
from collections.abc import Sequence
from typing import Any

import torch
from tqdm import tqdm

from benchmarks.common import Options, Row, bench
from benchmarks.ground_truth import read_views
from torchgrasp import (
    ContactSpec,
    PointCloud,
    Status,
    certify,
    fit_shape,
    load_hand,
    load_mixture,
    plan_contacts,
)
from torchgrasp.foundation.base import count_status
from torchgrasp.geometry.signed_distance import field_from_surface
from torchgrasp.ik.attempts import solve_contact_first
from torchgrasp.ik.candidates import GraspProblem
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.joint import solve_joint
from torchgrasp.ik.seeds import PostureLibrary, nearest_postures, query_mixture
from torchgrasp.shape.surface import extract_surface

SPEC = ContactSpec(table=0.0)
BARS = {("allegro", "contact_first"): (0.60, torch.inf), ("allegro", "joint"): (0.85, 20.0)}
"""Least mean share of certified starts that become executable, and most milliseconds of one of
these grasps.
"""


@bench("plan/executable", objects=True)
def executable(o: Options) -> list[Row]:
    """Count the executable grasps of each hand and mode on the first view of each object."""
    first = {
        name: cloud for name, _, cloud, _ in reversed(list(read_views(o.objects[0], views=o.views)))
    }
    results: dict[tuple[str, str], dict[str, dict[str, Any]]] = {}
    for name, cloud in tqdm(first.items(), desc="executable", disable=None, leave=False):
        for key, found in solve_view(cloud, o.hands, o.starts, o.seed).items():
            results.setdefault(key, {})[name] = found
    return [_row(*key, objects, o.starts) for key, objects in results.items()]


def solve_view(
    cloud: PointCloud, hands: Sequence[str], starts: int, seed: int
) -> dict[tuple[str, str], dict[str, Any]]:
    """Return what became of the starts on one view, by hand and mode."""
    shape = fit_shape(cloud, seed=seed, table=SPEC.table)
    found = {}
    surface = extract_surface(shape)
    world = CollisionWorld(field_from_surface(surface.vertices, surface.faces), SPEC.plane)
    began = time.process_time()
    plan = plan_contacts(shape, SPEC, starts, seed)
    certificate = certify(plan.contacts, SPEC)
    closed = (plan.status == Status.OK) & certificate.closed
    contacts = plan.contacts[closed]
    certificate = certificate[closed]
    planned = time.process_time() - began
    for name in hands:
        hand = load_hand(name)
        problem = GraspProblem(hand, contacts, certificate, world, surface.vertices.mean(0))
        for mode in ("contact_first", "joint"):
            began = time.process_time()
            if mode == "joint":
                library = PostureLibrary.of(hand, seed=seed)
                grasps = solve_joint(
                    problem, nearest_postures(library, contacts, world), shape, SPEC
                )
            else:
                grasps = solve_contact_first(
                    problem, query_mixture(hand, contacts, load_mixture(name))
                )
            counts = {status.name: count for status, count in count_status(grasps.status).items()}
            good = counts.get("OK", 0)
            milliseconds = 1e3 * (planned + time.process_time() - began)
            told = {
                "certified": len(contacts),
                "executable": good,
                "share": good / max(len(contacts), 1),
            }
            found[name, mode] = told | {"ms": milliseconds / max(good, 1), "statuses": counts}
    return found


def _row(hand: str, mode: str, objects: dict[str, dict[str, Any]], starts: int) -> Row:
    """Return the row of one hand and mode: means over the objects, and each object's own numbers."""
    share, cost, certified, good = (
        sum(o[key] for o in objects.values()) / len(objects)
        for key in ("share", "ms", "certified", "executable")
    )
    least, most = BARS.get((hand, mode), (0.0, torch.inf))
    each = ", ".join(
        f"{n} {o['share']:.2f} ({o['executable']}, {o['ms']:.0f} ms)" for n, o in objects.items()
    )
    counts = f"of {starts} starts {certified:.0f} certified, {good:.0f} executable"
    return Row(
        f"certified starts that become executable grasps, {hand}, {mode}, mean of {len(objects)} objects",
        f"share >= {least}, <= {most:g} ms" if least else "-",
        f"{share:.3f}, {cost:.1f} ms a grasp; {counts}; {each}",
        (share >= least and cost <= most) if least else None,
        {"objects": objects},
    )
