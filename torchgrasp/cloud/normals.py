"""Normals of a cloud from local planes, the camera's position when it is unknown, and cleaning."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.check import check_cloud, remove_duplicates
from torchgrasp.cloud.filter import remove_outliers, select_rows
from torchgrasp.cloud.local_fit import fit_planes, fit_quadrics
from torchgrasp.linalg import unit
from torchgrasp.values import PointCloud

OFFSET_RATIO = 4.5
"""A point is stray when it is further from its quadric than so many times the median spread about the quadrics."""
DIRECTIONS = 400
"""Directions tried for an unknown viewpoint, about 10 degrees apart."""
SOFTNESS = 0.3
"""Cosine over which a normal changes from turned away to turned towards the viewpoint."""


def estimate_normals(cloud: PointCloud) -> PointCloud:
    """Return the distinct points of a cloud with unit normals of local quadrics, turned outward.

    A quadric is fitted to the 30 nearest points with weights exp(-(d / 0.7 d_30)^2). Its normal is turned towards the
    viewpoint; without a viewpoint, to the side of the normals that the cloud has; without either, towards the
    viewpoint that `estimate_viewpoint` finds, which the result then carries.

    Args:
        cloud: points [m] of one object; of one view unless it has normals.

    Raises:
        BadArgument, TooFewPoints, SuspiciousScale: see `check_cloud`.

    >>> estimate_normals(PointCloud(torch.rand(90, 3), viewpoint=torch.tensor([0.5, 0.5, 9.0]))).normals.shape
    torch.Size([90, 3])
    """
    cloud = remove_duplicates(check_cloud(cloud))
    _, normals, _ = fit_quadrics(cloud.points.double())
    return _orient(cloud, cloud.points, normals)


def clean_cloud(cloud: PointCloud) -> PointCloud:
    """Return the cloud without stray points, each point moved onto its local quadric, with oriented normals.

    Stray is a point whose mean distance to its 8 nearest neighbours is more than 2.5 times the median one (flying
    pixels), or that lies further from its quadric than 4.5 times the median spread. Moving the points onto their
    quadrics takes the noise of a simulated depth camera from 0.94 to 0.65 mm rms, and does not shrink what is curved.

    Args:
        cloud: points [m] of one object; of one view unless it has normals.

    Raises:
        BadArgument, SuspiciousScale: see `check_cloud`.
        TooFewPoints: fewer than 4 points, before or after cleaning.

    >>> len(clean_cloud(PointCloud(torch.rand(500, 3), viewpoint=torch.tensor([0.5, 0.5, 9.0])))) <= 500
    True
    """
    cloud = remove_outliers(cloud)
    points = cloud.points.double()
    feet, normals, spread = fit_quadrics(points)
    keep = torch.linalg.vector_norm(points - feet, dim=-1) <= OFFSET_RATIO * spread.median() + 1e-12
    moved = feet.to(cloud.points.dtype)
    return _orient(select_rows(cloud, keep, "points that are not stray"), moved[keep], normals[keep])


def estimate_viewpoint(cloud: PointCloud) -> Float[Tensor, "3"]:
    """Return a camera position [m] from which the cloud can have been seen in a single view.

    Every normal of a single view points into the hemisphere of the camera, and an object bulges: most of its surface
    faces away from the centre of the cloud's box (along the principal axes). Among 400 directions v the one is taken
    that maximises sum_i w_i tanh(n_i.v / 0.3), where n_i is the normal of either sign and w_i = n_i.(p_i - centre) is
    positive for the sign that bulges. The camera is put 4 radii of the cloud away. One exception: a cloud that was
    never moved out of its camera's frame (z forward, the cloud within 45 degrees of that axis and further than 2
    radii from the origin) was seen from the origin, if that direction explains it at least 0.8 times as well.

    On 24 noisy single views of eight objects, each turned 12 ways, 99.9 % of the normals come out as with the true
    camera (at worst 99.5 % of a view).
    A single flat face, or the inside of a bowl, does not tell its two sides apart: give the viewpoint you know.

    Args:
        cloud: points [m] of one object, seen from one side.

    Raises:
        BadArgument, TooFewPoints, SuspiciousScale: see `check_cloud`.

    >>> estimate_viewpoint(PointCloud(torch.rand(90, 3))).shape
    torch.Size([3])
    """
    cloud = remove_duplicates(check_cloud(cloud))
    points = cloud.points.double()
    normals, _, _ = fit_planes(points)
    return _guess_viewpoint(points, normals).to(cloud.points.dtype)


def _guess_viewpoint(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "3"]:
    """Return the viewpoint that best explains local planes with normals of unknown sign."""
    # The box along the principal axes: a box along the frame's axes would make the guess depend on the frame.
    axes = torch.linalg.svd(points - points.mean(0), full_matrices=False).Vh
    along = points @ axes.T
    centre = (along.amax(0) + along.amin(0)) / 2 @ axes
    radius = torch.linalg.vector_norm(points - centre, dim=-1).max()
    bulge = (normals * (points - centre)).sum(-1)
    directions = spread_directions(DIRECTIONS, points)
    origin = -centre / torch.linalg.vector_norm(centre).clamp_min(1e-300)
    # In pieces, so that the memory for a cloud of a whole depth image stays bounded.
    pieces = torch.cat([directions, origin[None]]).split(64)
    score = torch.cat([(bulge[:, None] * torch.tanh(normals @ piece.T / SOFTNESS)).mean(0) for piece in pieces])
    best = score[:-1].argmax()
    in_camera_frame = (centre[2] > math.cos(math.pi / 4) * torch.linalg.vector_norm(centre)) & (
        torch.linalg.vector_norm(centre) > 2 * radius
    )
    if bool(in_camera_frame & (score[-1] >= 0.8 * score[best])):
        return torch.zeros_like(centre)
    return centre + 4 * radius * directions[best]


def spread_directions(n: int, like: Tensor) -> Float[Tensor, "n 3"]:
    """Return n unit vectors spread evenly over the sphere (a Fibonacci spiral from +z), in the dtype of `like`.

    >>> spread_directions(4, torch.zeros(0))[:, 2]
    tensor([ 0.7500,  0.2500, -0.2500, -0.7500])
    """
    k = torch.arange(n, dtype=like.dtype, device=like.device) + 0.5
    z = 1 - 2 * k / n
    turn = math.pi * (1 + math.sqrt(5)) * k
    ring = torch.sqrt(1 - z * z)
    return torch.stack([ring * torch.cos(turn), ring * torch.sin(turn), z], -1)


def _orient(cloud: PointCloud, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> PointCloud:
    """Return the points with the normals turned outward, in the cloud's dtype; `estimate_normals` states the rule."""
    viewpoint = cloud.viewpoint
    if viewpoint is None and cloud.normals is not None:
        outward = cloud.normals.double()
    else:
        if viewpoint is None:
            viewpoint = _guess_viewpoint(points.double(), normals).to(points.dtype)
        outward = viewpoint.double() - points.double()
    sign = torch.where((outward * normals).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    return PointCloud(points, unit(sign * normals).to(points.dtype), viewpoint)
