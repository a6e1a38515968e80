"""The PCD format of the Point Cloud Library, and its LZF compression."""

from typing import Any

import numpy as np

from torchgrasp.cloud.tables import read_table
from torchgrasp.limits import CLOUD_BYTES, CLOUD_POINTS


def parse_pcd(data: bytes) -> dict[str, Any]:
    """Return points, normals and viewpoint of a PCD file, None if missing, and whether the viewpoint is `default`.

    Many writers fill VIEWPOINT with the default `0 0 0 1 0 0 0`, wherever the camera was.
    """
    header, body = _split_header(data)
    names = header["FIELDS"]
    counts = [int(c) for c in header.get("COUNT", ["1"] * len(names))]
    sizes, kinds = header["SIZE"], header["TYPE"]
    if not len(names) == len(counts) == len(sizes) == len(kinds) or min(counts) < 1 or max(counts) > 4096:
        raise ValueError("FIELDS, SIZE, TYPE and COUNT that do not match")
    count = int(header["POINTS"][0]) if "POINTS" in header else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    if not 0 <= count <= CLOUD_POINTS:
        raise ValueError(f"{count} points, not up to {CLOUD_POINTS}")
    encoding = header["DATA"][0].lower()
    wanted = ("x", "y", "z", "normal_x", "normal_y", "normal_z")
    if encoding == "ascii":
        table = read_table(body, count, sum(counts))
        starts = np.cumsum([0, *counts[:-1]])
        columns = {name: table[:, s] for name, s in zip(names, starts, strict=True) if name in wanted}
    elif encoding in ("binary", "binary_compressed"):
        letters = {"F": "f", "I": "i", "U": "u"}
        formats = [f"({c},)<{letters[k.upper()]}{int(s)}" for k, s, c in zip(kinds, sizes, counts, strict=True)]
        if encoding == "binary_compressed":
            body = _decompress(body, [np.dtype(f) for f in formats], count)
        # Padding fields are all called "_": columns go by number.
        dtype = np.dtype({"names": [str(i) for i in range(len(names))], "formats": formats})
        rows = np.frombuffer(body, dtype=dtype, count=count)
        columns = {name: rows[f"{i}"][:, 0].astype(np.float64) for i, name in enumerate(names) if name in wanted}
    else:
        raise ValueError(f"DATA {encoding}, not ascii, binary or binary_compressed")
    points = np.stack([columns[name] for name in wanted[:3]], axis=-1)
    normals = np.stack([columns[name] for name in wanted[3:]], axis=-1) if wanted[3] in columns else None
    viewpoint = np.array([float(x) for x in header["VIEWPOINT"]]) if "VIEWPOINT" in header else None
    if viewpoint is not None and len(viewpoint) != 7:
        raise ValueError(f"VIEWPOINT with {len(viewpoint)} numbers, not 7")
    default = viewpoint is not None and np.array_equal(viewpoint, [0, 0, 0, 1, 0, 0, 0])
    position = None if viewpoint is None else viewpoint[:3]
    return {"points": points, "normals": normals, "viewpoint": position, "default": default}


def _split_header(data: bytes) -> tuple[dict[str, list[str]], bytes]:
    """Return a PCD file's header, as a dict of each line's words by its first word, and the data after the header."""
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        stop = data.find(b"\n", start)
        if stop < 0 or stop > 65536:
            raise ValueError("no PCD header")
        words = data[start:stop].decode("ascii").split("#")[0].split()
        if words:
            header[words[0].upper()] = words[1:]
        start = stop + 1
    return header, data[start:]


def _decompress(body: bytes, kinds: list[np.dtype[Any]], count: int) -> bytes:
    """Return decompressed data point by point; the file holds one field of all points, then the next field."""
    packed, unpacked = (int(n) for n in np.frombuffer(body, dtype="<u4", count=2))
    wanted = count * sum(kind.itemsize for kind in kinds)
    if unpacked != wanted or wanted > CLOUD_BYTES or packed > len(body) - 8:
        limits = f"at most {len(body) - 8} for {wanted}, and at most {CLOUD_BYTES}"
        raise ValueError(f"compressed data of {packed} bytes for {unpacked}, not of {limits}")
    data = decompress(body[8 : 8 + packed], unpacked)
    starts = np.cumsum([0, *(count * kind.itemsize for kind in kinds)])
    fields = [np.frombuffer(data, np.uint8, count * k.itemsize, s) for k, s in zip(kinds, starts[:-1], strict=True)]
    return np.concatenate([field.reshape(count, -1) for field in fields], axis=1).tobytes()


def decompress(data: bytes, size: int) -> bytes:
    """Return the `size` bytes to which LZF-compressed data expand; raise `ValueError` for malformed data.

    A control byte c < 32 is followed by c + 1 literal bytes. A larger c means a copy of (c >> 5) + 2 earlier bytes; a
    length of 9 is extended by the next byte. The distance back to the copied bytes has 13 bits.
    """
    out, i, end = bytearray(), 0, len(data)
    while i < end:
        control = data[i]
        i += 1
        if control < 32:
            length = control + 1
            if i + length > end:
                raise ValueError("LZF data that end early")
            out += data[i : i + length]
            i += length
        else:
            length = control >> 5
            if i + 1 + (length == 7) > end:
                raise ValueError("LZF data that end early")
            if length == 7:
                length += data[i]
                i += 1
            length += 2
            start = len(out) - ((control & 31) << 8) - data[i] - 1
            i += 1
            if start < 0:
                raise ValueError("LZF data that copy bytes from before their start")
            piece = out[start : start + length]
            while len(piece) < length:  # the copy overlaps what it writes
                piece += piece[: length - len(piece)]
            out += piece
        if len(out) > size:
            raise ValueError(f"LZF data of more than {size} bytes")
    if len(out) < size:
        raise ValueError(f"LZF data of {len(out)} bytes, not {size}")
    return bytes(out)
