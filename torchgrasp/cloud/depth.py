"""Point clouds from depth images, and checks of the depth, the intrinsics and the mask."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.cloud.check import MIN_POINTS, check_cloud
from torchgrasp.cloud.intrinsics import (
    Matrix,
    as_tensor,
    check_intrinsics,
    describe_array,
    parse_intrinsics,
)
from torchgrasp.cloud.lens import Lens, describe
from torchgrasp.cloud.pose import (
    check_view,
    read_camera_pose,
    tell_far,
    tell_inverse,
    tell_large,
    tell_tilt,
)
from torchgrasp.cloud.rays import tell_rays, unproject
from torchgrasp.cloud.sensor import Image
from torchgrasp.cloud.surroundings import tell_strip
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, CloudWarning, MendedInput, TooFewPoints
from torchgrasp.foundation.rules import Positive
from torchgrasp.foundation.told import warn_user
from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.geometry.linalg import Points, unit
from torchgrasp.geometry.support_search import Target
from torchgrasp.values.planning import PointCloud

Array = Tensor | np.ndarray
SATURATED = np.iinfo(np.uint16).max


@dataclasses.dataclass(frozen=True)
class DepthNumbers:
    """Bounds of what depth cameras measure, by which an image in another unit is found."""

    nearest: float = 0.06
    """Least median depth [m]; depth cameras see nothing nearer."""
    farthest: float = 50.0
    """Greatest depth [m] that depth cameras measure."""
    near: float = 0.05
    """Least share of the measured pixels that are nearer than `farthest`. If fewer are, they are
    stray ones, and the unit is another.
    """
    millimetres: float = 200.0
    """Median depth, too large for metres, above which the depths are in mm; below it they are in
    cm.
    """
    background: float = 0.05
    """Least share of pixels that have the greatest depth. From this share on, a greatest depth that
    is too far marks a background.
    """
    sampled: int = 5000
    """Number of pixels, about, by which the step of the depths is found."""
    levels: int = 10
    """Least number of different depths that show their step: an image of few faces has fewer."""
    even: float = 1e-3
    """Greatest error of a depth that is a whole number of steps, as a share of the step."""
    coarse: float = 0.005
    """Least step [m] of the depths for a warning: it is larger than edges of things and noise."""
    several: float = 0.05
    """Least share of a mask's pixels with one number for which this number may be another object.
    """
    viewed: int = 5000
    """Number of points, about, by which a table in the view is compared with the pose."""
    whole: float = 0.5
    """Share of the measured pixels in a mask, from which on the image shows little besides the
    object.
    """


DEPTH = DepthNumbers()


@checked
def cloud_from_depth(
    depth: Tensor | np.ndarray,
    intrinsics: object,
    mask: Tensor | np.ndarray | None = None,
    camera_pose: Tensor | np.ndarray | None = None,
    depth_unit: Positive | None = None,
    up: Sequence[float | int] | Tensor | np.ndarray | None = None,
) -> PointCloud:
    """Return the points [m] that a pinhole camera's depth image shows, in the object frame.

    In the camera's frame x points right, y down and z forward. A pixel with depth z in column u and
    row v shows the point z ((u - cx) / fx, (v - cy) / fy, 1). Both u and v count from 0. Pixels
    with depth 0, NaN, 65535 counts or more than 50 m were not measured, and are left out.

    The result's `viewpoint` is the camera, and its `frustum` are the sides of the image. Its dtype
    is that of a depth tensor of floats, else float64.

    Args:
        depth: image (h, w) or (h, w, 1) of distances along the optical axis: floats in metres, or
            integers (such as uint16) in millimetres.
        intrinsics: the camera, in one of these forms:
            - a matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, or its 9 numbers;
            - a 3 x 4 projection matrix;
            - (fx, fy, cx, cy) [pixels];
            - (fx, fy, cx, cy, width, height) with the size of the image;
            - the dict or object of ROS (CameraInfo), Open3D, RealSense, Zivid, Azure Kinect or BOP,
              with its depth_scale and distortion.
        mask: image (h, w) of bool or uint8 that is not 0 at the object's pixels; None for all
            measured pixels.
        camera_pose: rigid pose `obj_from_camera` (4, 4) [m] of the camera. None means that the
            object frame is the camera's frame.
        depth_unit: metres of one count of the depth, such as 0.00025. None means the depth_scale of
            the intrinsics; without it, the units named under `depth`.
        up: direction (3,) against gravity, in the object frame; None means z. It serves to find a
            wrong pose: with a `mask`, a table in the image must face up.

    A polynomial distortion of a raw image (plumb_bob, rational_polynomial) is removed: each pixel's
    ray is undistorted. `MendedInput` then warns that the distortion was removed. A `CloudWarning`
    is given for a camera more than 10 m from the origin. It is also given for depths in steps of 5
    mm or more, and for depths scaled to 0..1. Masks with several numbers and pixels far from square
    raise it, too. So do a mask with a strip of the table, and a large object under a high camera,
    whose unit may be another.

    Raises:
        BadArgument: depth that is negative or of another unit.
        BadArgument: intrinsics of another resolution, or with a distortion of another model, such
            as a fisheye's.
        BadArgument: a mask of another size or without pixels.
        BadArgument: a pose that is not rigid, is more than 100 m off, or turns a table upside down.
        TooFewPoints: fewer than 4 measured pixels.
        SuspiciousScale: an extent outside [5 mm, 2 m], as of a scene without a mask.

    >>> depth = np.full((48, 64), 500, dtype=np.uint16)  # [mm]
    >>> cloud_from_depth(depth, (600.0, 600.0, 32.0, 24.0)).viewpoint
    tensor([0., 0., 0.], dtype=torch.float64)
    """
    z_image, k, inside, lens = read_depth(depth, intrinsics, mask, depth_unit)
    seen = z_image > 0
    measured = seen if inside is None else seen & inside
    count = int(measured.sum())
    if count < MIN_POINTS:
        allowed = f"at least {MIN_POINTS} measured pixels in the mask"
        raise TooFewPoints("depth", f"{count} measured pixels", allowed)
    points = _points(z_image, k, measured, lens)
    if lens is not None:
        warn_user(
            MendedInput,
            f"an image with distortion {describe(lens.coefficients)}, which is taken from its "
            "rays; leave it out for a rectified image",
        )
    pose = (torch.eye(4) if camera_pose is None else read_camera_pose(camera_pose)).to(points)
    notes = tuple[str, ...]()
    # Without a mask, the image may show the object alone, without a table.
    if inside is not None:
        view = apply(pose, _points(z_image, k, seen, lens))
        view = view[:: 1 + len(view) // DEPTH.viewed].cpu()
        own = apply(pose, points)[:: 1 + len(points) // DEPTH.viewed].cpu()
        target = Target(own)
        support = check_view(view, pose.cpu(), up, depth_unit is not None, target)
        if support is not None and up is None:
            notes += tell_tilt(pose.cpu(), support.plane)
        plane = None if support is None else support.plane.to(dtype=own.dtype)
        notes += () if plane is None else tell_strip(own, plane)
        notes += () if depth_unit is not None else tell_large(own, pose.cpu(), plane)
        # an image that a lens bends shows no plane, and one of the object alone no table
        around = lens is None and count < DEPTH.whole * int(seen.sum())
        if around and (support is None or support.local or notes):
            notes += tell_rays(z_image.cpu(), k.cpu())
    notes += (*tell_far(pose), *tell_step(z_image))
    notes += tell_inverse(pose) if up is None else ()
    for note in notes:
        warn_user(CloudWarning, note)

    viewpoint = pose[:3, 3]
    frustum = frustum_of_image(k, z_image.shape, lens).to(points)
    if camera_pose is not None:
        points = apply(pose, points)
        frustum = rotate(pose, frustum)
    dtype = depth.dtype if isinstance(depth, Tensor) and depth.is_floating_point() else points.dtype
    return check_cloud(PointCloud(points.to(dtype), None, viewpoint.to(dtype), frustum.to(dtype)))


def _points(
    z_image: Image, k: Matrix, keep: Bool[Tensor, "h w"], lens: Lens | None = None
) -> Points:
    """Return the points [m], in the camera's frame, of the pixels in the mask `keep`."""
    row, column = torch.nonzero(keep, as_tuple=True)
    z = z_image[keep]
    if lens is not None:
        x, y = lens.rays(k, torch.stack([column, row], -1).to(k)).unbind(-1)
        return torch.stack([z * x, z * y, z], -1)
    return unproject(z, k, row, column)


