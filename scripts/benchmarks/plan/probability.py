"""Whether the probability of closure is true: planned and random contacts, judged on the true surface.

Nothing of it was fitted to closures: every object is unseen. Bins, errors and intervals are over whole families.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from benchmarks.common import Row
from benchmarks.ground_truth import read_views, sample_mesh
from benchmarks.plan.true_surface import DEFAULT, FRICTION, closed_on_mesh
from torchgrasp import ContactSpec, Status, closure_probability, fit_shape, plan_contacts
from torchgrasp.data import read_family, read_group
from torchgrasp.evaluation.calibration import BINS, judge
from torchgrasp.evaluation.intervals import count_by, format_share, share_over
from torchgrasp.files import format_columns
from torchgrasp.plan.closure import closed_exact
from torchgrasp.plan.closure_probability import well_inside
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import extract_surface
from torchgrasp.values import Contacts

TRIPLES, TRIED, SAMPLES = 24, 20_000, 3000
"""Rows of contacts of each sort in a view; random ones that are tried for them, and points of the surface."""
SIDES = (0.015, 0.110)
"""Least and greatest distance [m] between two random contacts."""
LOW, SHARE_OF_HEIGHT = 0.010, 0.3
"""Random contacts are so high [m], or on low things this share of their height."""
HARD = 1.0
"""Friction at which a hard triple is closed on the estimate: 4 in 10 of these are closed at .6 on the true surface."""
DRAWS = 400
"""Surfaces drawn for each probability, whose error is then 0.025 at most."""
NEAR, ERROR, SKILL, AREA = 0.08, 0.05, 0.3, 0.85
"""Bars of the bins, of the expected calibration error, of Brier skill and of the area under the curve."""
ENOUGH = 30
"""Triples from which on a bin is judged."""
CLOSED = {"solid": 0.93, "thin": 0.80, "shell": 0.80}
"""Bars of the planned triples that are closed."""
SORTS = ("planned", "random", "hard")
"""Certified plans; any triples of the estimated surface; triples of it that are closed there with much friction."""

Asked = dict[str, Any]
"""Of a triple: its sort, object's family and group, the probability, and whether it is closed on the true surface."""


def bench_probability(objects: Path, views: Sequence[str], starts: int, seed: int, fingertips: int = 3) -> list[Row]:
    """Compare the probability of closure with closure on the true surface, for every view of a folder."""
    asked: list[Asked] = []
    spec = ContactSpec(friction=FRICTION)
    for name, _, cloud, mesh in tqdm(list(read_views(objects, views=views)), desc="probability", disable=None):
        shape = fit_shape(cloud, table=0.0)
        told = {"family": read_family(objects, name), "group": read_group(objects, name)}
        for sort, contacts in draw_contacts(shape, mesh, starts, seed, fingertips).items():
            contacts = contacts[well_inside(shape, contacts)]
            said = closure_probability(shape, contacts, spec, DRAWS, seed).probability.tolist()
            closed = closed_on_mesh(contacts, mesh).tolist()
            asked += [told | {"sort": sort, "said": p, "closed": y} for p, y in zip(said, closed, strict=True)]
    print(format_reliability(asked))
    groups = sorted({str(row["group"]) for row in asked})
    return [judge_triples(asked), *(planned_closed(asked, group) for group in groups)]


