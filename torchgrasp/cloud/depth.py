"""Point clouds from depth images, and checks of the depth, the intrinsics and the mask."""

import math
from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.cloud.check import MIN_POINTS, check_cloud
from torchgrasp.cloud.pose import check_view, read_camera_pose
from torchgrasp.foundation.checks import check_tensor, checked
from torchgrasp.foundation.errors import BadArgument, TooFewPoints
from torchgrasp.foundation.rules import Positive
from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.geometry.linalg import unit
from torchgrasp.values.planning import PointCloud

Array = Tensor | np.ndarray
# least and greatest depth [m] that depth cameras measure
MIN_DEPTH = 0.06
MAX_DEPTH = 50.0
MATRICES = (
    "k",
    "cam_k",
    "camera_matrix",
    "intrinsic_matrix",
    "cameraintrinsics",
    "cameramatrix",
    "data",
)
"""Names of a matrix of intrinsics, or of an object that holds it: of ROS, BOP, Open3D and Zivid."""


@checked
def cloud_from_depth(
    depth: Tensor | np.ndarray,
    intrinsics: object,
    mask: Tensor | np.ndarray | None = None,
    camera_pose: Tensor | np.ndarray | None = None,
    depth_unit: Positive | None = None,
    up: Sequence[float | int] | Tensor | np.ndarray | None = None,
) -> PointCloud:
    """Return the points of a pinhole camera's depth image.

    A pixel (row v, column u) of depth z is the point z ((u - cx) / fx, (v - cy) / fy, 1). The
    camera's frame has x right, y down and z forward. Depths of 0, NaN, 65535 counts or more than 50
    m are not measured. The camera is the viewpoint, and the sides of the image give the frustum.

    Args:
        depth: (h, w) or (h, w, 1), distance along the optical axis: floats in metres, or integers
            (such as uint16) in millimetres.
        intrinsics: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], its 9 numbers, a 3 x 4 projection matrix,
            (fx, fy, cx, cy) [pixels], or (fx, fy, cx, cy, width, height) with the size of the
            image, which may be a crop. Or the dict or object of ROS (CameraInfo), Open3D,
            RealSense, Zivid or BOP, with its depth_scale.
        mask: (h, w), pixels of the object, bool or uint8 (0 is outside); None for all measured
            pixels.
        camera_pose: obj_from_camera (4, 4), rigid; None if the result shall be in the camera's
            frame.
        depth_unit: metres for one count of the depth, such as 0.00025; None for the depth_scale of
            the intrinsics, else for the units under `depth`.
        up: direction (3,) against gravity, in the object frame, with which the normal of a table in
            the image is compared; None for z.

    Raises:
        BadArgument: depth that is negative or of another unit; intrinsics of another resolution; a
            mask of another size or without pixels; a pose that is not rigid, is more than 100 m
            off, or turns a table upside down.
        TooFewPoints: fewer than 4 measured pixels.
        SuspiciousScale: an extent outside [5 mm, 2 m], as of a scene without a mask.

    >>> cloud_from_depth(np.full((48, 64), 500, dtype=np.uint16), (600.0, 600.0, 32.0, 24.0)).viewpoint
    tensor([0., 0., 0.], dtype=torch.float64)
    """
    z_image, k, inside = read_depth(depth, intrinsics, mask, depth_unit)
    measured = z_image > 0 if inside is None else (z_image > 0) & inside
    if int(measured.sum()) < MIN_POINTS:
        allowed = f"at least {MIN_POINTS} measured pixels in the mask"
        raise TooFewPoints("depth", f"{int(measured.sum())} measured pixels", allowed)
    points = _points(z_image, k, measured)
    pose = (torch.eye(4) if camera_pose is None else read_camera_pose(camera_pose)).to(points)
    if inside is not None:  # else the image may show the object alone, without a table
        everything = apply(pose, _points(z_image, k, z_image > 0))
        check_view(
            everything[:: 1 + len(everything) // 5000], pose.cpu(), up, depth_unit is not None
        )
    viewpoint = pose[:3, 3]
    frustum = frustum_of_image(k, z_image.shape).to(points)
    if camera_pose is not None:
        points = apply(pose, points)
        frustum = rotate(pose, frustum)
    dtype = depth.dtype if isinstance(depth, Tensor) and depth.is_floating_point() else points.dtype
    return check_cloud(PointCloud(points.to(dtype), None, viewpoint.to(dtype), frustum.to(dtype)))


def _points(
    z_image: Float[Tensor, "h w"], k: Float[Tensor, "3 3"], keep: Bool[Tensor, "h w"]
) -> Float[Tensor, "n 3"]:
    """Return the points [m], in the camera's frame, of the pixels in the mask `keep`."""
    row, column = torch.nonzero(keep, as_tuple=True)
    z = z_image[keep]
    return torch.stack([z * (column - k[0, 2]) / k[0, 0], z * (row - k[1, 2]) / k[1, 1], z], -1)


def frustum_of_image(intrinsics: Float[Tensor, "3 3"], size: Sequence[int]) -> Float[Tensor, "4 3"]:
    """Return the inward unit normals of a camera's frustum, for an image (h, w): left, right, top,
    bottom side.
    """
    (fx, _, cx), (_, fy, cy) = intrinsics[0].tolist(), intrinsics[1].tolist()
    height, width = size
    sides = [[fx, 0.0, cx], [-fx, 0.0, width - 1 - cx], [0.0, fy, cy], [0.0, -fy, height - 1 - cy]]
    return unit(torch.tensor(sides, dtype=intrinsics.dtype, device=intrinsics.device))


@checked
def read_depth(
    depth: Array, intrinsics: object, mask: Array | None = None, depth_unit: Positive | None = None
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "3 3"], Bool[Tensor, "h w"] | None]:
    """Check the arguments of `cloud_from_depth`; return depth [m] (0 if not measured), intrinsics
    [px] and mask.
    """
    k, stated, scale = _read_intrinsics(intrinsics)
    image = _as_tensor("depth", depth)
    if image.ndim == 3 and 1 in (image.shape[0], image.shape[-1]):  # one channel
        image = image.squeeze(-1 if image.shape[-1] == 1 else 0)
    narrow = image.is_complex() or image.dtype in (torch.bool, torch.uint8, torch.int8)
    if narrow or image.ndim != 2 or not image.numel():
        allowed = (
            "an image (h, w) of floats in metres, or of integers such as uint16 in millimetres"
        )
        raise BadArgument("depth", _describe(depth), allowed)
    metres = _in_metres(image, depth_unit if depth_unit or image.is_floating_point() else scale)
    wrong = _wrong_numbers(k, image.shape) or _wrong_size(k, stated, image.shape)
    if wrong is not None:
        raise BadArgument("intrinsics", *wrong)
    k = k.to(image.device)
    if mask is None:
        return metres, k, None
    inside = _as_tensor("mask", mask)
    if inside.shape != image.shape or inside.dtype not in (torch.bool, torch.uint8):
        allowed = f"an image of bool or uint8 of the depth's size {tuple(image.shape)}"
        raise BadArgument("mask", _describe(mask), allowed)
    if not bool((inside != 0).any()):
        raise BadArgument("mask", "no pixel inside", "a mask that is not 0 at the object's pixels")
    return metres, k, (inside != 0).to(image.device)


