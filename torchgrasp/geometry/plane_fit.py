"""Planes that hold many points of a view: triples of points propose planes, robust least squares
refines them.
"""

import dataclasses
import math
from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.lazy import spatial
from torchgrasp.geometry.linalg import Points, Vector

NOISE = 0.001
NOISE_GROWTH = 0.0035
"""Assumed noise [m] of a depth camera, and its growth with the squared distance [1/m]."""
ROUGH = 2.5  # a greater scale of the residuals, over the assumed noise, belongs to no flat plane
LEAST_SHARE = 0.05  # least share of the points on a plane
REACH = 0.30  # height [m] of objects above a plane
MOST_TILT = 30.0  # greatest angle [deg] between the normal and `up`


def assume_noise(
    points: Float[Tensor, "n 3"], eye: Float[Tensor, "3"] | None
) -> Float[Tensor, "n"]:
    """Return the assumed noise [m] of each point. If the camera is unknown, its distance is taken
    as 0.7 m.
    """
    squared = torch.full((len(points),), 0.7**2, dtype=points.dtype, device="cpu")
    return NOISE + NOISE_GROWTH * (squared if eye is None else (points - eye).square().sum(-1))


class SeenPoints:
    """One view: points [m] about their centre, their noise [m], camera position `eye`, upward
    direction `sky`.
    """

    def __init__(self, points: Points, eye: Vector | None, sky: Vector | None) -> None:
        self.points = points
        self.eye = eye
        self.sky = sky
        self.noise = assume_noise(points, eye)


@dataclasses.dataclass(frozen=True)
class PlaneFit:
    """A plane normal . p = offset [m] that holds `count` points; `scale` is the ratio of measured
    to assumed noise.
    """

    normal: Float[Tensor, "3"]
    offset: float
    scale: float
    count: int

    def turned_up(self, view: "SeenPoints") -> "PlaneFit":
        """Return the plane with its normal turned up, else towards the camera, else to the side
        with most points.
        """
        if view.sky is not None:
            side = float(self.normal @ view.sky)
        elif view.eye is not None:
            side = float(self.normal @ view.eye) - self.offset
        else:
            side = float((view.points @ self.normal - self.offset).clamp(-REACH, REACH).sum())
        return (
            self
            if side >= 0
            else dataclasses.replace(self, normal=-self.normal, offset=-self.offset)
        )


def fit_planes(view: SeenPoints, generator: torch.Generator) -> Iterator[PlaneFit]:
    """Yield at most 8 planes, each with the most points that lie on no plane before it."""
    scored = 2000  # points that score the proposals
    points = view.points[:scored]
    noise = view.noise[:scored]
    normals, offsets = _propose(view, scored, generator)
    held = _held(points, noise, normals, offsets)
    left = torch.ones(len(points), device="cpu")
    for _ in range(8 if len(held) else 0):
        counts = held @ left
        i = int(counts.argmax())
        if int(counts[i]) < 0.5 * LEAST_SHARE * len(points):
            break
        fit = _refine(view, normals[i], float(offsets[i]))
        yield fit
        left = left * ((points @ fit.normal - fit.offset).abs() > 3 * noise) * (1 - held[i])


def _propose(
    view: SeenPoints, scored: int, generator: torch.Generator
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m"]]:
    """Return unit normals and offsets [m] of planes through random triples of points, distant or
    neighbouring.
    """
    points = view.points
    some = points[:scored]
    near = torch.from_numpy(spatial.KDTree(some.numpy()).query(some.numpy(), min(60, len(some)))[1])
    pick = torch.randint(near.shape[1], (2, len(some), 1), generator=generator, device="cpu")
    far = points[torch.randint(len(points), (3, 4000), generator=generator, device="cpu")]
    a, b, c = torch.cat(
        [far, torch.stack([some, *(some[near.gather(1, k)[:, 0]] for k in pick)])], 1
    )
    normal = torch.linalg.cross(b - a, c - a)
    double_area = torch.linalg.vector_norm(normal, dim=-1)
    longest = torch.stack([(b - a).norm(dim=-1), (c - a).norm(dim=-1), (c - b).norm(dim=-1)]).amax(
        0
    )
    wide = (
        double_area / longest.clamp_min(1e-12) > 10 * view.noise.median()
    )  # a lower triangle's normal is noise
    normal = normal[wide] / double_area[wide, None]
    offset = (normal * a[wide]).sum(-1)
    if view.sky is not None:
        upright = (normal @ view.sky).abs() > math.cos(math.radians(MOST_TILT + 5.0))
        normal = normal[upright]
        offset = offset[upright]
    return normal, offset


def _held(
    points: Float[Tensor, "n 3"],
    noise: Float[Tensor, "n"],
    normals: Float[Tensor, "m 3"],
    offsets: Float[Tensor, "m"],
) -> Float[Tensor, "m n"]:
    """Return a matrix of planes by points: 1 if the point is within twice its noise of the plane,
    else 0.
    """
    held = torch.empty(len(normals), len(points), device="cpu")
    for rows in torch.arange(len(normals), device="cpu").split(500):
        held[rows] = ((normals[rows] @ points.T - offsets[rows, None]).abs_() < 2 * noise).float()
    return held


def _refine(view: SeenPoints, normal: Float[Tensor, "3"], offset: float) -> PlaneFit:
    """Refine a plane by iterated least squares with Tukey's weights, which change smoothly with the
    points.
    """
    points = view.points
    noise = view.noise
    scale = 1.0
    for _ in range(30):
        ratio = (points @ normal - offset) / noise
        core = ratio.abs() < 3 * scale
        scale = (
            min(max(float(3.14 * ratio[core].abs().quantile(0.25)), 0.2), ROUGH)
            if bool(core.any())
            else scale
        )
        weight = (1 - (ratio / (4.685 * scale)).square()).clamp_min(0).square() / noise.square()
        weight = weight / weight.sum()
        mean = weight @ points
        offset_points = points - mean
        spread = offset_points.T @ (weight[:, None] * offset_points)
        turned = torch.linalg.eigh(spread).eigenvectors[:, 0]
        turned = turned if float(turned @ normal) > 0 else -turned
        moved = float(mean @ turned)
        change = float((turned - normal).abs().max()) + abs(moved - offset)
        normal = turned
        offset = moved
        if change < 1e-12:
            break
    on = ((points @ normal - offset).abs() / noise) < 3 * scale
    return PlaneFit(normal, offset, scale, int(on.sum()))
