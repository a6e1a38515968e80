"""Planning in batches, each larger than the last, so that the first grasps come early."""

import dataclasses
import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch

from torchgrasp.base import count_status, join
from torchgrasp.errors import Status
from torchgrasp.ik.attempts import Attempts, best_grasps, executable, solve_as_paper, solve_contact_first
from torchgrasp.ik.joint import solve_sliding, try_best_seeds
from torchgrasp.ik.motion import collision_probability
from torchgrasp.ik.refine import ITERATIONS
from torchgrasp.plan.solve import plan_in_turn
from torchgrasp.plan.starts import check_starts
from torchgrasp.planner.contacts import Pool, SeededContacts, contact_costs, find_contacts, join_seeded
from torchgrasp.planner.problem import Problem
from torchgrasp.planner.request import ignore
from torchgrasp.shape.values import surface_deviation
from torchgrasp.specs import Ranking
from torchgrasp.success.features import measure_grasps
from torchgrasp.success.model import load_model
from torchgrasp.success.order import by_success, is_known, keep_promise, rank_by_success, rank_by_variance
from torchgrasp.values import ContactPlan, Grasps, format_success

FIRST, GROWTH = 8, 6
"""Number of contact sets that the hand tries in the first batch, and ratio of the sizes of successive batches."""
FIRST_STEPS = 8
"""Most steps of the solver in the first batch; the second batch tries unsolved contact sets with all steps."""
TRIED, TRIED_IN_SCENE = 250, 160
"""Most contact sets that the hand tries: fewer in a scene, because there it tries more postures for each set."""
OFFERED = 4  # planned rows for each row that the hand tries


class Batch(NamedTuple):
    """The size of one batch: the number of new initial guesses, and of contact sets that the hand tries."""

    starts: int
    tried: int


