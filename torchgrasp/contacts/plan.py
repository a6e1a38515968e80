"""The contact planner: solves Eqs. (10)-(14) on an uncertain shape, from many initial guesses at
once.
"""

import time
from collections.abc import Iterator

from jaxtyping import Float
from torch import Tensor

from torchgrasp.contacts.descent import FINISH, Stage, project, start_state
from torchgrasp.contacts.feasibility import check_feasibility
from torchgrasp.contacts.form_closure import Vectors
from torchgrasp.contacts.problem import ContactProblem, ShapeLike, rows_of
from torchgrasp.contacts.solver import descend
from torchgrasp.contacts.starts import (
    check_starts,
    drawn_starts,
    given_starts,
    settle_flatness,
    start_chunks,
)
from torchgrasp.foundation.base import flatnonzero, join, pick, put
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.rules import Count, Positive, Seed
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.values.planning import ContactPlan
from torchgrasp.values.specs import ContactSpec

SEARCH = (Stage(3.0, 0.3, 10), Stage(1.0, 3.0, 6)) * 4 + (Stage(0.3, 0.3, 8), Stage(0.3, 3.0, 8))
"""Solver stages from any initial guess: weights of the offset of the centre and of the cones, and
most steps.

The two kinds of stages alternate, because each goes on where the other is stuck.
"""
# from candidates, most of which are feasible but for rounding
TO_CENTRE = (Stage(0.3, 3.0, 8, exact=False),)
# fewest starts at a time under a time budget: with less, the overhead of each step outweighs them
LEAST_STARTS = 25


@checked
@single_threaded
def plan_contacts(
    shape: ShapeLike,
    spec: ContactSpec | None = None,
    starts: Count | Float[Tensor, "b f 3"] = 1000,
    seed: Seed = 0,
    *,
    time_budget: Positive | None = None,
) -> ContactPlan:
    """Return planned contact sets (Eqs. 10-14 of the paper), one for each initial guess, in the
    order of the guesses.

    A set has `spec.fingertips` contacts. `ContactPlan.status` of a failed set is the `Status` of
    the first constraint that it violates. If the solver fails from an initial guess that satisfies
    all constraints, the guess itself is the result. Without `time_budget` the result is
    deterministic. Guesses are drawn in chunks of 500. So a plan from 500 or 1000 guesses equals the
    first part of a plan from more.

    Args:
        shape: a `ShapeGP`, or another implicit surface with the same methods (`ShapeLike`).
        spec: the constraints on contacts; None means `ContactSpec()`.
        starts: number of random initial guesses, or b sets of initial contact points (b, f, 3)
            [m]. Random guesses are sets of points at which the surface is flat, if possible with
            force closure. If `spec.flatness` is None, they are drawn as in Sec. 6.2 of the paper.
        seed: random seed of the guesses.
        time_budget: wall time [s] of the call. The result then holds the first guesses that could
            be planned in this time, but at least 25 (`LEAST_STARTS`). None means all.

    Raises `BadArgument` for:

    * a number of `starts` that is not positive;
    * guesses of a wrong shape, or outside the domain of `shape`, the ball in which it is known;
    * a `spec.start_radius` beyond this domain.

    >>> from torchgrasp import fit_shape, load_object
    >>> plan = plan_contacts(fit_shape(load_object("jug").view), ContactSpec.paper(), starts=8)
    >>> plan.contacts.points.shape
    torch.Size([8, 3, 3])
    """
    spec = ContactSpec() if spec is None else spec
    check_starts(shape, spec, starts)
    settled = settle_flatness(shape, spec, seed)
    if isinstance(starts, Tensor):
        stages = SEARCH
        firsts = given_starts(shape, starts)
    else:
        stages = stages_for(settled.spec)
        firsts = drawn_starts(shape, settled, start_chunks(starts), seed)
    if time_budget is not None:
        firsts = _within(time_budget, firsts)
    problem = ContactProblem.of(shape, settled.spec)
    return join([plan_chunk(shape, problem, first, stages) for first in firsts])


def stages_for(spec: ContactSpec) -> tuple[Stage, ...]:
    """Return the stages of the contact solver for random initial guesses.

    A stage is a number of steps with given weights of the constraints.

    If `spec` demands a flat surface at contacts, the guesses are nearly feasible, and one stage of
    8 steps does. Otherwise ten stages search from any guess.
    """
    return SEARCH if spec.flatness is None else TO_CENTRE


def _within(seconds: float, firsts: Iterator[Vectors]) -> Iterator[Vectors]:
    """Yield as many initial guesses as can be planned in the given time, judged by the speed so
    far.
    """
    began = time.monotonic()
    done = 0
    fits = LEAST_STARTS
    for first in firsts:
        while len(first) > 0:
            if done:
                used = time.monotonic() - began
                fits = int((seconds - used) * done / used)
            if fits < LEAST_STARTS:
                return
            yield first[:fits]
            done = done + len(first[:fits])
            first = first[fits:]


def plan_chunk(
    shape: ShapeLike, problem: ContactProblem, first: Vectors, stages: tuple[Stage, ...]
) -> ContactPlan:
    """Return the contact plan from initial guesses on the surface, one contact set for each guess.

    `problem` holds the constraints, and `first` (b, f, 3) the guesses in normalised units. `stages`
    are the solver's stages before a last one that is the same for all (`FINISH`). Where the solver
    fails from a guess that satisfies all constraints, the guess is the result.
    """
    state = start_state(shape, first)
    for stage in (*stages, FINISH):
        state = descend(shape, problem, state, stage)
    plan = check_feasibility(shape, problem, project(shape, state.points, steps=3))
    failed = flatnonzero(plan.status != Status.OK)
    begun = check_feasibility(rows_of(shape, failed), problem.rows(failed), first[failed])
    return put(plan, failed, pick(begun.status == Status.OK, begun, plan[failed]))
