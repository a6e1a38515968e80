"""The camera of a view whose pixels were kept: seen from there, the points form a regular lattice.

Noise and steps of depth move a point along its ray. So the lattice stays regular however noisy the
view is. Clouds that were resampled, averaged or thinned at random show none.
"""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.neighbours import draw_rows, fit_local_planes, nearest
from torchgrasp.geometry.linalg import Points, Vector, across, fibonacci_sphere, matvec, norm, unit


@dataclasses.dataclass(frozen=True)
class PixelNumbers:
    """Parameters of the search for the camera from which a cloud is regular.

    The irregularity of a camera is the mean deviation of the angles between neighbouring pixels
    from their median. It is divided by the median. It is about 0 for a lattice, and a third for
    random points.
    """

    least: int = 100
    """Least number of points that show a lattice: few may be regular by chance."""
    probes: int = 500
    """Greatest number of points at which the irregularity is taken."""
    neighbours: int = 12
    """Number of nearest points of each probe, as the noise of depth moves true neighbours apart."""
    directions: int = 800
    """Number of directions, over a whole sphere, that are tried first; they are about 7 degrees
    apart.
    """
    above: float = 0.1
    """Least cosine between the direction of a camera and the upward one, as a camera is above the
    support.
    """
    usual: float = 0.6
    """Usual distance [m] of a camera, at which the search begins."""
    rare: float = 0.5
    """Share by which the irregularity counts as greater at e or 1 / e times the distance `usual`.
    Small things hardly show how far the camera is.
    """
    starts: int = 2
    """Number of the best directions that are refined together."""
    steps: int = 12
    """Number of refinements; each tries a grid of 27 cameras about each of the best."""
    narrow: float = 0.5
    """Width of a grid of cameras, as a share of that of the first, below which only the best start
    is refined.
    """
    narrowing: float = 0.65
    """Ratio of the width of a grid to that of the grid before."""
    turn: float = 0.1
    """Half width of the first grid [rad] across the direction."""
    stretch: float = 0.5
    """Half width of the first grid in the logarithm of the distance."""
    promising: float = 0.2
    """Irregularity of the best direction from which on the search is not worth while."""
    regular: float = 0.12
    """Greatest irregularity of a lattice, of which half the pixels may be missing."""
    error: float = 3.0
    """Angle [deg] within which the camera of a lattice is likely."""
    block: int = 64
    """Number of cameras that are compared at once, which bounds the memory."""


PIXELS = PixelNumbers()


def find_pixel_camera(points: Points, up: Vector | None = None) -> Vector | None:
    """Return the camera position (3,) [m] from which points form a regular lattice of pixels.

    The points (n, 3) [m] and the result are in one frame. It is None without such a position,
    or for fewer than 100 points (`PIXELS.least`). From the opposite side, the points form nearly
    the same lattice. So only cameras on the side of the vector `up` are tried. If `up` is None, the
    side is the one to which the surface bulges. The origin is tried first: there is the camera if
    the points are in its frame.
    """
    if len(points) < PIXELS.least:
        return None
    points = points.double()
    rows = draw_rows(len(points), PIXELS.probes).to(points.device)
    index = nearest(points, PIXELS.neighbours + 1, rows)[1]
    probes = points[rows]
    near = points[index[:, 1:]]  # (m, k, 3)
    centre = (points.amax(0) + points.amin(0)) / 2
    origin = torch.zeros_like(centre)
    if float(irregularity(probes, near, origin[None])) < PIXELS.regular:
        return origin
    if up is None:
        normals = fit_local_planes(points, rows)[0]
        # either sign of a normal gives the same
        up = unit((((probes - centre) * normals).sum(1, keepdim=True) * normals).sum(0))
    directions = fibonacci_sphere(PIXELS.directions).to(points)
    directions = directions[directions @ up.to(points) > PIXELS.above]
    eyes = centre + PIXELS.usual * directions
    score = irregularity(probes, near, eyes)
    if not (score < PIXELS.promising).any():
        return None
    best = torch.topk(score, min(PIXELS.starts, len(score)), largest=False).indices
    eye, least = _refine(probes, near, centre, eyes[best])
    return eye if least < PIXELS.regular else None


def is_lattice(points: Points, eye: Vector) -> bool:
    """Return whether points (n, 3) [m] form a regular lattice of pixels as seen from `eye` (3,) [m].

    It is False for fewer than 100 points (`PIXELS.least`).
    """
    if len(points) < PIXELS.least:
        return False
    rows = draw_rows(len(points), PIXELS.probes)
    near = points[nearest(points, PIXELS.neighbours + 1, rows)[1][:, 1:]]
    return float(irregularity(points[rows], near, eye[None])) < PIXELS.regular


def irregularity(
    probes: Float[Tensor, "m 3"], near: Float[Tensor, "m k 3"], eyes: Float[Tensor, "c 3"]
) -> Float[Tensor, "c"]:
    """Return how irregularly a cloud's points are spaced as seen from each of c camera positions.

    It has no unit. It is the mean deviation of the angles between neighbouring points from their
    median, divided by this median. So it is about 0 for a regular lattice of pixels. `probes` are m
    points [m], and `near` the k nearest points of each. The positions `eyes` [m] are in the same
    frame.
    """
    found = list[Tensor]()
    for some in eyes.split(PIXELS.block):
        ray = unit(probes - some[:, None])  # (b, m, 3)
        other = unit(near - some[:, None, None])  # (b, m, k, 3)
        # the square of the chord, which is an angle where it is small
        apart = 2 - 2 * matvec(other, ray)
        angle = apart.clamp_min(0.0).amin(-1).sqrt()
        usual = angle.median(1, keepdim=True).values
        found.append(((angle - usual).abs() / usual).mean(1))
    return torch.cat(found).nan_to_num(torch.inf)


def _refine(
    probes: Float[Tensor, "m 3"],
    near: Float[Tensor, "m k 3"],
    centre: Vector,
    eyes: Float[Tensor, "s 3"],
) -> tuple[Vector, float]:
    """Return the camera near one of the `eyes` [m] with the most regular pixels, and its
    irregularity.
    """
    side = torch.linspace(-1.0, 1.0, 3).to(eyes)
    grid = torch.cartesian_prod(side, side, side)  # (27, 3)
    width = 1.0
    score = eyes.new_zeros(len(eyes))
    for _ in range(PIXELS.steps):
        away = eyes - centre
        distance = norm(away)
        forward = away / distance[:, None]
        aside = torch.stack(across(forward), 1)  # (s, 2, 3)
        turned = forward[:, None] + PIXELS.turn * width * (grid[:, :2] @ aside)  # (s, 27, 3)
        far = distance[:, None] * torch.exp(PIXELS.stretch * width * grid[:, 2])  # (s, 27)
        tried = centre + far[..., None] * unit(turned)
        score = irregularity(probes, near, tried.flatten(0, 1)).reshape(far.shape)
        counted = score * (1 + PIXELS.rare * torch.log(far / PIXELS.usual) ** 2)
        best = counted.argmin(1, keepdim=True)
        eyes = torch.take_along_dim(tried, best[..., None], 1)[:, 0]
        score = torch.take_along_dim(score, best, 1)[:, 0]
        if width < PIXELS.narrow:
            first = torch.take_along_dim(counted, best, 1)[:, 0].argmin()
            eyes = eyes[first][None]
            score = score[first][None]
        width *= PIXELS.narrowing
    return eyes[0], float(score[0])
