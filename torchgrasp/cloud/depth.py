"""From depth images to point clouds."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.checks import RIGID, check_tensor, checked, is_rigid
from torchgrasp.cloud.check import MIN_POINTS, check_cloud
from torchgrasp.cloud.tables import parse_npy, parse_npz, read_lines
from torchgrasp.errors import BadArgument, TooFewPoints
from torchgrasp.files import is_file, read_bytes
from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.geometry.linalg import unit
from torchgrasp.limits import CLOUD_BYTES
from torchgrasp.values import PointCloud

MAX_DEPTH = 50.0  # largest median depth [m]; no depth camera sees so far


@checked
def cloud_from_depth(
    depth: Tensor | np.ndarray,
    intrinsics: Tensor | np.ndarray | Sequence[float | int],
    mask: Tensor | np.ndarray | None = None,
    camera_pose: Tensor | np.ndarray | None = None,
) -> PointCloud:
    """Return the points of a pinhole camera's depth image.

    A pixel (row v, column u) of depth z is the point z ((u - cx) / fx, (v - cy) / fy, 1). The camera's frame has x
    right, y down and z forward. Depths of 0, NaN or infinity are not measured. The camera is the viewpoint, and the
    sides of the image give the frustum.

    Args:
        depth: (h, w), distance along the optical axis: floats in metres, or integers (such as uint16) in millimetres.
        intrinsics: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] or (fx, fy, cx, cy) [pixels].
        mask: (h, w), pixels of the object, bool or uint8 (0 is outside); None: all measured pixels.
        camera_pose: obj_from_camera (4, 4), rigid; None: the result is in the camera's frame.

    Raises:
        BadArgument: depth that is negative, or in millimetres though floating; intrinsics of another resolution; a
            mask of another size or without pixels; a pose that is not rigid.
        TooFewPoints: fewer than 4 measured pixels.
        SuspiciousScale: an extent outside [5 mm, 2 m], as of a scene without a mask.

    >>> cloud_from_depth(np.full((48, 64), 500, dtype=np.uint16), (600.0, 600.0, 32.0, 24.0)).viewpoint
    tensor([0., 0., 0.], dtype=torch.float64)
    """
    z_image, k, inside = read_depth(depth, intrinsics, mask)
    measured = z_image > 0 if inside is None else (z_image > 0) & inside
    if int(measured.sum()) < MIN_POINTS:
        allowed = f"at least {MIN_POINTS} measured pixels in the mask"
        raise TooFewPoints("depth", f"{int(measured.sum())} measured pixels", allowed)
    row, column = torch.nonzero(measured, as_tuple=True)
    z = z_image[measured]
    points = torch.stack([z * (column - k[0, 2]) / k[0, 0], z * (row - k[1, 2]) / k[1, 1], z], -1)
    viewpoint = torch.zeros(3, dtype=points.dtype, device=points.device)
    frustum = frustum_of_image(k, z_image.shape).to(points)
    if camera_pose is not None:
        pose = check_rigid("camera_pose", _as_tensor("camera_pose", camera_pose)).to(points)
        points, viewpoint, frustum = apply(pose, points), pose[:3, 3], rotate(pose, frustum)
    dtype = depth.dtype if isinstance(depth, Tensor) and depth.is_floating_point() else points.dtype
    return check_cloud(PointCloud(points.to(dtype), None, viewpoint.to(dtype), frustum.to(dtype)))


def frustum_of_image(intrinsics: Float[Tensor, "3 3"], size: Sequence[int]) -> Float[Tensor, "4 3"]:
    """Return the inward unit normals of the sides of a camera's view, in its frame.

    The sides go through the outermost pixels: left, right, top, bottom. `size` is (h, w).
    """
    (fx, _, cx), (_, fy, cy) = intrinsics[0].tolist(), intrinsics[1].tolist()
    height, width = size
    sides = [[fx, 0.0, cx], [-fx, 0.0, width - 1 - cx], [0.0, fy, cy], [0.0, -fy, height - 1 - cy]]
    return unit(torch.tensor(sides, dtype=intrinsics.dtype, device=intrinsics.device))


@checked
def read_depth(
    depth: Tensor | np.ndarray,
    intrinsics: Tensor | np.ndarray | Sequence[float | int],
    mask: Tensor | np.ndarray | None = None,
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "3 3"], Bool[Tensor, "h w"] | None]:
    """Check the arguments of `cloud_from_depth`; return depth [m] (0: not measured), intrinsics and mask."""
    image = _as_tensor("depth", depth)
    if (
        image.ndim != 2
        or not image.numel()
        or image.dtype in (torch.bool, torch.uint8, torch.int8)
        or image.is_complex()
    ):
        allowed = "an image (h, w) of floats in metres, or of integers such as uint16 in millimetres"
        raise BadArgument("depth", _describe(depth), allowed)
    metres = image.double() if image.is_floating_point() else image.double() / 1000
    metres = torch.where(torch.isfinite(metres), metres, 0.0)
    if bool((metres < 0).any()):
        raise BadArgument("depth", f"{float(metres.min()):.4g} m", "depths >= 0, where 0 and NaN mean not measured")
    measured = metres[metres > 0]
    if len(measured) and float(measured.median()) > MAX_DEPTH:
        found = f"{float(measured.median()):.4g} m; are these mm? Divide them by 1000, or give uint16"
        raise BadArgument("depth", found, f"a median depth of at most {MAX_DEPTH:g} metres")
    k = _read_intrinsics(intrinsics, image.shape).to(image.device)
    if mask is None:
        return metres, k, None
    inside = _as_tensor("mask", mask)
    if inside.shape != image.shape or inside.dtype not in (torch.bool, torch.uint8):
        allowed = f"an image of bool or uint8 of the depth's size {tuple(image.shape)}"
        raise BadArgument("mask", _describe(mask), allowed)
    if not bool((inside != 0).any()):
        raise BadArgument("mask", "no pixel inside", "a mask that is not 0 at the object's pixels")
    return metres, k, (inside != 0).to(image.device)


def _read_intrinsics(
    intrinsics: Tensor | np.ndarray | Sequence[float | int], size: Sequence[int]
) -> Float[Tensor, "3 3"]:
    """Return the matrix of intrinsics [px] of an image (h, w), or refuse it."""
    max_shift = 0.15  # largest distance of the principal point from the image's middle, in sides of the image
    k = _as_tensor("intrinsics", intrinsics).double()
    if k.shape == (4,):
        fx, fy, cx, cy = k.tolist()
        k = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    if k.shape != (3, 3):
        raise BadArgument("intrinsics", f"shape {tuple(k.shape)}", "(fx, fy, cx, cy), or a 3 x 3 matrix")
    check_tensor("intrinsics", k, (3, 3))
    if not (k[0, 0] > 0 and k[1, 1] > 0) or k[0, 1] != 0 or k[1, 0] != 0 or k[2].tolist() != [0, 0, 1]:
        raise BadArgument("intrinsics", k.tolist(), "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0")
    height, width = size
    shift = [abs(float(k[0, 2]) / width - 0.5), abs(float(k[1, 2]) / height - 0.5)]
    if max(shift) > max_shift:
        found = f"a principal point ({float(k[0, 2]):.1f}, {float(k[1, 2]):.1f}) px in an image of {width} x {height}"
        raise BadArgument(
            "intrinsics", found, "a principal point near the image's middle, from intrinsics of the same resolution"
        )
    return k


def _as_tensor(name: str, value: Tensor | np.ndarray | Sequence[float | int]) -> Tensor:
    """Return an array of numbers as a tensor, or refuse it."""
    if isinstance(value, Tensor):
        return value
    try:
        array = np.array(value)
        return torch.from_numpy(array.astype(array.dtype.newbyteorder("=")))  # some files are big-endian
    except (TypeError, ValueError) as error:  # text, objects, rows of different length
        raise BadArgument(name, _describe(value), "an array of numbers") from error


def _describe(value: object) -> str:
    """Return the type of an image, its shape and its dtype."""
    shape, dtype = getattr(value, "shape", ()), getattr(value, "dtype", "no dtype")
    return f"{type(value).__name__} of shape {tuple(shape)}, {dtype}"


def check_rigid(name: str, pose: Tensor) -> Float[Tensor, "4 4"]:
    """Return a transform that is rigid to 1e-4; refuse others."""
    check_tensor(name, pose, (4, 4))
    if not bool(is_rigid(pose)):
        raise BadArgument(name, pose.tolist(), RIGID)
    return pose


def read_image(name: str, path: Path | str) -> np.ndarray:
    """Return the numbers of an image file: .npy, .npz with an array `depth` or `mask`, or .png of one channel.

    Args:
        name: "depth" or "mask", the name in errors and in .npz files.
        path: the file.

    Raises:
        BadArgument: no such file, another suffix, malformed content, or a picture of several channels.
    """
    data, suffix = _read_bytes(name, path, (".npy", ".npz", ".png"))
    try:
        if suffix == ".npy":
            return parse_npy(data)
        return parse_npz(data, (name,), name)[name] if suffix == ".npz" else _parse_png(data)
    except Exception as error:  # zlib, zipfile, numpy and Pillow each raise their own
        raise BadArgument(name, f"{path}: {error!r}", f"a well-formed {suffix} file of one channel") from error


def read_pose(name: str, path: Path | str) -> Float[Tensor, "4 4"]:
    """Return the rigid transform in a file: .npy, or .txt with four rows of four numbers.

    Raises:
        BadArgument: no such file, another suffix, malformed content, or no rigid transform.
    """
    data, suffix = _read_bytes(name, path, (".npy", ".txt"))
    try:
        table = parse_npy(data) if suffix == ".npy" else read_lines(data)
        pose = torch.from_numpy(np.array(table, dtype=np.float64))
    except Exception as error:
        raise BadArgument(name, f"{path}: {error!r}", f"a well-formed {suffix} file of 4 x 4 numbers") from error
    return check_rigid(name, pose)


def _read_bytes(name: str, path: Path | str, suffixes: tuple[str, ...]) -> tuple[bytes, str]:
    """Return the content and the suffix of a file, or refuse it."""
    path, allowed = Path(path), f"a {', '.join(suffixes[:-1])} or {suffixes[-1]} file"
    if not is_file(path):
        raise BadArgument(name, f"{path}, which is no file", allowed)
    if path.suffix.lower() not in suffixes or path.stat().st_size > CLOUD_BYTES:
        found = f"{path} of {path.stat().st_size} bytes"
        raise BadArgument(name, found, f"{allowed} of at most {CLOUD_BYTES} bytes")
    return read_bytes(path), path.suffix.lower()


def _parse_png(data: bytes) -> np.ndarray:
    """Return the pixels of a PNG of one channel: uint16, uint8 or bool."""
    from PIL import Image

    with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
        if image.mode not in ("1", "L", "I", "I;16", "I;16B"):
            raise ValueError(f"a picture of mode {image.mode}")
        return np.asarray(image)
