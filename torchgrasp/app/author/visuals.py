"""Visual meshes of a hand, for pictures: read from its URDF, and kept in the clean copy.

Nothing but pictures depends on them, so a visual that is missing or malformed is left out.
"""

import dataclasses
import functools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from torchgrasp.app.author.fit_shapes import primitive_mesh, read_mesh_file
from torchgrasp.foundation.errors import BadArgument, GraspError
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.foundation.limits import HAND_MESH_BYTES, MAX_EXTENT
from torchgrasp.hand.urdf import LinkShape, Urdf, pose_of, read_visuals


@dataclasses.dataclass(frozen=True)
class VisualNumbers:
    """Bounds of the visual meshes of a hand."""

    # greatest number of triangles of a link: more are not seen in a picture of a hand
    most_faces: int = 2000
    # edge [m] of the grid cells in which corners are joined first, if there are too many triangles
    first_cell: float = 5e-4
    growth: float = 1.3  # factor by which the cells grow until few enough triangles are left
    letters: int = 60  # greatest number of letters of a link's name in the name of a file


VISUAL = VisualNumbers()
FOLDER = "visual"  # of the meshes beside a clean URDF
Triangles = tuple[Float[np.ndarray, "_ 3"], np.ndarray]  # corners [m], and faces (t, 3)


@functools.lru_cache(maxsize=16)
def link_meshes(path: Path, data: bytes, folder: Path) -> dict[str, Triangles]:
    """Return one mesh for the <visual> elements of each link, by the name of the link.

    A mesh is its corners (v, 3) [m] in the link's frame, and its faces (t, 3), indices of corners.
    Where it has more than 2000 faces (`VISUAL.most_faces`), near corners are joined. A link is left
    out if one of its visuals is missing, malformed or too large. It is too large, too, if all
    meshes kept so far leave no place for it (`HAND_MESH_BYTES`). `path` and `data` are the path and
    the bytes of the URDF; mesh files lie inside `folder`.
    """
    found = {}
    size = 0
    for link, shapes in read_visuals(path, data).items():
        if not shapes:
            continue
        parts = []
        try:
            for shape in shapes:
                parts.append(_mesh_of(path, data, shape, folder))
        except GraspError:
            continue
        whole: Any = trimesh.util.concatenate(parts)
        reach = float(np.abs(whole.vertices).max())
        own = sum(part.vertices.nbytes + part.faces.nbytes for part in parts)
        # a link that is left out takes no place of the others
        if size + own > HAND_MESH_BYTES or not reach <= MAX_EXTENT:
            continue
        size += own
        found[link] = _thinned(np.asarray(whole.vertices), np.asarray(whole.faces))
    return found


def keep_visuals(
    published: Urdf, clean: Urdf, mergers: Sequence[Mapping[str, str]], folder: Path
) -> dict[str, Triangles]:
    """Return the visual meshes of a published URDF for the links of its repaired copy `clean`, by
    link.

    A mesh is its corners (v, 3) [m] in the link's frame, and its faces (t, 3), indices of corners.
    A link of `clean` also gets the meshes of the links that were merged into it. Each of the
    `mergers` gives, for every link that was merged, the link that took it over. They are in the
    order of merging. Links that stay have the same frames in both URDFs. Mesh files lie inside
    `folder`. A link with a missing or malformed visual is left out.
    """
    names = {link.name for link in clean.links}
    meshes = link_meshes(published.path, published.data, folder)
    parts: dict[str, list[Triangles]] = {}
    partial = set[str]()
    for link, shapes in read_visuals(published.path, published.data).items():
        owner = link
        for merger in mergers:
            owner = merger.get(owner, owner)
        if owner not in names or not shapes:
            continue
        # a link of which a part is missing would be drawn with a hole
        if link not in meshes:
            partial.add(owner)
            continue
        vertices, faces = meshes[link]
        moved = np.linalg.inv(published.pose_at_zero(owner)) @ published.pose_at_zero(link)
        corners = vertices @ moved[:3, :3].T + moved[:3, 3]
        parts.setdefault(owner, []).append((corners, faces))
    found = {}
    for owner, some in parts.items():
        if owner in partial:
            continue
        corners, faces = zip(*some, strict=True)
        found[owner] = trimesh.util.append_faces(corners, faces)
    return found


def mesh_files(meshes: Mapping[str, Triangles]) -> dict[str, tuple[str, bytes]]:
    """Return for each link, by its name, the path and the bytes of a mesh file, binary STL.

    `meshes` holds by link corners (v, 3) [m], in the link's frame, and faces (t, 3). The path is
    relative to the folder of the URDF. Nothing is written.
    """
    files = {}
    for number, (link, (vertices, faces)) in enumerate(meshes.items()):
        word = re.sub(r"[^A-Za-z0-9_.-]", "_", link)[: VISUAL.letters]
        data = trimesh.Trimesh(vertices, faces, process=False).export(file_type="stl")
        assert isinstance(data, bytes)
        files[link] = f"{FOLDER}/{number:02}_{word}.stl", data
    return files


def _mesh_of(path: Path, data: bytes, shape: LinkShape, folder: Path) -> "trimesh.Trimesh":
    """Return a visual as a mesh in its link's frame; raise `HandFileError` for an unusable one."""
    if shape.kind == "mesh":
        urdf = Urdf(path, "", "", (), (), data, b"")
        mesh = read_mesh_file(urdf, shape.file, folder)
        mesh.merge_vertices()
        mesh.apply_scale(shape.size)
    else:
        mesh = primitive_mesh(shape)
    mesh.apply_transform(pose_of(shape))
    if not np.isfinite(mesh.vertices).all() or not len(mesh.faces):
        raise BadArgument("urdf", f"{path}: a visual without faces", "a mesh")
    return mesh


def _thinned(vertices: np.ndarray, faces: np.ndarray) -> Triangles:
    """Return a mesh with few triangles: corners in one cell of a grid become their mean."""
    cell = VISUAL.first_cell
    thin_vertices = vertices
    thin_faces = faces
    while len(thin_faces) > VISUAL.most_faces:
        cells = np.floor(vertices / cell).astype(np.int64)
        _, owner = np.unique(cells, axis=0, return_inverse=True)
        owner = owner.reshape(-1)
        counts = np.bincount(owner)[:, None]
        sums = [np.bincount(owner, vertices[:, k]) for k in range(3)]
        thin_vertices = np.stack(sums, 1) / counts
        joined = owner[faces]
        a, b, c = joined.T
        joined = joined[(a != b) & (b != c) & (c != a)]
        # two layers that were joined leave triangles that lie on each other
        _, first = np.unique(np.sort(joined, 1), axis=0, return_index=True)
        thin_faces = joined[np.sort(first)]
        cell *= VISUAL.growth
    return thin_vertices, thin_faces
