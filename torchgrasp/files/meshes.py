"""Triangles of mesh files of strangers: one file each, nothing packed, and nothing that a file names is opened."""

import io
import re
from typing import Any

SUFFIXES = (".obj", ".off", ".ply", ".stl")
"""Formats whose memory is bounded by the size of the file."""

_REFERENCE = re.compile(rb"/\S*")
"""Normal and texture of a corner in an .obj; a corner of two textures would be two, and the surface open there."""


def load_triangles(data: bytes, suffix: str, **options: Any) -> Any:
    """Return what trimesh reads from the bytes of a file; errors are whatever its readers raise.

    Args:
        data: of the file.
        suffix: one of `SUFFIXES`.
        options: of `trimesh.load_mesh`.
    """
    import trimesh

    data = _geometry(data) if suffix == ".obj" else data
    # from memory and without a resolver: materials and textures beside it stay closed
    return trimesh.load_mesh(io.BytesIO(data), file_type=suffix[1:], skip_materials=True, **options)


def _geometry(data: bytes) -> bytes:
    """Return vertices and faces of an .obj: trimesh takes minutes for 30,000 groups or materials."""
    lines = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines()
    kept = (line for line in map(bytes.strip, lines) if line[:2] in (b"v ", b"f ", b"v\t", b"f\t"))
    return b"\n".join(line if line[:1] == b"v" else _REFERENCE.sub(b"", line) for line in kept)