def _in_metres(image: Tensor, unit: float | None) -> Float[Tensor, "h w"]:
    """Return a depth image in float64 [m], 0 where nothing was measured; refuse depths that cannot
    be metres.
    """
    counts = image.double()
    metres = counts * unit if unit else counts if image.is_floating_point() else counts / 1000
    metres = torch.where(torch.isfinite(metres), metres, 0.0)
    if (
        not image.is_floating_point() and float(counts.max()) == 65535
    ):  # the largest uint16: saturated
        metres = torch.where(counts == 65535, 0.0, metres)
    if bool((metres < 0).any()):
        raise BadArgument(
            "depth",
            f"{float(metres.min()):.4g} m",
            "depths >= 0, where 0 and NaN mean not measured",
        )
    measured = metres[metres > 0]
    near = measured[measured <= MAX_DEPTH]
    if len(near) < 0.05 * len(measured):
        middle = float(measured.median())
        name, factor = ("mm", 0.001) if middle > 200 else ("cm", 0.01)
        found = f"{middle:.4g} m; are these {name}? Give depth_unit={factor * (unit or 1):g}"
        raise BadArgument("depth", found, f"a median depth of at most {MAX_DEPTH:g} metres")
    if len(near) and float(near.median()) < MIN_DEPTH:
        found = f"{float(near.median()):.3g} m; how many metres is a count? Give depth_unit"
        raise BadArgument("depth", found, f"a median depth of at least {MIN_DEPTH:g} metres")
    return torch.where(metres <= MAX_DEPTH, metres, 0.0)


