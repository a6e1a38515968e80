"""Depth images, masks and camera poses from files."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.depth import check_rigid
from torchgrasp.cloud.io.arrays import MAX_BYTES, parse_npy, parse_npz
from torchgrasp.cloud.io.text import read_lines
from torchgrasp.errors import BadArgument
from torchgrasp.files import is_file, read_bytes


def read_image(name: str, path: Path | str) -> np.ndarray:
    """Return the numbers of an image file: .npy, .npz with an array `depth` or `mask`, or .png of one channel.

    Args:
        name: "depth" or "mask"; errors and .npz files have this name.

    Raises:
        BadArgument: no such file, another suffix, malformed content, or a picture of several channels.

    >>> read_image("depth", "none.png")
    Traceback (most recent call last):
    torchgrasp.errors.BadArgument: depth: expected a .npy, .npz or .png file, got none.png, which is no file
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
    if path.suffix.lower() not in suffixes or path.stat().st_size > MAX_BYTES:
        raise BadArgument(name, f"{path} of {path.stat().st_size} bytes", f"{allowed} of at most {MAX_BYTES} bytes")
    return read_bytes(path), path.suffix.lower()


def _parse_png(data: bytes) -> np.ndarray:
    """Return the pixels of a PNG of one channel: uint16, uint8 or bool."""
    import io

    from PIL import Image

    with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
        if image.mode not in ("1", "L", "I", "I;16", "I;16B"):
            raise ValueError(f"a picture of mode {image.mode}")
        return np.asarray(image)
