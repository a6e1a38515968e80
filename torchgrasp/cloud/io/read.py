"""Point clouds from and to files. A malformed file is refused by name; none runs code."""

import io
import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgrasp.base import check_tensor, named_tensors
from torchgrasp.cloud.check import MIN_POINTS, check_cloud
from torchgrasp.cloud.io.pcd import parse_pcd
from torchgrasp.cloud.io.ply import format_ply, parse_ply
from torchgrasp.cloud.io.text import MAX_POINTS, read_lines
from torchgrasp.errors import BadArgument, CloudFileError, TooFewPoints
from torchgrasp.files import write_file
from torchgrasp.values import PointCloud

MAX_BYTES = 512 * 2**20
"""Most bytes of a file, and of its unpacked content: some 100 for each of `MAX_POINTS`."""


def read_cloud(path: Path | str, viewpoint: Sequence[float | int] | Tensor | None = None) -> PointCloud:
    """Read the point cloud of one object, in metres and float64.

    * `.ply`, ascii or binary: x y z, optionally nx ny nz; the viewpoint from a header line `comment viewpoint x y z`.
      A mesh gives 2000 surface points, with normals if closed.
    * `.pcd`, ascii or binary: x y z, optionally normal_x normal_y normal_z; the viewpoint from VIEWPOINT, unless it
      is the default `0 0 0 1 0 0 0` and within the cloud's bounding box.
    * `.npz`: arrays `points` (n, 3), optionally `normals` (n, 3) and `viewpoint` (3,), or (n, 3) of several views.
    * `.npy`, `.xyz` (text): an (n, 3) array, or (n, 6) with normals.

    Args:
        path: the file.
        viewpoint: the camera's position (3,) [m] in the cloud's frame, instead of the file's.

    Raises:
        CloudFileError: no such file; an unknown suffix; malformed content; more than 512 MB or 5 million points.
        BadArgument: a viewpoint other than three numbers; a non-finite number; points on one line.
        TooFewPoints: fewer than 4 distinct points.
        SuspiciousScale: an extent outside [5 mm, 2 m].

    >>> read_cloud("scan.docx")
    Traceback (most recent call last):
    torchgrasp.errors.CloudFileError: path: found scan.docx, allowed is a file ending in .ply, .pcd, .npz, .npy, .xyz
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
        ".npz": _parse_npz,
        ".npy": lambda data: _split_columns(_array_from_npy(data)),
        ".xyz": lambda data: _split_columns(read_lines(data)),
    }
    if suffix not in parsers:
        raise CloudFileError("path", path, f"a file ending in {', '.join(parsers)}")
    if not path.is_file():
        raise CloudFileError("path", f"{path}, which is no file", f"a {suffix} file")
    if path.stat().st_size > MAX_BYTES:
        raise CloudFileError("path", f"{path} of {path.stat().st_size} bytes", f"at most {MAX_BYTES} bytes")
    try:
        arrays = parsers[suffix](path.read_bytes())
    except Exception as error:  # zlib, zipfile, numpy and trimesh each raise their own
        raise CloudFileError("path", f"{path}: {error!r}", f"a well-formed {suffix} file") from error
    arrays = {name: _check_array(path, name, array) for name, array in arrays.items() if array is not None}
    points = arrays["points"]
    if len(points) < MIN_POINTS:
        raise TooFewPoints("path", f"{path} with {len(points)} points", f"at least {MIN_POINTS} points")
    position = arrays.get("viewpoint") if position is None else position
    return check_cloud(PointCloud(points, arrays.get("normals"), position))


def save_cloud(cloud: PointCloud, path: Path | str) -> Path:
    """Write a cloud as `.npz` (exact) or binary `.ply` (float32), atomically.

    Raises:
        BadArgument: another suffix; several views for `.ply`, which has one viewpoint.
        OutputError: the file cannot be written.

    >>> save_cloud(PointCloud(torch.rand(9, 3)), "cloud.txt")
    Traceback (most recent call last):
    torchgrasp.errors.BadArgument: path: found cloud.txt, allowed is a file ending in .npz or .ply
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


def _check_array(path: Path, name: str, array: Any) -> Tensor:
    """Return an array as float64, or refuse its file."""
    array = np.asarray(array)
    if array.dtype.kind not in "fiu":
        raise CloudFileError("path", f"{path}: {name} of type {array.dtype}", "real numbers")
    if array.ndim not in ((1, 2) if name == "viewpoint" else (2,)) or array.shape[-1] != 3:
        raise CloudFileError("path", f"{path}: {name} of shape {array.shape}", "(n, 3), or (3,) for one viewpoint")
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


def _array_from_npy(data: bytes) -> np.ndarray:
    """Return the array of a .npy file, which must hold what its header promises."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"version {version} of the npy format")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(stream)
    if dtype.hasobject or dtype.itemsize * math.prod(shape) > len(data):
        raise ValueError(f"an array of shape {shape} and type {dtype}, which the file cannot hold")
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)


def _parse_npz(data: bytes) -> dict[str, Any]:
    """Parse a .npz file after a check of its unpacked size."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        names = {f"{name}.npy": name for name in ("points", "normals", "viewpoint")}
        members = [info for info in archive.infolist() if info.filename in names]
        if "points.npy" not in [info.filename for info in members]:
            raise ValueError("no array named 'points'")
        if sum(info.file_size for info in members) > MAX_BYTES:
            raise ValueError(f"arrays of more than {MAX_BYTES} bytes")
        return {names[info.filename]: _array_from_npy(archive.read(info)) for info in members}
