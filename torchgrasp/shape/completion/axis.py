"""An axis of revolution of any direction: the line that the normals of most points meet.

The lines along the normals of a surface of revolution meet its axis: they lie in a linear line complex of pitch 0
(Pottmann and Wallner, Computational Line Geometry, 2001). A miss, moment times direction, is linear in each of the two.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.geometry.frames import apply, inverse, rigid, rotate
from torchgrasp.geometry.linalg import farthest_points, fibonacci_sphere, unit
from torchgrasp.geometry.plane import LEAST_TILT
from torchgrasp.shape.completion.revolution import BODY_SHARE, ONE_WAY, Revolution, lines_from_above, split_body
from torchgrasp.shape.completion.silhouette import TIE, Outlines
from torchgrasp.shape.completion.symmetry import PROBES, SymmetryScorer

STARTS, ITERATIONS = 12, 12
"""Directions from which a fit starts, and its steps: with 60 and 40 the axes of 70 of 71 views are the same."""
HALF_WEIGHT, WIDE, NARROWING = 0.004, 0.02, 0.6
"""Miss [m] of half the weight in the end and at first, and by how much each step narrows what the first adds."""
MAX_TURN = 0.3
"""Greatest turn [rad] of one step: misses are linear in smaller ones."""
DAMPING = 1e-6
"""Relative damping of a step: a ball leaves the direction free, and a prism the place along a side."""
MAX_COST = 1.0
"""Greatest mean of log(1 + (miss / HALF_WEIGHT)^2): bodies with a handle have 0.8, without one 0.1 to 0.4."""
ROUNDNESS, ROUND_ERROR = 0.055, 0.0018
"""Usual miss of a body's normals, a share of the radius and an error [m]. In units of both its RMS is below 1 for
bodies of revolution from 8 to 45 mm radius; a tub and an oval tin have more (docs/shape.md)."""
TURNS = 12
"""Steps of a full turn at which the body is tried against free space."""
MAX_FREE, FREE = 0.12, 0.003
"""Share of the turned body that may lie this deep [m] in free space: bottles have 0.08, toys and tools from 0.13."""


def find_axis(scorer: SymmetryScorer) -> tuple[Float[Tensor, "4 4"], Revolution] | None:
    """Return the frame of an axis of revolution, and the body about its z axis; None: there is none.

    The frame is `axis_from_cloud`; its x axis points towards the cameras. The axis is fitted to the scorer's probes.
    Turned about it, those of the body must keep out of free space and of the table.

    >>> from torchgrasp.values import PointCloud
    >>> angle, along = torch.rand(2, 900, generator=torch.Generator().manual_seed(0)).double()
    >>> angle = 2.8 * angle - 1.4
    >>> normals = torch.stack([angle.cos(), 0 * angle, angle.sin()], 1)
    >>> points = 0.03 * normals + torch.stack([0 * angle, 0.12 * along, 0 * angle], 1)
    >>> seen = PointCloud(points, normals, torch.tensor([0.5, 0.06, 0.0]).double())
    >>> axis_from_cloud, body = find_axis(SymmetryScorer.of(seen, None))
    >>> [round(abs(float(x)), 2) for x in axis_from_cloud[2, :3]]
    [0.0, 1.0, 0.0]
    """
    center, direction, cost = _fit_axis(scorer.probes, scorer.probe_normals)
    if not cost < MAX_COST:
        return None
    axis_from_cloud = _frame(center, direction, scorer.outline)
    points = apply(axis_from_cloud, scorer.points)
    lines = lines_from_above(points, rotate(axis_from_cloud, scorer.normals))
    origin = torch.zeros(2, dtype=torch.float64)
    body = split_body(points, lines, origin)
    allowed = torch.hypot(ROUNDNESS * body.typical, torch.full_like(body.typical, ROUND_ERROR))
    rms = (body.miss / allowed)[body.side].square().mean().sqrt()
    if not bool((body.mask.double().mean() > BODY_SHARE) & (rms < 1.0) & (body.one_way < ONE_WAY)):
        return None
    spread = farthest_points(points[body.mask], PROBES, tie=TIE)
    turned = apply(inverse(axis_from_cloud), _turn(points[body.mask][spread]))
    excluded = scorer.outline.violation(turned) > FREE
    if scorer.table is not None:
        excluded |= scorer.table.height(turned) < -FREE
    return (axis_from_cloud, Revolution(origin, body.mask)) if excluded.double().mean() < MAX_FREE else None


def _fit_axis(
    points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"], float]:
    """Return a point of the axis [m] that most lines along the normals meet, its direction and its cost.

    Gauss-Newton steps with weights (Cauchy) from several directions at once. A line along the axis misses by less than
    its distance, and parallel ones not at all.
    """
    direction = fibonacci_sphere(2 * STARTS)[:STARTS]
    center, cost = points.mean(0).expand_as(direction), torch.zeros(STARTS, dtype=torch.float64)
    for step in range(ITERATIONS):
        across = torch.stack(_across(direction), 1)
        arm = points - center[:, None]
        moment = torch.linalg.cross(arm, normals.expand_as(arm))
        miss = (moment * direction[:, None]).sum(-1)
        lever = torch.linalg.cross(direction[:, None].expand_as(arm), normals.expand_as(arm))
        slope = torch.cat([lever @ across.mT, moment @ across.mT], 2)
        scale = HALF_WEIGHT + (WIDE - HALF_WEIGHT) * NARROWING**step
        weighted = slope / (1.0 + (miss / scale) ** 2)[..., None]
        system = slope.mT @ weighted
        system = system + DAMPING * torch.diag_embed(system.diagonal(dim1=1, dim2=2).clamp_min(1e-9))
        found = -torch.linalg.solve(system, (weighted * miss[..., None]).sum(1))
        length = torch.linalg.vector_norm(found[:, 2:], dim=1, keepdim=True)
        turn = found[:, 2:] * (MAX_TURN / length.clamp_min(MAX_TURN))
        center = center + (found[:, None, :2] @ across)[:, 0]
        direction = unit(direction + (turn[:, None] @ across)[:, 0])
        center = center + ((points.mean(0) - center) * direction).sum(1, keepdim=True) * direction
        cost = torch.log1p((miss / HALF_WEIGHT) ** 2).mean(1)
    best = int(cost.argmin())
    return center[best], direction[best], float(cost[best])


def _across(direction: Float[Tensor, "*b 3"]) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b 3"]]:
    """Return two unit vectors at right angles to each direction and to each other."""
    helper = torch.zeros_like(direction).scatter(-1, direction.abs().argmin(-1, keepdim=True), 1.0)
    first = unit(torch.linalg.cross(direction, helper))
    return first, torch.linalg.cross(direction, first)


def _frame(center: Float[Tensor, "3"], direction: Float[Tensor, "3"], outline: Outlines) -> Float[Tensor, "4 4"]:
    """Return `axis_from_cloud`, with x towards the cameras unless they look along the axis."""
    eye = torch.stack([view.viewpoint for view in outline.views]).mean(0) - center
    level = eye - (eye @ direction) * direction
    length = torch.linalg.vector_norm(level)
    x = level / length if length > LEAST_TILT * torch.linalg.vector_norm(eye) else _across(direction)[0]
    rotation = torch.stack([x, torch.linalg.cross(direction, x), direction])
    return rigid(rotation, -rotation @ center)


def _turn(points: Float[Tensor, "n 3"]) -> Float[Tensor, "m 3"]:
    """Return points turned about z, at each step of a turn but none."""
    angle = 2 * math.pi / TURNS * torch.arange(1, TURNS, dtype=torch.float64)
    x, y, z = points.unbind(1)
    cos, sin = angle.cos()[:, None], angle.sin()[:, None]
    return torch.stack([cos * x - sin * y, sin * x + cos * y, z.expand(len(angle), -1)], -1).reshape(-1, 3)
