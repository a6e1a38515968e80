"""Regions of space that contacts must keep to, or avoid: boxes, meshes, masks of an image, or any
signed distance.
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import ndimage, trimesh
from torchgrasp.foundation.rules import Fraction, Pose, show
from torchgrasp.geometry.frames import apply, inverse
from torchgrasp.geometry.linalg import norm
from torchgrasp.geometry.mesh import read_mesh
from torchgrasp.geometry.mesh_distance import surface_distance
from torchgrasp.geometry.plane import Plane, as_plane
from torchgrasp.scene.scene import Scene
from torchgrasp.values.planning import PointCloud

LEAST_DEPTH = 1e-3  # depth [m] in front of the camera from which points are seen
Distance = Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n"]]
"""Function that returns the signed distance [m] of points (n, 3) [m]: negative inside a region."""


@checked
@dataclasses.dataclass(frozen=True)
class Region(Value):
    """A region of space in the frame of the cloud, as a signed distance.

    `plan_grasps` takes a region as `keep` or `avoid`, and a `ContactSpec` as `region`. `box`,
    `mesh`, `mask` and `rim` make common regions. Call a region to get signed distances.

    Args:
        distance: function of points (n, 3) [m] in float64 that returns their signed distances (n,)
            [m], negative inside.
        name: name of the region in errors.
        placed: whether the region must be at the object, as a box or a mesh must. The object is
            the cloud and the space behind it. If the region is over 30 mm away, planning raises
            `BadArgument` for `keep`, and warns `NoEffect` for `avoid`. If the region holds the
            whole object, planning warns `NoEffect` for `keep`.

    >>> from torchgrasp import load_object
    >>> ball = Region(lambda points: points.norm(dim=-1) - 0.05)
    >>> rim = Region.rim(load_object("jug").view, table=0.0)
    >>> point = torch.tensor([[0.0, 0.0, 0.06]])
    >>> ball(point).round(decimals=3), rim(torch.tensor([0.0, 0.0, 0.01])) > 0
    (tensor([0.0100]), tensor(True))
    """

    distance: Distance
    name: str = "distance"
    placed: bool = False

    @checked
    def __call__(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Return the signed distance (*b,) [m] of points (*b, 3) [m], negative inside the region.

        Raises `BadArgument` if the function does not return one finite float for each point.
        """
        flat = points.detach().double().reshape(-1, 3)
        found = self.distance(flat)
        if not (
            isinstance(found, Tensor)
            and found.is_floating_point()  # a mask of the points inside is no distance
            and found.shape == flat.shape[:1]
            and bool(torch.isfinite(found).all())
        ):
            raise BadArgument(
                self.name,
                f"{show(found)} for {len(flat)} points",
                "a tensor of one finite number each, a float: its signed distance [m]",
            )
        return found.to(points).reshape(points.shape[:-1])

    @classmethod
    @checked
    def box(
        cls, low: Float[Tensor, "3"], high: Float[Tensor, "3"], obj_from_box: Pose | None = None
    ) -> "Region":
        """Return the region inside a box.

        Args:
            low: least coordinates (3,) [m] of the box, in the box's frame.
            high: greatest coordinates (3,) [m] of the box, in the box's frame.
            obj_from_box: pose (4, 4) [m] of the box's frame in the cloud's frame. None means that
                the two are the same.

        Raises `BadArgument` unless `low` is less than `high` on each axis.
        """
        if not bool((low < high).all()):
            raise BadArgument(
                "low", f"{low.tolist()} beside high {high.tolist()}", "less than high on each axis"
            )
        middle = (low + high).double() / 2
        half = (high - low).double() / 2
        frame = torch.eye(4, dtype=torch.float64)
        if obj_from_box is not None:
            frame = inverse(obj_from_box.double())

        def distance(points: Tensor) -> Tensor:
            local = apply(frame.to(points), points) - middle.to(points)
            beyond = local.abs() - half.to(points)
            return norm(beyond.clamp_min(0)) + beyond.amax(-1).clamp_max(0)

        return cls(distance, placed=True)

    @classmethod
    @checked
    def mesh(cls, mesh: "trimesh.Trimesh | Path | str") -> "Region":
        """Return the region inside a closed mesh.

        `mesh` is a trimesh, or an .obj, .off, .ply or .stl file. It is in metres, in the frame of
        the cloud. Raises `MeshError` for a mesh that is missing, malformed, open, turned inward, or
        has no volume. Raises `SuspiciousScale` unless its longest side is 5 mm to 2 m.
        """
        solid = read_mesh(mesh)
        surface = surface_distance(
            torch.tensor(np.array(solid.vertices)), torch.tensor(np.array(solid.faces))
        )

        def distance(points: Tensor) -> Tensor:
            return torch.from_numpy(surface(points.cpu().numpy())).to(points)

        return cls(distance, placed=True)

    @classmethod
    @checked
    def mask(cls, scene: Scene, mask: Bool[Tensor, "h w"]) -> "Region":
        """Return the region that the pixels of a mask (h, w) cover, as the scene's camera sees it.

        The region is in the frame of the scene. It reaches through the object, so it also holds
        points on the hidden side. Points outside the image are outside.

        Args:
            scene: the scene, whose image has h rows and w columns.
            mask: mask (h, w) of the covered pixels.

        Raises `BadArgument` for a mask of a wrong shape or without pixels.
        """
        image = scene.image
        if mask.shape != image.depth.shape or not bool(mask.any()):
            wanted = f"some of the image's {tuple(image.depth.shape)} pixels"
            raise BadArgument("mask", f"{int(mask.sum())} pixels of {tuple(mask.shape)}", wanted)
        inside = np.pad(mask.cpu().numpy(), 1)  # what lies beyond the border is outside
        outward, inward = (np.asarray(ndimage.distance_transform_edt(x)) for x in (~inside, inside))
        # from the middle of a pixel to a border
        pixels = np.where(inside, 0.5 - inward, outward - 0.5)
        k = image.intrinsics.double().cpu().numpy()
        camera = inverse(image.obj_from_camera.double()).cpu()
        focal = np.diag(k)[:2]
        middle = k[:2, 2] + 1

        def distance(points: Tensor) -> Tensor:
            seen = apply(camera, points.cpu()).numpy()
            depth = np.maximum(seen[:, 2], LEAST_DEPTH)  # behind the camera nothing is seen
            place = seen[:, :2] / depth[:, None] * focal + middle
            found = ndimage.map_coordinates(pixels, place[:, ::-1].T, order=1, mode="nearest")
            return torch.from_numpy(found * depth / focal.mean()).to(points)

        return cls(distance)

    @classmethod
    @checked
    def rim(cls, cloud: PointCloud, table: Plane | float, share: Fraction = 0.2) -> "Region":
        """Return the region above a level near the top of an object.

        The level is lower than the cloud's highest point by `share` of that point's height over the
        table. The region has no upper end.

        Args:
            cloud: the cloud of the object.
            table: the table's `Plane` in the frame of the cloud, or its height [m] along z.
            share: share of the height, in [0, 1].

        Raises `BadArgument` for a `share` outside [0, 1].
        """
        plane = as_plane(table)
        assert plane is not None
        level = (1 - share) * float(plane.height(cloud.points).max())
        return cls(lambda points: level - plane.height(points))


