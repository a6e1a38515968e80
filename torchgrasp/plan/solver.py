"""Batched Levenberg-Marquardt steps on the rows of a `ContactProblem`, along the surface.

Every triple has its own damping; a step that does not lower its own cost is refused. After each step the points are
brought back to the surface by the mean alone, which costs a fraction of a full evaluation and lets steps be long.
"""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Batch, pick, put
from torchgrasp.linalg import limit_norm
from torchgrasp.plan.objectives import Cost, differentiate_cost
from torchgrasp.plan.problem import Constraints, ContactProblem, Shape, TripleJet, forces_from_tensions, triple_jet
from torchgrasp.shape.surface import newton_step

LONGEST_STEP = 0.3
"""A point moves at most this far in a step, in normalised units: about the range in which the surface is smooth."""

TENSION_DAMPING = 0.1
"""Damping of the tensions relative to that of the points."""

FIRST_DAMPING = 1e-2
"""Damping at the start of each stage."""

PULL = 0.1
"""Length of the weighted gradient of a user's objective where its stage begins."""

SURFACE = 10.0
"""Weight of the surface: a step that leaves it would be undone by the way back, which the cones then resist."""

BOUNDS = 3.0
"""Weight of all bounds but the cones."""


@dataclasses.dataclass(frozen=True)
class Stage:
    """A number of steps with constant weights of the objective and of the cones.

    A triple whose next step is shorter than `settled` is left alone for the rest of the stage.
    """

    centre: float
    cones: float
    steps: int
    settled: float = 1e-3


FINISH = Stage(centre=0.0, cones=3.0, steps=30, settled=1e-8)
"""Last, feasibility alone: without an objective every residual can vanish."""


@dataclasses.dataclass(frozen=True)
class State(Batch):
    """The triples with the tensions of their sides, the shape at their points, and their damping."""

    points: Float[Tensor, "b 3 3"]
    tension: Float[Tensor, "b 3"]
    jet: TripleJet
    damping: Float[Tensor, "b"]


@dataclasses.dataclass(frozen=True)
class ObjectiveTerm(Batch):
    """A cost that joins the squared rows: its weight, and its value and gradient, weighted."""

    weight: Float[Tensor, "b"]
    value: Float[Tensor, "b"]
    gradient: Float[Tensor, "b 12"]


def first_objective_term(objective: Cost, shape: Shape, state: State) -> ObjectiveTerm:
    """Return the cost at a state, with the weight that it keeps."""
    value, gradient = differentiate_cost(objective, shape, state.points, state.jet)
    length = torch.linalg.vector_norm(gradient, dim=-1)
    weight = PULL / torch.where(length > 0, length, 1.0)
    return ObjectiveTerm(weight, weight * value, weight[:, None] * gradient)


def project(shape: Shape, points: Float[Tensor, "b k 3"], steps: int) -> Float[Tensor, "b k 3"]:
    """Move normalised points along the gradient onto f_d = 0 by Newton steps of the mean alone."""
    x = points.flatten(0, 1)
    for _ in range(steps):
        distance, gradient = shape.slope(x)
        x = x + limit_norm(newton_step(distance, gradient, gradient)[:, None] * gradient, LONGEST_STEP)
    return x.view_as(points)


def start_state(shape: Shape, points: Float[Tensor, "b 3 3"]) -> State:
    """Return the state of triples at `points` with equal tensions: each force points to the contacts' centre."""
    tension = normalise_tensions(points, points.new_ones(len(points), 3))
    return State(points, tension, triple_jet(shape, points), points.new_full((len(points),), FIRST_DAMPING))


