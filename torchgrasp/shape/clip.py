"""Triangle meshes cut along the zero level of a field."""

import numpy as np


def clip_mesh(vertices: np.ndarray, faces: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the part of a mesh on which a field is negative, and which vertices the cut made.

    Triangles that the zero level crosses are cut along it, the field taken as linear in each.

    Args:
        vertices: of shape (v, 3).
        faces: of shape (f, 3).
        values: the field at the vertices (v,).

    >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> kept, faces, cut = clip_mesh(corners, np.array([[0, 1, 2]]), np.array([-1.0, 1, -1]))
    >>> sorted(kept[cut].tolist()), len(faces)
    ([[0.5, 0.0, 0.0], [0.5, 0.5, 0.0]], 2)
    """
    keep = values < 0
    count = keep[faces].sum(1)
    pieces = [faces[count == 3]]
    made: dict[tuple[int, int], int] = {}
    ends: list[tuple[int, int]] = []

    def cross(a: int, b: int) -> int:
        """Return the vertex at which the field vanishes on a side."""
        key = (min(a, b), max(a, b))
        if key not in made:
            made[key] = len(vertices) + len(ends)
            ends.append(key)
        return made[key]

    for face in faces[(count == 1) | (count == 2)]:
        inside = keep[face]
        lone = int(np.argmax(inside) if inside.sum() == 1 else np.argmin(inside))
        a, b, c = (int(face[(lone + k) % 3]) for k in range(3))  # the winding stays
        ab, ac = cross(a, b), cross(a, c)
        pieces.append(np.array([[a, ab, ac]] if inside.sum() == 1 else [[ab, b, c], [ab, c, ac]]))
    index = np.array(ends, dtype=np.int64).reshape(-1, 2)
    start, end = values[index[:, 0]], values[index[:, 1]]
    share = (start / (start - end))[:, None]
    crossings = (1 - share) * vertices[index[:, 0]] + share * vertices[index[:, 1]]
    every = np.concatenate([vertices, crossings])
    used, faces = np.unique(np.concatenate(pieces), return_inverse=True)
    return every[used], faces.reshape(-1, 3), used >= len(vertices)
