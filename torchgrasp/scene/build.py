"""Scenes from what is given: the image, the table and the labels of its pixels."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.cloud.depth import check_rigid, read_depth
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.frames import apply, inverse, rigid
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.plane import Plane, as_plane
from torchgrasp.scene.image import DepthImage
from torchgrasp.scene.segment import on_surface, segment
from torchgrasp.scene.support import fit_support

LEAST_PIXELS = 30
"""Fewest pixels of a target: fewer show no shape."""
LEAST_PART = 0.05
"""Least share of a mask's pixels that are the target: in a box drawn around a thing they are a third."""
MASK_PART, PIECE_PART = 0.3, 0.5
"""A piece of a thing belongs to a mask that holds this share of the piece, or is made up by it to this share."""
MASK_ERROR = 4
"""Pixels about a mask that belong neither to the target nor to a neighbour: masks are off by so many."""
MOST_PIXELS = 1024
"""Longest side [px] of the image that stands for a cloud."""
WIDEST = 75.0
"""Widest angle [deg] of a cloud's points from the middle of its view."""


def read_image(
    depth: Tensor | np.ndarray,
    intrinsics: Tensor | np.ndarray | Sequence[float | int],
    camera_pose: Tensor | np.ndarray | None,
) -> DepthImage:
    """Return a checked depth image in float64 [m]; a missing pose is the camera's own frame."""
    z, k, _ = read_depth(depth, intrinsics)
    pose = torch.eye(4, dtype=torch.float64)
    if camera_pose is not None:
        pose = check_rigid("camera_pose", torch.as_tensor(camera_pose).double()).cpu()
    if int((z > 0).sum()) < LEAST_PIXELS:
        raise BadArgument("depth", f"{int((z > 0).sum())} measured pixels", f"at least {LEAST_PIXELS}")
    return DepthImage(z.cpu(), k.cpu(), pose)


def find_table(
    points: Float[Tensor, "n 3"], viewpoint: Float[Tensor, "3"], table: Plane | float | None, up: object
) -> Plane:
    """Return the plane that is given, or the one that is fitted, with the camera above it."""
    plane = as_plane(table)
    direction = None if up is None else torch.as_tensor(up).double().cpu()
    if plane is None:
        return fit_support(points, viewpoint, direction)
    if direction is not None and float(unit(direction) @ plane.normal.double()) < 0.5:
        raise BadArgument("up", direction.tolist(), "a direction within 60 degrees of the table's normal")
    if float(plane.height(viewpoint)) <= 0:
        raise BadArgument("table", f"the camera {-float(plane.height(viewpoint)):.3g} m below it", "a table below it")
    return plane


def read_labels(labels: Tensor | np.ndarray, shape: tuple[int, ...]) -> Int[Tensor, "..."]:
    """Return checked labels: whole numbers >= 0 of the depth's or the cloud's shape."""
    read = torch.as_tensor(np.asarray(labels).astype(np.int64) if isinstance(labels, np.ndarray) else labels)
    if tuple(read.shape) != tuple(shape) or read.is_floating_point() or read.dtype == torch.bool:
        found = f"shape {tuple(read.shape)}, {read.dtype}"
        raise BadArgument("labels", found, f"whole numbers of shape {tuple(shape)}, one for each pixel or point")
    if bool((read < 0).any()):
        raise BadArgument("labels", int(read.min()), "labels >= 0; 0 is the table and all that is no thing")
    return read.long().cpu()