def _read_forms(value: object) -> tuple[Any, list[float] | None, float | None, list[float]]:
    """Return, from any form of intrinsics, their numbers, image [width, height], metres per count
    and ROS's window.
    """
    if isinstance(value, Tensor | np.ndarray | Sequence) and not isinstance(value, str):
        return value, None, None, []
    names = (
        *MATRICES,
        "K",
        "fx",
        "fy",
        "cx",
        "cy",
        "ppx",
        "ppy",
        "width",
        "height",
        "roi",
        "binning_x",
        "binning_y",
    )
    inner: Any = (
        value
        if isinstance(value, Mapping)
        else {n: getattr(value, n) for n in names if hasattr(value, n)}
    )
    named = dict[str, Any]()
    key = ""
    for _ in range(4):  # ROS and Zivid write a matrix as an object
        named |= {str(name).lower(): x for name, x in inner.items()}
        key = next((name for name in MATRICES if name in named), "")
        inner = named.pop(key, None)
        if not isinstance(inner, Mapping):
            break
    if not key:
        inner = [
            named.get("fx"),
            named.get("fy"),
            named.get("cx", named.get("ppx")),
            named.get("cy", named.get("ppy")),
        ]
    if not isinstance(inner, Tensor | np.ndarray) and not _is_table(inner):
        found = f"a {type(value).__name__} of {', '.join(str(name)[:20] for name in list(named)[:8]) or 'nothing'}"
        allowed = (
            "fx, fy, cx and cy, or a matrix K; of a file of many images, the entry of this image"
        )
        raise BadArgument("intrinsics", found, allowed)
    if (
        key == "intrinsic_matrix"
        and isinstance(inner, list)
        and len(inner) == 9
        and inner[2] == inner[5] == 0
    ):
        inner = [inner[i::3] for i in range(3)]  # Open3D writes column by column
    width, height = (named.get(name, named.get(f"image_{name}")) for name in ("width", "height"))
    scale = named.get("depth_scale")
    for name, x in (("width", width), ("height", height), ("depth_scale", scale)):
        if x is not None and (not _is_table([x]) or not 0 < x < 1e9):
            raise BadArgument("intrinsics", f"{name} = {str(x)[:60]!r}", f"a positive {name}")
    if scale is not None:  # Open3D's counts of a metre; metres of a count, or of BOP millimetres
        scale = (
            1 / scale if key == "intrinsic_matrix" else scale if "ppx" in named else scale / 1000
        )
    return (
        inner,
        None if width is None or height is None else [float(width), float(height)],
        scale,
        _window(named),
    )


