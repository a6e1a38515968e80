"""Reader and writer of the PLY format; a mesh is read as points on its surface."""

from typing import Any

import numpy as np

from torchgrasp.cloud.tables import read_table
from torchgrasp.geometry.mesh import load_triangles
from torchgrasp.lazy import trimesh
from torchgrasp.limits import CLOUD_POINTS, TEXT_MESH_BYTES

TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2"},
    **{"uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
"""NumPy's types by the old and new names of the PLY format."""


def parse_ply(data: bytes) -> dict[str, Any]:
    """Return points, normals, viewpoint, frustum and table of a PLY file by name; entries that it lacks are None."""
    header, body = _split_header(data)
    encoding, viewpoint, frustum, table = "", None, None, None
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    for line in header:
        match line.split():
            case ["format", kind, "1.0"]:
                encoding = kind
            case ["comment", "viewpoint", x, y, z]:
                viewpoint = np.array([float(x), float(y), float(z)])
            case ["comment", "frustum", *numbers] if len(numbers) == 12:
                frustum = np.array([float(x) for x in numbers]).reshape(4, 3)
            case ["comment", "table", *numbers] if len(numbers) == 4:
                table = np.array([float(x) for x in numbers])
            case ["element", name, count]:
                elements.append((name, int(count), []))
            case ["property", "list", _, _, name] if elements:
                elements[-1][2].append((name, "list"))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1][2].append((name, TYPES[kind]))
            case ["property" | "element" | "format", *_]:
                raise ValueError(f"the header line {line!r}")
    if encoding not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise ValueError(f"the encoding {encoding!r}")
    # Before the body is parsed: a mesh has twice as many faces as corners.
    if any(not 0 <= count <= 2 * CLOUD_POINTS for _, count, _ in elements):
        raise ValueError(f"elements {[(name, count) for name, count, _ in elements]}; at most {CLOUD_POINTS} points")
    faces = sum(count for name, count, _ in elements if name == "face")
    if faces:
        if encoding == "ascii" and len(body) > TEXT_MESH_BYTES:
            raise ValueError(f"a mesh of {len(body)} bytes of text, which may have {TEXT_MESH_BYTES}")
        points, normals = _sample_mesh(data)
        return {"points": points, "normals": normals, "viewpoint": viewpoint}
    if not elements or elements[0][0] != "vertex" or any(kind == "list" for _, kind in elements[0][2]):
        raise ValueError("a first element that is not a plain vertex")
    _, count, properties = elements[0]
    columns = _read_columns(body, encoding, count, properties)
    points = np.stack([columns[name] for name in "xyz"], axis=-1)
    normals = np.stack([columns[f"n{axis}"] for axis in "xyz"], axis=-1) if "nx" in columns else None
    return {"points": points, "normals": normals, "viewpoint": viewpoint, "frustum": frustum, "table": table}


def format_ply(
    points: np.ndarray,
    normals: np.ndarray | None = None,
    viewpoint: np.ndarray | None = None,
    frustum: np.ndarray | None = None,
    table: np.ndarray | None = None,
) -> bytes:
    """Return the bytes of a binary PLY file; comment lines hold the viewpoint, the frustum and the table."""
    lines = ["ply", "format binary_little_endian 1.0"]
    for name, numbers in (("viewpoint", viewpoint), ("frustum", frustum), ("table", table)):
        if numbers is not None:
            lines.append(f"comment {name} " + " ".join(repr(float(x)) for x in numbers.flat))
    lines.append(f"element vertex {len(points)}")
    names = ["x", "y", "z"] + (["nx", "ny", "nz"] if normals is not None else [])
    lines += [f"property float {name}" for name in names]
    rows = points if normals is None else np.concatenate([points, normals], axis=1)
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii") + rows.astype("<f4").tobytes()


def _split_header(data: bytes) -> tuple[list[str], bytes]:
    """Return the lines of a PLY file's header, and the data after the header."""
    end = data.find(b"end_header", 0, 65536)
    stop = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or stop == 0:
        raise ValueError("no PLY header")
    return data[:end].decode("ascii").splitlines()[1:], data[stop:]


def _read_columns(body: bytes, encoding: str, count: int, properties: list[tuple[str, str]]) -> dict[str, np.ndarray]:
    """Return the numbers of each property of the vertices, by the name of the property."""
    names = [name for name, _ in properties]
    if len(set(names)) != len(names) or not 0 <= count <= CLOUD_POINTS:
        raise ValueError(f"the properties {names} of {count} vertices")
    if encoding == "ascii":
        table = read_table(body, count, len(names))
        return {name: table[:, i] for i, name in enumerate(names)}
    order = "<" if encoding == "binary_little_endian" else ">"
    dtype = np.dtype([(name, order + kind) for name, kind in properties])
    table = np.frombuffer(body, dtype=dtype, count=count)
    return {name: table[name] for name in names}


def _sample_mesh(data: bytes) -> tuple[np.ndarray, np.ndarray | None]:
    """Return points on the surface of a PLY file's mesh, and their normals; None if the mesh is not closed."""
    try:
        mesh = load_triangles(data, ".ply", process=False)
    except Exception as error:  # the parser raises whatever the bytes provoke
        raise ValueError(f"a mesh that cannot be parsed ({error})") from error
    if not isinstance(mesh, trimesh.Trimesh) or not mesh.area > 0 or not np.isfinite(mesh.vertices).all():
        raise ValueError("a mesh without a surface")
    points, faces = trimesh.sample.sample_surface(mesh, 2000, seed=0)[:2]
    mesh.merge_vertices()
    return np.asarray(points), np.asarray(mesh.face_normals[faces]) if mesh.is_volume else None
