"""Depth images of a pinhole camera, made from arrays, files and point clouds."""

import dataclasses
import functools
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.cloud.depth import Array, frustum_of_image, read_depth
from torchgrasp.cloud.lens import describe
from torchgrasp.cloud.pose import read_camera_pose
from torchgrasp.cloud.rays import unproject
from torchgrasp.cloud.safe_files import parse_npz, unread_arrays
from torchgrasp.files import explain, read_bounded
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, CloudFileError
from torchgrasp.foundation.lazy import ndimage
from torchgrasp.foundation.limits import CLOUD_BYTES
from torchgrasp.foundation.rules import Pose
from torchgrasp.geometry.frames import apply, inverse, rigid, rotate
from torchgrasp.geometry.linalg import Points, Vector, norm, unit
from torchgrasp.geometry.plane import FINE


@dataclasses.dataclass(frozen=True)
class ImageNumbers:
    """Numbers of pixels by which objects in depth images are judged."""

    least_pixels: int = 30
    """Least number of pixels of an object: fewer do not show its shape."""
    border_pixels: int = 5
    """Least number of pixels at the image border of an object that is cut off there. Fewer are
    noise.
    """
    squares: int = 3
    """Least number of measured depths in a square of 3 x 3 pixels whose median is taken."""
    usual: int = 640 * 480
    """Number of pixels of the image for which counts of pixels are given."""


@dataclasses.dataclass(frozen=True)
class ProjectionNumbers:
    """Parameters of the depth image that is made by projecting the points of a cloud onto an image
    plane of its camera.
    """

    steep: float = 0.01
    """Least length of the part of the vertical unit vector that lies in the image plane. A view
    with a shorter one is from straight above: any direction is then taken as down.
    """
    widest: float = 75.0
    """Greatest angle [deg] of a point from the middle of a view."""
    cells: int = 64
    """Number of cells to a side of a view, of which those with points count as filled."""
    inset: float = 0.001
    """Share of a cell by which the last point of a view lies inside the last cell."""
    most_steps: int = 1023
    """Greatest number of pixels from one side of an image made of a cloud to the other."""
    least_extent: float = 1e-6
    """Least extent of a view at depth 1, so that nothing is divided by 0."""


IMAGE = ImageNumbers()
PROJECTION = ProjectionNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class DepthImage(Value):
    """A pinhole camera's depth image, as in `Scene.image`.

    Attributes:
        depth: depth (h, w) [m] along the optical axis, 0 where nothing was measured.
        intrinsics: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels.
        obj_from_camera: pose (4, 4) [m] of the camera (x right, y down, z forward) in the frame
            "obj".
        bounded: whether the border of the image is that of the camera's view. It is not in an image
            made of a cloud.
    """

    depth: Float[Tensor, "h w"]
    intrinsics: Float[Tensor, "3 3"]
    obj_from_camera: Pose
    bounded: bool = True

    @property
    def focal(self) -> float:
        """The focal length fx [px], along a row of pixels."""
        return float(self.intrinsics[0, 0])

    @property
    def frustum(self) -> Float[Tensor, "4 3"] | None:
        """Inward unit normals (4, 3) of the sides of the camera's view: left, right, top, bottom.

        They are in the frame "obj" to which the pose leads; None if the image has no border.
        """
        if not self.bounded:
            return None
        return rotate(
            self.obj_from_camera.double(),
            frustum_of_image(self.intrinsics.double(), self.depth.shape),
        )

    @checked
    def to_upright(self, obj_from_upright: Pose) -> "DepthImage":
        """Return the image with the pose of the camera in an upright frame, rounded to multiples of
        2^-30.

        `obj_from_upright` (4, 4) [m] is the pose of the upright frame in the image's frame "obj".
        """
        pose = (
            inverse(obj_from_upright.double()).to(self.obj_from_camera.device)
            @ self.obj_from_camera.double()
        )
        return dataclasses.replace(self, obj_from_camera=torch.round(pose / FINE) * FINE)

    def points(self) -> Float[Tensor, "h w 3"]:
        """Return the point of every pixel (h, w, 3) [m], in the frame "obj" to which the pose
        leads.

        Where nothing was measured it is the camera's position.
        """
        z = self.depth.double()
        k = self.intrinsics.double()
        row = torch.arange(z.shape[0], dtype=z.dtype, device=z.device)[:, None]
        column = torch.arange(z.shape[1], dtype=z.dtype, device=z.device)
        camera = unproject(z, k, row, column)
        return apply(self.obj_from_camera.double(), camera.reshape(-1, 3)).reshape(*z.shape, 3)

    def rays(self) -> Float[Tensor, "h w 3"]:
        """Return the vectors (h, w, 3) from the camera to depth 1, through all pixels, in the frame
        "obj".
        """
        at_one = dataclasses.replace(self, depth=torch.ones_like(self.depth))
        return at_one.points() - self.obj_from_camera[:3, 3].double()

    def at_border(self, pixels: Int[Tensor, "n 2"]) -> bool:
        """Return whether an object reaches the border of the camera's image, in 5 pixels or more.

        `pixels` holds row and column of each of the object's n pixels. The bound is
        `IMAGE.border_pixels`. An image that is not `bounded` gives False. Pixels in the two
        outermost rows and columns count as at the border.
        """
        last = torch.tensor(self.depth.shape, device=pixels.device) - 1
        reaching = ((pixels <= 1) | (pixels >= last - 1)).any(-1)
        return self.bounded and int(reaching.sum()) >= IMAGE.border_pixels

    def without_speckle(self) -> "DepthImage":
        """Return the image with each depth replaced by the median of the 3 x 3 pixels around it.

        Only measured depths count; a depth with fewer than three of them in this square stays as it
        is.
        """
        depth = self.depth.numpy()
        padded = np.pad(np.where(depth > 0, depth, np.nan), 1, constant_values=np.nan)
        squares = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).reshape(*depth.shape, 9)
        # NaN are last (h, w, 9)
        ranked = np.sort(squares, axis=-1)
        count = np.isfinite(squares).sum(-1)
        place = np.maximum(count - 1, 0) // 2
        middle = np.take_along_axis(ranked, place[..., None], -1)[..., 0]
        known = (count >= IMAGE.squares) & (depth > 0)
        found = np.where(known, np.nan_to_num(middle), depth)
        return dataclasses.replace(self, depth=torch.from_numpy(found))


