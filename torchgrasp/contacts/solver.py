"""The solver of a `ContactProblem`: the steps of `contacts.descent`, by torch or as a compiled loop."""

from typing import TypeGuard

from torchgrasp.contacts.descent import Descent, Stage, State
from torchgrasp.contacts.problem import ContactProblem, ShapeLike
from torchgrasp.foundation.fused import is_fused
from torchgrasp.geometry.optim import levenberg_marquardt
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.hollow import HollowShape
from torchgrasp.shape.kernel import is_thin


def descend(shape: ShapeLike, problem: ContactProblem, state: State, stage: Stage) -> State:
    """Return the contact sets after one stage of the contact solver that begins with `state`.

    The stage makes Levenberg-Marquardt steps along the surface of `shape`. `problem` holds the
    constraints, and `stage` their weights and the greatest number of steps.
    """
    if not stage.exact and _is_fused(shape, problem, state):
        from torchgrasp.contacts import fused_descent  # it imports numba

        return fused_descent.descend(shape, problem, state, stage)
    return levenberg_marquardt(Descent(shape, problem, stage), state, stage.steps)[0]


def _is_fused(shape: ShapeLike, problem: ContactProblem, state: State) -> TypeGuard[ShapeGP]:
    """Return whether the compiled loop can compute. It can with thin plates, and without a region
    or an edge of the table.
    """
    if not (type(shape) is ShapeGP or type(shape) is HollowShape):
        return False
    if not all(is_fused(state.points, wall.x, wall.weights) for wall in shape.walls):
        return False
    thin = all(is_thin(wall.kernel) for wall in shape.walls)
    return thin and problem.beyond is None and len(problem.table) < 2
