"""The loop of the planner: contact sets in batches, each larger than the last.

`step` reads like this. Find new contact sets. Choose the most promising. Move the hand onto their
fixed contacts. Where no posture reaches them, move contacts and hand together ("sliding contacts").
A contact set is named by its index in the `Candidates`, its row.
"""

import dataclasses
import time
from collections.abc import Iterator

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchgrasp.foundation.base import join
from torchgrasp.ik.attempts import (
    Attempts,
    best_grasps,
    executable,
    solve_as_paper,
    solve_contact_first,
    try_best_seeds,
)
from torchgrasp.ik.joint import solve_sliding
from torchgrasp.ik.refine import ITERATIONS
from torchgrasp.planner.objects import CloudIndex, Objects
from torchgrasp.planner.ranking import rank
from torchgrasp.planner.report import Report
from torchgrasp.planner.rows import (
    Candidates,
    Row,
    choose,
    draw,
    find_candidates,
    join_candidates,
    with_costs,
)
from torchgrasp.planner.schedule import SCHEDULE
from torchgrasp.values.planning import Grasps

FEW_STEPS = 8
"""Largest number of solver steps in the first batch, for an early grasp; the second batch takes all
steps.
"""


def plan_objects(objects: Objects, deadline: float) -> Iterator[list[Grasps]]:
    """Yield the grasps of each batch as a list, with the grasps of each object, executable ones
    first.

    The grasps are in the upright frame. Their `meta` says how many initial guesses were planned so
    far. No batch begins after `deadline` [s], a time of `time.monotonic`.
    """
    sizes = objects.sizes
    drawn = draw(objects, [size.starts for size in sizes if size.starts])
    report = Report(objects, len(sizes), sum(size.starts > 0 for size in sizes))
    report.shape()
    rows: Candidates | None = None
    planned = 0
    for turn, size in enumerate(sizes, start=1):
        last = turn == len(sizes)
        planned += size.starts
        if size.starts:
            most = SCHEDULE.offered * size.tried if objects.request.mode == "joint" else size.tried
            found = find_candidates(objects, *next(drawn), most, report.note)
            if objects.request.mode == "joint":
                found = with_costs(objects, found)
            rows = found if rows is None else join_candidates([rows, found])
        assert rows is not None
        rows, grasps, cloud = step(objects, rows, size.tried, turn, last)
        late = time.monotonic() >= deadline
        if late:  # what waits for a later batch has failed
            left = torch.cat([rows.find(Row.BEGUN), rows.find(Row.STUCK)])
            if len(left):
                grasps = join([grasps, rows.best(left)])
                cloud = torch.cat([cloud, rows.cloud[left]])
        ranked = rank(objects, grasps, cloud)
        report.end_batch(ranked[0], last=late)
        yield [dataclasses.replace(grasps, meta={"starts": str(planned)}) for grasps in ranked]
        if late:
            return


def step(
    objects: Objects, rows: Candidates, tried: int, turn: int, last: bool
) -> tuple[Candidates, Grasps, CloudIndex]:
    """Return all contact sets after at most `tried` further ones of each object were tried.

    `rows` are the contact sets before. Three results are returned: all contact sets, the grasps of
    those that ended now, and the index of each grasp's object. `turn` is the number of the batch,
    from 1, and `last` says whether it is the last one.
    """
    if objects.request.mode != "joint":
        grasps = solve_all(objects, rows)
        return rows, grasps, torch.zeros_like(grasps.status)
    fresh = choose(rows, tried, len(objects))
    rows = rows.begin(fresh, turn)
    if turn == 1 and not last:
        rows, ended = try_first(objects, rows, fresh)
    else:
        now = torch.cat([rows.find(Row.BEGUN), fresh])
        rows, ended = try_fully(objects, rows, now, now[:0], last)
    return rows, rows.best(ended), rows.cloud[ended]


