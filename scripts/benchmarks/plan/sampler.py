"""Random triples by rejection alone beside the planner, in the same time: what the optimiser adds to its starts.

The rejection is the planner's own survey of the surface: certain, flat places above the table, triples of which that
are closed. The planner moves them on. Both are checked alike.
"""

import dataclasses
import itertools
import time
from typing import Any

import torch
from tqdm import tqdm

from benchmarks.common import Row
from benchmarks.plan.true_surface import DEFAULT, FRICTION, closed_on_mesh
from torchgrasp import ContactPlan, Hand, Status, fit_shape, load_hand, plan_contacts
from torchgrasp.base import join
from torchgrasp.geometry.signed_distance import field_from_surface
from torchgrasp.ik.candidates import GraspProblem
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.joint import solve_joint
from torchgrasp.ik.seeds import PostureLibrary, nearest_postures
from torchgrasp.plan.certify import certify
from torchgrasp.plan.feasibility import check_feasibility
from torchgrasp.plan.starts import STARTS_PER_CHUNK, drawn_starts, settle_flatness
from torchgrasp.planner.contacts import spread_rows
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import extract_surface

MEASURED = ("rows", "certified", "executable", "closed on the truth", "objective mm", "best objective mm")
"""What is measured: certified is a share of the rows, executable one of `OFFERED` certified triples far apart."""
OFFERED = 40
"""Certified triples offered to the Allegro hand."""


def bench_sampler(views: list[Any], starts: int, seed: int) -> Row:
    """Compare on the first view of each object; means over the objects."""
    first = {name: (cloud, mesh) for name, _, cloud, mesh in reversed(views)}
    hand, found = load_hand("allegro"), {"planner": [], "sampler": []}
    for cloud, mesh in tqdm(first.values(), desc="sampler", disable=None, leave=False):
        shape = fit_shape(cloud, seed=seed, table=DEFAULT.table)
        began = time.process_time()
        planned = plan_contacts(shape, DEFAULT, starts, seed)
        drawn = sample(shape, time.process_time() - began, seed)
        for name, plan in (("planner", planned), ("sampler", drawn)):
            found[name].append(judge(shape, plan, mesh, hand, seed))
    mean = {name: [sum(column) / len(column) for column in zip(*rows, strict=True)] for name, rows in found.items()}
    return Row(
        f"{starts} starts of the planner beside rejection alone in the same time, mean of {len(first)} objects",
        "none",
        "; ".join(
            f"{name} " + ", ".join(f"{what} {x:.3g}" for what, x in zip(MEASURED, values, strict=True))
            for name, values in mean.items()
        ),
        None,
        {"found": found, "friction": FRICTION},
    )


def sample(shape: ShapeGP, seconds: float, seed: int) -> ContactPlan:
    """Return random triples, checked, as many as fit into the processor's time."""
    began, parts, flat = time.process_time(), [], dataclasses.replace(DEFAULT, flat_radius=DEFAULT.ring_radius)
    for draw in itertools.count(seed):
        settled = settle_flatness(shape, flat, draw)
        parts += [check_feasibility(shape, flat, x) for x in drawn_starts(shape, settled, [STARTS_PER_CHUNK], draw)]
        if time.process_time() - began >= seconds:
            break
    return join(parts)


def judge(shape: ShapeGP, plan: ContactPlan, mesh: Any, hand: Hand, seed: int) -> tuple[float, ...]:
    """Return `MEASURED` of a plan."""
    good = plan[plan.status == Status.OK]
    closed = closed_on_mesh(good.contacts, mesh).double().mean() if len(good) else torch.tensor(torch.nan)
    contacts = plan.contacts[spread_rows(plan, OFFERED)]
    surface = extract_surface(shape)
    world = CollisionWorld(field_from_surface(surface.vertices, surface.faces), DEFAULT.plane)
    problem = GraspProblem(hand, contacts, certify(contacts, DEFAULT), world, surface.vertices.mean(0))
    seeds = nearest_postures(PostureLibrary.of(hand, seed=seed), contacts, world)
    grasps = solve_joint(problem, seeds, shape, DEFAULT)
    executable = float((grasps.status == Status.OK).sum()) / max(len(contacts), 1)
    quality = 1e3 * good.quality
    return (
        float(len(plan)),
        len(good) / len(plan),
        executable,
        float(closed),
        float(quality.mean()),
        float(quality.min()) if len(good) else float("nan"),
    )