def read_image(
    depth: Array, intrinsics: object, camera_pose: Array | None, depth_unit: float | None = None
) -> DepthImage:
    """Return a checked depth image in float64 [m].

    Args:
        depth: image (h, w): floats in metres, or integers in millimetres.
        intrinsics: matrix (3, 3), (fx, fy, cx, cy) [pixels], or another form that
            `cloud_from_depth` takes.
        camera_pose: pose `obj_from_camera` (4, 4) [m]; None means the camera's own frame.
        depth_unit: metres of one count of the depth. None means that of the intrinsics, else the
            units named under `depth`.

    Raises `BadArgument` for arguments of a wrong type, size or unit, and for a pose that is not
    rigid. It is also raised for a distortion, and for fewer than 30 measured pixels.
    """
    z, k, _, lens = read_depth(depth, intrinsics, depth_unit=depth_unit)
    if lens is not None:
        found = f"a raw image of a scene, with distortion {describe(lens.coefficients)}"
        allowed = "a rectified image; `cloud_from_depth` takes a raw one of the object alone"
        raise BadArgument("intrinsics", found, allowed)
    pose = (
        torch.eye(4, dtype=torch.float64)
        if camera_pose is None
        else read_camera_pose(camera_pose).cpu()
    )
    if (count := int((z > 0).sum())) < IMAGE.least_pixels:
        raise BadArgument("depth", f"{count} measured pixels", f"at least {IMAGE.least_pixels}")
    return DepthImage(z.cpu(), k.cpu(), pose)


def scale_pixels(count: int, labels: Int[Tensor, "h w"]) -> float:
    """Return the number of pixels that corresponds to `count` in an image of another size.

    It is the same share of the image as `count` is of 640 x 480 pixels. The image has the size of
    `labels` (h, w).
    """
    return count * labels.numel() / IMAGE.usual


def label_radii(points: Float[Tensor, "h w 3"], labels: Int[Tensor, "h w"]) -> Float[Tensor, "k"]:
    """Return the root mean square distance [m] of the points of each label from their mean.

    Entry i of the result is for label i, from 0 to the greatest one. A label without points gets 0.
    `labels` holds the label of each of the h x w `points` [m].
    """
    label = labels.reshape(-1)
    own = points.reshape(-1, 3)
    count = torch.bincount(label).clamp_min(1)
    # (k, 3)
    mean = torch.stack([torch.bincount(label, weights=x) / count for x in own.unbind(-1)], -1)
    squared = (own - mean[label]).square().sum(-1)
    return (torch.bincount(label, weights=squared) / count).sqrt()


