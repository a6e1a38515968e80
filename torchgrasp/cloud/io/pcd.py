"""The PCD format of the Point Cloud Library."""

from typing import Any

import numpy as np

from torchgrasp.cloud.io.text import MAX_POINTS, read_table


def parse_pcd(data: bytes) -> dict[str, Any]:
    r"""Return points, normals and viewpoint of a PCD file, or None.

    Many writers fill VIEWPOINT with the default `0 0 0 1 0 0 0`. It counts only outside the points' bounding box.

    Raises:
        ValueError: no PCD file; compressed data; fewer bytes than the header promises.

    >>> parse_pcd(b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 1\nDATA ascii\n1 2 3\n")["points"]
    array([[1., 2., 3.]])
    """
    header, body = _split_header(data)
    names = header["FIELDS"]
    counts = [int(c) for c in header.get("COUNT", ["1"] * len(names))]
    sizes, kinds = header["SIZE"], header["TYPE"]
    if not len(names) == len(counts) == len(sizes) == len(kinds) or min(counts) < 1 or max(counts) > 4096:
        raise ValueError("FIELDS, SIZE, TYPE and COUNT that do not match")
    count = int(header["POINTS"][0]) if "POINTS" in header else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    if not 0 <= count <= MAX_POINTS:
        raise ValueError(f"{count} points, not up to {MAX_POINTS}")
    encoding = header["DATA"][0].lower()
    wanted = ("x", "y", "z", "normal_x", "normal_y", "normal_z")
    if encoding == "ascii":
        table = read_table(body, count, sum(counts))
        starts = np.cumsum([0, *counts[:-1]])
        columns = {name: table[:, s] for name, s in zip(names, starts, strict=True) if name in wanted}
    elif encoding == "binary":
        letters = {"F": "f", "I": "i", "U": "u"}
        # Padding fields are all called "_": columns go by number.
        formats = [f"({c},)<{letters[k.upper()]}{int(s)}" for k, s, c in zip(kinds, sizes, counts, strict=True)]
        dtype = np.dtype({"names": [str(i) for i in range(len(names))], "formats": formats})
        rows = np.frombuffer(body, dtype=dtype, count=count)
        columns = {name: rows[f"{i}"][:, 0].astype(np.float64) for i, name in enumerate(names) if name in wanted}
    else:
        raise ValueError(f"DATA {encoding}; convert it to binary or ascii")
    points = np.stack([columns[name] for name in wanted[:3]], axis=-1)
    normals = np.stack([columns[name] for name in wanted[3:]], axis=-1) if wanted[3] in columns else None
    return {"points": points, "normals": normals, "viewpoint": _viewpoint(header, points)}


def _split_header(data: bytes) -> tuple[dict[str, list[str]], bytes]:
    """Split a PCD file into its header's words and the data."""
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


def _viewpoint(header: dict[str, list[str]], points: np.ndarray) -> np.ndarray | None:
    """Return the position in VIEWPOINT; None for the default within the cloud."""
    if "VIEWPOINT" not in header:
        return None
    numbers = np.array([float(x) for x in header["VIEWPOINT"]])
    if len(numbers) != 7:
        raise ValueError(f"VIEWPOINT with {len(numbers)} numbers, not 7")
    finite = points[np.isfinite(points).all(1)]
    within = len(finite) and bool(((finite.min(0) <= 0) & (finite.max(0) >= 0)).all())
    return None if within and np.array_equal(numbers, [0, 0, 0, 1, 0, 0, 0]) else numbers[:3]
