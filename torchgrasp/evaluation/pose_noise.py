"""Where things really stand: the hand beside where it was planned to be, or the object beside where it was seen.

Neither is known to the planner or the controller. Both come to a trial as the hand's place in its planned frame.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.frames import inverse, rigid, rotation_from_vector


def draw_pose_errors(shift: float, turn: float, grasps: int, draws: int, seed: int) -> Float[Tensor, "g n 4 4"]:
    """Return drawn places of the hand in its planned frame, uniform within the largest errors [m, rad] of each axis."""
    generator = torch.Generator().manual_seed(seed)
    most = torch.tensor([turn] * 3 + [shift] * 3, dtype=torch.float64)
    drawn = 2 * torch.rand(grasps, draws, 6, generator=generator, dtype=torch.float64) - 1
    angles, shifts = (most * drawn).split(3, -1)
    return rigid(rotation_from_vector(angles), shifts)


def draw_object_poses(
    shift: float, turn: float, pivot: Float[Tensor, "3"], count: int, seed: int
) -> Float[Tensor, "n 4 4"]:
    """Return drawn places of an object on its table, as poses in the frame in which it was seen.

    Args:
        shift: largest error along each of the table's axes [m].
        turn: largest turn about the vertical through the pivot [rad].
        pivot: of the turn [m]: a point of the object.
        count: how many.
        seed: of the draws, which are uniform.
    """
    generator = torch.Generator().manual_seed(seed)
    drawn = 2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    rotation = rotation_from_vector(turn * drawn[:, :1] * up)
    return rigid(rotation, shift * drawn[:, [1, 2, 2]] * (1 - up) + pivot - rotation @ pivot)


def error_from_object_pose(obj_from_hand: Float[Tensor, "4 4"], place: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """Return where the hand stands in its planned frame when the object is at a place and the hand as planned.

    >>> error_from_object_pose(torch.eye(4), torch.eye(4)).equal(torch.eye(4))
    True
    """
    return inverse(obj_from_hand) @ inverse(place) @ obj_from_hand
