"""What a controller commands: the joints, and where the arm is to bring and hold the palm."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

STILL = torch.zeros(3, dtype=torch.float64)
"""The palm stays on its path."""


class Targets(NamedTuple):
    """Commands until the next tick.

    Args:
        joints: targets of all joints of the URDF, in the order of `hand.tree.joint_names` [rad].
        palm: displacement of the palm [m] from its path, in the axes of the hand. The wrist does not turn.
        left: what is left [m] of the approach to the pre-grasp: 0 once the hand is there.

    >>> Targets(torch.zeros(16)).palm  # the arm stays
    tensor([0., 0., 0.], dtype=torch.float64)
    """

    joints: Float[Tensor, " j"]
    palm: Float[Tensor, "3"] = STILL
    left: float = 0.0
