"""The PCD format of the Point Cloud Library, and its LZF compression."""

from typing import Any

import numpy as np

from torchgrasp.files import Malformed
from torchgrasp.files.columns import find_columns, read_fields
from torchgrasp.foundation.limits import CLOUD_BYTES, CLOUD_POINTS


def parse_pcd(data: bytes) -> dict[str, Any]:
    """Return points, normals and viewpoint of a PCD file, None if missing, and whether the
    viewpoint is `default`.

    Many writers fill VIEWPOINT with the default `0 0 0 1 0 0 0`, wherever the camera was.
    """
    header, body = _split_header(data)
    if missing := [word for word in ("FIELDS", "SIZE", "TYPE") if word not in header]:
        raise Malformed(f"a header without {', '.join(missing)}")
    names = header["FIELDS"]
    counts = [int(c) for c in header.get("COUNT", ["1"] * len(names))]
    sizes = header["SIZE"]
    kinds = header["TYPE"]
    if (
        not len(names) == len(counts) == len(sizes) == len(kinds)
        or min(counts) < 1
        or max(counts) > 4096
    ):
        raise Malformed("FIELDS, SIZE, TYPE and COUNT that do not match")
    count = (
        int(header["POINTS"][0])
        if "POINTS" in header
        else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    )
    if not 0 <= count <= CLOUD_POINTS:
        raise Malformed(f"{count} points, not up to {CLOUD_POINTS}")
    letters = {"F": "f", "I": "i", "U": "u"}
    encoding = header["DATA"][0].lower()
    fields = [
        (f"{letters[k.upper()]}{int(s)}", c) for k, s, c in zip(kinds, sizes, counts, strict=True)
    ]
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise Malformed(f"DATA {encoding}, not ascii, binary or binary_compressed")
    if encoding == "binary_compressed":
        body = _decompress(body, [np.dtype(f"({n},)<{kind}") for kind, n in fields], count)
    found = find_columns(
        names, read_fields(body, fields, count, "" if encoding == "ascii" else "<")
    )
    viewpoint = np.array([float(x) for x in header["VIEWPOINT"]]) if "VIEWPOINT" in header else None
    if viewpoint is not None and len(viewpoint) != 7:
        raise Malformed(f"VIEWPOINT with {len(viewpoint)} numbers, not 7")
    default = viewpoint is not None and np.array_equal(viewpoint, [0, 0, 0, 1, 0, 0, 0])
    position = None if viewpoint is None else viewpoint[:3]
    return {**found, "viewpoint": position, "default": default}


def _split_header(data: bytes) -> tuple[dict[str, list[str]], bytes]:
    """Return a PCD file's header, as a dict of each line's words by its first word, and the data
    after the header.
    """
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        stop = data.find(b"\n", start)
        if stop < 0 or stop > 65536:
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
    """Return the `size` bytes to which LZF-compressed data expand; raise `Malformed` for malformed
    data.

    A control byte c < 32 is followed by c + 1 literal bytes. A larger c means a copy of (c >> 5) +
    2 earlier bytes; a length of 9 is extended by the next byte. The distance back to the copied
    bytes has 13 bits.
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
        if control < 32:
            out += take(control + 1)
        else:
            length = (control >> 5) + 2
            length += take(1)[0] if length == 9 else 0
            start = len(out) - ((control & 31) << 8) - take(1)[0] - 1
            if start < 0:
                raise Malformed("LZF data that copy bytes from before their start")
            piece = out[start : start + length]
            out += (piece * (length // len(piece) + 1))[
                :length
            ]  # the copy may overlap what it writes
        if len(out) > size:
            raise Malformed(f"LZF data of more than {size} bytes")
    if len(out) < size:
        raise Malformed(f"LZF data of {len(out)} bytes, not {size}")
    return bytes(out)
