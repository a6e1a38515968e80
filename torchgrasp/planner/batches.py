"""Planning in batches, each larger than the last, so that the first grasps come early."""

import dataclasses
import time
from collections.abc import Iterator, Sequence
from itertools import accumulate
from typing import NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor

from torchgrasp.contacts.resist import resist_loads
from torchgrasp.foundation.base import join
from torchgrasp.foundation.errors import Status
from torchgrasp.ik.attempts import (
    Attempts,
    best_grasps,
    executable,
    solve_as_paper,
    solve_contact_first,
)
from torchgrasp.ik.joint import solve_sliding, try_best_seeds
from torchgrasp.ik.motion import collision_probability
from torchgrasp.ik.refine import ITERATIONS
from torchgrasp.planner.contacts import (
    Pool,
    SeededContacts,
    contact_costs,
    find_contacts,
    join_seeded,
)
from torchgrasp.planner.problem import Problem
from torchgrasp.planner.report import Report
from torchgrasp.planner.schedule import OFFERED
from torchgrasp.planner.stack import Owner, Stack, by_cloud
from torchgrasp.success.features import measure_grasps
from torchgrasp.success.loads import strength_of
from torchgrasp.success.model import load_success_model
from torchgrasp.success.order import by_success, grade, is_covered, keep_promise, rank_by_variance
from torchgrasp.values.planning import ContactPlan, Grasps
from torchgrasp.values.specs import Ranking


def plan_hand(problem: Problem, deadline: float) -> Iterator[Grasps]:
    """Yield the grasps of each batch, as `Planner.run`; if none is likely to hold, plan with
    relaxed constraints, too.

    A contact set must be flat within the largest of `FLAT_RADII` that the object allows, which can
    leave few contacts. Then the hand may begin above its pose, too, and go down while it closes
    (`opened_pose`). The failed grasps are those of the last constraints (`ContactSpec.relaxed`).
    """
    batches = (grasps for (grasps,) in Planner(Stack.of([problem])).run(deadline))
    yield from _relax(problem, batches, deadline)


def plan_hands(
    problems: Sequence[Problem], deadline: float, device: torch.device
) -> list[list[Grasps]]:
    """Return for each problem the batches that `plan_hand` yields; all problems are solved together
    on a device.
    """
    if not problems:
        return []
    batches = zip(*Planner(Stack.of(problems, device)).run(deadline), strict=True)
    return [
        list(_relax(problem, iter(own), deadline))
        for problem, own in zip(problems, batches, strict=True)
    ]


def _relax(problem: Problem, batches: Iterator[Grasps], deadline: float) -> Iterator[Grasps]:
    """Yield batches with the given constraints; if no grasp is likely to hold, plan with relaxed
    constraints, too.
    """
    failed = list[Grasps]()
    best = 0.0
    relaxed = problem.given_spec.relaxed(
        problem.spec.ring_radius, float(problem.hand.tips.radius.max())
    )
    while True:
        failed.clear()
        for grasps in batches:
            good = grasps[executable(grasps)]
            failed.append(grasps)
            if len(good):
                best = max(best, float(torch.sigmoid(good.score).max()))
                yield from failed
                failed.clear()
        spec = (
            None
            if best > 0.5 or problem.buried or time.monotonic() >= deadline
            else next(relaxed, None)
        )
        if spec is None:
            break
        problem = problem.replace(
            "flat", "drawn", given_spec=spec, descends=True
        )  # nothing else depends on these
        batches = (grasps for (grasps,) in Planner(Stack.of([problem])).run(deadline))
    yield from failed


class Owned(NamedTuple):
    """Grasps of several clouds, with the cloud of each."""

    grasps: Grasps
    owner: Owner

    def select(self, rows: Tensor) -> "Owned":
        """Return the grasps at a mask or indices."""
        return Owned(self.grasps[rows], self.owner[rows])


def join_owned(parts: Sequence[Owned]) -> Owned:
    """Return several groups of grasps as one group, in order."""
    return Owned(join([part.grasps for part in parts]), torch.cat([part.owner for part in parts]))


