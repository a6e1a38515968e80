"""Triangle meshes: reading, checks, clipping by a scalar field, and closest points on triangles."""

import contextlib
import io
import logging
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from torchgrasp.files import Malformed, explain, is_file, read_bytes
from torchgrasp.foundation.errors import MeshError, SuspiciousScale
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.foundation.limits import (
    MAX_EXTENT,
    MESH_BYTES,
    MESH_FACES,
    MIN_EXTENT,
    PLY_HEADER_BYTES,
    PLY_PROPERTIES,
)

# formats whose memory is bounded by the size of the file
SUFFIXES = (".obj", ".off", ".ply", ".stl")
# normal and texture of a corner in an .obj: two textures would open the surface
_REFERENCE = re.compile(rb"/\S*")
MESH_FILE = f"a mesh file ({', '.join(SUFFIXES)})"
LEAST_VOLUME = 1e-12  # least volume [m^3] of a body
MOST_INWARD = 100  # most bodies turned inward that are looked at, the largest ones
LEAST_SPAN = 1e-40  # least squared double area [m4] of a triangle that is divided by
FOLD = 3.1398  # least angle [rad] between faces that lie on each other: 179.9 degrees
MOST_FOLDED = 0.01  # greatest share of the surface that is folded: scans have less than 0.1 %
STALE_NORMAL = 1e-4  # least difference of unit normals that no rounding of a file explains
# a binary .stl: title, 32-bit count of faces, and bytes of each face
STL_TITLE = 80
STL_HEAD = STL_TITLE + 4
STL_FACE = 50


def read_mesh(mesh: "trimesh.Trimesh | Path | str") -> "trimesh.Trimesh":
    """Return a checked closed triangle mesh [m], which is given or read from a file.

    A bad mesh is never repaired.

    Raises:
        MeshError: the file is no .obj, .off, .ply or .stl file, or has more than 50 MiB.
        MeshError: the mesh has no faces, or more than 500,000.
        MeshError: the mesh has vertices that are not finite, an open surface, or no volume.
        MeshError: the faces are not all turned outward, or over 1 % of the surface lies on other
            faces.
        SuspiciousScale: the longest side of the bounding box is outside [5 mm, 2 m]; most often the
            unit is mm.
    """
    name = "a mesh"
    if not isinstance(mesh, trimesh.Trimesh):
        if not is_file(mesh) or Path(mesh).suffix.lower() not in SUFFIXES:
            raise MeshError("mesh", f"{mesh}, which is no {'such ' * is_file(mesh)}file", MESH_FILE)
        path = Path(mesh)
        name = str(mesh)
        if path.stat().st_size > MESH_BYTES:
            raise MeshError(
                "mesh", f"{path} of {path.stat().st_size} bytes", f"at most {MESH_BYTES} bytes"
            )
        try:
            loaded = load_triangles(read_bytes(path), path.suffix.lower())
        except Exception as error:  # the readers of trimesh raise whatever their format runs into
            raise MeshError("mesh", f"{path}: {explain(error)}", MESH_FILE) from error
        if not isinstance(loaded, trimesh.Trimesh) or len(loaded.faces) == 0:
            raise MeshError("mesh", f"{path}, which holds no faces", "a closed triangle mesh")
        mesh = loaded
    check_solid(mesh, name)
    folded = _folded_share(mesh)
    if folded > MOST_FOLDED:
        found = f"{name} with {folded:.0%} of its surface folded onto other faces"
        allowed = "faces side by side: make triangles of concave polygons before they are saved"
        raise MeshError("mesh", found, allowed)
    extent = float(mesh.extents.max())
    if not MIN_EXTENT <= extent <= MAX_EXTENT:
        raise SuspiciousScale(
            "mesh", f"{name} of {extent:.4g} m", f"{MIN_EXTENT:g} m to {MAX_EXTENT:g} m: use metres"
        )
    return mesh


def check_solid(mesh: "trimesh.Trimesh", name: str) -> None:
    """Raise `MeshError` unless a mesh [m] is closed and encloses a volume, with all faces turned
    outward.

    It must have one to 500,000 faces (`MESH_FACES`), and finite vertices. Faces of a cavity are
    turned into it. The message calls the mesh `name`.
    """
    if not 0 < len(mesh.faces) <= MESH_FACES:
        allowed = f"a closed mesh of at most {MESH_FACES} triangles"
        raise MeshError("mesh", f"{name} of {len(mesh.faces)} faces", allowed)
    if mesh.faces.shape[1] != 3 or mesh.vertices.shape[1] != 3:
        found = f"{name} of faces {mesh.faces.shape} and vertices {mesh.vertices.shape}"
        raise MeshError("mesh", found, "triangles in space")
    if not np.isfinite(mesh.vertices).all():
        raise MeshError("mesh", f"{name} with a non-finite vertex", "finite vertices [m]")
    if not mesh.is_watertight:
        raise MeshError("mesh", f"{name} with an open surface", "a closed (watertight) mesh")
    with np.errstate(invalid="ignore", divide="ignore"):  # trimesh divides by the volume
        volume = mesh.volume
    if not (mesh.is_winding_consistent and volume > LEAST_VOLUME):
        raise MeshError(
            "mesh", f"{name} of volume {volume:.3g} m^3", "a positive volume, faces turned outward"
        )
    inward = _inward_volume(mesh)
    if inward > LEAST_VOLUME:
        found = f"{name} with a body of {1e6 * inward:.3g} cm^3 turned inward, in no other body"
        raise MeshError("mesh", found, "every face turned outward, but those of a cavity")
    if not np.linalg.eigvalsh(mesh.moment_inertia).min() > 0:  # a simulator cannot move it
        raise MeshError(
            "mesh",
            f"{name} without inertia, as of a body turned inward",
            "every face turned outward",
        )


