"""Safe readers of untrusted files: NumPy arrays, text tables, images and camera intrinsics. No file can run code."""

import functools
import io
import json
import math
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from torchgrasp.errors import BadArgument
from torchgrasp.files import check_file, read_bytes
from torchgrasp.lazy import Image
from torchgrasp.limits import CLOUD_BYTES, CLOUD_POINTS, JSON_BYTES, LINE_LETTERS, TEXT_COLUMNS, TOML_BYTES


def parse_npy(data: bytes) -> np.ndarray:
    """Return the array of a .npy file; raise `ValueError` for objects and for fewer bytes than its header promises."""
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


def parse_npz(data: bytes, names: Sequence[str], required: str = "") -> dict[str, np.ndarray]:
    """Return the arrays of a .npz file by name, all if no `names` are given; raise `ValueError` for a bad file."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [info for info in archive.infolist() if not names or info.filename.removesuffix(".npy") in names]
        if required and f"{required}.npy" not in [info.filename for info in members]:
            found = [info.filename.removesuffix(".npy") for info in archive.infolist()][:8]
            raise ValueError(f"no array named {required!r}, but {found}")
        if sum(info.file_size for info in members) > CLOUD_BYTES:
            raise ValueError(f"arrays of more than {CLOUD_BYTES} bytes")
        return {info.filename.removesuffix(".npy"): parse_npy(archive.read(info)) for info in members}


def read_table(data: bytes, rows: int, columns: int) -> Float[np.ndarray, "rows columns"]:
    """Return the first `rows` rows of a table separated by white space. Little memory beyond the numbers is used.

    Raises `ValueError` if `rows` or `columns` is above its limit, or the data has fewer numbers or a word that is none.
    """
    if not (0 <= rows <= CLOUD_POINTS and 1 <= columns <= TEXT_COLUMNS):
        raise ValueError(f"{rows} points of {columns} numbers, not up to {CLOUD_POINTS} of {TEXT_COLUMNS}")
    wanted = rows * columns
    if 2 * wanted > len(data) + 1:  # a number has at least a digit and a space
        raise ValueError(f"fewer numbers than {rows} points have")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # at a word that is no number; the count shows it
        numbers = np.fromstring(data, dtype=np.float64, count=wanted, sep=" ") if wanted else np.zeros(0)
    if len(numbers) < wanted:
        raise ValueError(f"fewer numbers than {rows} points have, or a word that is no number")
    return numbers.reshape(rows, columns)


def read_lines(data: bytes) -> Float[np.ndarray, "rows columns"]:
    """Return a text's numbers, one row for each line; blanks, commas or semicolons separate the numbers.

    `#` starts a comment. A first line that begins with the words x y z names the columns.
    """

    def lines() -> Iterator[str]:
        stream = io.TextIOWrapper(io.BytesIO(data), encoding="ascii")
        all_lines = count = 0
        while line := stream.readline(LINE_LETTERS + 1):
            all_lines += 1
            if len(line) > LINE_LETTERS:
                raise ValueError(f"a line of more than {LINE_LETTERS} characters")
            if all_lines > 2 * CLOUD_POINTS:
                raise ValueError(f"more than {2 * CLOUD_POINTS} lines")
            line = line.split("#")[0].replace(",", " ").replace(";", " ")
            if not line.isspace() and line:
                count += 1
                if count == 1 and line.lower().replace('"', "").split()[:3] == ["x", "y", "z"]:
                    continue
                if count > CLOUD_POINTS:
                    raise ValueError(f"more than {CLOUD_POINTS} lines of numbers")
                if count <= 2 and len(line.split()) > TEXT_COLUMNS:  # the other lines have as many, or are refused
                    raise ValueError(f"more than {TEXT_COLUMNS} numbers in a line")
                yield line

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of a file without numbers, which is refused below
        table = np.loadtxt(lines(), ndmin=2)
    if not table.size:
        raise ValueError("no numbers")
    return table


def read_image(name: str, path: Path | str) -> Any:
    """Return the array in an image file: .npy, .npz, .png or .tiff; also .exr for depth, or .json for masks.

    The argument `name` "depth" has one channel, and is the array `depth` of a .npz file. The argument "mask" may be a
    picture or several masks, in each form that `torchgrasp.scene.masks.read_labels` takes.
    """
    masks = name == "mask"
    data, suffix = read_suffixed(name, path, (".npy", ".npz", ".png", ".tif", ".tiff", ".json" if masks else ".exr"))
    try:
        if suffix == ".npy":
            return parse_npy(data)
        if suffix == ".npz":
            arrays = parse_npz(data, () if masks else (name,), "" if masks else name)
            several = list(arrays.values())
            return arrays.get(name, several[0] if len(several) == 1 else several)
        if suffix == ".json":
            return parse_json(data)
        return _read_exr(Path(path)) if suffix == ".exr" else _parse_picture(data, masks)
    except ModuleNotFoundError as error:
        raise BadArgument(name, f"{path} without the package OpenEXR", "pip install OpenEXR, or a .png file") from error
    except Exception as error:  # zlib, zipfile, numpy and Pillow each raise their own
        allowed = f"a well-formed {suffix} file" + " of one channel" * (not masks)
        raise BadArgument(name, f"{path}: {error!r}", allowed) from error


def parse_json(data: bytes) -> Any:
    """Return the content of a JSON file; raise `ValueError` for a large file."""
    if len(data) > JSON_BYTES:
        raise ValueError(f"{len(data)} bytes")
    return json.loads(data)


def read_intrinsics(name: str, path: Path | str, image: str = "") -> Any:
    """Return the intrinsics in a .json, .yaml, .npy or .txt file, as `cloud_from_depth` takes them.

    `image` is the number of the image, by which BOP's scene_camera.json names its entry.
    """
    data, suffix = read_suffixed(name, path, (".json", ".yaml", ".yml", ".npy", ".txt"))
    try:
        if suffix in (".npy", ".txt"):
            return parse_npy(data).squeeze() if suffix == ".npy" else read_lines(data).squeeze()
        if suffix == ".json":
            found = parse_json(data)
        else:
            import yaml

            if len(data) > TOML_BYTES:
                raise ValueError(f"{len(data)} bytes")
            found = next(yaml.safe_load_all(data))
    except Exception as error:  # YAML and JSON each raise their own
        raise BadArgument(name, f"{path}: {error!r}", f"a well-formed {suffix} file of intrinsics") from error
    entry = str(int(image)) if image.isdecimal() else ""
    return found[entry] if isinstance(found, dict) and entry in found else found


def read_suffixed(name: str, path: Path | str, suffixes: tuple[str, ...]) -> tuple[bytes, str]:
    """Return the bytes and the suffix of a file; raise `BadArgument` if missing, too large or of another suffix."""
    path, allowed = Path(path), f"a {', '.join(suffixes[:-1])} or {suffixes[-1]} file"
    check_file(path, CLOUD_BYTES, allowed, functools.partial(BadArgument, name))
    if path.suffix.lower() not in suffixes:
        raise BadArgument(name, path, allowed)
    return read_bytes(path), path.suffix.lower()


def _parse_picture(data: bytes, colours: bool) -> np.ndarray:
    """Return the pixels of a PNG or TIFF image of one channel; if `colours`, several channels are allowed, too."""
    with Image.open(io.BytesIO(data), formats=("PNG", "TIFF")) as image:
        if colours and image.mode in ("P", "RGB", "RGBA"):  # the number of a palette's colour is the label
            return np.asarray(image)
        if image.mode not in ("1", "L", "I", "I;16", "I;16B", "F"):
            raise ValueError(f"a picture of mode {image.mode}")
        return np.asarray(image)


def _read_exr(path: Path) -> np.ndarray:
    """Return the pixels of an OpenEXR file's depth channel (Z or V), or of its only channel."""
    import OpenEXR  # pyright: ignore[reportMissingImports]

    channels = OpenEXR.File(str(path)).channels()
    depth = [name for name in channels if name.split(".")[-1] in ("Z", "V")] or list(channels)
    if len(depth) > 1:
        raise ValueError(f"channels {', '.join(depth)[:80]}")
    return channels[depth[0]].pixels
