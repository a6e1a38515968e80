"""Reader and writer of the PLY format; a mesh is read as points on its surface."""

import math
from typing import Any

import numpy as np

from torchgrasp.files import Malformed, explain
from torchgrasp.files.columns import find_columns, read_fields
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.foundation.limits import CLOUD_POINTS, PLY_HEADER_BYTES, TEXT_MESH_BYTES
from torchgrasp.geometry.mesh import load_triangles

TYPES = {
    **{
        "char": "i1",
        "int8": "i1",
        "uchar": "u1",
        "uint8": "u1",
        "short": "i2",
        "int16": "i2",
        "ushort": "u2",
    },
    **{"uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
"""NumPy's types by the old and new names of the PLY format."""
SHAPES = {"viewpoint": (3,), "frustum": (4, 3), "table": (4,)}
"""Shapes of the arrays in comments."""
MEANT = ("scale", "scaling", "offset", "shift", "unit", "units")
"""First words of comments that may change what the coordinates mean; no standard has them."""
DEVIATION = "std_m"  # the property of an estimated surface, which `save_surface` writes
SAMPLED = 2000  # points on the surface of a mesh
ROUNDING = 1e-5  # greatest rounding [m] of coordinates that are written in float32
Property = tuple[str, str, str]  # name, type, and type of the length if it is a list


def parse_ply(data: bytes) -> dict[str, Any]:
    """Return the arrays of a PLY file by name, in the file's unit.

    They are "points" and "normals" (n, 3), "viewpoint" (3,), "frustum" (4, 3) and "table" (4,),
    where the file has them. "said" lists comments on a unit or a scale, which are not applied. A
    mesh gives points on its surface. "estimated" is whether it has standard deviations (`std_m`).
    Raises `Malformed` for a malformed file.
    """
    header, body = _split_header(data)
    encoding = ""
    known = dict[str, Any]()
    said = list[str]()
    elements: list[tuple[str, int, list[Property]]] = []
    for line in header:
        match line.split():
            case ["format", kind, "1.0"]:
                encoding = kind
            case ["comment", name, *numbers] if name in SHAPES and len(numbers) == math.prod(
                SHAPES[name]
            ):
                known[name] = np.array([float(x) for x in numbers]).reshape(SHAPES[name])
            case ["comment" | "obj_info", word, _, *_] if word.lower().rstrip(":=") in MEANT:
                said.append(line)
            case ["element", name, count]:
                elements.append((name, int(count), []))
            case ["property", "list", length, kind, name] if (
                elements and {length, kind} <= TYPES.keys()
            ):
                elements[-1][2].append((name, TYPES[kind], TYPES[length]))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1][2].append((name, TYPES[kind], ""))
            case ["property" | "element" | "format", *_]:
                raise Malformed(f"the header line {line!r}")
    if encoding not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise Malformed(f"the encoding {encoding!r}")
    known["said"] = said
    # Before the body is parsed: a mesh has twice as many faces as corners.
    if any(not 0 <= count <= 2 * CLOUD_POINTS for _, count, _ in elements):
        counts = [(name, count) for name, count, _ in elements]
        raise Malformed(f"elements {counts}; at most {CLOUD_POINTS} points")
    faces = sum(count for name, count, _ in elements if name == "face")
    if faces:
        if encoding == "ascii" and len(body) > TEXT_MESH_BYTES:
            found = f"a mesh of {len(body)} bytes of text"
            raise Malformed(f"{found}, which may have {TEXT_MESH_BYTES}")
        points, normals = _sample_mesh(data)
        estimated = any(name == DEVIATION for _, _, of in elements for name, _, _ in of)
        return {
            "points": points,
            "normals": normals,
            "viewpoint": known.get("viewpoint"),
            "said": said,
            "estimated": estimated,
        }
    if not elements or elements[0][0] != "vertex":
        raise Malformed("a first element that is not called vertex")
    _, count, properties = elements[0]
    last = not any(more for _, more, _ in elements[1:])
    return _read_columns(body, encoding, count, properties, last) | known


def format_ply(
    points: np.ndarray,
    normals: np.ndarray | None = None,
    viewpoint: np.ndarray | None = None,
    frustum: np.ndarray | None = None,
    table: np.ndarray | None = None,
) -> bytes:
    """Return the bytes of a binary PLY file of a cloud.

    `points` and `normals` are (n, 3). Comment lines hold the `viewpoint` (3,), the `frustum` (4, 3)
    of inward normals, and the `table` (4,), normal and offset. Lengths are in metres. Numbers are
    in float32; far from the origin, where that is too coarse, they are in float64.
    """
    lines = ["ply", "format binary_little_endian 1.0"]
    for name, numbers in (("viewpoint", viewpoint), ("frustum", frustum), ("table", table)):
        if numbers is not None:
            lines.append(f"comment {name} " + " ".join(repr(float(x)) for x in numbers.flat))
    lines.append(f"element vertex {len(points)}")
    coarse = float(np.spacing(np.abs(points).max(initial=0.0).astype(np.float32))) / 2
    kind, code = ("double", "<f8") if coarse > ROUNDING else ("float", "<f4")
    names = ["x", "y", "z"] + (["nx", "ny", "nz"] if normals is not None else [])
    lines += [f"property {kind} {name}" for name in names]
    rows = points if normals is None else np.concatenate([points, normals], axis=1)
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii") + rows.astype(code).tobytes()


def _split_header(data: bytes) -> tuple[list[str], bytes]:
    """Return the lines of a PLY file's header, and the data after the header."""
    end = data.find(b"end_header", 0, PLY_HEADER_BYTES)
    stop = data.find(b"\n" if b"\n" in data[: max(end, 0)] else b"\r", end) + 1
    if not data.startswith(b"ply") or end < 0 or stop == 0:
        raise Malformed("no PLY header")
    return data[:end].decode("ascii").splitlines()[1:], data[stop:]


def _read_columns(
    body: bytes, encoding: str, count: int, properties: list[Property], last: bool
) -> dict[str, Any]:
    """Return points and normals of the vertices; their lists must be as long as those of the first
    vertex.
    """
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[encoding]
    names = list[str]()
    fields = list[tuple[str, int]]()
    lengths = dict[int, int]()
    for name, kind, counter in properties:
        if counter:
            names = [*names, "_"]
            fields = [*fields, (counter, 1)]
            first = read_fields(body, fields, min(count, 1), order, False)
            lengths[len(fields)] = int(first[-1][0, 0])
        fields.append((kind, lengths.get(len(fields), 1)))
        names.append(f"list {name}" if counter else name)
    columns = read_fields(body, fields, count, order, last)
    for i, length in lengths.items():
        if (columns[i - 1] != length).any():
            raise Malformed(f"a {names[i]} of different lengths")
    return find_columns(names, columns)


def _sample_mesh(data: bytes) -> tuple[np.ndarray, np.ndarray | None]:
    """Return points on the surface of a PLY file's mesh, and their normals; None if the mesh is not
    closed.
    """
    try:
        mesh = load_triangles(data, ".ply", process=False)
    except Exception as error:  # the parser raises whatever the bytes provoke
        raise Malformed(f"a mesh with {explain(error)}") from error
    if (
        not isinstance(mesh, trimesh.Trimesh)
        or not mesh.area > 0
        or not np.isfinite(mesh.vertices).all()
    ):
        raise Malformed("a mesh without a surface")
    points, faces = trimesh.sample.sample_surface(mesh, SAMPLED, seed=0)[:2]
    mesh.merge_vertices()
    return np.asarray(points), np.asarray(mesh.face_normals[faces]) if mesh.is_volume else None