def _folded_share(mesh: "trimesh.Trimesh") -> float:
    """Return the share of a mesh's surface whose faces lie on neighbours that face the other way.

    Readers split polygons into fans. The fan of a concave polygon covers its notch twice, with
    opposite faces: volume and closedness are right, and the surface is not.
    """
    on_each_other = mesh.face_adjacency_angles > FOLD
    pairs = mesh.face_adjacency[on_each_other]
    return float(mesh.area_faces[pairs].min(1).sum() / mesh.area)


def _inward_volume(mesh: "trimesh.Trimesh") -> float:
    """Return the volume [m^3] of a body whose faces are turned inward, though it is no cavity; 0 if
    there is none.

    A cavity lies in the box of a body that is turned outward.
    """
    body = trimesh.graph.connected_component_labels(mesh.face_adjacency, len(mesh.faces))
    count = int(body.max()) + 1
    if count == 1:
        return 0.0
    corners = np.asarray(mesh.vertices - mesh.vertices.mean(0))[mesh.faces]  # (f, 3 corners, 3)
    a, b, c = corners.transpose(1, 0, 2)
    volume = np.bincount(body, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6, count)
    low = np.full((count, 3), np.inf)
    high = np.full((count, 3), -np.inf)
    np.minimum.at(low, body, corners.min(1))
    np.maximum.at(high, body, corners.max(1))
    outward = volume > 0
    for k in np.argsort(volume)[:MOST_INWARD].tolist():
        inside = (low[outward] <= low[k]) & (high[k] <= high[outward])
        if volume[k] < -LEAST_VOLUME and not inside.all(1).any():
            return -float(volume[k])
    return 0.0


