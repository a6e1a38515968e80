"""What one camera saw: things on a table."""

import dataclasses

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.frames import inverse
from torchgrasp.plane import GRID, Plane, to_upright
from torchgrasp.values import PointCloud


@dataclasses.dataclass(frozen=True)
class DepthImage(Value):
    """A pinhole camera's depth image: `depth` [m] along the optical axis, 0 where nothing was measured.

    `intrinsics` [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] are pixels. `obj_from_camera` is the camera's pose.
    """

    depth: Float[Tensor, "h w"]
    intrinsics: Float[Tensor, "3 3"]
    obj_from_camera: Float[Tensor, "4 4"]

    def to_upright(self, obj_from_upright: Float[Tensor, "4 4"]) -> "DepthImage":
        """Return the image with its camera in an upright frame, rounded."""
        pose = inverse(obj_from_upright) @ self.obj_from_camera.double()
        return dataclasses.replace(self, obj_from_camera=torch.round(pose / GRID**1.5) * GRID**1.5)


@dataclasses.dataclass(frozen=True)
class Scene(Value):
    """Things on a table, as one camera saw them, in the frame that was given ("obj").

    Args:
        points: every measured point [m].
        labels: 0 for the table and all that is no thing; 1, 2, ... for the things.
        image: what the camera measured: it tells free space from hidden space.
        pixels: row and column of each point in the image.
        table: the plane that things stand on; None: unknown.
        target: label of the thing to be grasped; None: not chosen.
    """

    points: Float[Tensor, "n 3"]
    labels: Int[Tensor, "n"]
    image: DepthImage
    pixels: Int[Tensor, "n 2"]
    table: Plane | None = None
    target: int | None = None

    @property
    def viewpoint(self) -> Float[Tensor, "3"]:
        """The camera's position [m]."""
        return self.image.obj_from_camera[:3, 3]

    @property
    def things(self) -> tuple[int, ...]:
        """The labels of the things, ascending."""
        return tuple(k for k in self.labels.unique().tolist() if k > 0)

    def rows_of(self, label: int | None = None) -> Bool[Tensor, "n"]:
        """Tell which points are a thing's, by default the target's."""
        return self.labels == (self.target if label is None else label)

    def cloud(self, label: int | None = None) -> PointCloud:
        """Return the points of a thing, by default the target, with the camera as viewpoint."""
        return PointCloud(self.points[self.rows_of(label)], None, self.viewpoint.to(self.points))

    def to_upright(self, obj_from_upright: Float[Tensor, "4 4"]) -> "Scene":
        """Return the scene in the `upright_frame` of its target and table, all rounded."""
        return dataclasses.replace(
            self,
            points=to_upright(self.points, obj_from_upright),
            image=self.image.to_upright(obj_from_upright),
            table=None if self.table is None else Plane.horizontal(0.0),
        )