def _window(named: Mapping[str, Any]) -> list[float]:
    """Return x, y, width and height of ROS's region of interest [px], and the binning in x and y; 0
    if not set.
    """
    roi = named.get("roi", {})
    sides = ("x_offset", "y_offset", "width", "height")
    found: list[Any] = [
        roi.get(side, 0) if isinstance(roi, Mapping) else getattr(roi, side, 0) for side in sides
    ]
    found += [named.get("binning_x", 0), named.get("binning_y", 0)]
    if not _is_table(found) or not all(0 <= number < 1e6 for number in found):
        raise BadArgument(
            "intrinsics", f"roi and binning {str(found)[:80]}", "numbers of pixels >= 0"
        )
    return [float(number) for number in found]


def _is_table(value: object) -> bool:
    """Return whether a value from a file is a list of at most 12 numbers, or of rows of at most 4."""
    if not isinstance(value, list | tuple) or not 0 < len(value) <= 12:
        return False
    parts = [x for row in value for x in (row[:5] if isinstance(row, list | tuple) else [row])]
    rows = all(len(row) <= 4 for row in value if isinstance(row, list | tuple))
    return rows and all(isinstance(x, Real) and not isinstance(x, bool) for x in parts)


def _read_intrinsics(
    value: object,
) -> tuple[Float[Tensor, "3 3"], list[float] | None, float | None]:
    """Return the intrinsic matrix [px], the image's [width, height], and metres per depth unit;
    refuse wrong ones.
    """
    value, stated, scale, window = _read_forms(value)
    k = _as_tensor("intrinsics", value)
    allowed = "(fx, fy, cx, cy), or a 3 x 3 matrix"
    k = k if k.is_complex() else k.double()
    if k.ndim == 1 and len(k) in (9, 12):
        k = k.reshape(3, -1)
    if k.shape in ((4,), (6,)):
        (fx, fy, cx, cy), stated = k[:4].tolist(), k[4:].tolist() or stated
        k = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    if k.shape not in ((3, 3), (3, 4), (4, 4)):
        raise BadArgument("intrinsics", f"shape {tuple(k.shape)}", allowed)
    check_tensor("intrinsics", k, tuple(k.shape))
    if bool(k[:3, 3:].any()):
        raise BadArgument(
            "intrinsics", f"a fourth column {k[:3, 3].tolist()}", f"{allowed}: K of this camera"
        )
    k = k[:3, :3]
    if (
        not (k[0, 0] > 0 and k[1, 1] > 0)
        or k[0, 1] != 0
        or k[1, 0] != 0
        or k[2].tolist() != [0, 0, 1]
    ):
        turned = bool(k[2, :2].any()) and not bool(k[:2, 2].any())
        allowed = (
            "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0" + ", the transpose" * turned
        )
        raise BadArgument("intrinsics", k.tolist(), allowed)
    if any(window):  # of ROS, whose matrix is that of the whole sensor
        corner, size, bins = k.new_tensor(window).reshape(3, 2)
        bins = bins.clamp_min(1)
        k = torch.cat(
            [torch.cat([k[:2, :2], k[:2, 2:] - corner[:, None]], 1) / bins[:, None], k[2:]]
        )
        size = torch.where(size > 0, size, torch.tensor(stated or [0.0, 0.0]).to(size)) / bins
        stated = size.floor().tolist() if bool(size.all()) else stated
    return k, stated, scale