def with_true_normals(mesh: "trimesh.Trimesh") -> "trimesh.Trimesh":
    """Return a mesh whose face normals are those of its triangles.

    A mesh with such normals is returned itself. Another one is copied, its vertices and faces
    alone. Before version 5.2, trimesh keeps normals that were read before an uneven scaling, and
    casts rays by them. A file may also hold wrong normals.
    """
    corners = np.asarray(mesh.vertices)[mesh.faces]  # (f, 3 corners, 3)
    normals, valid = trimesh.triangles.normals(corners)
    off = np.abs(mesh.face_normals[valid] - normals).max(initial=0.0)
    if off < STALE_NORMAL:
        return mesh
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def closest_on_triangles(
    points: np.ndarray, triangles: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return (closest, feature): the closest point (n, 3) of triangle i to point i, and where it
    lies.

    The `points` (n, 3) and the corners of the `triangles` (n, 3 corners, 3) have the same unit. The
    feature (n,) is 0 inside the face. On the sides ab, bc, ca it is 1 to 3. At the corners a, b, c,
    in the order given, it is 4 to 6.
    """
    a = triangles[:, 0]
    u = triangles[:, 1] - triangles[:, 0]
    v = triangles[:, 2] - triangles[:, 0]
    w = points - a
    uu, vv, uv = (np.einsum("ij,ij->i", x, y) for x, y in ((u, u), (v, v), (u, v)))
    uw = np.einsum("ij,ij->i", u, w)
    vw = np.einsum("ij,ij->i", v, w)
    span = np.maximum(uu * vv - uv * uv, LEAST_SPAN)
    s = (vv * uw - uv * vw) / span
    t = (uu * vw - uv * uw) / span
    best = a + s[:, None] * u + t[:, None] * v
    feature = np.zeros(len(points), dtype=int)
    out = np.nonzero((s < 0) | (t < 0) | (s + t > 1))[0]  # then the closest point lies on a side
    corner = triangles[out]
    side = np.roll(corner, -1, 1) - corner
    along = np.einsum("ikj,ikj->ik", points[out, None] - corner, side) / np.einsum(
        "ikj,ikj->ik", side, side
    )
    along = np.clip(along, 0, 1)
    feet = corner + along[..., None] * side
    gap = points[out, None] - feet
    k = np.einsum("ikj,ikj->ik", gap, gap).argmin(1)
    rows = np.arange(len(out))
    best[out] = feet[rows, k]
    along = along[rows, k]
    feature[out] = np.where(along <= 0, 4 + k, np.where(along >= 1, 4 + (k + 1) % 3, 1 + k))
    return best, feature


def clip_mesh(
    vertices: np.ndarray, faces: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (vertices, faces, on_cut): the part of a mesh where a scalar field is negative.

    The returned vertices (w, 3) and faces (g, 3) are as the given ones. `on_cut` (w,) is a mask of
    the vertices that lie on the cut, where the field is 0. `values` (v,) is the field at the
    `vertices` (v, 3), of any unit. It is linear within each of the `faces` (f, 3), which hold
    indices of vertices.
    """
    keep = values < 0
    count = keep[faces].sum(1)
    pieces = [faces[count == 3]]
    made: dict[tuple[int, int], int] = {}
    ends: list[tuple[int, int]] = []

    def cross(a: int, b: int) -> int:
        """Return the index of the new vertex on the edge between the vertices a and b. There the
        field is 0.
        """
        key = (min(a, b), max(a, b))
        if key not in made:
            made[key] = len(vertices) + len(ends)
            ends.append(key)
        return made[key]

    for face in faces[(count == 1) | (count == 2)]:
        inside = keep[face]
        lone = int(np.argmax(inside) if inside.sum() == 1 else np.argmin(inside))
        a, b, c = (int(face[(lone + k) % 3]) for k in range(3))  # the winding stays
        ab = cross(a, b)
        ac = cross(a, c)
        pieces.append(np.array([[a, ab, ac]] if inside.sum() == 1 else [[ab, b, c], [ab, c, ac]]))
    index = np.array(ends, dtype=np.int64).reshape(-1, 2)
    start = values[index[:, 0]]
    end = values[index[:, 1]]
    share = (start / (start - end))[:, None]
    crossings = (1 - share) * vertices[index[:, 0]] + share * vertices[index[:, 1]]
    every = np.concatenate([vertices, crossings])
    used, faces = np.unique(np.concatenate(pieces), return_inverse=True)
    return every[used], faces.reshape(-1, 3), used >= len(vertices)


def load_triangles(data: bytes, suffix: str, **options: Any) -> Any:
    """Return what `trimesh.load_mesh` reads from the bytes of a mesh file: most often one mesh.

    `data` are the bytes, and `suffix` is the file's, such as ".obj". `options` go to
    `trimesh.load_mesh`. Raises `Malformed` for more than 500,000 faces (`MESH_FACES`). For bad
    bytes, trimesh may raise any exception.
    """
    data = _geometry(data) if suffix == ".obj" else data
    if (faces := _count_faces(data, suffix)) > MESH_FACES:
        raise Malformed(f"a mesh of {faces} faces; at most {MESH_FACES}")
    # from memory and without a resolver: materials and textures beside it stay closed
    with _quiet(trimesh.util.log):
        return trimesh.load_mesh(
            io.BytesIO(data), file_type=suffix[1:], skip_materials=True, **options
        )


@contextlib.contextmanager
def _quiet(log: logging.Logger) -> Iterator[None]:
    """Suppress the records that this thread sends to `log` in a `with` block; Python would print
    them on stderr.
    """
    here = threading.get_ident()

    def drop(record: logging.LogRecord) -> bool:
        return record.thread != here

    log.addFilter(drop)
    try:
        yield
    finally:
        log.removeFilter(drop)


def _count_faces(data: bytes, suffix: str) -> int:
    """Return the number of faces that a file declares. Return 0 for a format in which the file's
    size bounds the number.
    """
    if suffix == ".obj":
        return data.count(b"\nf")
    if suffix == ".stl":
        declared = int.from_bytes(data[STL_TITLE:STL_HEAD], "little")
        binary = len(data) == STL_HEAD + STL_FACE * declared
        return declared if binary else data.count(b"facet normal")
    return _read_header(data) if suffix == ".ply" else 0


def _read_header(data: bytes) -> int:
    """Return the number of faces in the header of a .ply file. The header is read as leniently as
    trimesh reads it.
    """
    properties = faces = 0
    for line in io.BytesIO(data[:PLY_HEADER_BYTES]):
        words = line.split()
        if b"end_header" in words:
            break
        properties += b"property" in line
        if words and b"element" in words[0] and words[1:2] == [b"face"]:
            faces += int(words[-1])
    else:
        raise Malformed(f"a header without an end in {PLY_HEADER_BYTES} bytes")
    if properties > PLY_PROPERTIES:
        raise Malformed(f"a header of {properties} properties; at most {PLY_PROPERTIES}")
    return faces


def _geometry(data: bytes) -> bytes:
    """Return only the vertex and face lines of an .obj file, because trimesh is slow with many
    groups or materials.

    A negative index counts back from the vertex above its line; trimesh counts from the last of the
    file. It is replaced by the index that it means.
    """
    lines = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines()
    kept = list[bytes]()
    vertices = 0
    for line in map(bytes.strip, lines):
        if line[:2] in (b"v ", b"v\t"):
            vertices += 1
            kept.append(line)
        elif line[:2] in (b"f ", b"f\t"):
            face = _REFERENCE.sub(b"", line)
            if b"-" in face:
                corners = [int(word) for word in face.split()[1:]]
                places = [k if k > 0 else vertices + 1 + k for k in corners]
                face = b" ".join([b"f", *(b"%d" % k for k in places)])
            kept.append(face)
    return b"\n".join(kept)