def try_first(
    objects: Objects, rows: Candidates, fresh: Int[Tensor, "k"]
) -> tuple[Candidates, Int[Tensor, "e"]]:
    """Return all contact sets after some were tried with few solver steps, and the indices of those
    that ended.

    This gives an early grasp. For an object that has no grasp by then, all steps are taken at once.
    `rows` are all contact sets before, and `fresh` the indices of those to try.
    """
    rows, solved = solve_fixed(objects, rows, fresh, FEW_STEPS, Row.BEGUN)
    missing = without(rows, solved, len(objects))
    if not bool(missing.any()):
        return rows, solved
    return try_fully(objects, rows, fresh[missing[rows.cloud[fresh]]], solved, last=False)


def try_fully(
    objects: Objects,
    rows: Candidates,
    now: Int[Tensor, "k"],
    before: Int[Tensor, "d"],
    last: bool,
) -> tuple[Candidates, Int[Tensor, "e"]]:
    """Return all contact sets after some were tried with all solver steps, and the indices of those
    that ended.

    `rows` are all contact sets before, `now` the indices of those to try, and `before` of those
    that ended in this batch already. Contacts that no posture reaches may slide with the hand.
    Sliding has a fixed cost. So it is solved in the `last` batch, and for an object without any
    grasp in this batch.
    """
    clouds = len(objects)
    rows, solved = solve_fixed(objects, rows, now, ITERATIONS, Row.STUCK)
    ended = torch.cat([before, solved])
    slides = torch.ones(clouds, dtype=torch.bool, device=now.device)
    if not last:
        slides = without(rows, ended, clouds)
    if bool(slides.any()):
        rows, slid = solve_with_sliding(objects, rows, rows.find(Row.STUCK, slides))
        ended = torch.cat([ended, slid])
    return rows, ended


def without(rows: Candidates, solved: Int[Tensor, "k"], clouds: int) -> Bool[Tensor, "c"]:
    """Return a mask of the c objects of which no contact set is in `solved`.

    `rows` are all contact sets, `solved` indices of some, and `clouds` is the number c of objects.
    """
    return torch.bincount(rows.cloud[solved], minlength=clouds) == 0


def solve_fixed(
    objects: Objects, rows: Candidates, now: Int[Tensor, "k"], steps: int, failed: Row
) -> tuple[Candidates, Int[Tensor, "s"]]:
    """Return all contact sets after the hand moved onto the contacts of some, and the indices of
    those solved.

    The contacts stay fixed. `rows` are all contact sets before, and `now` the indices of those to
    try with at most `steps` solver steps. Those without a grasp keep their best failed grasp, and
    get the status `failed`.
    """
    contacts, certificate, seeds = rows.select(now)
    reach = objects.reach(contacts, certificate, rows.cloud[now])
    grasps, row = best_grasps(try_best_seeds(reach, seeds, steps))
    solved = executable(grasps)
    status = torch.where(solved, int(Row.ENDED), int(failed))
    return rows.put(now[row], grasps, status), now[row[solved]]


def solve_with_sliding(
    objects: Objects, rows: Candidates, now: Int[Tensor, "k"]
) -> tuple[Candidates, Int[Tensor, "k"]]:
    """Return all contact sets after contacts and hand moved together for some, and the indices of
    these.

    `rows` are all contact sets before, and `now` the indices of those to try. All of them end;
    those without a grasp keep their best failed one.
    """
    contacts, certificate, seeds = rows.select(now)
    attempts = Attempts(torch.ones_like(certificate.closed), executable)
    attempts.add(rows.best(now), torch.arange(len(now), device=now.device))
    reach = objects.reach(contacts, certificate, rows.cloud[now])
    solve_sliding(objects.slide(rows.cloud[now]), reach, seeds, attempts)
    grasps, row = best_grasps(attempts)
    ended = torch.full_like(row, int(Row.ENDED))
    return rows.put(now[row], grasps, ended), now[row]


def solve_all(objects: Objects, rows: Candidates) -> Grasps:
    """Return grasps of all contact sets, by the solver of the mode "paper" or "contact_first".

    `rows` are the contact sets.
    """
    reach = objects.reach(rows.contacts, rows.certificate, rows.cloud)
    solve = solve_as_paper if objects.request.mode == "paper" else solve_contact_first
    return solve(reach, rows.seeds)
