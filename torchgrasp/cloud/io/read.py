"""Point clouds from files and into files; a file from a stranger is refused by name, and runs no code."""

import io
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgrasp.base import check_tensor
from torchgrasp.cloud.check import check_cloud
from torchgrasp.cloud.io.pcd import parse_pcd
from torchgrasp.cloud.io.ply import format_ply, parse_ply
from torchgrasp.cloud.io.text import MAX_POINTS, read_lines
from torchgrasp.errors import BadArgument, CloudFileError, TooFewPoints
from torchgrasp.files import write_file
from torchgrasp.values import PointCloud

MAX_BYTES = 512 * 2**20
"""Largest file, and largest unpacked content, that is read."""
SUFFIXES = (".ply", ".pcd", ".npz", ".npy", ".xyz")
"""The formats, by suffix."""


def read_cloud(path: Path | str, viewpoint: Sequence[float | int] | Tensor | None = None) -> PointCloud:
    """Read the point cloud of one object from a file; numbers come back as float64, lengths are metres.

    * `.ply`, ascii or binary: x y z, optionally nx ny nz; the camera's position from a header line
      `comment viewpoint x y z`. If the file has faces it is a mesh, and 2000 points of its surface are drawn,
      with their outward normals where the mesh is closed.
    * `.pcd`, ascii or binary: x y z, optionally normal_x normal_y normal_z; the camera's position from VIEWPOINT,
      except from the default `0 0 0 1 0 0 0` when that point lies within the cloud's bounding box.
    * `.npz`: arrays `points` (n, 3), optionally `normals` (n, 3) and `viewpoint` (3,), or (n, 3) of several views.
    * `.npy`, `.xyz` (text): an (n, 3) array, or (n, 6) with normals.

    Args:
        path: the file.
        viewpoint: the camera's position (3,) [m] in the cloud's frame; it replaces the one in the file.

    Raises:
        CloudFileError: no such file, an unknown suffix, content that is not what the suffix says, more than
            512 MB or 5 million points.
        BadArgument: a viewpoint that is no three numbers, a non-finite number (a pixel without depth belongs left
            out), or points on one line.
        TooFewPoints: fewer than 4 distinct points.
        SuspiciousScale: an extent outside [5 mm, 2 m].

    >>> read_cloud("scan.docx")
    Traceback (most recent call last):
    torchgrasp.errors.CloudFileError: path: found scan.docx, allowed is a file ending in .ply, .pcd, .npz, .npy, .xyz
    """
    position = None if viewpoint is None else _check_viewpoint(viewpoint)
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise CloudFileError("path", path, f"a file ending in {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise CloudFileError("path", f"{path}, which is no file", f"a {suffix} file")
    if path.stat().st_size > MAX_BYTES:
        raise CloudFileError("path", f"{path} of {path.stat().st_size} bytes", f"at most {MAX_BYTES} bytes")
    parse = {".ply": parse_ply, ".pcd": parse_pcd, ".npz": _parse_npz, ".npy": _parse_npy, ".xyz": _parse_text}[suffix]
    try:
        arrays = parse(path.read_bytes())
    except Exception as error:  # zlib, zipfile, the tokenizer, numpy and trimesh each raise their own for spoilt bytes
        raise CloudFileError("path", f"{path}: {error!r}", f"a well-formed {suffix} file") from error
    arrays = {name: _check_array(path, name, array) for name, array in arrays.items() if array is not None}
    points, normals = arrays["points"], arrays.get("normals")
    if len(points) < 4:
        raise TooFewPoints("path", f"{path} with {len(points)} points", "at least 4 points")
    if position is not None:
        arrays["viewpoint"] = position
    return check_cloud(PointCloud(points, normals, arrays.get("viewpoint")))


def save_cloud(cloud: PointCloud, path: Path | str) -> Path:
    """Write a cloud as `.npz` (exact) or binary `.ply` (float32, for other programs), atomically.

    Both keep normals and viewpoint, and `read_cloud` reads both back.

    Raises:
        BadArgument: another suffix, or several views for `.ply`, which has one viewpoint.
        OutputError: the file cannot be written.

    >>> save_cloud(PointCloud(torch.rand(9, 3)), "cloud.txt")
    Traceback (most recent call last):
    torchgrasp.errors.BadArgument: path: found cloud.txt, allowed is a file ending in .npz or .ply
    """
    path = Path(path)
    fields = {"points": cloud.points, "normals": cloud.normals, "viewpoint": cloud.viewpoint}
    arrays = {name: value.detach().cpu().numpy() for name, value in fields.items() if value is not None}
    if path.suffix.lower() == ".npz":
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)  # pyright: ignore[reportArgumentType]
        content = buffer.getvalue()
    elif path.suffix.lower() == ".ply":
        if cloud.viewpoint is not None and cloud.viewpoint.ndim == 2:
            raise BadArgument("path", path, "a file ending in .npz, for a cloud of several views")
        content = format_ply(**arrays)
    else:
        raise BadArgument("path", path, "a file ending in .npz or .ply")
    return write_file(path, content)


