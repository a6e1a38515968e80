"""Triangles of mesh files: one file each, not packed; no other file that it names is opened."""

import contextlib
import io
import logging
import re
import threading
from collections.abc import Iterator
from typing import Any

from torchgrasp.limits import MESH_FACES, PLY_HEADER_BYTES, PLY_PROPERTIES

SUFFIXES = (".obj", ".off", ".ply", ".stl")  # formats whose memory is bounded by the size of the file

_REFERENCE = re.compile(rb"/\S*")
"""Normal and texture of a corner in an .obj: a corner with two textures would become two, and open the surface."""


def load_triangles(data: bytes, suffix: str, **options: Any) -> Any:
    """Return the mesh that trimesh reads from the bytes of a file; its readers raise errors of any kind.

    Args:
        data: of the file.
        suffix: one of `SUFFIXES`.
        options: of `trimesh.load_mesh`.

    Raises:
        ValueError: more than `MESH_FACES`, or a header beyond `PLY_PROPERTIES` or `PLY_HEADER_BYTES`.
    """
    import trimesh

    data = _geometry(data) if suffix == ".obj" else data
    if (faces := _count_faces(data, suffix)) > MESH_FACES:
        raise ValueError(f"a mesh of {faces} faces; at most {MESH_FACES}")
    # from memory and without a resolver: materials and textures beside it stay closed
    with _quiet(trimesh.util.log):
        return trimesh.load_mesh(io.BytesIO(data), file_type=suffix[1:], skip_materials=True, **options)


@contextlib.contextmanager
def _quiet(log: logging.Logger) -> Iterator[None]:
    """Drop the log records of this thread: Python would print them on stderr."""
    here = threading.get_ident()

    def drop(record: logging.LogRecord) -> bool:
        return record.thread != here

    log.addFilter(drop)
    try:
        yield
    finally:
        log.removeFilter(drop)


def _count_faces(data: bytes, suffix: str) -> int:
    """Return the number of faces that a file declares; 0 if only its size bounds them."""
    if suffix == ".obj":
        return data.count(b"\nf")
    if suffix == ".stl":
        declared = int.from_bytes(data[80:84], "little")
        return declared if len(data) == 84 + 50 * declared else data.count(b"facet normal")
    return _read_header(data) if suffix == ".ply" else 0


def _read_header(data: bytes) -> int:
    """Return the number of faces in the header of a .ply, read as leniently as trimesh does."""
    properties = faces = 0
    for line in io.BytesIO(data[:PLY_HEADER_BYTES]):
        words = line.split()
        if b"end_header" in words:
            break
        properties += b"property" in line
        if words and b"element" in words[0] and words[1:2] == [b"face"]:
            faces += int(words[-1])
    else:
        raise ValueError(f"a header without an end in {PLY_HEADER_BYTES} bytes")
    if properties > PLY_PROPERTIES:
        raise ValueError(f"a header of {properties} properties; at most {PLY_PROPERTIES}")
    return faces


def _geometry(data: bytes) -> bytes:
    """Return only the vertices and faces of an .obj: trimesh is slow with many groups or materials."""
    lines = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines()
    kept = (line for line in map(bytes.strip, lines) if line[:2] in (b"v ", b"f ", b"v\t", b"f\t"))
    return b"\n".join(line if line[:1] == b"v" else _REFERENCE.sub(b"", line) for line in kept)
