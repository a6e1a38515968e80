"""A guess of where the camera of a view was, and a test whether a camera can have been at a place."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.neighbours import draw_rows, nearest
from torchgrasp.foundation.errors import NoSupport
from torchgrasp.foundation.lazy import spatial
from torchgrasp.geometry.linalg import Points, Vector, fibonacci_sphere, unit
from torchgrasp.geometry.support_planes import find_supports

MAX_EDGE_ON = 0.15
MAX_BEHIND = 0.2
"""Largest shares of a view's points that its camera sees edge-on, and that lie behind others."""
DRAWN = 2000  # most points that tell where the camera was


def guess_viewpoint(
    points: Points, normals: Points, up: Vector | None = None, assumed: bool = False
) -> tuple[Vector, float]:
    """Return a camera position [m] that explains a view, and the angle [deg] within which the
    camera is likely.

    Of all directions above the support, the one that explains the points best is taken; the camera
    is placed along it, 4 radii of the cloud away. The direction `up` is above the support; the
    normal of a support in the points replaces it. If `up` is None or `assumed`, a guess, the camera
    may be at the origin, where the points lie in front of it and a camera can have taken the view.
    An angle of 180 degrees means that the points hardly tell the direction.
    """
    rows = draw_rows(len(points), DRAWN).to(points.device)
    points = points[rows]
    normals = normals[rows]
    in_front = points[:, 2] > math.cos(math.radians(50)) * torch.linalg.vector_norm(points, dim=-1)
    centre, radius = _enclose(points)
    above = up is None or assumed or float(centre @ up.to(points)) < 0
    far = bool(torch.linalg.vector_norm(centre) > 2 * radius)
    if (
        far
        and above
        and bool(in_front.all())
        and can_see(points, normals, torch.zeros_like(points[0]))
    ):
        return torch.zeros_like(points[0]), 15.0
    try:
        up = find_supports(points, up=up)[0].plane.normal
    except NoSupport:
        pass
    directions = fibonacci_sphere(400).to(points)  # about 10 degrees apart
    if up is not None:
        directions = directions[directions @ up.to(points) > 0.1]
    bulge, density = _explain(points, normals, centre + 4 * radius * directions)
    score = bulge + 3 * density  # wrong cameras were rarest with three
    best = score.argmax()
    rivals = directions[score > score[best] - 0.3] @ directions[best]
    angle = max(15.0, math.degrees(math.acos(min(float(rivals.min()), 1.0))))
    return centre + 4 * radius * directions[best], angle if score[best] > 1 else 180.0


def can_see(points: Points, normals: Points, viewpoint: Vector) -> bool:
    """Return whether a camera at a place [m] can have taken a view.

    Seen from there, points must not hide other points. In addition, one of three conditions must
    hold: the points are as dense as the camera's pixels; no other place explains the points much
    better; the camera looks down on a support.
    """
    rows = draw_rows(len(points), DRAWN).to(points.device)
    points = points[rows]
    normals = normals[rows]
    edge_on, behind = share_unseen(points, normals, viewpoint)
    if edge_on > MAX_EDGE_ON or behind > MAX_BEHIND:
        return False
    centre, radius = _enclose(points)
    others = centre + 4 * radius * fibonacci_sphere(400).to(points)
    bulge, density = _explain(points, normals, torch.cat([viewpoint[None], others]))
    score = bulge + 3 * density
    if bool(density[0] > 0) or bool(score[0] > score.max() - 0.5):
        return True
    try:
        find_supports(points, viewpoint)
    except NoSupport:
        return False
    return True


def _enclose(points: Points) -> tuple[Vector, Float[Tensor, ""]]:
    """Return the centre of the points' box along their principal axes, and its distance to the
    farthest point.
    """
    axes = torch.linalg.svd(
        points - points.mean(0), full_matrices=False
    ).Vh  # independent of the frame
    along = points @ axes.T
    centre = (along.amax(0) + along.amin(0)) / 2 @ axes
    return centre, torch.linalg.vector_norm(points - centre, dim=-1).max()


def _explain(
    points: Points, normals: Points, viewpoints: Float[Tensor, "k 3"]
) -> tuple[Float[Tensor, "k"], Float[Tensor, "k"]]:
    """Return two scores of each camera position, at most 1, for how well it explains a view's bulge
    and point density.

    Visible surfaces bulge towards the camera. A pixel covers an area that grows with the squared
    distance, over the cosine between ray and normal.
    """
    away = viewpoints - points[:, None]
    distance = torch.linalg.vector_norm(away, dim=-1).clamp_min(1e-12)
    cosine = (away * normals[:, None]).sum(-1) / distance
    bulge = (normals * (points - _enclose(points)[0])).sum(-1)
    bulging = (bulge[:, None] * torch.tanh(cosine / 0.3)).sum(0) / bulge.abs().sum().clamp_min(
        1e-12
    )
    density = -2 * torch.log(nearest(points, 13)[0][:, -1].clamp_min(1e-12))  # up to a constant
    density = density - density.median()
    error = density[:, None] - torch.log(cosine.abs().clamp_min(0.1)) + 2 * torch.log(distance)
    error = (error - error.median(0).values).abs().mean(0)
    return bulging, 1 - error / density.abs().mean().clamp_min(1e-12)


def share_unseen(points: Points, normals: Points, viewpoint: Vector) -> tuple[float, float]:
    """Return the share of points that a camera would see edge-on, and the share of points hidden
    behind others.

    The second share is 1 if a point lies behind the camera.
    """
    ray = unit(points - viewpoint)
    edge_on = float(
        ((ray * normals).sum(-1).abs() < 0.17).double().mean()
    )  # the cosine of 80 degrees
    middle = (points.amax(0) + points.amin(0)) / 2
    forward = middle - viewpoint
    if not bool(forward.any()) or bool(((points - viewpoint) @ forward <= 0).any()):
        return edge_on, 1.0  # within the cloud, or beside it
    axes = torch.linalg.svd(unit(forward)[None]).Vh  # forward, or backward, and two axes across
    local = (points - viewpoint) @ axes.T
    depth = local[:, 0].abs()
    pixels = (local[:, 1:] / depth[:, None]).cpu().numpy()
    apart, index = spatial.KDTree(pixels).query(pixels, k=min(6, len(pixels)))
    # a point lies behind a neighbour if it is deeper by more than a slope explains
    step = (depth[:, None] - depth[torch.from_numpy(index).to(depth.device)]).abs()
    step = step - 2 * torch.from_numpy(apart).to(depth) * depth[:, None]
    radius = torch.linalg.vector_norm(points - middle, dim=-1).max()
    return edge_on, float((step.amax(1) > 0.1 * radius).double().mean())
