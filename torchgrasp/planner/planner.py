"""The loop of the planner: contact sets in batches, each larger than the last.

`step` reads like this. Find new contact sets. Choose the most promising. Move the hand onto their
fixed contacts. Where no posture reaches them, move contacts and hand together ("sliding contacts").
A contact set is named by its row, which is its index in the `Candidates`. Here c counts objects,
and the letters k, d, e and s count such indices.
"""

import dataclasses
import time
from collections.abc import Iterator

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchgrasp.foundation.base import join, row_numbers
from torchgrasp.ik.attempts import (
    Attempts,
    best_grasps,
    is_executable,
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
    """Yield a list after each batch of initial guesses: for each object, the grasps that this batch
    finished.

    Grasps of earlier batches are not repeated. A search that goes on gives its grasp in a later
    batch. Executable grasps come first. The grasps are in the upright frame of their object. Their
    `meta` has, as "starts", the number of initial guesses planned so far. No batch begins after
    `deadline` [s], a time of `time.monotonic`.
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


def plan_object(objects: Objects, deadline: float) -> Iterator[Grasps]:
    """Yield the grasps of each batch of initial guesses of the one object in `objects`.

    Executable grasps come first. They are in the upright frame. No batch begins after `deadline`
    [s], a time of `time.monotonic`.
    """
    for (grasps,) in plan_objects(objects, deadline):
        yield grasps


def step(
    objects: Objects, rows: Candidates, tried: int, turn: int, last: bool
) -> tuple[Candidates, Grasps, CloudIndex]:
    """Try to grasp at most `tried` further contact sets of each object.

    Return three results: all contact sets `rows` with their new states and grasps; the best grasp
    of each set whose search ended in this batch; the index of each grasp's object. `turn` is the
    number of the batch, from 1, and `last` says whether it is the last one. In a mode other than
    "joint" all sets are tried (`solve_all`), and `rows` stay unchanged.
    """
    if objects.request.mode != "joint":
        grasps = solve_all(objects, rows)
        return rows, grasps, torch.zeros_like(grasps.status)
    fresh = choose(rows, tried, len(objects))
    rows = rows.begin(fresh, turn)
    if turn == 1 and not last:
        rows, ended = try_first(objects, rows, fresh)
    else:
        begun = torch.cat([rows.find(Row.BEGUN), fresh])
        rows, ended = try_fully(objects, rows, begun, begun[:0], last)
    return rows, rows.best(ended), rows.cloud[ended]


def try_first(
    objects: Objects, rows: Candidates, fresh: Int[Tensor, "k"]
) -> tuple[Candidates, Int[Tensor, "e"]]:
    """Solve for the hand on fixed contacts with at most 8 solver steps, for an early grasp.

    `rows` are all contact sets, and `fresh` holds the indices of those to try. Return `rows` with
    the new states and grasps, then the indices of the sets whose search ended. A set with an
    executable grasp gets the state `Row.ENDED`, a failed one `Row.BEGUN`. For an object without a
    grasp by then, `try_fully` goes on with its sets at once.
    """
    rows, solved = solve_fixed(objects, rows, fresh, FEW_STEPS, Row.BEGUN)
    missing = without(rows, solved, len(objects))
    if not bool(missing.any()):
        return rows, solved
    return try_fully(objects, rows, fresh[missing[rows.cloud[fresh]]], solved, last=False)


def try_fully(
    objects: Objects,
    rows: Candidates,
    tried: Int[Tensor, "k"],
    ended: Int[Tensor, "d"],
    last: bool,
) -> tuple[Candidates, Int[Tensor, "e"]]:
    """Solve for the hand on fixed contacts with all solver steps, then with sliding contacts.

    `rows` are all contact sets, and `tried` holds the indices of those to try. `ended` holds the
    indices of those whose search ended earlier in this batch. Return `rows` with the new states and
    grasps, then `ended` with the indices of the sets whose search ended now.

    A set with an executable grasp gets the state `Row.ENDED`, a failed one `Row.STUCK`. Sliding
    contacts (`solve_with_sliding`) take long. In the `last` batch they are tried for all stuck
    sets. In others they are tried for stuck sets of objects without a grasp in this batch. The
    search of these sets then ends.
    """
    clouds = len(objects)
    rows, solved = solve_fixed(objects, rows, tried, ITERATIONS, Row.STUCK)
    ended = torch.cat([ended, solved])
    wanting = without(rows, ended, clouds)
    if last:
        wanting = torch.ones_like(wanting)
    if bool(wanting.any()):
        stuck = rows.find(Row.STUCK, wanting)
        rows, slid = solve_with_sliding(objects, rows, stuck)
        ended = torch.cat([ended, slid])
    return rows, ended


def without(rows: Candidates, solved: Int[Tensor, "k"], clouds: int) -> Bool[Tensor, "c"]:
    """Return a mask (c,) of the objects of which no contact set is solved.

    `rows` are all contact sets, and `solved` holds the indices of the solved ones. `clouds` is the
    number c of objects.
    """
    return torch.bincount(rows.cloud[solved], minlength=clouds) == 0


def solve_fixed(
    objects: Objects, rows: Candidates, now: Int[Tensor, "k"], steps: int, failed: Row
) -> tuple[Candidates, Int[Tensor, "s"]]:
    """Solve for the hand on fixed contacts, with at most `steps` solver steps.

    `rows` are all contact sets, and `now` holds the indices of those to try. Return `rows` with the
    new states and grasps, then the indices of the sets that have an executable grasp now. These
    sets get the state `Row.ENDED`. The others in `now` get the state `failed` and their best failed
    grasp.
    """
    contacts, certificate, seeds = rows.select(now)
    reach = objects.reach(contacts, certificate, rows.cloud[now])
    # the contacts of a set are the same in all its grasps, so strength decides
    grasps, row = best_grasps(try_best_seeds(reach, seeds, steps), objects.strength)
    solved = is_executable(grasps)
    status = torch.where(solved, int(Row.ENDED), int(failed))
    return rows.put(now[row], grasps, status), now[row[solved]]


def solve_with_sliding(
    objects: Objects, rows: Candidates, now: Int[Tensor, "k"]
) -> tuple[Candidates, Int[Tensor, "k"]]:
    """Solve for hand and contacts together, where the contacts slide on the surface.

    `rows` are all contact sets, and `now` (k,) holds the indices of those to try. Each must have a
    failed grasp from its fixed contacts. Return `rows` with the new states and grasps, then the
    same k indices, in any order. Each set of `now` gets the state `Row.ENDED` and its best grasp so
    far, which may be a failed one.
    """
    contacts, certificate, seeds = rows.select(now)
    attempts = Attempts(torch.ones_like(certificate.closed), is_executable)
    attempts.add(rows.best(now), row_numbers(now))
    reach = objects.reach(contacts, certificate, rows.cloud[now])
    solve_sliding(objects.slide(rows.cloud[now]), reach, seeds, attempts)
    grasps, row = best_grasps(attempts)
    ended = torch.full_like(row, int(Row.ENDED))
    return rows.put(now[row], grasps, ended), now[row]


def solve_all(objects: Objects, rows: Candidates) -> Grasps:
    """Return the grasps of all contact sets `rows` in the modes "paper" and "contact_first",
    executable ones first.

    `objects.request.mode` is the mode that the user chose. In "paper", the paper's solver (COBYLA)
    moves the hand onto the contacts. In "contact_first", postures of the learned model are refined
    onto fixed contacts. `objects` holds the shapes of all objects, the hand and the constraints.
    The grasps are in the upright frame.
    """
    reach = objects.reach(rows.contacts, rows.certificate, rows.cloud)
    solve = solve_as_paper if objects.request.mode == "paper" else solve_contact_first
    return solve(reach, rows.seeds)
