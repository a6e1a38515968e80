"""Batched Levenberg-Marquardt steps of an augmented Lagrangian on the rows of a `ContactProblem`.

Every triple has its own damping; a step that does not lower its own cost is refused. The logits z enter the six
closure rows alone, so they are eliminated exactly: what is solved per triple is a 6 x 6 and a 9 x 9 system.
"""

import dataclasses
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.plan.flat import BendGuide, bend_guide
from torchgrasp.plan.problem import ContactProblem, Rows, Shape, TripleJet, carry, triple_jet
from torchgrasp.plan.wrench import tangents
from torchgrasp.values import Batch, SomeValue, Value

LONGEST_STEP = 0.3
"""A point moves at most this far in a step, in normalised units: about the range in which the surface is smooth."""

LONGEST_TURN = 3.0
"""A logit changes at most this much in a step."""

Z_DAMPING = 0.1
"""Damping of the logits relative to that of the points: logits range over about 10, points over about 1."""


GUIDE_EVERY = 4
"""Steps between two evaluations of the rows for flat surface."""


@dataclasses.dataclass(frozen=True)
class Weights:
    """Weights of the rows in a stage: constraints against the objective, and closure within the constraints."""

    centre: float
    surface: float
    closure: float
    bounds: float


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
    return State(points, z, tangents(points, jet.normals), jet, points.new_full((len(points),), 1e-2))


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


def cost(rows: Rows, multipliers: Multipliers, weights: Weights) -> Float[Tensor, "b"]:
    """Return the augmented Lagrangian of each triple."""
    shifted = (
        weights.centre * rows.centre,
        weights.surface * (rows.surface + multipliers.surface),
        weights.closure * (rows.closure + multipliers.closure),
        weights.bounds * shift_bounds(rows, multipliers).clamp(min=0.0),
    )
    return torch.cat(shifted, 1).square().sum(1) / 2


def step(
    rows: Rows, multipliers: Multipliers, weights: Weights, damping: Float[Tensor, "b"]
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b m"]]:
    """Return the damped Gauss-Newton step of the points and the logits."""
    active = shift_bounds(rows, multipliers)
    on = weights.bounds * (active > 0)
    value = torch.cat(
        [weights.centre * rows.centre, weights.surface * (rows.surface + multipliers.surface), on * active], 1
    )
    slope = torch.cat(
        [
            weights.centre * rows.centre_by_points,
            weights.surface * rows.surface_by_points,
            on[..., None] * rows.bounds_by_points,
        ],
        1,
    )
    closure = weights.closure * (rows.closure + multipliers.closure)
    by_points, by_z = weights.closure * rows.closure_by_points, weights.closure * rows.closure_by_z
    # min over dz of |closure + by_points dp + by_z dz|^2 + d |dz|^2 = |.|^2 in the metric (I + by_z by_z^T / d)^-1
    z_damping = Z_DAMPING * damping[:, None, None]
    soft = torch.eye(6, dtype=closure.dtype, device=closure.device) + by_z @ by_z.mT / z_damping
    factor = torch.linalg.cholesky(soft)
    whitened = torch.linalg.solve_triangular(factor, torch.cat([by_points, closure[..., None]], -1), upper=False)
    slope, value = torch.cat([slope, whitened[..., :9]], 1), torch.cat([value, whitened[..., 9]], 1)
    normal = slope.mT @ slope + damping[:, None, None] * torch.eye(9, dtype=slope.dtype, device=slope.device)
    points_step = -torch.cholesky_solve(slope.mT @ value[..., None], torch.linalg.cholesky(normal))
    left = torch.cholesky_solve(closure[..., None] + by_points @ points_step, factor)
    z_step = -(by_z.mT @ left / z_damping)[..., 0]
    points_step = points_step.unflatten(1, (3, 3))[..., 0]
    reach = torch.linalg.vector_norm(points_step, dim=-1).amax(-1)
    shrink = torch.maximum(reach / LONGEST_STEP, z_step.abs().amax(-1) / LONGEST_TURN).clamp(min=1.0)
    return points_step / shrink[:, None, None], z_step / shrink[:, None]


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


def descend(
    shape: Shape,
    problem: ContactProblem,
    state: State,
    multipliers: Multipliers,
    weights: Weights,
    steps: int,
    flatness: float | None = None,
) -> tuple[State, Rows]:
    """Take `steps` Levenberg-Marquardt steps with constant weights and multipliers; one shape evaluation each.

    With `flatness`, rows for flat surface around the contacts join, evaluated anew every `GUIDE_EVERY` steps. Tangents
    are carried along with their normals. Returns the state and its rows.
    """
    rows = problem.rows(state.points, state.z, state.tangent, state.jet)
    guide = None
    for i in range(steps):
        if flatness is not None and i % GUIDE_EVERY == 0:
            guide = bend_guide(shape, state.points, state.tangent, state.jet, flatness)
        joined = join_guide(rows, guide, state.points)
        points_step, z_step = step(joined, multipliers, weights, state.damping)
        points, z = state.points + points_step, state.z + z_step.unflatten(1, state.z.shape[1:])
        jet = triple_jet(shape, points)
        tried = State(points, z, carry(state.tangent, jet.normals), jet, (state.damping / 4).clamp(min=1e-9))
        tried_rows = problem.rows(points, z, tried.tangent, jet)
        before = cost(joined, multipliers, weights)
        after = cost(join_guide(tried_rows, guide, points), multipliers, weights)
        inside = torch.linalg.vector_norm(points, dim=-1).amax(-1) < problem.domain_radius
        better = (after <= before) & inside  # a comparison with NaN is False: such a step is refused
        refused = dataclasses.replace(state, damping=(state.damping * 6).clamp(max=1e8))
        state, rows = pick(better, tried, refused), pick(better, tried_rows, rows)
    return state, rows
