"""The PCD format of the Point Cloud Library, and its LZF compression."""

from typing import Any

import numpy as np

from torchgrasp.files import Malformed
from torchgrasp.files.columns import find_columns, read_fields
from torchgrasp.foundation.limits import CLOUD_BYTES, CLOUD_POINTS, PLY_HEADER_BYTES

MOST_NUMBERS = 4096
"""Most numbers of a point in one field: histograms of features have a few hundred."""
LITERALS = 1 << 5
"""A control byte of LZF below this counts literal bytes; its other bits are part of a distance."""
LETTERS = {"F": "f", "I": "i", "U": "u"}
"""NumPy's letters of the types."""
DEFAULT = [0, 0, 0, 1, 0, 0, 0]
"""The viewpoint that many writers fill in: position, and quaternion wxyz."""


def parse_pcd(data: bytes) -> dict[str, Any]:
    """Return the arrays of a PCD file by name, in the file's unit.

    They are "points" and "normals" (n, 3) and "viewpoint" (3,), None if missing. "turn" (4,) is the
    quaternion wxyz of VIEWPOINT. "default" is whether VIEWPOINT is `0 0 0 1 0 0 0`, which many
    writers fill in, wherever the camera was. Raises `Malformed` for a malformed file.
    """
    header, body = _split_header(data)
    if missing := [word for word in ("FIELDS", "SIZE", "TYPE") if word not in header]:
        raise Malformed(f"a header without {', '.join(missing)}")
    names = header["FIELDS"]
    counts = [int(c) for c in header.get("COUNT", ["1"] * len(names))]
    sizes = header["SIZE"]
    kinds = header["TYPE"]
    alike = len(names) == len(counts) == len(sizes) == len(kinds)
    if not alike or min(counts) < 1 or max(counts) > MOST_NUMBERS:
        raise Malformed("FIELDS, SIZE, TYPE and COUNT that do not match")
    if "POINTS" in header:
        count = int(header["POINTS"][0])
    else:
        count = int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    if not 0 <= count <= CLOUD_POINTS:
        raise Malformed(f"{count} points, not up to {CLOUD_POINTS}")
    encoding = header["DATA"][0].lower()
    fields = [
        (f"{LETTERS[k.upper()]}{int(s)}", c) for k, s, c in zip(kinds, sizes, counts, strict=True)
    ]
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise Malformed(f"DATA {encoding}, not ascii, binary or binary_compressed")
    if encoding == "binary_compressed":
        body = _decompress(body, [np.dtype(f"({n},)<{kind}") for kind, n in fields], count)
    order = "" if encoding == "ascii" else "<"
    found = find_columns(names, read_fields(body, fields, count, order))

    viewpoint = np.array([float(x) for x in header["VIEWPOINT"]]) if "VIEWPOINT" in header else None
    if viewpoint is None:
        return {**found, "viewpoint": None, "default": False}
    if len(viewpoint) != 7:
        raise Malformed(f"VIEWPOINT with {len(viewpoint)} numbers, not 7")
    default = np.array_equal(viewpoint, DEFAULT)
    return {**found, "viewpoint": viewpoint[:3], "turn": viewpoint[3:], "default": default}


def _split_header(data: bytes) -> tuple[dict[str, list[str]], bytes]:
    """Return a PCD file's header and the data after it. The header is a dict of each line's words
    by its first word.
    """
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        stop = data.find(b"\n", start)
        if stop < 0 or stop > PLY_HEADER_BYTES:
            raise Malformed("no PCD header")
        words = data[start:stop].decode("ascii").split("#")[0].split()
        if words:
            header[words[0].upper()] = words[1:]
        start = stop + 1
    return header, data[start:]


def _decompress(body: bytes, kinds: list[np.dtype[Any]], count: int) -> bytes:
    """Return decompressed data point by point; the file holds one field of all points, then the
    next field.
    """
    packed, unpacked = (int(n) for n in np.frombuffer(body, dtype="<u4", count=2))
    wanted = count * sum(kind.itemsize for kind in kinds)
    if unpacked != wanted or wanted > CLOUD_BYTES or packed > len(body) - 8:
        limits = f"at most {len(body) - 8} for {wanted}, and at most {CLOUD_BYTES}"
        raise Malformed(f"compressed data of {packed} bytes for {unpacked}, not of {limits}")
    data = decompress(body[8 : 8 + packed], unpacked)
    starts = np.cumsum([0, *(count * kind.itemsize for kind in kinds)])
    fields = [
        np.frombuffer(data, np.uint8, count * k.itemsize, s)
        for k, s in zip(kinds, starts[:-1], strict=True)
    ]
    return np.concatenate([field.reshape(count, -1) for field in fields], axis=1).tobytes()


def decompress(data: bytes, size: int) -> bytes:
    """Return the `size` bytes to which LZF-compressed data expand.

    A control byte c < 32 is followed by c + 1 literal bytes. A larger c means a copy of (c >> 5) +
    2 earlier bytes. A length of 9 is extended by the next byte. The distance back to the copied
    bytes has 13 bits. Raises `Malformed` for malformed data.
    """
    out = bytearray()
    i = 0

    def take(count: int) -> bytes:
        nonlocal i
        i += count
        if i > len(data):
            raise Malformed("LZF data that end early")
        return data[i - count : i]

    while i < len(data):
        control = take(1)[0]
        if control < LITERALS:
            out += take(control + 1)
        else:
            length = (control >> 5) + 2
            length += take(1)[0] if length == 9 else 0
            start = len(out) - ((control & (LITERALS - 1)) << 8) - take(1)[0] - 1
            if start < 0:
                raise Malformed("LZF data that copy bytes from before their start")
            piece = out[start : start + length]
            # The copy may overlap what it writes.
            out += (piece * (length // len(piece) + 1))[:length]
        if len(out) > size:
            raise Malformed(f"LZF data of more than {size} bytes")
    if len(out) < size:
        raise Malformed(f"LZF data of {len(out)} bytes, not {size}")
    return bytes(out)