def combine(
    keep: Distance | None, avoid: Distance | None, also: Distance | None = None
) -> Distance | None:
    """Return the region that is inside `keep` and `also`, and outside `avoid`; None if all three
    are None.

    The three and the result are functions of points (n, 3) [m] in one frame. They return signed
    distances (n,) [m] from a region, negative inside it. None sets no limit.
    """
    named = ("keep", keep, 1), ("spec.region", also, 1), ("avoid", avoid, -1)
    parts = [
        (Region(x.distance if isinstance(x, Region) else x, name), k)
        for name, x, k in named
        if x is not None
    ]
    if not parts:
        return None
    return Region(lambda x: functools.reduce(torch.maximum, (k * part(x) for part, k in parts)))


def seen_from(region: Distance | None, obj_from_frame: Float[Tensor, "4 4"]) -> Distance | None:
    """Return the signed distance [m] from a `region` as a function of points in another frame.

    Such a function takes points (n, 3) [m] and returns signed distances (n,) [m], negative inside.
    `region` is one of points in the frame `obj`. `obj_from_frame` (4, 4) [m] is the pose of the
    other frame in `obj`. If `region` is None, the result is None.
    """
    if region is None:
        return None
    return lambda points: region(apply(obj_from_frame.to(points), points.reshape(-1, 3)))
