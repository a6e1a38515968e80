"""Batched Levenberg-Marquardt steps of an augmented Lagrangian on the rows of a `ContactProblem`.

Every triple has its own damping; a step that does not lower its own cost is refused. The logits z enter the six
closure rows alone, so they are eliminated exactly: what is solved per triple is a 6 x 6 and a 9 x 9 system.
"""

import dataclasses
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.base import Batch, SomeValue, Value
from torchgrasp.plan.flat import BendGuide, bend_guide
from torchgrasp.plan.problem import ContactProblem, Rows, Shape, TripleJet, carry, triple_jet
from torchgrasp.plan.wrench import tangents

LONGEST_STEP = 0.3
"""A point moves at most this far in a step, in normalised units: about the range in which the surface is smooth."""

LONGEST_TURN = 3.0
"""A logit changes at most this much in a step."""

Z_DAMPING = 0.1
"""Damping of the logits relative to that of the points: logits range over about 10, points over about 1."""

FIRST_DAMPING = 1e-2
"""Damping at the start of each stage."""

GUIDE_EVERY = 4
"""Steps between two evaluations of the rows for flat surface."""

FEASIBILITY = 3.0
"""Weight of the surface and of all bounds."""


@dataclasses.dataclass(frozen=True)
class Stage:
    """A number of steps with constant weights of the objective and of closure, after which multipliers may rise."""

    centre: float
    closure: float
    steps: int
    keeps_multipliers: bool = True


@dataclasses.dataclass(frozen=True)
class Multipliers(Batch):
    """Scaled multipliers: each row is shifted by its own before it is squared."""

    surface: Float[Tensor, "b 3"]
    closure: Float[Tensor, "b 6"]
    bounds: Float[Tensor, "b k"]


@dataclasses.dataclass(frozen=True)
class State(Batch):
    """The triples with the shape at their points, the tangents that are carried along, and their damping."""

    points: Float[Tensor, "b 3 3"]
    z: Float[Tensor, "b 3 e"]
    tangent: Float[Tensor, "b 3 3"]
    jet: TripleJet
    damping: Float[Tensor, "b"]


def start_state(shape: Shape, problem: ContactProblem, points: Float[Tensor, "b 3 3"]) -> State:
    """Return the state of triples at `points` with equal coefficients."""
    jet = triple_jet(shape, points)
    z = points.new_zeros(len(points), 3, problem.edges)
    return State(points, z, tangents(points, jet.normals), jet, points.new_full((len(points),), FIRST_DAMPING))


def no_multipliers(rows: Rows) -> Multipliers:
    """Return multipliers of zero."""
    return Multipliers(*(torch.zeros_like(r) for r in (rows.surface, rows.closure, rows.bounds)))


def raise_multipliers(rows: Rows, multipliers: Multipliers) -> Multipliers:
    """Return the multipliers after a stage of constant weights: equalities add up, inequalities never pull."""
    return Multipliers(
        multipliers.surface + rows.surface,
        multipliers.closure + rows.closure,
        (multipliers.bounds + rows.bounds).clamp(min=0.0),
    )


def shift_bounds(rows: Rows, multipliers: Multipliers) -> Float[Tensor, "b k"]:
    """Return the bounds plus their multipliers; rows of a guide come last and have none."""
    known = multipliers.bounds.shape[1]
    return torch.cat([rows.bounds[:, :known] + multipliers.bounds, rows.bounds[:, known:]], 1)


def cost(rows: Rows, multipliers: Multipliers, stage: Stage) -> Float[Tensor, "b"]:
    """Return the augmented Lagrangian of each triple."""
    shifted = (
        stage.centre * rows.centre,
        FEASIBILITY * (rows.surface + multipliers.surface),
        stage.closure * (rows.closure + multipliers.closure),
        FEASIBILITY * shift_bounds(rows, multipliers).clamp(min=0.0),
    )
    return torch.cat(shifted, 1).square().sum(1) / 2