def _check_viewpoint(viewpoint: Any) -> Tensor:
    """Return a position in float64, or refuse what is no three finite numbers."""
    try:
        position = torch.as_tensor(viewpoint, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise BadArgument("viewpoint", repr(viewpoint), "three numbers [m]") from error
    return check_tensor("viewpoint", position, (3,))


def _check_array(path: Path, name: str, array: Any) -> Tensor:
    """Return a numeric array of a file as float64, or refuse the file."""
    array = np.asarray(array)
    shape = (3,) if name == "viewpoint" and array.ndim == 1 else (None, 3)
    if array.dtype.kind not in "fiu":
        raise CloudFileError("path", f"{path}: {name} of type {array.dtype}", "real numbers")
    if len(array.shape) != len(shape) or array.shape[-1] != 3:
        raise CloudFileError(
            "path", f"{path}: {name} of shape {array.shape}", "shape (n, 3), or (3,) for one viewpoint"
        )
    if len(array) > MAX_POINTS:
        raise CloudFileError("path", f"{path} with {len(array)} points", f"at most {MAX_POINTS} points")
    bad = int((~np.isfinite(array)).reshape(-1, 3).any(1).sum())
    if bad:
        raise BadArgument("path", f"{path}: {bad} rows of {name} with NaN or infinity", "finite numbers only")
    return torch.from_numpy(np.array(array, dtype=np.float64, order="C"))  # a copy: owned, writable, native bytes


def _split_columns(table: np.ndarray) -> dict[str, Any]:
    """Split (n, 3) points or (n, 6) points and normals."""
    if table.ndim != 2 or table.shape[1] not in (3, 6):
        raise ValueError(f"an array of shape {table.shape}, not (n, 3) or (n, 6)")
    return {"points": table[:, :3], "normals": table[:, 3:] if table.shape[1] == 6 else None}


def _parse_npy(data: bytes) -> dict[str, Any]:
    """Parse the bytes of a .npy file."""
    return _split_columns(_array_from_npy(data))


def _array_from_npy(data: bytes) -> np.ndarray:
    """Return the array of a .npy file; its header is believed only as far as there are bytes behind it."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"version {version} of the npy format")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(stream)
    promised = dtype.itemsize
    for side in shape:  # Python integers do not overflow
        promised *= int(side)
    if dtype.hasobject or promised > len(data):
        raise ValueError(f"an array of shape {shape} and type {dtype}, which the file cannot hold")
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)


def _parse_npz(data: bytes) -> dict[str, Any]:
    """Parse the bytes of a .npz file, its unpacked size checked before anything is unpacked."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        names = {f"{name}.npy": name for name in ("points", "normals", "viewpoint")}
        members = [info for info in archive.infolist() if info.filename in names]
        if "points.npy" not in [info.filename for info in members]:
            raise ValueError("no array named 'points'")
        if sum(info.file_size for info in members) > MAX_BYTES:
            raise ValueError(f"arrays of more than {MAX_BYTES} bytes")
        return {names[info.filename]: _array_from_npy(archive.read(info)) for info in members}


def _parse_text(data: bytes) -> dict[str, Any]:
    """Parse text: three or six numbers a line, separated by blanks or commas; `#` starts a comment."""
    return _split_columns(read_lines(data))
