"""Rows of the peer: seconds of one thread for each grasp, its search alone, from our postures, and our whole call."""

import dataclasses
import math
import time

from benchmarks.anytime.course import Course
from benchmarks.anytime.single_start import SingleStart
from benchmarks.common import Row
from torchgrasp import ContactSpec, Hand, PointCloud, ShapeGP, Status, certify
from torchgrasp.ik import IKSeeds
from torchgrasp.ik.attempts import assign
from torchgrasp.ik.candidates import GraspCandidates, GraspProblem, check_candidates, measure_errors
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.joint import solve_joint
from torchgrasp.ik.ranking import rank_in_group
from torchgrasp.plan.feasibility import check_feasibility
from torchgrasp.plan.solve import plan_contacts
from torchgrasp.plan.solver import project
from torchgrasp.planner.contacts import find_seeds, spread_rows
from torchgrasp.planner.problem import Problem, Request


@dataclasses.dataclass
class Tally:
    """Searches, seconds, grasps that satisfy the peer's own constraints, and executable ones."""

    tried: int = 0
    seconds: float = 0.0
    feasible: int = 0
    executable: int = 0


def bench_peers(
    clouds: list[PointCloud], courses: list[Course], hand: Hand, spec: ContactSpec, tries: int
) -> list[Row]:
    """Refine the same contacts and postures by single starts of SLSQP and by `solve_joint`, under the same checks.

    The peer is given what our stages before refinement found, and their time is not counted as its own.
    """
    peer, ours = Tally(), Tally()
    for cloud in clouds:
        _try(cloud, hand, spec, tries, peer, ours)
    whole = sum(c.seconds for c in courses) / max(sum(c.executable for c in courses), 1)
    each, good = (peer.seconds / count if count else math.inf for count in (peer.feasible, peer.executable))
    refined = ours.seconds / max(ours.executable, 1)
    return [
        Row(
            f"FRoGGeR-style single starts (SLSQP) from our postures, {len(clouds)} views x {tries}, one thread",
            "none",
            f"{peer.feasible} of {peer.tried} feasible, {each:.2f} s each; "
            f"{peer.executable} pass our checks, {good:.2f} s each",
            None,
            {"peer": vars(peer), "ours": vars(ours)},
        ),
        Row(
            "the same contacts and postures refined by `solve_joint`",
            "none",
            f"{ours.executable} of {ours.tried} pass, {refined:.3f} s each: {good / refined:.0f} times less",
            None,
            {},
        ),
        Row(
            "our whole call, cloud to ranked grasps",
            "less than the peer's search alone",
            f"{whole:.3f} s for each executable grasp: {each / whole:.0f} times less than a feasible one of the peer",
            whole < each,
            {"whole": whole},
        ),
    ]


def starts_of(
    cloud: PointCloud, hand: Hand, spec: ContactSpec, tries: int
) -> tuple[GraspProblem, IKSeeds, ShapeGP, ContactSpec]:
    """Return what both refine: closed contacts with the postures nearest to them, the shape, the settled spec."""
    problem = Problem.of(Request(cloud, hand, spec), hand)
    plan = plan_contacts(problem.shape, problem.spec, 4 * tries)
    contacts = plan.contacts[spread_rows(plan, 2 * tries)]
    certificate = certify(contacts, problem.spec)
    contacts, certificate = contacts[certificate.closed][:tries], certificate[certificate.closed][:tries]
    return problem.reach(contacts, certificate), find_seeds(problem, contacts), problem.shape, problem.spec


def start_of(problem: GraspProblem, seeds: IKSeeds, shape: ShapeGP, spec: ContactSpec, row: int) -> SingleStart:
    """Return the peer's search from one of the seeds."""
    seed = seeds[row : row + 1]
    begin, points = Configuration(seed.joints, seed.obj_from_hand), assign(problem.contacts, seed).points
    return SingleStart(problem.hand, shape, problem.world, spec, begin, points)


def _try(cloud: PointCloud, hand: Hand, spec: ContactSpec, tries: int, peer: Tally, ours: Tally) -> None:
    """Count both on one view."""
    problem, seeds, shape, spec = starts_of(cloud, hand, spec, tries)
    began = time.process_time()
    solved = solve_joint(problem, seeds, shape, spec)
    ours.seconds += time.process_time() - began
    ours.tried += len(problem.contacts)
    ours.executable += int((solved.status == Status.OK).sum())
    first = seeds[rank_in_group(seeds.row) < 1]
    for row in range(len(first)):
        search = start_of(problem, first, shape, spec, row)
        began = time.process_time()
        found = search.search()
        peer.seconds += time.process_time() - began
        peer.tried += 1
        if found is None:
            continue
        configuration, touched = found
        errors = measure_errors(hand, configuration, touched, problem.world)
        peer.feasible += bool(certify(touched, spec).closed) and int(errors.status) == Status.OK
        plan = check_feasibility(shape, spec, project(shape, shape.normalise(touched.points), 3))
        order = first.permutation[row : row + 1]
        candidates = GraspCandidates(configuration, plan.contacts, certify(plan.contacts, spec), order, plan.status)
        peer.executable += int(check_candidates(problem, candidates).status) == Status.OK
