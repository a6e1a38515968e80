"""NumPy's files, none of which runs code."""

import io
import math
import zipfile
from collections.abc import Sequence

import numpy as np

MAX_BYTES = 512 * 2**20
"""Most bytes of a file, and of its unpacked content: some 100 for each point of the largest cloud."""


def parse_npy(data: bytes) -> np.ndarray:
    """Return the array of a .npy file, which must hold what its header promises.

    Raises:
        ValueError: objects, another version, or fewer bytes than promised.
    """
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


def parse_npz(data: bytes, names: Sequence[str], required: str) -> dict[str, np.ndarray]:
    """Return the arrays of these names in a .npz file, after a check of their unpacked size.

    Raises:
        ValueError: no array of the `required` name, arrays that are too large, or what `parse_npy` refuses.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [info for info in archive.infolist() if info.filename.removesuffix(".npy") in names]
        if f"{required}.npy" not in [info.filename for info in members]:
            found = [info.filename.removesuffix(".npy") for info in archive.infolist()][:8]
            raise ValueError(f"no array named {required!r}, but {found}")
        if sum(info.file_size for info in members) > MAX_BYTES:
            raise ValueError(f"arrays of more than {MAX_BYTES} bytes")
        return {info.filename.removesuffix(".npy"): parse_npy(archive.read(info)) for info in members}
