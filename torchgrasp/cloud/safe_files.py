"""Safe readers of untrusted files: NumPy arrays, images and camera intrinsics. No file can run
code.
"""

import functools
import io
import json
import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchgrasp.files import Malformed, check_file, explain, read_bounded
from torchgrasp.files.columns import read_lines
from torchgrasp.foundation.errors import BadArgument, NoEffect
from torchgrasp.foundation.lazy import Image
from torchgrasp.foundation.limits import CLOUD_BYTES, JSON_BYTES, SHOWN_LETTERS, TOML_BYTES
from torchgrasp.foundation.told import warn_user

GREY = ("1", "L", "I", "I;16", "I;16B", "F")
COLOURS = ("P", "RGB", "RGBA")
"""Pillow's modes of pictures."""
HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
"""Readers of the headers of .npy files, by the version of the format."""


def parse_npy(data: bytes) -> np.ndarray:
    """Return the array of a .npy file, given its bytes.

    Raises `Malformed` for an array of Python objects, and for fewer bytes than the header states.
    """
    if not data.startswith(b"\x93NUMPY"):
        raise Malformed("no header of an .npy file")
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read = HEADERS.get(version)
    if read is None:
        raise Malformed(f"version {version} of the npy format")
    shape, _, dtype = read(stream)
    if dtype.hasobject or dtype.itemsize * math.prod(shape) > len(data):
        raise Malformed(f"an array of shape {shape} and type {dtype}, which the file cannot hold")
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)


def parse_npz(data: bytes, names: Sequence[str], required: str = "") -> dict[str, np.ndarray]:
    """Return the arrays of a .npz file by name, given its bytes; all if no `names` are given.

    `required` is an array that the file must hold, "" for none. Raises `Malformed` for a bad file.
    """
    if not zipfile.is_zipfile(io.BytesIO(data)):
        raise Malformed("no archive, as .npz files are")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        infos = [(info.filename.removesuffix(".npy"), info) for info in archive.infolist()]
        members = {name: info for name, info in infos if not names or name in names}
        if required and f"{required}.npy" not in [info.filename for info in members.values()]:
            found = [name for name, _ in infos][:8]
            raise Malformed(f"no array named {required!r}, but {found}")
        if sum(info.file_size for info in members.values()) > CLOUD_BYTES:
            raise Malformed(f"arrays of more than {CLOUD_BYTES} bytes")
        return {name: parse_npy(archive.read(info)) for name, info in members.items()}


