"""Scenes from and to files: a depth image with its camera, and what is known of it."""

import io
from pathlib import Path

import numpy as np
import torch

from torchgrasp.checks import checked
from torchgrasp.cloud.tables import parse_npz
from torchgrasp.errors import BadArgument, CloudFileError
from torchgrasp.files import is_file, read_bytes, write_file
from torchgrasp.geometry.plane import Plane
from torchgrasp.limits import CLOUD_BYTES
from torchgrasp.scene.scene import Scene

NAMES = ("depth", "intrinsics", "camera_pose", "labels", "mask", "table")
"""Arrays of a scene's file; the first two are required."""


@checked
def read_scene(path: Path | str) -> Scene:
    """Read a scene from a .npz file, by the rules of `Scene.from_depth`.

    Its arrays are `depth` (h, w) in metres or integer millimetres, `intrinsics` (3, 3) or (4,), and optionally
    `camera_pose` (4, 4), `labels` (h, w) of things or `mask` (h, w) of the target, and `table` (4,): normal and offset.

    Raises:
        CloudFileError: no such file, or malformed content.
        BadArgument: what `Scene.from_depth` refuses.

    >>> import tempfile
    >>> from torchgrasp import load_scene
    >>> file = save_scene(load_scene(), Path(tempfile.mkdtemp(), "scene.npz"))
    >>> read_scene(file).things
    (1, 2, 3, 4)
    """
    path = Path(path)
    if path.suffix.lower() != ".npz" or not is_file(path):
        raise CloudFileError("path", path, "a .npz file with depth and intrinsics")
    if path.stat().st_size > CLOUD_BYTES:
        raise CloudFileError("path", f"{path} of {path.stat().st_size} bytes", f"at most {CLOUD_BYTES} bytes")
    try:
        arrays = parse_npz(read_bytes(path), NAMES, "depth")
        depth, intrinsics, table = arrays.pop("depth"), arrays.pop("intrinsics"), arrays.pop("table", None)
        plane = None if table is None else Plane(torch.tensor(table[:3].astype(float)), float(table[3]))
    except BadArgument:
        raise
    except Exception as error:  # zlib, zipfile and numpy each raise their own
        raise CloudFileError("path", f"{path}: {error!r}", "a .npz file with depth and intrinsics") from error
    return Scene.from_depth(depth, intrinsics, arrays.pop("camera_pose", None), **arrays, table=plane)


def is_scene(path: Path) -> bool:
    """Tell whether a file is a scene's: a .npz file with a depth image."""
    import zipfile

    if path.suffix.lower() != ".npz" or not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return "depth.npy" in archive.namelist()


@checked
def save_scene(scene: Scene, path: Path | str) -> Path:
    """Write a scene as .npz, atomically: depth in float32, labels, camera and table; `read_scene` reads it.

    Raises:
        BadArgument: another suffix.
        OutputError: the file cannot be written.

    >>> import tempfile
    >>> from torchgrasp import load_scene
    >>> file = save_scene(load_scene(), Path(tempfile.mkdtemp(), "scene.npz"))
    >>> sorted(np.load(file))
    ['camera_pose', 'depth', 'intrinsics', 'labels', 'table']
    """
    path, buffer = Path(path), io.BytesIO()
    if path.suffix.lower() != ".npz":
        raise BadArgument("path", path, "a file ending in .npz")
    labels = np.zeros(scene.image.depth.shape, dtype=np.int32)
    row, column = scene.pixels.cpu().numpy().T
    labels[row, column] = scene.labels.cpu().numpy()
    arrays = {
        "depth": scene.image.depth.cpu().numpy().astype(np.float32),
        "intrinsics": scene.image.intrinsics.cpu().numpy(),
        "camera_pose": scene.image.obj_from_camera.cpu().numpy(),
        "labels": labels,
    }
    if scene.table is not None:
        arrays["table"] = np.array([*scene.table.normal.tolist(), scene.table.offset])
    np.savez_compressed(buffer, **arrays)  # pyright: ignore[reportArgumentType]
    return write_file(path, buffer.getvalue())
