"""Depth images whose numbers are no depths: distances along rays, or inverse depths.

With right depths, a table is flat. Distances along rays bend it, and so do inverse depths, such as
disparities. So the numbers are compared with the depths that they would mean.
"""

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.geometry.linalg import Points, unit


@dataclasses.dataclass(frozen=True)
class RayNumbers:
    """Parameters of the test whether depths are distances from the camera along its rays, or
    inverse depths.
    """

    near: float = 0.005
    """Greatest distance [m] from a plane of points that count as on it."""
    drawn: int = 5000
    """Number of points, about, to which planes are fitted."""
    patches: int = 4
    """Number of patches along a side of the image; in each, the search for a plane starts."""
    fewest: int = 20
    """Least number of points to which a plane is fitted."""
    fits: int = 4
    """Number of fits, each to the points near the plane of the fit before."""
    better: float = 1.3
    """Least ratio of two shares of points on one plane, at which a note is given. The first share
    is that with the depths read as distances or inverse depths. The second is that with the depths
    as they are.
    """


RAYS = RayNumbers()


def unproject(
    depth: Float[Tensor, "*b"], intrinsics: Float[Tensor, "3 3"], row: Tensor, column: Tensor
) -> Float[Tensor, "*b 3"]:
    """Return the points [m], in the camera's frame, of pixels at depths [m].

    `intrinsics` are in pixels. `row` and `column` are those of the pixels; they broadcast with
    `depth`.
    """
    k = intrinsics
    x = depth * (column - k[0, 2]) / k[0, 0]
    y = depth * (row - k[1, 2]) / k[1, 1]
    return torch.stack([x, y, depth], -1)


def tell_rays(depth: Float[Tensor, "h w"], intrinsics: Float[Tensor, "3 3"]) -> tuple[str, ...]:
    """Return one note, a sentence, if depths (h, w) [m] are perhaps distances along the rays, or
    inverse depths; else none.

    Read as such, they would put over 1.3 times as many points (`RAYS.better`) into one plane. The
    `intrinsics` are in pixels, and depths of 0 are not measured.
    """
    row, column = torch.nonzero(depth > 0, as_tuple=True)
    step = 1 + len(row) // RAYS.drawn
    row = row[::step]
    column = column[::step]
    z = depth[row, column].double()
    if not len(z):
        return ()
    k = intrinsics.double()
    rays = unproject(torch.ones_like(z), k, row, column)  # at a depth of 1 m
    height, width = depth.shape
    patch = row * RAYS.patches // height * RAYS.patches + column * RAYS.patches // width
    # of few points, no share is known
    least = RAYS.better * _share_flat(z[:, None] * rays, patch)
    along = _share_flat(z[:, None] * unit(rays), patch)
    # an inverse depth has any scale: the median stays
    inverse = _share_flat((z.median().square() / z)[:, None] * rays, patch)
    if along <= least and inverse <= least:
        return ()
    if inverse > along:
        found = "the support is flat if the numbers are inverse depths, such as disparities"
        return (f"{found}: then give the depth, focal length * baseline / disparity",)
    found = "the support is flat if the depth is the distance along the ray of each pixel"
    fix = "the depth along the optical axis, distance / sqrt(1 + ((u-cx)/fx)^2 + ((v-cy)/fy)^2)"
    return (f"{found}: then give {fix}",)


def _share_flat(points: Points, patch: Int[Tensor, "n"]) -> float:
    """Return the greatest share of `points` (n, 3) [m] in one plane; 0 if no patch has enough.

    A plane is fitted to each patch of the image, then to all points near it.
    """
    best = 0.0
    for one in patch.unique().tolist():
        part = patch == one
        for _ in range(RAYS.fits):
            if int(part.sum()) < RAYS.fewest:
                break
            middle = points[part].mean(0)
            normal = torch.linalg.svd(points[part] - middle, full_matrices=False).Vh[2]
            part = ((points - middle) @ normal).abs() < RAYS.near
            best = max(best, float(part.double().mean()))
    return best
