"""Errors of pose that the hand does not know: its own, or the object's."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value, check_tensor
from torchgrasp.frames import inverse, rigid, rotation_from_vector


@dataclasses.dataclass(frozen=True)
class PoseNoise(Value):
    """Uniform errors along and about each axis, at most [m, rad]; `draws` a grasp."""

    translation: float = 0.0
    rotation: float = 0.0
    draws: int = 1


def apply_error(obj_from_hand: Float[Tensor, "4 4"], error: Float[Tensor, "4 4"] | None) -> Float[Tensor, "4 4"]:
    """Return the true pose of a hand from its planned pose and the error in it.

    Both may be of any device and floating dtype; the result is on the CPU in float64.

    Raises:
        BadArgument: an error that is no finite (4, 4).
    """
    planned = obj_from_hand.to("cpu", torch.float64)
    return planned if error is None else planned @ check_tensor("error", error, (4, 4)).to("cpu", torch.float64)


def draw_hand_errors(noise: PoseNoise, grasps: int, seed: int) -> Float[Tensor, "g n 4 4"]:
    """Draw errors of the hand in its planned frame."""
    generator = torch.Generator().manual_seed(seed)
    largest = torch.tensor([noise.rotation] * 3 + [noise.translation] * 3, dtype=torch.float64)
    drawn = 2 * torch.rand(grasps, noise.draws, 6, generator=generator, dtype=torch.float64) - 1
    rotations, translations = (largest * drawn).split(3, -1)
    return rigid(rotation_from_vector(rotations), translations)


def draw_object_poses(noise: PoseNoise, pivot: Float[Tensor, "3"], count: int, seed: int) -> Float[Tensor, "n 4 4"]:
    """Draw poses of an object in the frame in which it was seen.

    The object moves on its table and rotates about the vertical through `pivot` [m].
    """
    generator = torch.Generator().manual_seed(seed)
    drawn = 2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    rotation = rotation_from_vector(noise.rotation * drawn[:, :1] * up)
    return rigid(rotation, noise.translation * drawn[:, [1, 2, 2]] * (1 - up) + pivot - rotation @ pivot)


def error_from_object_pose(
    obj_from_hand: Float[Tensor, "4 4"], object_pose: Float[Tensor, "4 4"]
) -> Float[Tensor, "4 4"]:
    """Return the error of a hand whose object is elsewhere.

    >>> error_from_object_pose(torch.eye(4), torch.eye(4)).equal(torch.eye(4))
    True
    """
    return inverse(obj_from_hand) @ inverse(object_pose) @ obj_from_hand