def image_of_cloud(
    points: Points, viewpoint: Vector, up: Vector
) -> tuple[DepthImage, Int[Tensor, "n 2"]]:
    """Return the depth image of a cloud, seen from its viewpoint, and the pixel (n, 2) of each
    point.

    A pixel is row and column. The camera is a pinhole, upright, and looks at the middle of the
    points. A pixel covers about two points and keeps the nearest. `points` (n, 3) and `viewpoint`
    (3,) are in metres; `up` (3,) is the unit vector that points up. All are in one frame. Raises
    `BadArgument` for points all around the camera.
    """
    forward = unit(unit(points - viewpoint).mean(0))
    down = -up + (up @ forward) * forward
    # straight from above, any direction will do
    if float(norm(down)) < PROJECTION.steep:
        side = points[norm(points - points.mean(0)).argmax()] - viewpoint
        down = side - (side @ forward) * forward
    down = unit(down)
    pose = rigid(torch.stack([torch.linalg.cross(down, forward), down, forward], -1), viewpoint)
    camera = apply(inverse(pose), points)
    # (n, 2), at a depth of 1
    flat = camera[:, :2] / camera[:, 2:]
    widest = math.tan(math.radians(PROJECTION.widest))
    ahead = bool((camera[:, 2] > 0).all())
    if not ahead or float(norm(flat).max()) > widest:
        allowed = f"a view within {PROJECTION.widest:g} degrees of its middle"
        raise BadArgument("cloud", "points all around the camera", allowed)
    low = flat.amin(0)
    high = flat.amax(0)
    extent = (high - low).clamp_min(PROJECTION.least_extent)
    # a pixel covers about two points of the filled part of the view
    cells = ((flat - low) / extent * (PROJECTION.cells - PROJECTION.inset)).long()
    cell = cells[:, 0] * PROJECTION.cells + cells[:, 1]
    filled = len(cell.unique()) / PROJECTION.cells**2
    pixel = math.sqrt(2 * float(extent.prod()) * filled / len(points))
    pixel = max(pixel, float(extent.max()) / PROJECTION.most_steps)
    width, height = (int(side) + 1 for side in (extent / pixel).tolist())
    middle = (low + high) / 2
    size = torch.tensor([width, height], dtype=points.dtype)
    centre = (size - 1) / 2 - middle / pixel
    k = torch.eye(3, dtype=torch.float64)
    k[0, 0] = 1 / pixel
    k[1, 1] = 1 / pixel
    k[:2, 2] = centre
    column, row = torch.round(flat / pixel + centre).long().unbind(-1)
    pixels = torch.stack([row.clamp(0, height - 1), column.clamp(0, width - 1)], -1)
    # of several points in a pixel the nearest is seen
    depth = torch.full((height * width,), torch.inf, dtype=torch.float64)
    depth.scatter_reduce_(0, pixels[:, 0] * width + pixels[:, 1], camera[:, 2], "amin")
    depth = torch.where(torch.isfinite(depth), depth, 0.0).reshape(height, width)
    return DepthImage(depth, k, pose, bounded=False), pixels


def read_arrays(path: Path) -> dict[str, Any]:
    """Return the arrays in a scene's .npz file by name, in the types and shapes that a scene needs.

    The entry `unread` is a list of the names of its other arrays.

    Raises `CloudFileError` for a file that is missing or malformed.
    """
    typed = {
        "table": (float, 4),
        "others": (float, (-1, 4)),
        "depth_unit": (float, ()),
        "target": (np.int64, ()),
        "bounded": (bool, ()),
        "given": (np.int64, -1),
    }
    names = ("depth", "intrinsics", "camera_pose", "labels", "mask", *typed)
    allowed = "a .npz file with depth and intrinsics"
    if path.suffix.lower() != ".npz":
        raise CloudFileError("path", path, allowed)
    data = read_bounded(path, CLOUD_BYTES, allowed, functools.partial(CloudFileError, "path"))
    try:
        arrays = parse_npz(data, names, "depth")
        found = {name: arrays[name] for name in ("depth", "intrinsics")} | arrays
        unread = unread_arrays(data, names)
        for name in typed.keys() & found.keys():
            kind, shape = typed[name]
            found[name] = found[name].astype(kind, casting="safe").reshape(shape)[()]
    except BadArgument:
        raise
    except Exception as error:  # zlib, zipfile and numpy each raise their own
        raise CloudFileError("path", f"{path}: {explain(error)}", allowed) from error
    return {**found, "unread": unread}


def is_scene(path: Path) -> bool:
    """Return whether a file holds a scene: a .npz file with a depth image."""
    if path.suffix.lower() != ".npz" or not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return "depth.npy" in archive.namelist()


def find_nearest(pixels: Bool[Tensor, "h w"]) -> tuple[Float[Tensor, "h w"], Int[Tensor, "h w"]]:
    """Return each pixel's distance [px] to the nearest pixel of a mask, and the index of that
    pixel.

    The index is row * w + column, that in the flattened image. `pixels` is the mask.
    """
    found: Any = ndimage.distance_transform_edt(~pixels.numpy(), return_indices=True)
    row, column = torch.from_numpy(found[1]).long()
    return torch.from_numpy(found[0]), row * pixels.shape[1] + column