def draw_contacts(shape: ShapeGP, mesh: Any, starts: int, seed: int, fingertips: int) -> dict[str, Contacts]:
    """Return up to 24 rows of contacts of each of `SORTS`."""
    plan = plan_contacts(shape, dataclasses.replace(DEFAULT, fingertips=fingertips), starts, seed)
    found = {"planned": plan[plan.status == Status.OK].contacts[:TRIPLES]}
    generator = np.random.default_rng(seed)
    points, _ = sample_mesh(extract_surface(shape).mesh(), SAMPLES, generator)
    points = points[shape.contains(points)]
    normals = shape.predict(points).normal
    low, high = mesh.bounds[:, 2]
    rows = torch.nonzero(points[:, 2] > low + min(LOW, SHARE_OF_HEIGHT * (high - low)))[:, 0]
    drawn = rows[torch.from_numpy(generator.integers(max(len(rows), 1), size=(TRIED if len(rows) else 0, fingertips)))]
    first, second = torch.tensor(list(itertools.combinations(range(fingertips), 2))).T
    side = torch.linalg.vector_norm(points[drawn[:, first]] - points[drawn[:, second]], dim=-1)
    drawn = drawn[(side.amin(-1) > SIDES[0]) & (side.amax(-1) < SIDES[1])]
    hard = closed_exact(points[drawn], normals[drawn], HARD)
    for sort, chosen in (("random", drawn), ("hard", drawn[hard])):
        chosen = chosen[:TRIPLES]
        found[sort] = Contacts(points[chosen], normals[chosen])
    return found


def judge_triples(asked: Sequence[Asked]) -> Row:
    """Return the row of the bars of all sorts together."""
    said, closed = _columns(asked)
    found = judge(said, closed, [row["family"] for row in asked])
    bins: Any = found["bins"]
    off = max((abs(b.predicted - b.passed.value) for b in bins if b.passed.total >= ENOUGH), default=float("nan"))
    error, skill, area = (float(found[name]) for name in ("error", "skill", "auc"))  # pyright: ignore[reportArgumentType]
    return Row(
        f"probability of closure of {len(asked)} planned and random contacts, the truth at friction {FRICTION}",
        f"bins within {NEAR}, expected calibration error <= {ERROR}, Brier skill >= {SKILL}, area >= {AREA}",
        f"worst bin {off:.3f}, error {error:.3f}, skill {skill:.2f}, area {area:.3f}",
        off <= NEAR and error <= ERROR and skill >= SKILL and area >= AREA,
        {"said": said.tolist(), "closed": closed.tolist(), "sort": [row["sort"] for row in asked]},
    )


def planned_closed(asked: Sequence[Asked], group: str) -> Row:
    """Return the row of the planned triples of a group that are closed on the true surface."""
    mine = [row for row in asked if row["group"] == group and row["sort"] == "planned"]
    share, bar = share_over(count_by((row["family"], row["closed"]) for row in mine)), CLOSED.get(group)
    return Row(
        f"planned triples closed on the true surface at friction {FRICTION}, {group or 'all'}",
        "none" if bar is None else f">= {bar}",
        format_share(share),
        None if bar is None else share.value >= bar,
        share._asdict(),
    )


def format_reliability(asked: Sequence[Asked]) -> str:
    """Return said and true shares by bins, for each sort, for each group and for all, as a table."""
    heads = [f"{k / BINS:.1f}-" for k in range(BINS)]
    table: list[tuple[str, ...]] = [("triples", "number", "closed %", "said %", "ECE", "skill", "area", *heads)]
    groups = sorted({str(row["group"]) for row in asked})
    parts = [(sort, [row for row in asked if row["sort"] == sort]) for sort in SORTS]
    parts += [(group, [row for row in asked if row["group"] == group]) for group in groups]
    for name, mine in [*parts, ("all", list(asked))]:
        if not mine:
            continue
        found = judge(*_columns(mine), [row["family"] for row in mine])
        cells = [""] * BINS
        for one in found["bins"]:  # pyright: ignore[reportGeneralTypeIssues]
            cells[round(one.low * BINS)] = f"{one.predicted:.2f} {one.passed.value:.2f} ({one.passed.total})"
        shares = (f"{100 * float(found[key]):.1f}" for key in ("passed", "predicted"))  # pyright: ignore[reportArgumentType]
        scores = (f"{found['error']:.3f}", f"{found['skill']:.2f}", f"{found['auc']:.3f}")
        table.append((name or "-", str(len(mine)), *shares, *scores, *cells))
    return format_columns(table, left=(0,))


def _columns(asked: Sequence[Asked]) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the probabilities, and which triples are closed."""
    return torch.tensor([row["said"] for row in asked]), torch.tensor([row["closed"] for row in asked])
