"""From a shape with uncertainty to contact triples: Eqs. (10)-(14) solved from many starts at once."""

import time
from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import join, pick, put
from torchgrasp.errors import BadArgument, Status
from torchgrasp.plan.feasibility import check_feasibility
from torchgrasp.plan.improve import Improve, Objective, improver
from torchgrasp.plan.problem import ContactProblem, Shape
from torchgrasp.plan.solver import FINISH, Stage, descend, project, start_state
from torchgrasp.plan.starts import check_starts, drawn_starts, given_starts
from torchgrasp.specs import ContactSpec
from torchgrasp.values import ContactPlan

SEARCH = (Stage(centre=3.0, cones=0.3, steps=10), Stage(centre=1.0, cones=3.0, steps=6)) * 4 + (
    Stage(centre=0.3, cones=0.3, steps=8),
    Stage(centre=0.3, cones=3.0, steps=8),
)
"""Stages from starts anywhere: centre and closure by turns, as if Eq. (14) were a constraint, which most often it can
be: contacts that are free to move about a body can have their centre in its centre. Each turn leads out of places
where the other is stuck, and triples with both are left alone. Where the centre cannot be reached the last two stages
give way."""

IMPROVE = (Stage(centre=0.3, cones=3.0, steps=8),)
"""Stages from surveyed starts, most of which are feasible but for rounding: towards the centre, Eq. (14)."""

FEW = 25
"""Starts of which the first tell the pace where time is limited: with less the overhead of each step outweighs them."""

Chunk = tuple[Float[Tensor, "_ 3 3"], tuple[Stage, ...]]


def plan_contacts(
    shape: Shape,
    spec: ContactSpec | None = None,
    starts: int | Float[Tensor, "b 3 3"] = 1000,
    seed: int = 0,
    *,
    objective: Objective = "center",
    time_budget: float | None = None,
) -> ContactPlan:
    """Plan three contacts from each of many starts, Eqs. (10)-(14): one row a start, in the order of the starts.

    A row that fails carries the `Status` of the first constraint that it violates; where no contacts can satisfy them
    all rows do. Points are in metres and the frame of the cloud, normals outward. With `spec.flatness` drawn starts
    are surveyed (see `drawn_starts`); where the descent from a feasible start fails, the start itself is the plan. The
    result is deterministic without `time_budget`; a plan from 500 or 1000 starts begins one from more.

    Args:
        shape: a `ShapeGP`, or another implicit surface with the same methods.
        spec: what the contacts must satisfy; `ContactSpec()` by default.
        starts: the number of starts, drawn on the sphere of `spec.start_radius` (Sec. 6.2), or starting points [m].
        seed: seed of the draw.
        objective: what is minimised: "center", Eq. (14); "epsilon", minus the radius of the largest ball in the hull of
            the wrenches (Ferrari and Canny 1992; 0.1 s a start); "min_weight", minus the greatest margin of the
            certificate; "probability", minus the share of 400 surfaces drawn from a `ShapeGP` on which the contacts
            are closed at `spec.friction`, 0 in failed rows (0.02 s a start); or a function of contacts (b, 3, 3) [m]
            and outward unit normals (b, 3, 3) that returns costs (b,), each of its own row alone, differentiable by
            autograd, in any unit. `quality` holds the values. All but "center" begin where that ends, and a row
            only changes for a lower value.
        time_budget: seconds of wall time for the call: of all starts as many are planned as will fit, at the pace of
            those before, and never less than 25. None: all.

    Raises:
        BadArgument: `starts` is not positive, of a wrong shape, or outside the shape's domain; an unknown objective,
            or a cost that returns no number for each row or has no gradient; another argument is not what it should be.

    Source of the scheme: penalties and Levenberg-Marquardt, Nocedal and Wright, Numerical Optimization, ch. 10, 17.

    >>> from torchgrasp import fit_shape, load_object
    >>> plan = plan_contacts(fit_shape(load_object("jug").view), ContactSpec.paper(), starts=8)
    >>> plan.contacts.points.shape
    torch.Size([8, 3, 3])
    """
    spec = ContactSpec() if spec is None else spec
    check_starts(shape, spec, starts, seed)
    if time_budget is not None and not time_budget > 0:  # also refuses NaN
        raise BadArgument("time_budget", time_budget, "a positive number of seconds, or None")
    improve = improver(objective, shape, spec, seed)
    chunks = _chunks(shape, spec, starts, seed)
    if time_budget is not None:
        chunks = _within(time_budget, chunks)
    return join([plan_chunk(shape, spec, first, stages, improve) for first, stages in chunks])


def _within(seconds: float, chunks: Iterator[Chunk]) -> Iterator[Chunk]:
    """Yield as much of the chunks as will be planned in time, at the pace of what was."""
    began, done, fits = time.monotonic(), 0, FEW
    for first, stages in chunks:
        while len(first) > 0:
            if done:
                used = time.monotonic() - began
                fits = int((seconds - used) * done / used)
            if fits < FEW:
                return
            yield first[:fits], stages
            done, first = done + len(first[:fits]), first[fits:]


def _chunks(
    shape: Shape,
    spec: ContactSpec,
    starts: int | Float[Tensor, "b 3 3"],
    seed: int,
) -> Iterator[Chunk]:
    """Yield normalised starts on the surface and the stages from there, chunk by chunk."""
    if isinstance(starts, Tensor):
        for first in given_starts(shape, starts):
            yield first, SEARCH
    else:
        for first in drawn_starts(shape, spec, starts, seed):
            yield first, SEARCH if spec.flatness is None else IMPROVE


def plan_chunk(
    shape: Shape,
    spec: ContactSpec,
    first: Float[Tensor, "b 3 3"],
    stages: tuple[Stage, ...],
    improve: Improve | None = None,
) -> ContactPlan:
    """Plan from normalised starts on the surface; a feasible start from which nothing is found is itself the plan."""
    problem = ContactProblem.of(shape, spec)
    state = start_state(shape, first)
    for stage in (*stages, FINISH):
        state = descend(shape, problem, state, stage)
    found = check_feasibility(shape, spec, project(shape, state.points, steps=3))
    lost = torch.nonzero(found.status != Status.OK)[:, 0]
    begun = check_feasibility(shape, spec, first[lost])
    found = put(found, lost, pick(begun.status == Status.OK, begun, found[lost]))
    return found if improve is None else improve(found, state.tension)