def schedule(starts: int, most: int) -> list[Batch]:
    """Return batches with `starts` guesses and `most` contact sets in all; a small remainder joins the last batch."""
    batches, size, most = list[Batch](), FIRST, min(most, starts)
    tried = planned = 0
    while tried < most:
        size = size if most - tried >= 2 * size else most - tried
        tried += size
        further = min(starts, max(OFFERED * tried, starts * tried // most)) - planned
        batches.append(Batch(further, size))
        planned, size = planned + further, GROWTH * size
    return batches


def plan_hand(problem: Problem, deadline: float) -> Iterator[Grasps]:
    """Yield the grasps of each batch, as `Planner.run`; if none is likely to hold, plan with relaxed constraints, too.

    A contact set must be flat within the largest of `FLAT_RADII` that the object allows, which can leave few contacts.
    Then the hand may begin above its pose, too, and go down while it closes (`opened_pose`).
    The failed grasps are those of the last constraints (`ContactSpec.relaxed`).
    """
    failed, given, best = list[Grasps](), problem.given_spec, 0.0
    relaxed = given.relaxed(problem.spec.ring_radius, float(problem.hand.tips.radius.max()))
    for spec in (given, *relaxed):
        failed.clear()
        if spec is not given:
            problem = problem.replace("flat", given_spec=spec, descends=True)  # nothing else depends on these
        for grasps in Planner(problem).run(deadline):
            good = grasps[executable(grasps)]
            failed.append(grasps)
            if len(good):
                best = max(best, float(torch.sigmoid(good.score).max()))
                yield from failed
                failed.clear()
        if best > 0.5 or problem.buried or time.monotonic() >= deadline:
            break
    yield from failed


class Planner:
    """Plans the grasps of one problem in batches.

    In mode "joint" the hand first moves onto fixed contacts. Where that fails, contacts and hand move together
    ("sliding contacts"). Sliding is solved only in the last batch, or in a batch without any grasp, because it has a
    fixed cost. Other modes have one batch.
    """

    def __init__(self, problem: Problem) -> None:
        """Begin without any grasps.

        `unfinished` holds contact sets on which a few solver steps failed, `unsolved` sets on which all steps failed.
        Both hold the best failed grasp of each set, too.
        """
        self.problem, self.pool, self.first = problem, Pool(), True
        self.unfinished, self.unsolved = (list[tuple[SeededContacts, Grasps]]() for _ in range(2))

    def run(self, deadline: float) -> Iterator[Grasps]:
        """Yield the grasps of each batch in the upright frame, executable ones first.

        `meta` says how many initial guesses were planned so far. No batch begins after `deadline`, a time of
        `time.monotonic`.
        """
        problem, request = self.problem, self.problem.request
        check_starts(problem.shape, problem.given_spec, request.starts)
        most = TRIED if problem.scene is None else TRIED_IN_SCENE
        batches = schedule(request.starts, most) if request.mode == "joint" else [Batch(request.starts, most)]
        sizes = [batch.starts for batch in batches if batch.starts]
        plans, planned = plan_in_turn(problem.shape, problem.flat, sizes, request.seed), 0
        report = Report(problem, len(batches), len(sizes))
        report.shape()
        for number, batch in enumerate(batches, start=1):
            planned += batch.starts
            plan = next(plans) if batch.starts else None
            if request.mode == "joint":
                solved = self._solve_joint(plan, batch.tried, report, last=number == len(batches))
            else:
                assert plan is not None
                found = find_contacts(problem, plan, batch.tried, report.note)
                solve = solve_as_paper if request.mode == "paper" else solve_contact_first
                solved = solve(problem.reach(found.contacts, found.certificate), found.seeds)
            grasps = rank(problem, solved)
            late = time.monotonic() >= deadline
            if late:
                grasps = join([grasps, *(failed for _, failed in (*self.unfinished, *self.unsolved))])
            report.end_batch(grasps, last=late)
            yield dataclasses.replace(grasps, meta={"starts": str(planned)})
            if late:
                return

    def _solve_joint(self, plan: ContactPlan | None, tried: int, report: "Report", last: bool) -> Grasps:
        """Return grasps on the most promising contact sets so far, and on sets that earlier batches left unsolved."""
        if plan is not None:
            found = find_contacts(self.problem, plan, OFFERED * tried, report.note)
            self.pool.add(found, contact_costs(self.problem, found))
        found = self.pool.take(tried)
        first, self.first = self.first, False
        if first and not last:
            solved, rest, failed = self._on_fixed_contacts(found, FIRST_STEPS)
            if len(solved):
                self.unfinished.append((rest, failed))
                return solved
        found = join_seeded([*(rest for rest, _ in self.unfinished), found])
        self.unfinished.clear()
        solved, rest, failed = self._on_fixed_contacts(found, ITERATIONS)
        self.unsolved.append((rest, failed))
        if len(solved) and not last:
            return solved
        rests, failures = zip(*self.unsolved, strict=True)
        self.unsolved.clear()
        return join([solved, self._with_sliding_contacts(join_seeded(rests), join(failures))])

    def _on_fixed_contacts(self, found: SeededContacts, steps: int) -> tuple[Grasps, SeededContacts, Grasps]:
        """Return grasps on fixed contacts, the contact sets without a grasp, and their best failed grasps."""
        reach = self.problem.reach(found.contacts, found.certificate)
        found = found._replace(seeds=reach.drop_unreachable(found.seeds))
        grasps, row = best_grasps(try_best_seeds(reach, found.seeds, steps))
        solved = executable(grasps)
        return grasps[solved], found.select(row[~solved]), grasps[~solved]

    def _with_sliding_contacts(self, found: SeededContacts, failed: Grasps) -> Grasps:
        """Return grasps with sliding contacts, or the best failed grasp of each contact set."""
        attempts = Attempts(torch.ones_like(found.certificate.closed), executable)
        attempts.add(failed, torch.arange(len(failed), device=failed.status.device))
        reach = self.problem.reach(found.contacts, found.certificate)
        solve_sliding(reach, found.seeds, self.problem.shape, self.problem.spec, attempts)
        return best_grasps(attempts)[0]


def rank(problem: Problem, solved: Grasps) -> Grasps:
    """Return grasps in the order of the request's ranking, scored by the log-odds of success at the request's task.

    If the object cannot be lifted out of its surroundings, its grasps get the status `BURIED`. Grasps of less success
    than a promise asks for get `NO_PROMISE`.
    """
    request, hand, spec = problem.request, problem.hand, problem.spec
    if problem.buried:
        buried = torch.where(solved.status == Status.OK, int(Status.BURIED), solved.status)
        solved = dataclasses.replace(solved, status=buried)
    good = solved[solved.status == Status.OK]
    task = request.grasp_task
    features = measure_grasps(hand, problem.body, good, spec.friction, task, task.lifts(spec.plane))
    log_odds = load_model(features.device).log_odds(features)
    if problem.obstacles is not None:
        free = 1 - collision_probability(hand, good, problem.obstacles, spec.plane).to(log_odds)
        log_odds = torch.logit(torch.sigmoid(log_odds) * free, eps=1e-6)
    ranked = rank_by_success(solved, log_odds, is_known(features) & (not problem.vague))
    if request.promise is not None:
        ranked = keep_promise(ranked, request.promise)
    return ranked if request.order == "success" else rank_by_variance(ranked)


def rank_together(batches: Sequence[Grasps], ranking: Ranking) -> Grasps:
    """Return the grasps of all batches, the executable ones first, with the metadata of the last batch."""
    ranked = by_success(join(batches))
    ranked = ranked if ranking == "success" else rank_by_variance(ranked)
    return dataclasses.replace(ranked, meta=batches[-1].meta)


class Report:
    """Reports progress to the observer: each stage once with the results of all batches, and the end of each batch."""

    def __init__(self, problem: Problem, batches: int, planned: int) -> None:
        """Take the number of all `batches`, and the number `planned` of those batches that plan new initial guesses."""
        self.problem, self.batches, self.planned = problem, batches, planned
        self.parts: dict[str, list[Any]] = {"plan": [], "certify": [], "query": []}
        self.ended = self.offered = self.closed = 0

    def shape(self) -> None:
        """Report the estimated shape, and the fraction of its surface with a standard deviation below 4 mm."""
        if self.problem.request.observer is ignore:
            return
        shape, vertices = self.problem.shape, self.problem.surface.vertices
        jet = shape.jet(shape.normalise(vertices[:: len(vertices) // 500 + 1]))
        std_m = shape.std_factor * shape.scale * surface_deviation(jet.variance, jet.gradient)
        certain = float((std_m < 0.004).double().mean())
        self.problem.tell("shape", f"{len(shape.x)} points, {certain:.0%} of the surface certain to 4 mm", shape)

    def note(self, stage: str, value: Any, offered: int = 0) -> None:
        """Store the result of one stage of one batch; `offered` is how many contact sets stage "certify" checked."""
        if stage == "query":  # rows are counted through all batches
            value = dataclasses.replace(value, row=value.row + self.closed - len(self.parts["certify"][-1]))
        elif stage == "certify":
            self.offered, self.closed = self.offered + offered, self.closed + len(value)
        self.parts[stage].append(value)
        if len(self.parts[stage]) == self.planned:
            self._tell(stage)

    def end_batch(self, grasps: Grasps, last: bool) -> None:
        """Report that a batch has ended; if it is the `last` one, report the stages not yet reported, too."""
        self.ended += 1
        if self.ended < self.batches:
            good = int(executable(grasps).sum())
            best = f", the best {format_success(grasps)} likely" if good else ""
            text = f"{self.ended} of {self.batches}: {good} executable of {len(grasps)}{best}"
            self.problem.tell("batch", text, grasps)
        if last and len(self.parts["plan"]) < self.planned:
            for stage in self.parts:
                self._tell(stage)

    def _tell(self, stage: str) -> None:
        """Report to the observer the results of one stage, from all batches so far."""
        value = join(self.parts[stage])
        if stage == "plan":
            text = f"{len(value)} starts: {describe(count_status(value.status))}"
        elif stage == "certify":
            text = f"{self.closed} of {self.offered} closed at friction {self.problem.spec.planned_friction:g}"
        else:
            text = f"{len(value)} seeds for {len(torch.unique(value.row))} of {self.closed} triples"
        self.problem.tell(stage, text, value)


def describe(counts: dict[Status, int]) -> str:
    """Return how often each status occurs as one line of text, the successes first."""
    ordered = sorted(counts.items(), key=lambda pair: pair[0] is not Status.OK)
    return ", ".join(f"{n} {s.name.lower()}" for s, n in ordered) or "none"