def frustum_of_image(
    intrinsics: Matrix, size: Sequence[int], lens: Lens | None = None
) -> Float[Tensor, "4 3"]:
    """Return the inward unit normals of the four sides of a camera's view, in its frame.

    They are those of the left, right, top and bottom side of an image of `size` (h, w) [pixels].
    The camera's frame has x right, y down and z forward; `intrinsics` (3, 3) are in pixels. The
    sides of an image that a `lens` bends are the planes through the middle of each border.
    """
    (fx, _, cx), (_, fy, cy) = intrinsics[:2].tolist()
    height, width = size
    if lens is not None:
        column = (width - 1) / 2
        row = (height - 1) / 2
        middles = [[0.0, row], [width - 1, row], [column, 0.0], [column, height - 1]]
        rays = lens.rays(intrinsics, intrinsics.new_tensor(middles))
        left, right = rays[:2, 0].tolist()
        top, bottom = rays[2:, 1].tolist()
        bent = [[1.0, 0.0, -left], [-1.0, 0.0, right], [0.0, 1.0, -top], [0.0, -1.0, bottom]]
        return unit(intrinsics.new_tensor(bent))
    sides = [[fx, 0.0, cx], [-fx, 0.0, width - 1 - cx], [0.0, fy, cy], [0.0, -fy, height - 1 - cy]]
    return unit(torch.tensor(sides, dtype=intrinsics.dtype, device=intrinsics.device))