class Planner:
    """Plans the grasps of one problem, or of a stack of problems, in batches.

    In mode "joint" the hand first moves onto fixed contacts. Where that fails, contacts and hand
    move together ("sliding contacts"). Sliding is solved only in the last batch, or for a cloud
    without any grasp in the batch, because it has a fixed cost. Other modes have one batch.
    """

    def __init__(self, stack: Stack) -> None:
        """Begin without any grasps.

        `unfinished` holds contact sets on which a few solver steps failed, `unsolved` sets on which
        all steps failed. Both hold the best failed grasp of each set, too.
        """
        self.stack = stack
        self.pool = Pool(len(stack))
        self.first = True
        self.unfinished, self.unsolved = (list[tuple[SeededContacts, Owned]]() for _ in range(2))

    def run(self, deadline: float) -> Iterator[list[Grasps]]:
        """Yield the grasps of each batch, one value for each cloud, in the upright frame,
        executable ones first.

        `meta` says how many initial guesses were planned so far. No batch begins after `deadline`,
        a time of `time.monotonic`.
        """
        stack = self.stack
        problem = self.stack.first
        request = self.stack.first.request
        batches = problem.batches
        plans = stack.plans()
        planned = 0
        report = Report(problem, len(batches), sum(batch.starts > 0 for batch in batches))
        report.shape()
        waiting = list[Owned]()
        for number, batch in enumerate(batches, start=1):
            planned += batch.starts
            plan = next(plans) if batch.starts else None
            if request.mode == "joint":
                solved = self._solve_joint(plan, batch.tried, report, last=number == len(batches))
            else:
                assert plan is not None
                found = find_contacts(stack, *plan, batch.tried, report.note)
                solve = solve_as_paper if request.mode == "paper" else solve_contact_first
                grasps = solve(
                    stack.reach(found.contacts, found.certificate, found.owner), found.seeds
                )
                solved = Owned(grasps, torch.zeros_like(grasps.status))
            late = time.monotonic() >= deadline
            waiting.append(solved)
            if len(stack) > 1 and not (late or number == len(batches)):
                # the grasps of several clouds are ranked once, because the host waits for them
                continue
            ranked = rank(stack, join_owned(waiting))
            waiting.clear()
            if late:
                ranked = self._with_failures(ranked)
            report.end_batch(ranked[0], last=late)
            yield [dataclasses.replace(grasps, meta={"starts": str(planned)}) for grasps in ranked]
            if late:
                return

    def _solve_joint(
        self, plan: tuple[ContactPlan, Owner] | None, tried: int, report: Report, last: bool
    ) -> Owned:
        """Return grasps on the most promising contact sets so far, and on sets that earlier batches
        left unsolved.
        """
        if plan is not None:
            found = find_contacts(self.stack, *plan, OFFERED * tried, report.note)
            self.pool.add(*contact_costs(self.stack, found))
        found = self.pool.take(tried)
        done = list[Owned]()
        first = self.first
        self.first = False
        if first and not last:
            few = 8  # most steps; the second batch tries unsolved contact sets with all steps
            solved, rest, failed = self._on_fixed_contacts(found, few)
            without = self._without(solved)
            self.unfinished.append(_part(rest, failed, ~without))
            found = found.select(torch.nonzero(without[found.owner])[:, 0])
            done = [solved]
            if not bool(without.any()):
                return solved
        else:
            found = join_seeded([*(rest for rest, _ in self.unfinished), found])
            self.unfinished.clear()
        solved, rest, failed = self._on_fixed_contacts(found, ITERATIONS)
        self.unsolved.append((rest, failed))
        sliding = torch.ones(len(self.stack), dtype=torch.bool, device=rest.owner.device)
        if not last:
            sliding = self._without(join_owned([*done, solved]))
        if bool(sliding.any()):
            now = [_part(*part, sliding) for part in self.unsolved]
            self.unsolved = (
                [] if bool(sliding.all()) else [_part(*part, ~sliding) for part in self.unsolved]
            )
            rests, failures = zip(*now, strict=True)
            solved = join_owned(
                [solved, self._with_sliding_contacts(join_seeded(rests), join_owned(failures))]
            )
        return join_owned([*done, solved])

    def _with_failures(self, ranked: list[Grasps]) -> list[Grasps]:
        """Return the grasps of each cloud, followed by the failed grasps of contact sets that were
        left for later.
        """
        parts = [failed for _, failed in (*self.unfinished, *self.unsolved)]
        if not parts:
            return ranked
        grasps, owner = join_owned(parts)
        grasps = self.stack.first.on_arm(grasps)
        grasps = prove_resistance(self.stack, Owned(grasps, owner))
        clouds = zip(ranked, by_cloud(owner, len(self.stack)), strict=True)
        return [join([found, grasps[own].to(found.joints.device)]) for found, own in clouds]

    def _without(self, solved: Owned) -> Bool[Tensor, "c"]:
        """Return a mask of the clouds that have no grasp among those solved."""
        return torch.bincount(solved.owner, minlength=len(self.stack)) == 0

    def _on_fixed_contacts(
        self, found: SeededContacts, steps: int
    ) -> tuple[Owned, SeededContacts, Owned]:
        """Return grasps on fixed contacts, the contact sets without a grasp, and their best failed
        grasps.
        """
        reach = self.stack.reach(found.contacts, found.certificate, found.owner)
        grasps, row = best_grasps(try_best_seeds(reach, found.seeds, steps))
        solved = executable(grasps)
        every = Owned(grasps, found.owner[row])
        return every.select(solved), found.select(row[~solved]), every.select(~solved)

    def _with_sliding_contacts(self, found: SeededContacts, failed: Owned) -> Owned:
        """Return grasps with sliding contacts, or the best failed grasp of each contact set."""
        attempts = Attempts(torch.ones_like(found.certificate.closed), executable)
        attempts.add(failed.grasps, torch.arange(len(failed.owner), device=failed.owner.device))
        reach = self.stack.reach(found.contacts, found.certificate, found.owner)
        solve_sliding(self.stack.slide(found.owner), reach, found.seeds, attempts)
        grasps, row = best_grasps(attempts)
        return Owned(grasps, found.owner[row])