def label_image(
    image: DepthImage, table: Plane, labels: Int[Tensor, "h w"] | None, mask: Bool[Tensor, "h w"] | None
) -> Int[Tensor, "h w"]:
    """Return the label of each pixel: those given without table and flying pixels, or those of `segment`.

    A mask becomes label 1. It loses the table and strips of neighbours; what is left of its thing just outside it
    belongs to nothing.

    Raises:
        BadArgument: nothing but the table is left of a mask, or nothing of all labels.
    """
    if labels is not None:
        kept = torch.where(on_surface(image, table), labels, 0)
        if not bool((kept > 0).any()):
            raise BadArgument("labels", "none that rises above the table", "labels of things on the table")
        return kept
    things = segment(image, table)
    if mask is None:
        return things
    inside = mask & on_surface(image, table)
    pieces = torch.where(inside, things, 0)
    whole, part = _counts(things, things), _counts(pieces, things)
    belongs = (part >= PIECE_PART * whole) | (part >= MASK_PART * max(1, int(inside.sum())))
    belongs[0] = True
    target = inside & belongs[things]
    seen = int((mask & (image.depth > 0)).sum())
    if int(target.sum()) < max(LEAST_PIXELS, LEAST_PART * seen):
        found = f"{int(target.sum())} of {seen} measured pixels above the table"
        raise BadArgument(
            "mask", found, f"at least {LEAST_PIXELS}, and a {1 / LEAST_PART:.0f}th: this target is the table"
        )
    from scipy.ndimage import binary_dilation

    about = torch.from_numpy(binary_dilation(mask.numpy(), iterations=MASK_ERROR))
    rest = torch.where(target | (about & belongs[things]), 0, things)
    few = _counts(rest, things) < LEAST_PIXELS
    rest = torch.where(few[rest], 0, rest)
    _, number = torch.cat([torch.zeros(1, dtype=torch.long), rest.reshape(-1)]).unique(return_inverse=True)
    rest = number[1:].reshape(rest.shape)
    return torch.where(target, 1, torch.where(rest > 0, rest + 1, 0))


def _counts(labels: Tensor, all_labels: Tensor) -> Int[Tensor, "k"]:
    """Count the pixels of each of all labels."""
    return torch.bincount(labels.reshape(-1), minlength=int(all_labels.max()) + 1)


def image_of_cloud(
    points: Float[Tensor, "n 3"], viewpoint: Float[Tensor, "3"], up: Float[Tensor, "3"]
) -> tuple[DepthImage, Int[Tensor, "n 2"]]:
    """Return the depth image that a pinhole camera at the viewpoint takes of a cloud, and each point's row and column.

    The camera looks at the middle of the points, upright. A pixel holds about two points and the nearest depth.
    """
    forward = unit(unit(points - viewpoint).mean(0))
    down = -up + (up @ forward) * forward
    if float(torch.linalg.vector_norm(down)) < 0.01:  # straight from above: any direction serves
        side = points[(points - points.mean(0)).norm(dim=-1).argmax()] - viewpoint
        down = side - (side @ forward) * forward
    down = unit(down)
    pose = rigid(torch.stack([torch.linalg.cross(down, forward), down, forward], -1), viewpoint)
    camera = apply(inverse(pose), points)
    flat = camera[:, :2] / camera[:, 2:]
    if not bool((camera[:, 2] > 0).all()) or float(flat.norm(dim=-1).max()) > math.tan(math.radians(WIDEST)):
        raise BadArgument("cloud", "points all around the camera", f"a view within {WIDEST:g} degrees of its middle")
    low, high = flat.amin(0), flat.amax(0)
    extent = (high - low).clamp_min(1e-6)
    cells = ((flat - low) / extent * 63.999).long()
    filled = len((cells[:, 0] * 64 + cells[:, 1]).unique()) / 64**2
    pixel = math.sqrt(2 * float(extent.prod()) * filled / len(points))
    pixel = max(pixel, float(extent.max()) / (MOST_PIXELS - 1))
    width, height = (int(side) + 1 for side in (extent / pixel).tolist())
    middle = (low + high) / 2
    centre = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=points.dtype) - middle / pixel
    k = torch.tensor([[1 / pixel, 0, centre[0]], [0, 1 / pixel, centre[1]], [0, 0, 1]], dtype=torch.float64)
    column, row = torch.round(flat / pixel + centre).long().unbind(-1)
    pixels = torch.stack([row.clamp(0, height - 1), column.clamp(0, width - 1)], -1)
    depth = torch.full((height * width,), torch.inf, dtype=torch.float64)
    depth.scatter_reduce_(0, pixels[:, 0] * width + pixels[:, 1], camera[:, 2], "amin")
    depth = torch.where(torch.isfinite(depth), depth, 0.0).reshape(height, width)
    return DepthImage(depth, k, pose, bounded=False), pixels
