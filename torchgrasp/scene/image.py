"""What a pinhole depth camera measured."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.checks import Pose, checked
from torchgrasp.cloud.depth import frustum_of_image
from torchgrasp.geometry.frames import apply, inverse, rotate
from torchgrasp.geometry.plane import GRID


@checked
@dataclasses.dataclass(frozen=True)
class DepthImage(Value):
    """A pinhole camera's depth image: `depth` [m] along the optical axis, 0 where nothing was measured.

    `intrinsics` [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] are pixels. `obj_from_camera` is the camera's pose.

    >>> camera = torch.tensor([[100.0, 0, 1.5], [0, 100, 1.5], [0, 0, 1]])
    >>> image = DepthImage(torch.full((4, 4), 0.5), camera, torch.eye(4))
    >>> image.points()[0, 0]  # [m]
    tensor([-0.0075, -0.0075,  0.5000], dtype=torch.float64)
    >>> image.frustum.shape, image.to_upright(torch.eye(4)).obj_from_camera.shape
    (torch.Size([4, 3]), torch.Size([4, 4]))
    """

    depth: Float[Tensor, "h w"]
    intrinsics: Float[Tensor, "3 3"]
    obj_from_camera: Pose
    bounded: bool = True  # whether its border is the camera's; an image made of a cloud has none

    @property
    def frustum(self) -> Float[Tensor, "4 3"] | None:
        """Inward normals of the sides of the camera's view, in the frame of `obj`; None: it has no border."""
        if not self.bounded:
            return None
        return rotate(self.obj_from_camera.double(), frustum_of_image(self.intrinsics.double(), self.depth.shape))

    @checked
    def to_upright(self, obj_from_upright: Pose) -> "DepthImage":
        """Return the image with its camera in an upright frame, rounded."""
        pose = inverse(obj_from_upright.double()).to(self.obj_from_camera.device) @ self.obj_from_camera.double()
        return dataclasses.replace(self, obj_from_camera=torch.round(pose / GRID**1.5) * GRID**1.5)

    def points(self) -> Float[Tensor, "h w 3"]:
        """Return the point [m] of every pixel; the camera's position where nothing was measured."""
        z, k = self.depth.double(), self.intrinsics.double()
        row = torch.arange(z.shape[0], dtype=z.dtype, device=z.device)[:, None]
        column = torch.arange(z.shape[1], dtype=z.dtype, device=z.device)
        camera = torch.stack([z * (column - k[0, 2]) / k[0, 0], z * (row - k[1, 2]) / k[1, 1], z], -1)
        return apply(self.obj_from_camera.double(), camera.reshape(-1, 3)).reshape(*z.shape, 3)