def step(
    rows: Rows, multipliers: Multipliers, stage: Stage, damping: Float[Tensor, "b"]
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b m"], Float[Tensor, "b"]]:
    """Return the damped Gauss-Newton step of the points and the logits, and the decrease of cost it promises.

    The step is NaN where the system is not positive definite, as in a row that is not finite.
    """
    active = shift_bounds(rows, multipliers)
    on = FEASIBILITY * (active > 0)
    value = torch.cat([stage.centre * rows.centre, FEASIBILITY * (rows.surface + multipliers.surface), on * active], 1)
    slope = torch.cat(
        [
            stage.centre * rows.centre_by_points,
            FEASIBILITY * rows.surface_by_points,
            on[..., None] * rows.bounds_by_points,
        ],
        1,
    )
    closure = stage.closure * (rows.closure + multipliers.closure)
    by_points, by_z = stage.closure * rows.closure_by_points, stage.closure * rows.closure_by_z
    # min over dz of |closure + by_points dp + by_z dz|^2 + d |dz|^2 = |.|^2 in the metric (I + by_z by_z^T / d)^-1
    z_damping = Z_DAMPING * damping[:, None, None]
    soft = torch.eye(6, dtype=closure.dtype, device=closure.device) + by_z @ by_z.mT / z_damping
    factor, failed = torch.linalg.cholesky_ex(soft)
    whitened = torch.linalg.solve_triangular(factor, torch.cat([by_points, closure[..., None]], -1), upper=False)
    outer_slope, outer_value = slope, value
    before = (value.square().sum(1) + closure.square().sum(1)) / 2
    slope, value = torch.cat([slope, whitened[..., :9]], 1), torch.cat([value, whitened[..., 9]], 1)
    normal = slope.mT @ slope + damping[:, None, None] * torch.eye(9, dtype=slope.dtype, device=slope.device)
    outer_factor, outer_failed = torch.linalg.cholesky_ex(normal)
    points_step = -torch.cholesky_solve(slope.mT @ value[..., None], outer_factor)
    points_step = torch.where(((failed == 0) & (outer_failed == 0))[:, None, None], points_step, torch.nan)
    left = torch.cholesky_solve(closure[..., None] + by_points @ points_step, factor)
    z_step = -(by_z.mT @ left / z_damping)[..., 0]
    points_step = points_step.unflatten(1, (3, 3))[..., 0]
    reach = torch.linalg.vector_norm(points_step, dim=-1).amax(-1)
    shrink = torch.maximum(reach / LONGEST_STEP, z_step.abs().amax(-1) / LONGEST_TURN).clamp(min=1.0)
    points_step, z_step = points_step / shrink[:, None, None], z_step / shrink[:, None]
    flat_step = points_step.flatten(1)[..., None]
    closure = closure + (by_points @ flat_step + by_z @ z_step[..., None])[..., 0]
    linear = torch.cat([outer_value + (outer_slope @ flat_step)[..., 0], closure], 1)
    return points_step, z_step, before - linear.square().sum(1) / 2


def join_guide(rows: Rows, guide: BendGuide | None, points: Float[Tensor, "b 3 3"]) -> Rows:
    """Return the rows with those of the guide at `points` among the bounds."""
    if guide is None:
        return rows
    bounds = torch.cat([rows.bounds, guide.rows(points)], 1)
    return dataclasses.replace(
        rows, bounds=bounds, bounds_by_points=torch.cat([rows.bounds_by_points, guide.by_points], 1)
    )


def pick(choose: Bool[Tensor, "b"], new: SomeValue, old: SomeValue) -> SomeValue:
    """Return the new rows of a value where `choose`, the old ones elsewhere."""

    def merge(a: Any, b: Any) -> Any:
        return pick(choose, a, b) if isinstance(a, Value) else torch.where(choose.view(-1, *[1] * (a.ndim - 1)), a, b)

    fields = dataclasses.fields(new)  # pyright: ignore[reportArgumentType]
    return type(new)(**{f.name: merge(getattr(new, f.name), getattr(old, f.name)) for f in fields})


def put(whole: SomeValue, at: Int[Tensor, "a"], part: SomeValue) -> SomeValue:
    """Return a value with `part` in the rows `at`."""

    def place(w: Any, p: Any) -> Any:
        return put(w, at, p) if isinstance(w, Value) else w.index_copy(0, at, p)

    fields = dataclasses.fields(whole)  # pyright: ignore[reportArgumentType]
    return type(whole)(**{f.name: place(getattr(whole, f.name), getattr(part, f.name)) for f in fields})


def descend(
    shape: Shape,
    problem: ContactProblem,
    state: State,
    multipliers: Multipliers,
    stage: Stage,
    settled: float,
    flatness: float | None = None,
) -> State:
    """Take up to `stage.steps` Levenberg-Marquardt steps of one evaluation each.

    Triples whose next step is shorter than `settled`, or not finite, are left alone from then on. With `flatness`,
    rows for flat surface around the contacts join, evaluated anew every `GUIDE_EVERY` steps. Tangents are carried
    along.
    """
    whole, at = state, torch.arange(len(state), device=state.points.device)
    state = dataclasses.replace(state, damping=torch.full_like(state.damping, FIRST_DAMPING))
    rows = problem.rows(state.points, state.z, state.tangent, state.jet)
    guide = None
    for i in range(stage.steps):
        if flatness is not None and i % GUIDE_EVERY == 0:
            guide = bend_guide(shape, state.points, state.tangent, state.jet, flatness)
        joined = join_guide(rows, guide, state.points)
        points_step, z_step, promised = step(joined, multipliers, stage, state.damping)
        moves = points_step.abs().flatten(1).amax(-1) > settled
        if not bool(moves.all()):
            whole = put(whole, at, state)
            if not bool(moves.any()):
                return whole
            at, state, rows, multipliers = at[moves], state[moves], rows[moves], multipliers[moves]
            guide, joined = None if guide is None else guide[moves], joined[moves]
            points_step, z_step, promised = points_step[moves], z_step[moves], promised[moves]
        points, z = state.points + points_step, state.z + z_step.unflatten(1, state.z.shape[1:])
        jet = triple_jet(shape, points)
        before = cost(joined, multipliers, stage)
        tried_tangent = carry(state.tangent, jet.normals)
        tried_rows = problem.rows(points, z, tried_tangent, jet)
        kept = (before - cost(join_guide(tried_rows, guide, points), multipliers, stage)) / promised
        inside = torch.linalg.vector_norm(points, dim=-1).amax(-1) < problem.domain_radius
        better = (kept > 0) & inside  # a comparison with NaN is False: such a step is refused
        # Nielsen's rule: the less of its promise a step keeps, the more the next is damped.
        eased = state.damping * (1 - (2 * kept - 1) ** 3).clamp(min=1 / 5, max=2.0)
        tried = State(points, z, tried_tangent, jet, eased.clamp(min=1e-9))
        refused = dataclasses.replace(state, damping=(4 * state.damping).clamp(max=1e9))
        state, rows = pick(better, tried, refused), pick(better, tried_rows, rows)
    return put(whole, at, state)
