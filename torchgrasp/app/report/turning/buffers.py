"""Arrays as text that a page can read, and meshes thinned to what a page can hold."""

import base64

import numpy as np
from jaxtyping import Float, Int

KINDS = {"f4": "<f4", "u4": "<u4", "u1": "|u1"}
"""Numbers of a buffer, little-endian as browsers read them; one step of a float32 is 10 nm at 0.1 m."""


def pack(values: np.ndarray, kind: str = "f4") -> dict[str, object]:
    """Return an array as a buffer: its kind, its shape and its bytes as text.

    >>> pack(np.array([[1, 2]]), "u1")
    {'kind': 'u1', 'shape': [1, 2], 'data': 'AQI='}
    """
    data = np.ascontiguousarray(values).astype(KINDS[kind]).tobytes()
    return {"kind": kind, "shape": list(values.shape), "data": base64.b64encode(data).decode("ascii")}


def unpack(buffer: dict) -> np.ndarray:
    """Return the array of a buffer.

    >>> unpack(pack(np.array([0.5, -1.0]))).tolist()
    [0.5, -1.0]
    """
    data = np.frombuffer(base64.b64decode(buffer["data"]), KINDS[buffer["kind"]])
    return data.reshape(buffer["shape"])


def thin_mesh(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], most: int
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, "g 3"]]:
    """Return which vertices to keep, and faces between those, at most so many.

    The vertices of a cell of a grid become its first one; the cells grow until the faces are few enough.
    """
    kept, thinned = np.arange(len(vertices)), faces
    cell = float(np.linalg.norm(np.ptp(vertices, axis=0))) / 256 if len(vertices) else 0.0
    while len(thinned) > most:
        _, kept, group = np.unique(np.round(vertices / cell), axis=0, return_index=True, return_inverse=True)
        thinned = group.reshape(-1)[faces]
        a, b, c = thinned.T
        thinned = thinned[(a != b) & (b != c) & (c != a)]
        cell *= 1.2
    return kept, thinned


def thin_rows(count: int, most: int) -> Int[np.ndarray, " k"]:
    """Return at most so many rows, evenly from the first to the last.

    >>> thin_rows(5, 3).tolist(), thin_rows(2, 3).tolist()
    ([0, 2, 4], [0, 1])
    """
    return np.arange(count) if count <= most else np.round(np.linspace(0, count - 1, most)).astype(np.int64)