def _wrong_numbers(k: Float[Tensor, "3 3"], size: Sequence[int]) -> tuple[str, str] | None:
    """Return what is wrong with intrinsics that no camera has, and the fix; None if the intrinsics
    are plausible.
    """
    height, width = size
    (fx, _, cx), (_, fy, cy) = k[:2].tolist()
    if min(fx / width, fy / height) < 0.15:
        angle = math.degrees(2 * math.atan(max(width / fx, height / fy) / 2))
        fix = "multiply normalised ones by width and height, divide millimetres by the size of a pixel"
        return (
            f"fx = {fx:.4g} and fy = {fy:.4g}, a view of {angle:.0f} degrees",
            f"focal lengths in pixels: {fix}",
        )

    def fits(fx: float, fy: float, cx: float, cy: float) -> bool:
        return abs(fx / fy - 1) < 0.05 and max(abs(cx / width - 0.5), abs(cy / height - 0.5)) < 0.1

    orders = {"fx, cx, fy, cy": (fx, cx, fy, cy), "cx, cy, fx, fy": (cx, cy, fx, fy)}
    for order, numbers in orders.items():
        if not fits(fx, fy, cx, cy) and min(numbers) > 0 and fits(*numbers):
            return f"the order {order}", "the order fx, fy, cx, cy"
    if max(abs(cx / width - 0.5), abs(cy / height - 0.5)) > 8:
        return (
            f"a principal point ({cx:.4g}, {cy:.4g}) px in an image of {width} x {height}",
            "a crop nearer to it",
        )
    return None


def _wrong_size(
    k: Float[Tensor, "3 3"], stated: list[float] | None, size: Sequence[int]
) -> tuple[str, str] | None:
    """Return the error and its fix if intrinsics belong to another resolution; None if they fit the
    image or a crop.
    """
    height, width = size
    image = k.new_tensor([width, height])
    centre = 2 * k[:2, 2]
    if stated is not None:
        own = k.new_tensor(stated)
        corner = (own - centre) / 2  # of the crop
        inside = bool(((corner > -0.05 * own) & (corner < 1.05 * own - image)).all())
        if torch.equal(own, image) or (inside and bool((corner.abs() > 0.04 * own).any())):
            return None
        found = (
            f"those of an image of {own[0]:g} x {own[1]:g} px for an image of {width} x {height}"
        )
    else:  # the principal point tells the size of the image, roughly
        scales = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2, 3, 4)
        modes = (
            (320, 240),
            (424, 240),
            (480, 270),
            (512, 424),
            (640, 360),
            (640, 480),
            (640, 576),
            (848, 480),
        )
        modes += (
            (960, 540),
            (1024, 768),
            (1280, 720),
            (1280, 960),
            (1920, 1080),
            (1944, 1200),
            (2048, 1536),
        )
        sizes = [image * s for s in scales] + [
            m for m in map(k.new_tensor, modes) if not torch.equal(m, image)
        ]
        own = next((m for m in sizes if bool(((centre / m - 1).abs() < 0.05).all())), None)
        if own is None or float((centre / image - 1).abs().max()) < 0.16:
            return None
        found = (
            f"a principal point ({k[0, 2]:.1f}, {k[1, 2]:.1f}) px in an image of {width} x {height}"
        )
    fix = ""
    ratio = image / own
    if abs(float(ratio[0] / ratio[1]) - 1) < 0.02:
        fix = f"all four times {float(ratio[0]):.4g}; "
    elif torch.equal(own, image.flip(0)):
        fix = "the transposed image, (height, width); "
    crop = "of a crop, cx and cy less its corner, and (fx, fy, cx, cy, width, height) with the size of the crop"
    return found, f"intrinsics of the same resolution: {fix}{crop}"


def _as_tensor(name: str, value: Any) -> Tensor:
    """Return an array of numbers as a tensor; raise `BadArgument` about `name` for anything else."""
    if isinstance(value, Tensor):
        return value
    try:
        array = np.array(value)
        return torch.from_numpy(
            array.astype(array.dtype.newbyteorder("="))
        )  # some files are big-endian
    except (TypeError, ValueError) as error:  # text, objects, rows of different length
        raise BadArgument(name, _describe(value), "an array of numbers") from error


def _describe(value: object) -> str:
    """Return the type, the shape and the dtype of an image as text."""
    shape = getattr(value, "shape", ())
    dtype = getattr(value, "dtype", "no dtype")
    return f"{type(value).__name__} of shape {tuple(shape)}, {dtype}"
