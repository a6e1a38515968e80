"""Linear algebra: vectors, Cholesky factors, Mahalanobis distances, farthest points and
reflections.

Cholesky factors are checked, but a matrix is never repaired. The functions work in any unit of
length. Vectors have d numbers along the last axis; leading axes are those of batches, which
broadcast.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from torchgrasp.foundation.errors import BadArgument, IndefiniteCovariance
from torchgrasp.foundation.fused import is_fused
from torchgrasp.foundation.lazy import sparse
from torchgrasp.foundation.rules import is_known

Points = Float[Tensor, "n 3"]
Vector = Float[Tensor, "3"]
# largest difference of a given unit vector's length from 1: what rounding in a text file leaves
UNIT_TOLERANCE = 1e-3
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))  # golden section of the full circle [rad]


def norm(v: Float[Tensor, "*b d"], keepdim: bool = False) -> Float[Tensor, "*c"]:
    """Return the Euclidean lengths of vectors along the last axis, in the unit of the vectors.
    `keepdim` keeps this axis with size 1.
    """
    return torch.linalg.vector_norm(v, dim=-1, keepdim=keepdim)


def check_unit_vectors(name: str, vectors: Float[Tensor, "*b d"]) -> None:
    """Raise `BadArgument` if the length of a vector differs from 1 by more than 0.001
    (`UNIT_TOLERANCE`). The error calls the vectors `name`. NaN is accepted.
    """
    length = norm(vectors).flatten()
    off = (length - 1).abs().nan_to_num(0.0, posinf=torch.inf)
    if (off > UNIT_TOLERANCE).any():
        raise BadArgument(
            name, f"a vector of length {float(length[off.argmax()]):.6g}", "unit vectors"
        )


def dot(
    a: Float[Tensor, "*b d"], b: Float[Tensor, "*c d"], keepdim: bool = False
) -> Float[Tensor, "*e"]:
    """Return the dot products of vectors along the last axis. Other axes broadcast; `keepdim` keeps
    the last axis with size 1.
    """
    return (a * b).sum(-1, keepdim=keepdim)


def matvec(matrix: Float[Tensor, "*b m n"], v: Float[Tensor, "*c n"]) -> Float[Tensor, "*e m"]:
    """Return the products (m,) of matrices (m, n) and vectors `v` (n,). Leading batch axes
    broadcast.
    """
    return (matrix @ v[..., None])[..., 0]


def eye_like(n: int, like: Tensor) -> Float[Tensor, "n n"]:
    """Return the n x n identity matrix, with the dtype and device of the tensor `like`."""
    return torch.eye(n, dtype=like.dtype, device=like.device)


def unit(v: Float[Tensor, "*b d"]) -> Float[Tensor, "*b d"]:
    """Return unit vectors in the direction of the vectors `v` along the last axis.

    A zero vector gives NaN.
    """
    return v / norm(v, keepdim=True)


def unit_of_any(v: Float[Tensor, "*b d"]) -> Float[Tensor, "*b d"]:
    """Return unit vectors in the direction of vectors of any length.

    Unlike `unit`, it also works where squared lengths would overflow or underflow. A zero vector
    gives NaN.
    """
    exponent = torch.frexp(v.abs().amax(-1, keepdim=True)).exponent - 1
    # A power of two rounds nothing.
    power = torch.pow(torch.full_like(v[..., :1], 2.0), exponent)
    return unit(v / power)


def perpendicular(v: Float[Tensor, "*b 3"], axis: Float[Tensor, "*c 3"]) -> Float[Tensor, "*d 3"]:
    """Return the components of vectors `v` that are perpendicular to unit vectors `axis`. Batch
    axes broadcast.
    """
    return v - dot(v, axis, keepdim=True) * axis


def across(normal: Float[Tensor, "*b 3"]) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b 3"]]:
    """Return (first, second): two unit vectors perpendicular to each unit normal.

    The axes first, second and normal are a right-handed frame.
    """
    helper = torch.zeros_like(normal).scatter(-1, normal.abs().argmin(-1, keepdim=True), 1.0)
    first = unit(torch.linalg.cross(normal, helper))
    return first, torch.linalg.cross(normal, first)


def number_components(pairs: np.ndarray, count: int) -> np.ndarray:
    """Return the index (n,) of the connected component of each node of a graph, counted from 0.

    The graph has n = `count` nodes and the edges `pairs` (e, 2), which hold indices of nodes.
    """
    linked = np.ones(len(pairs), dtype=bool)
    links = sparse.coo_array((linked, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return sparse.csgraph.connected_components(links, directed=False)[1]


def number_rows(rows: Shaped[Tensor, "n d"]) -> Int[Tensor, "n"]:
    """Return the index (n,) of each of n rows in the list of distinct rows, in lexical order.

    `torch.unique` of whole rows takes much longer than that of one column after the other.
    """
    number = torch.zeros(len(rows), dtype=torch.int64, device=rows.device)
    if len(rows) and rows.dtype == torch.int64:
        ends = torch.stack(rows.aminmax(dim=0)).tolist()  # as whole numbers of any size
        sizes = [most - least + 1 for least, most in zip(*ends, strict=True)]
        if math.prod(sizes) <= torch.iinfo(torch.int64).max:  # one number tells each row
            for column, size in zip((rows - rows.amin(0)).T, sizes, strict=True):
                number = number * size + column
            return number.unique(return_inverse=True)[1]
    for column in rows.T:
        values, place = column.unique(return_inverse=True)
        pair = number * len(values) + place
        number = pair.unique(return_inverse=True)[1]
    return number


def number_cells(places: Float[Tensor, "n d"], side: float) -> Int[Tensor, "n"]:
    """Return the number, from 0, of the grid cell that holds each of n points.

    Only cells with points are numbered. `places` are the points (n, d), and cells are `side` wide,
    in their unit.
    """
    return number_rows(torch.floor(places / side).long())


def fibonacci_sphere(
    n: int, angle: float = math.pi * (1 + math.sqrt(5)), start: float = 0.5
) -> Float[Tensor, "n 3"]:
    """Return n unit vectors (n, 3) that a spiral spreads evenly over the sphere, from +z to -z.

    Vector k has the azimuth `angle` * (k + `start`) [rad].
    """
    k = torch.arange(n, dtype=torch.float64, device="cpu")
    z = 1 - (2 * k + 1) / n
    rotation = angle * (k + start)
    ring = torch.sqrt(1 - z * z)
    return torch.stack([ring * torch.cos(rotation), ring * torch.sin(rotation), z], -1)


def limit_norm(v: Float[Tensor, "*b d"], longest: float) -> Float[Tensor, "*b d"]:
    """Return vectors (*b, d), shortened to the length `longest` (in their own unit) where they are
    longer.
    """
    # a zero vector has no second derivative of its length, which does not count here
    moving = torch.where((v == 0).all(-1, keepdim=True), v.detach(), v)
    least = max(longest, torch.finfo(v.dtype).tiny)  # both lengths may be 0
    return v * (longest / norm(moving, keepdim=True).clamp_min(least))


def solve_least_squares(
    rows: Float[Tensor, "n k"], values: Float[Tensor, "n"]
) -> Float[Tensor, "k"]:
    """Return the shortest vector x that minimises |rows @ x - values|, by the pseudo-inverse.

    `rows` holds n equations for k unknowns, `values` their right sides.
    """
    # On a CPU the column pivots of torch.linalg.lstsq are undefined: its last digits differ from
    # call to call.
    return torch.linalg.pinv(rows) @ values


def cholesky(matrix: Float[Tensor, "*b n n"], what: str, fix: str) -> Float[Tensor, "*b n n"]:
    """Return the lower Cholesky factors of symmetric matrices, without added jitter.

    Raises `IndefiniteCovariance` for an indefinite matrix; the message calls it `what` and suggests
    the `fix`. Inside torch.vmap, where values are unknown, its factor is NaN instead.
    """
    factor, info = torch.linalg.cholesky_ex(matrix)
    if not is_known(matrix):
        return torch.where((info == 0)[..., None, None], factor, torch.nan)
    if not (info == 0).all() & torch.isfinite(factor).all():  # one wait for the device
        finite = bool(torch.isfinite(matrix).all())
        smallest = float(torch.linalg.eigvalsh(matrix).min()) if finite else float("nan")
        raise IndefiniteCovariance(what, smallest, fix)
    return factor


def squared_mahalanobis(
    difference: Float[Tensor, "*b d"], factor: Float[Tensor, "*b d d"]
) -> Float[Tensor, "*b"]:
    """Return the squared Mahalanobis distances x^T S^-1 x of difference vectors x (no unit).

    `factor` is the lower Cholesky factor of the covariance S.
    """
    whitened = torch.linalg.solve_triangular(factor, difference[..., None], upper=False)[..., 0]
    return (whitened * whitened).sum(-1)


def farthest_points(
    points: Float[Tensor, "n *d"],
    count: int,
    first: int = 0,
    tie: float = 0.0,
    distance: Callable[[Tensor, Tensor], Tensor] | None = None,
    before: Float[Tensor, "m *d"] | None = None,
) -> Int[Tensor, "picks"]:
    """Return the indices of `count` points, or of all if fewer, each the farthest from those before
    it.

    The choice begins with the point of the index `first`. Points count as equally far if their
    distance is at least (1 - `tie`) times the greatest one. The first of them is taken. Points in
    `before` count as already chosen and are not returned; with any of them, `first` is not used.
    `distance(points, one)` returns the distances (n,) of all points to one; None means the squared
    Euclidean distance.
    """
    every = points.detach().cpu()
    if distance is None and before is None and is_fused(every) and len(every):
        from torchgrasp.geometry import fused_points  # it imports numba

        rows = every.flatten(1).numpy()
        picks = fused_points.farthest(rows, min(count, len(every)), first, tie)
        return torch.from_numpy(picks).to(points.device)
    # NumPy is an order of magnitude faster than torch for few points.
    x = np.ascontiguousarray(every.numpy().T)

    def gaps(one: Tensor) -> np.ndarray:
        if distance is not None:
            return distance(every, one).numpy()
        off = x - one.numpy()[:, None]
        return np.einsum("in,in->n", off, off)

    picks = np.full(min(count, len(every)), first)
    nearest = np.full(len(every), np.inf, dtype=x.dtype)
    for one in every[:0] if before is None else before.detach().cpu():
        np.minimum(nearest, gaps(one), out=nearest)
    for k in range(0 if before is not None and len(before) else 1, len(picks)):
        if k:
            np.minimum(nearest, gaps(every[picks[k - 1]]), out=nearest)
        picks[k] = (nearest >= (1.0 - tie) * nearest.max()).argmax()  # the first of the largest
    return torch.from_numpy(picks).to(points.device)


def reflect(points: Float[Tensor, "*b 3"], plane: Float[Tensor, "*c 4"]) -> Float[Tensor, "*d 3"]:
    """Return points mirrored across planes n . x = o, given as vectors (n, o).

    n is a unit normal (3), and o the offset in the unit of the points. Batch axes broadcast.
    """
    height = (points * plane[..., :3]).sum(-1, keepdim=True) - plane[..., 3:]
    return points - 2.0 * height * plane[..., :3]


def reflect_directions(
    directions: Float[Tensor, "*b 3"], plane: Float[Tensor, "*c 4"]
) -> Float[Tensor, "*d 3"]:
    """Return directions mirrored across planes n . x = o, given as vectors (n, o).

    n is a unit normal (3); the offset o is not used. Batch axes broadcast.
    """
    return directions - 2.0 * (directions * plane[..., :3]).sum(-1, keepdim=True) * plane[..., :3]
