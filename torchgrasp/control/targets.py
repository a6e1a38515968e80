"""What a controller commands: the joints, and where the arm is to hold the palm."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

STILL = torch.zeros(3, dtype=torch.float64)
"""The palm stays where the arm brought it."""


class Targets(NamedTuple):
    """Commands until the next tick.

    Args:
        joints: targets of all joints of the URDF, in the order of `hand.tree.joint_names` [rad].
        palm: displacement of the palm [m] from where the arm brought it, in the axes of the hand. The wrist does not
            turn.

    >>> Targets(torch.zeros(16)).palm  # the arm stays
    tensor([0., 0., 0.], dtype=torch.float64)
    """

    joints: Float[Tensor, " j"]
    palm: Float[Tensor, "3"] = STILL