@checked
def read_depth(
    depth: Array, intrinsics: object, mask: Array | None = None, depth_unit: Positive | None = None
) -> tuple[Image, Matrix, Bool[Tensor, "h w"] | None, Lens | None]:
    """Check the arguments of `cloud_from_depth`; return depth, intrinsics, mask and distortion.

    The depth (h, w) is in metres, 0 where nothing was measured. The intrinsics (3, 3) are in
    pixels. The mask (h, w) and the distortion are None if not given. Raises `BadArgument` for
    arguments of a wrong type, size or unit. A `CloudWarning` is given for a mask of several
    numbers, depths scaled to 0..1, or pixels far from square.
    """
    k, stated, scale, lens = parse_intrinsics(intrinsics)
    image = as_tensor("depth", depth)
    # one channel
    if image.ndim == 3 and 1 in (image.shape[0], image.shape[-1]):
        image = image.squeeze(-1 if image.shape[-1] == 1 else 0)
    narrow = image.is_complex() or image.dtype in (torch.bool, torch.uint8, torch.int8)
    if narrow or image.ndim != 2 or not image.numel():
        allowed = (
            "an image (h, w) of floats in metres, or of integers such as uint16 in millimetres"
        )
        raise BadArgument("depth", describe_array(depth), allowed)
    stated_unit = None if image.is_floating_point() else scale
    metres = _in_metres(image, depth_unit or stated_unit)
    check_intrinsics(k, stated, image.shape)
    k = k.to(image.device)
    if mask is None:
        return metres, k, None, lens

    pixels = as_tensor("mask", mask)
    if pixels.shape != image.shape or pixels.dtype not in (torch.bool, torch.uint8):
        allowed = f"an image of bool or uint8 of the depth's size {tuple(image.shape)}"
        raise BadArgument("mask", describe_array(mask), allowed)
    inside = pixels != 0
    if not inside.any():
        raise BadArgument("mask", "no pixel inside", "a mask that is not 0 at the object's pixels")
    marks, count = pixels[inside].unique(return_counts=True)
    # the border of a mask that was scaled has many numbers, each in few pixels
    marks = marks[count >= DEPTH.several * count.sum()]
    if len(marks) > 1:
        found = f"numbers from {int(marks.min())} to {int(marks.max())} count as one object"
        warn_user(CloudWarning, f"mask: {found}; if they are several, give mask == number")
    return metres, k, inside.to(image.device), lens


