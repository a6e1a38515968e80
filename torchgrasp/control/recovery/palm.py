"""How the palm goes to where the object was found: straight, along the table, within the reach of the arm."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.closing import PALM_SPEED
from torchgrasp.geometry.linalg import limit_norm, unit
from torchgrasp.geometry.plane import Plane


def palm_goal(shift: Float[Tensor, "3"], table: Plane | None, reach: float) -> Float[Tensor, "3"]:
    """Return the displacement [m] with which a palm of a `reach` [m] follows an object that is displaced by `shift`."""
    if table is not None:
        up = unit(table.normal)
        shift = shift - (shift @ up) * up
    return limit_norm(shift, reach)


def next_palm(palm: Float[Tensor, "3"], goal: Float[Tensor, "3"], period: float) -> Float[Tensor, "3"]:
    """Return the displacement of a palm [m] a period [s] later, on its way to a goal.

    >>> goal = torch.tensor([0.003, 0.0, 0.0])
    >>> palm = next_palm(torch.zeros(3), goal, period=0.05)
    >>> palm, bool((next_palm(palm, goal, period=0.05) == goal).all())
    (tensor([0.0020, 0.0000, 0.0000]), True)
    """
    way, longest = goal - palm, PALM_SPEED * period
    return goal if float(torch.linalg.vector_norm(way)) <= longest else palm + limit_norm(way, longest)
