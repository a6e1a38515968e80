"""Point clouds from and to files. A malformed file is refused by name; none runs code."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from torchgrasp.base import named_tensors
from torchgrasp.checks import check_tensor, checked
from torchgrasp.cloud.check import check_cloud
from torchgrasp.cloud.io.arrays import MAX_BYTES, parse_npy, parse_npz
from torchgrasp.cloud.io.pcd import parse_pcd
from torchgrasp.cloud.io.ply import format_ply, parse_ply
from torchgrasp.cloud.io.rows import CloudFile, make_cloud
from torchgrasp.cloud.io.text import read_lines
from torchgrasp.errors import BadArgument, CloudFileError
from torchgrasp.files import is_file, read_bytes, write_file
from torchgrasp.values import PointCloud

SCALE: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Metres in each unit of length."""


@checked
def read_cloud(
    path: Path | str, viewpoint: Sequence[float | int] | Tensor | None = None, unit: Literal["m", "cm", "mm"] = "m"
) -> PointCloud:
    """Read the point cloud of one object, in float64; `read_cloud_file` also tells what was left out.

    * `.ply`, ascii or binary: x y z, optionally nx ny nz; header lines `comment viewpoint x y z` and
      `comment frustum` with 12 numbers give the camera.
      A mesh gives 2000 surface points, with normals if closed.
    * `.pcd`, ascii, binary or compressed: x y z, optionally normal_x normal_y normal_z; the viewpoint from VIEWPOINT.
      Its default `0 0 0 1 0 0 0` counts only if the points look like those of a camera in the origin.
    * `.npz`: arrays `points` (n, 3), optionally `normals` (n, 3), `viewpoint` (3,) and `frustum` (4, 3);
      of several views `viewpoint` (n, 3) and `frustum` (n, 4, 3).
    * `.npy`, `.xyz`, `.txt`, `.csv` (text): an (n, 3) array, or (n, 6) with normals; colours are left out.

    Arrays (h, w, 3) of an image are taken, too. Rows with NaN, infinity or, more than once, (0, 0, 0) are left out.

    Args:
        path: the file.
        viewpoint: the camera's position (3,) [m] in the cloud's frame, instead of the file's.
        unit: of the file's points and viewpoint.

    Raises:
        CloudFileError: no such file; an unknown suffix; malformed content; more than 512 MB or 5 million points.
        BadArgument: a viewpoint other than three numbers; points on one line.
        TooFewPoints: fewer than 4 distinct points.
        SuspiciousScale: an extent outside [5 mm, 2 m].

    >>> read_cloud("scan.docx")
    Traceback (most recent call last):
    torchgrasp.errors.CloudFileError: path: expected a file ending in .ply, .pcd, .npz, .npy or .xyz, got scan.docx
    """
    return check_cloud(read_cloud_file(path, viewpoint, unit).cloud)


@checked
def read_cloud_file(
    path: Path | str, viewpoint: Sequence[float | int] | Tensor | None = None, unit: Literal["m", "cm", "mm"] = "m"
) -> CloudFile:
    """Read a cloud of any size, such as a whole scene, with notes on what was left out.

    Args:
        path, viewpoint, unit: as of `read_cloud`.

    Raises:
        CloudFileError, BadArgument, TooFewPoints: see `read_cloud`.

    >>> read_cloud_file("none.ply")
    Traceback (most recent call last):
    torchgrasp.errors.CloudFileError: path: expected a .ply file, got none.ply, which is no file
    """
    try:
        position = None if viewpoint is None else torch.as_tensor(viewpoint, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise BadArgument("viewpoint", repr(viewpoint), "three numbers [m]") from error
    if position is not None:
        check_tensor("viewpoint", position, (3,))
    path, suffix = Path(path), Path(path).suffix.lower()
    parsers = {
        ".ply": parse_ply,
        ".pcd": parse_pcd,
        ".npz": lambda data: parse_npz(data, ("points", "normals", "viewpoint", "frustum"), "points"),
        ".npy": lambda data: {"table": parse_npy(data)},
        **dict.fromkeys((".xyz", ".txt", ".csv"), lambda data: {"table": read_lines(data)}),
    }
    if suffix not in parsers:
        # Text may also be called .txt and .csv.
        raise CloudFileError("path", path, "a file ending in .ply, .pcd, .npz, .npy or .xyz")
    if not is_file(path):
        raise CloudFileError("path", f"{path}, which is no file", f"a {suffix} file")
    if path.stat().st_size > MAX_BYTES:
        raise CloudFileError("path", f"{path} of {path.stat().st_size} bytes", f"at most {MAX_BYTES} bytes")
    try:
        arrays = parsers[suffix](read_bytes(path))
    except Exception as error:  # zlib, zipfile, numpy and trimesh each raise their own
        raise CloudFileError("path", f"{path}: {error!r}", f"a well-formed {suffix} file") from error
    return make_cloud(str(path), arrays, position, SCALE[unit])


@checked
def cloud_from_array(
    points: np.ndarray, normals: np.ndarray | None = None, viewpoint: np.ndarray | Sequence[float | int] | None = None
) -> PointCloud:
    """Return the cloud of NumPy arrays [m] by the rules of `read_cloud`: missing rows and colours are left out.

    Args:
        points: (n, 3), (h, w, 3) of an image, or with three more columns of normals.
        normals: of the same shape as points, or None.
        viewpoint: the camera (3,), or None.

    Raises:
        BadArgument, TooFewPoints, SuspiciousScale: see `read_cloud`.

    >>> len(cloud_from_array(np.random.default_rng(0).random((6, 8, 3))))
    48
    """
    arrays = {"table" if normals is None else "points": points, "normals": normals, "viewpoint": viewpoint}
    return check_cloud(make_cloud("an array", arrays).cloud)


@checked
def save_cloud(cloud: PointCloud, path: Path | str) -> Path:
    """Write a cloud as `.npz` (exact) or binary `.ply` (float32), atomically.

    Raises:
        BadArgument: another suffix; several views for `.ply`, which has one viewpoint.
        OutputError: the file cannot be written.

    >>> save_cloud(PointCloud(torch.rand(9, 3)), "cloud.txt")
    Traceback (most recent call last):
    torchgrasp.errors.BadArgument: path: expected a file ending in .npz or .ply, got cloud.txt
    """
    path, buffer = Path(path), io.BytesIO()
    arrays = {name: tensor.detach().cpu().numpy() for name, tensor in named_tensors(cloud).items()}
    if path.suffix.lower() not in (".npz", ".ply"):
        raise BadArgument("path", path, "a file ending in .npz or .ply")
    if path.suffix.lower() == ".npz":
        np.savez_compressed(buffer, **arrays)  # pyright: ignore[reportArgumentType]
        return write_file(path, buffer.getvalue())
    if cloud.viewpoint is not None and cloud.viewpoint.ndim == 2:
        raise BadArgument("path", path, "a file ending in .npz, for a cloud of several views")
    return write_file(path, format_ply(**arrays))
