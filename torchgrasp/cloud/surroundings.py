"""Points of a table that were left around an object in its cloud."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.neighbours import draw_rows
from torchgrasp.foundation.lazy import spatial
from torchgrasp.geometry.linalg import Points, across, dot
from torchgrasp.geometry.plane import Plane


@dataclasses.dataclass(frozen=True)
class SurroundingNumbers:
    """Bounds by which points are those of a table around an object."""

    layer: float = 0.004
    """Half thickness [m] of a table's layer: a depth camera's noise at half a metre."""
    risen: float = 0.015
    """Least height [m] above the table of points that count as the object's."""
    fewest: int = 20
    """Least number of the object's points (`risen`), and least number of points on the table."""
    beyond: float = 0.02
    """Distance [m] from the object's outline, seen from above, beyond which points on the table
    count. A foot is hardly wider than the rest.
    """
    share: float = 0.1
    """Least share of all points that are on the table and farther than `beyond` from the outline.
    """
    beside: float = 0.01
    """Distance [m] from the outline beyond which points of a mask on the table are told. Borders of
    masks err by less.
    """
    strip: float = 0.05
    """Least share of all points of the mask that are on the table and farther than `beside` from
    the outline.
    """
    sectors: int = 12
    """Number of equal sectors around the object, seen from above."""
    sides: float = 0.55
    """Least share of the sectors with points of the table: the object hides some, and legs
    lie on fewer.
    """
    planes: int = 64
    """Number of planes, each through one point, that are tried where the table is unknown."""
    fits: int = 3
    """Number of fits of the best of the tried planes (`planes`), each to the points near it."""
    below: float = 0.02
    """Greatest share of points clearly below a tried plane (`planes`): below a table nothing is
    seen.
    """


SURROUNDINGS = SurroundingNumbers()


def find_surroundings(points: Points, normals: Points, table: Plane | None) -> float:
    """Return the share of points that are those of a table around an object; 0 if there is none.

    These points lie on the table, over 20 mm from the object's outline, and on most of its sides.
    The `normals` (n, 3) of the points (n, 3) [m] face the camera. The `table` is in the frame of
    the points. None means unknown: planes with many of the points are tried.
    """
    points = points.double().cpu()
    if table is not None:
        return _share_around(points, table)
    return _share_around_some(points, normals.double().cpu())


def tell_strip(points: Points, table: Plane) -> tuple[str, ...]:
    """Return one note, a sentence, if many points of a mask lie on the table beside the object,
    else none. Many are at least 5 % (`SURROUNDINGS.strip`).

    A mask from a colour image that is not aligned with the depth has such points. `points` (n, 3)
    [m] and the `table` are in one frame.
    """
    share = len(_beside(points, table, SURROUNDINGS.beside)) / len(points)
    if share < SURROUNDINGS.strip:
        return ()
    found = f"mask: {share:.0%} of its points lie on the table beside the object"
    return (f"{found}: unless they are a thin part of it, align the mask with the depth image",)


def _beside(points: Points, table: Plane, least: float) -> Float[Tensor, "k 2"]:
    """Return where points (n, 3) [m] on a table lie that are farther than `least` [m] from the
    object's outline. The places [m] are in the table's plane, seen from the middle of the object.
    """
    height = table.height(points)
    on = points[height.abs() < SURROUNDINGS.layer]
    risen = points[height > SURROUNDINGS.risen]
    if min(len(on), len(risen)) < SURROUNDINGS.fewest:
        return points.new_zeros(0, 2)
    axes = torch.stack(across(table.normal.to(points)), -1)  # (3, 2)
    # seen from above: the convex outline of the object
    outline = spatial.ConvexHull((risen @ axes).numpy(), qhull_options="QJ")
    sides = torch.from_numpy(outline.equations).to(points)  # (k, 3)
    flat = on @ axes
    outside = (flat @ sides[:, :2].T + sides[:, 2]).amax(1)
    return flat[outside > least] - (risen @ axes).mean(0)


def _share_around(points: Points, table: Plane) -> float:
    """Return the share of points (n, 3) [m] on a table around an object; 0 if they do not surround
    it.
    """
    far = _beside(points, table, SURROUNDINGS.beyond)
    share = len(far) / len(points)
    turn = torch.atan2(far[:, 1], far[:, 0]) / (2 * torch.pi) + 0.5
    sector = (turn * SURROUNDINGS.sectors).long().clamp_max(SURROUNDINGS.sectors - 1)
    seen = len(sector.unique()) / SURROUNDINGS.sectors
    return share if share >= SURROUNDINGS.share and seen >= SURROUNDINGS.sides else 0.0


def _share_around_some(points: Points, normals: Points) -> float:
    """Return the share of points (n, 3) [m] on the plane with most of them, if it is a table around
    an object.

    The object rises from it towards the camera, which the `normals` (n, 3) face. Else the result is
    0.
    """
    rows = draw_rows(len(points), SURROUNDINGS.planes)
    normal = normals[rows]  # (m, 3)
    height = points @ normal.T - dot(normal, points[rows])  # (n, m)
    # nothing is seen below a table: this leaves out the sides of objects
    allowed = _share_below(height) <= SURROUNDINGS.below
    count = torch.where(allowed, (height.abs() < SURROUNDINGS.layer).sum(0), 0)
    best = int(count.argmax())
    plane = Plane(normal[best], float(normal[best] @ points[rows[best]]))
    for _ in range(SURROUNDINGS.fits):
        layer = plane.height(points).abs() < SURROUNDINGS.layer
        if int(layer.sum()) < SURROUNDINGS.fewest:
            return 0.0
        plane = _fit(points[layer], normal[best])
    below = _share_below(plane.height(points))
    return _share_around(points, plane) if below <= SURROUNDINGS.below else 0.0


def _share_below(height: Float[Tensor, "n *m"]) -> Float[Tensor, "*m"]:
    """Return the share of n heights [m] that are clearly below 0, for each of m planes."""
    return (height < -SURROUNDINGS.risen).double().mean(0)


def _fit(points: Points, towards: Float[Tensor, "3"]) -> Plane:
    """Return the plane through points (n, 3) [m] whose normal is on the side of `towards`."""
    middle = points.mean(0)
    normal = torch.linalg.svd(points - middle, full_matrices=False).Vh[2]
    normal = torch.where(normal @ towards < 0, -normal, normal)
    return Plane(normal, float(normal @ middle))