def unread_arrays(data: bytes, known: Sequence[str]) -> list[str]:
    """Return the sorted names of the arrays of a .npz file that are none of the `known`."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        held = sorted({name.removesuffix(".npy") for name in archive.namelist()})
    return [name for name in held if name not in known]


def read_image_file(name: str, path: Path | str) -> Any:
    """Return the array in a file of a depth image, or of masks.

    `name` is the argument that the file is for, "depth" or "mask", and stands in errors. Formats
    are .npy, .npz, .png and .tiff; also .exr for depth, and .json for masks. A depth image has one
    channel, and is the array `depth` of a .npz file. Other arrays of this file raise the warning
    `NoEffect`. Masks may be a picture or several masks, in each form that
    `torchgrasp.scene.masks.read_labels` takes. Raises `BadArgument` for a file that is missing or
    malformed, or of another format.
    """
    masks = name == "mask"
    data, suffix = read_suffixed(
        name, path, (".npy", ".npz", ".png", ".tif", ".tiff", ".json" if masks else ".exr")
    )
    try:
        if suffix == ".npy":
            return parse_npy(data)
        if suffix == ".npz":
            arrays = parse_npz(data, () if masks else (name,), "" if masks else name)
            others = [] if masks else unread_arrays(data, (name,))
            if others:
                found = f"{path}: arrays {', '.join(others)[:SHOWN_LETTERS]} are not read"
                warn_user(NoEffect, f"{found}; give camera, pose and unit as options")
            several = list(arrays.values())
            return arrays.get(name, several[0] if len(several) == 1 else several)
        if suffix == ".json":
            return parse_json(data)
        return _read_exr(Path(path)) if suffix == ".exr" else _parse_picture(data, masks)
    except ModuleNotFoundError as error:
        found = f"{path} without the package OpenEXR"
        raise BadArgument(name, found, "pip install OpenEXR, or a .png file") from error
    except Exception as error:  # zlib, zipfile, numpy and Pillow each raise their own
        allowed = f"a well-formed {suffix} file" + " of one channel" * (not masks)
        raise BadArgument(name, f"{path}: {explain(error)}", allowed) from error


def parse_json(data: bytes) -> Any:
    """Return the content of a JSON file, given its bytes.

    Raises `Malformed` for more than 32 MiB (`JSON_BYTES`), and `ValueError` for bytes that are no
    JSON.
    """
    if len(data) > JSON_BYTES:
        raise Malformed(f"{len(data)} bytes")
    return json.loads(data)


def read_intrinsics(name: str, path: Path | str, image: str = "") -> Any:
    """Return a camera's intrinsics in a .json, .yaml, .npy or .txt file, for `cloud_from_depth`.

    They are a dict, a list or an array, as the file holds them.

    BOP's scene_camera.json holds an entry for each image; `image` is its number as text, "" for
    other files. Errors call the argument `name`. Raises `BadArgument` for a file of another format,
    or a malformed one.
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
                raise Malformed(f"{len(data)} bytes")
            found = next(yaml.safe_load_all(data))
    except Exception as error:  # YAML and JSON each raise their own
        allowed = f"a well-formed {suffix} file of intrinsics"
        raise BadArgument(name, f"{path}: {explain(error)}", allowed) from error
    entry = str(int(image)) if image.isdecimal() else ""
    return found[entry] if isinstance(found, dict) and entry in found else found


def read_suffixed(name: str, path: Path | str, suffixes: tuple[str, ...]) -> tuple[bytes, str]:
    """Return the bytes and the lower-case suffix of a file.

    Raises `BadArgument`, which calls the argument `name`, for a file that is missing, larger than
    512 MiB, or a pointer of Git LFS. Raises it also for a file with none of the `suffixes`.
    """
    path = Path(path)
    allowed = f"a {', '.join(suffixes[:-1])} or {suffixes[-1]} file"
    refuse = functools.partial(BadArgument, name)
    check_file(path, CLOUD_BYTES, allowed, refuse)
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        raise refuse(path, allowed)
    return read_bounded(path, CLOUD_BYTES, allowed, refuse), suffix


def _parse_picture(data: bytes, colours: bool) -> np.ndarray:
    """Return the pixels of a PNG or TIFF image of one channel; if `colours`, several channels are
    allowed, too.
    """
    with Image.open(io.BytesIO(data), formats=("PNG", "TIFF")) as image:
        # The number of a palette's colour is the label.
        allowed = GREY + COLOURS if colours else GREY
        if image.mode not in allowed:
            raise Malformed(f"a picture of mode {image.mode}")
        pixels = np.asarray(image)
        if image.mode == "P":
            _check_palette(pixels, image.getpalette() or [])
        return pixels


def _check_palette(pixels: np.ndarray, palette: list[int]) -> None:
    """Raise `Malformed` for a picture whose colour 0 is not black, though it has black pixels.

    Programs that save few colours order them as they like: there 0 is no background.
    """
    colours = np.array(palette).reshape(-1, 3)
    black = [k for k in np.unique(pixels).tolist() if k < len(colours) and not colours[k].any()]
    if black and colours[0].any():
        raise Malformed(f"a palette where black has number {black[0]}; save it as RGB")


def _read_exr(path: Path) -> np.ndarray:
    """Return the pixels of an OpenEXR file's depth channel (Z or V), or of its only channel."""
    import OpenEXR  # pyright: ignore[reportMissingImports]

    channels = OpenEXR.File(str(path)).channels()
    depth = [name for name in channels if name.split(".")[-1] in ("Z", "V")] or list(channels)
    if len(depth) > 1:
        raise Malformed(f"channels {', '.join(depth)[:SHOWN_LETTERS]}")
    return channels[depth[0]].pixels