def _in_metres(image: Tensor, unit: float | None) -> Image:
    """Return a depth image in float64 [m], 0 where nothing was measured; refuse depths that cannot
    be metres.
    """
    counts = image.double()
    metres = counts
    whole = not image.is_floating_point()
    if unit:
        metres = counts * unit
    elif whole:
        metres = counts / 1000.0
    metres = torch.where(torch.isfinite(metres), metres, 0.0)
    if whole and float(counts.max()) == SATURATED:
        metres = torch.where(counts == SATURATED, 0.0, metres)
    if (metres < 0).any():
        allowed = "depths >= 0, where 0 and NaN mean not measured"
        raise BadArgument("depth", f"{float(metres.min()):.4g} m", allowed)

    measured = metres[metres > 0]
    if not whole and unit is None and len(measured) and float(measured.max()) == 1:
        share = float((measured == 1).double().mean())
        if share >= DEPTH.background:
            found = f"{share:.0%} of the depths are exactly 1, and none is larger"
            fix = "if it is a z-buffer, or depth scaled to 0..1, give metres"
            warn_user(CloudWarning, f"depth: {found}: {fix}")
    near = measured[measured <= DEPTH.farthest]
    # Renderers write one large number, such as 1e10, where they see nothing.
    background = measured == measured.max() if len(near) else measured > math.inf
    if int(background.sum()) >= DEPTH.background * len(measured):
        measured = measured[~background]
    if len(near) < DEPTH.near * len(measured):
        middle = float(measured.median())
        name = "cm"
        metre = 100.0
        if middle > DEPTH.millimetres:
            name = "mm"
            metre = 1000.0
        found = f"{middle:.4g} m; are these {name}? Give depth_unit={(unit or 1) / metre:g}"
        allowed = f"a median depth of at most {DEPTH.farthest:g} metres"
        raise BadArgument("depth", found, allowed)
    if len(near) and float(near.median()) < DEPTH.nearest:
        found = f"{float(near.median()):.3g} m; how many metres is a count? Give depth_unit"
        allowed = f"a median depth of at least {DEPTH.nearest:g} metres"
        raise BadArgument("depth", found, allowed)
    return torch.where(metres <= DEPTH.farthest, metres, 0.0)


def tell_step(depth: Image) -> tuple[str, ...]:
    """Return one note, a sentence, if an image's depths [m] have steps of 5 mm or more, else none.

    Such depths are whole numbers of steps from the least one. The bound is `DEPTH.coarse`. Depths
    of 0 were not measured, and do not count.
    """
    step = _step_of(depth[depth > 0])
    if step < DEPTH.coarse:
        return ()
    found = f"depth: its steps are {1e3 * step:.3g} mm, in which edges and small things are lost"
    return (f"{found}; save more digits, such as 16-bit millimetres",)


def _step_of(measured: Float[Tensor, "n"]) -> float:
    """Return the step [m] of which all depths (n,) [m] are whole numbers from the least one on; 0
    if there is none, or the depths are too few.
    """
    some = measured[:: 1 + len(measured) // DEPTH.sampled].unique()
    if len(some) < DEPTH.levels:
        return 0.0
    step = float(some.diff().min())
    counts = (some - some[0]) / step
    return step if ((counts - counts.round()).abs() < DEPTH.even).all() else 0.0