def _part(
    rest: SeededContacts, failed: Owned, clouds: Bool[Tensor, "c"]
) -> tuple[SeededContacts, Owned]:
    """Return contact sets and their failed grasps of some of the clouds."""
    rows = torch.nonzero(clouds[rest.owner])[:, 0]
    return rest.select(rows), failed.select(rows)


def rank(stack: Stack, solved: Owned) -> list[Grasps]:
    """Return the grasps of each cloud in the order of the request's ranking, scored by their
    log-odds of success.

    If the object cannot be lifted out of its surroundings, its grasps get the status `BURIED`.
    Grasps of less success than a promise asks for get `NO_PROMISE`.
    """
    problem = stack.first
    hand = stack.hand
    request = stack.first.request
    grasps = solved.grasps
    spec = stack.first.spec
    task = request.grasp_task
    if problem.buried:
        buried = torch.where(grasps.status == Status.OK, int(Status.BURIED), grasps.status)
        grasps = dataclasses.replace(grasps, status=buried)
    grasps = problem.on_arm(grasps)
    grasps = prove_resistance(stack, Owned(grasps, solved.owner))
    rows = torch.nonzero(grasps.status == Status.OK)[:, 0]
    good = grasps[rows]
    body = stack.body.rows(solved.owner[rows])
    features = measure_grasps(hand, body, good, spec.friction, task, task.lifts(spec.plane))
    log_odds = load_success_model(features.device).log_odds(features)
    if problem.obstacles is not None:
        free = 1 - collision_probability(hand, good, problem.obstacles, spec.plane).to(log_odds)
        log_odds = torch.logit(torch.sigmoid(log_odds) * free, eps=1e-6)
    known = is_covered(features)
    owner = solved.owner
    if len(stack) > 1:  # the host sorts
        cpu = torch.device("cpu")
        grasps = grasps.to(cpu)
        log_odds = log_odds.cpu()
        known = known.cpu()
        owner = owner.cpu()
        rows = rows.cpu()
    vague = torch.tensor([one.vague for one in stack.problems], device=known.device)
    graded = grade(grasps, log_odds, known & ~vague[owner[rows]])
    if request.promise is not None:
        graded = keep_promise(graded, request.promise)
    ranked = by_success(graded, owner)
    counts = torch.bincount(owner, minlength=len(stack)).tolist()
    found = [
        ranked[last - count : last] for last, count in zip(accumulate(counts), counts, strict=True)
    ]
    return found if request.order == "success" else [rank_by_variance(one) for one in found]


def prove_resistance(stack: Stack, solved: Owned) -> Grasps:
    """Return grasps with the loads that they resist; of executable ones, those that resist less
    than all fail.
    """
    grasps = solved.grasps
    contacts = solved.grasps.contacts
    if stack.loads is None:
        return grasps
    strength = strength_of(stack.hand, grasps, contacts, stack.strongest)
    own = stack.loads[solved.owner]
    proof = resist_loads(contacts.points, contacts.normals, strength, own, stack.first.spec)
    fields = dict(
        zip(("task_margin", "task_load", "task_twist", "task_forces"), proof, strict=True)
    )
    weak = (grasps.status == Status.OK) & ~(proof.margin >= 1)
    status = grasps.status.masked_fill(weak, int(Status.NOT_RESISTED))
    proven = dataclasses.replace(grasps.certificate, task_strength=strength, **fields)
    return dataclasses.replace(grasps, certificate=proven, status=status)


def rank_together(batches: Sequence[Grasps], ranking: Ranking) -> Grasps:
    """Return the grasps of all batches, the executable ones first, with the metadata of the last
    batch.
    """
    ranked = by_success(join(batches))
    ranked = ranked if ranking == "success" else rank_by_variance(ranked)
    return dataclasses.replace(ranked, meta=batches[-1].meta)