def normalise_tensions(points: Float[Tensor, "b 3 3"], tension: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
    """Return the tensions over the mean size of the forces, which no row depends on."""
    force, _ = forces_from_tensions(points, tension)
    return tension / torch.linalg.vector_norm(force, dim=-1).mean(-1, keepdim=True)


def residual(rows: Constraints, stage: Stage) -> tuple[Float[Tensor, "b r"], Float[Tensor, "b r"]]:
    """Return the weighted rows, of which bounds that hold are 0, and their weights."""
    weight = torch.full_like(rows.bounds, BOUNDS)
    weight[:, :3] = stage.cones
    weight = torch.cat(
        [
            torch.full_like(rows.centre, stage.centre),
            torch.full_like(rows.surface, SURFACE),
            weight * (rows.bounds > 0),
        ],
        1,
    )
    return weight * torch.cat([rows.centre, rows.surface, rows.bounds], 1), weight


def step(
    rows: Constraints, stage: Stage, damping: Float[Tensor, "b"], downhill: Float[Tensor, "b 12"] | None = None
) -> tuple[Float[Tensor, "b 12"], Float[Tensor, "b"], Float[Tensor, "b"]]:
    """Return the damped Gauss-Newton step, how far it moves a point at most, and the decrease of cost it promises.

    `downhill` is the negative gradient of a cost that joins the squared rows, linearly. The step is NaN where the
    system is not positive definite, as in a row that is not finite.
    """
    value, weight = residual(rows, stage)
    slope = weight[..., None] * torch.cat([rows.centre_by_x, rows.surface_by_x, rows.bounds_by_x], 1)
    scale = torch.tensor([1.0] * 9 + [TENSION_DAMPING] * 3, dtype=slope.dtype, device=slope.device)
    factor, failed = torch.linalg.cholesky_ex(slope.mT @ slope + torch.diag_embed(damping[:, None] * scale))
    pull = -(slope.mT @ value[..., None])
    pull = pull if downhill is None else pull + downhill[..., None]
    x = torch.cholesky_solve(pull, factor)[..., 0]
    x = torch.where((failed == 0)[:, None], x, torch.nan)
    reach = torch.linalg.vector_norm(x[:, :9].unflatten(1, (3, 3)), dim=-1).amax(-1)
    shrink = (reach / LONGEST_STEP).clamp(min=1.0)
    x = x / shrink[:, None]
    linear = value + (slope @ x[..., None])[..., 0]
    promised = (value.square().sum(1) - linear.square().sum(1)) / 2
    return x, reach / shrink, promised if downhill is None else promised + (downhill * x).sum(1)


def average_slopes(rows: Constraints, refused: Constraints) -> Constraints:
    """Return rows with the mean of their slopes and those where a step was refused.

    Near an observation the normals of a thin plate turn about it in a cusp, so that slopes on its two sides differ,
    and the step from each leads over it to the other. Along their mean the way down is found (a bundle of gradients).
    """
    names = ("surface_by_x", "bounds_by_x")
    return dataclasses.replace(rows, **{n: (getattr(rows, n) + getattr(refused, n)) / 2 for n in names})


def descend(shape: Shape, problem: ContactProblem, state: State, stage: Stage, objective: Cost | None = None) -> State:
    """Take up to `stage.steps` Levenberg-Marquardt steps of one evaluation each.

    Triples that have settled, or whose step is not finite, are left alone from then on. An `objective` joins the rows
    with a weight at which its first gradient has the length `PULL`, so that its unit does not matter.
    """
    whole, at = state, torch.arange(len(state), device=state.points.device)
    state = dataclasses.replace(state, damping=torch.full_like(state.damping, FIRST_DAMPING))
    rows = problem.rows(state.points, state.tension, state.jet)
    extra = None if objective is None else first_objective_term(objective, shape, state)
    for _ in range(stage.steps):
        x, reach, promised = step(rows, stage, state.damping, None if extra is None else -extra.gradient)
        moves = reach > stage.settled  # a comparison with NaN is False: such a row stays
        if not bool(moves.all()):
            whole = put(whole, at, state)
            if not bool(moves.any()):
                return whole
            at, state, rows, x, promised = at[moves], state[moves], rows[moves], x[moves], promised[moves]
            extra = None if extra is None else extra[moves]
        points = project(shape, state.points + x[:, :9].unflatten(1, (3, 3)), steps=1)
        tension = normalise_tensions(points, state.tension + x[:, 9:])
        jet = triple_jet(shape, points)
        tried_rows = problem.rows(points, tension, jet)
        before, after = (residual(r, stage)[0].square().sum(1) / 2 for r in (rows, tried_rows))
        tried_extra = None
        if extra is not None and objective is not None:
            value, gradient = differentiate_cost(objective, shape, points, jet)
            tried_extra = ObjectiveTerm(extra.weight, extra.weight * value, extra.weight[:, None] * gradient)
            before, after = before + extra.value, after + tried_extra.value
        kept = (before - after) / promised
        inside = torch.linalg.vector_norm(points, dim=-1).amax(-1) < problem.domain_radius
        better = (kept > 0) & inside  # False for NaN: such a step is refused
        # Nielsen's rule: the less of its promise a step keeps, the more the next is damped.
        eased = state.damping * (1 - (2 * kept - 1) ** 3).clamp(min=1 / 5, max=2.0)
        tried = State(points, tension, jet, eased.clamp(min=1e-9))
        refused = dataclasses.replace(state, damping=(4 * state.damping).clamp(max=1e9))
        state, rows = pick(better, tried, refused), pick(better, tried_rows, average_slopes(rows, tried_rows))
        extra = None if extra is None or tried_extra is None else pick(better, tried_extra, extra)
    return put(whole, at, state)
