"""Which side is outside, by given normals or the camera."""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.checks import checked
from torchgrasp.cloud.check import check_cloud, remove_duplicates
from torchgrasp.cloud.neighbours import fit_planes, nearest
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.linalg import fibonacci_sphere, unit
from torchgrasp.values import PointCloud

MAX_OPPOSED = 0.35
"""Share of opposite pairs that means random signs: these give .5, 10 % of flips .18."""


@checked
@dataclasses.dataclass(frozen=True)
class NormalCheck(Value):
    """What given normals are worth.

    >>> ball = unit(torch.randn(500, 3))
    >>> found = check_normals(PointCloud(0.05 * ball, 2 * ball))
    >>> found.oriented, found.scaled, int(found.flipped.sum())
    (True, 500, 0)
    """

    flipped: Bool[Tensor, "n"]  # which normals oppose most of their neighbours'
    opposed: float  # share of opposite normals among pairs of neighbours
    oriented: bool  # whether the signs can be trusted
    scaled: int  # number of normals not of unit length; their users normalise them


@checked
def check_normals(cloud: PointCloud) -> NormalCheck:
    """Compare the given normals of neighbouring points.

    Raises:
        BadArgument: a cloud without normals; see also `check_cloud`.
        TooFewPoints, SuspiciousScale: see `check_cloud`.

    >>> ball = unit(torch.randn(500, 3))
    >>> check_normals(PointCloud(0.05 * ball, ball)).oriented
    True
    """
    normals = check_cloud(cloud).normals
    if normals is None:
        raise BadArgument("cloud", "no normals", "a cloud with normals")
    return compare_normals(cloud.points.double(), normals.double())


def compare_normals(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> NormalCheck:
    """Compare the normals of neighbouring points."""
    distance, index = nearest(points, 9)  # the point itself and eight neighbours: enough for a majority
    directions = unit(normals)
    cosine = (directions[:, None] * directions[index[:, 1:]]).sum(-1)
    height = ((points[index[:, 1:]] - points[:, None]) * directions[:, None]).sum(-1).abs()
    # Across an edge of 45 degrees signs say nothing; a point far over the tangent plane may be behind a thin wall.
    compared = (cosine.abs() > 0.7) & (height <= 0.3 * distance[:, 1:])
    against = compared & (cosine < 0)
    pairs = int(compared.sum())
    opposed = int(against.sum()) / pairs if pairs >= 20 else 0.0  # of fewer pairs any share may be chance
    scaled = (torch.linalg.vector_norm(normals, dim=-1) - 1).abs() > 1e-3  # text files round to three digits
    flipped = 2 * against.sum(-1) > compared.sum(-1)
    return NormalCheck(flipped, opposed, oriented=opposed < MAX_OPPOSED, scaled=int(scaled.sum()))


@checked
def estimate_viewpoint(cloud: PointCloud) -> Float[Tensor, "3"]:
    """Return a camera position [m] that explains a single view.

    Normals of a view face the camera, and objects bulge. The direction v maximises sum_i w_i tanh(n_i.v / 0.3),
    where w_i = n_i.(p_i - centre) makes the sign of n_i irrelevant. The centre is that of the principal box. The
    camera is 4 radii away. The origin is preferred if it scores 0.8 of the best and the cloud looks like one in its
    camera's frame: within 45 degrees of z, more than 2 radii away.

    The sides of a flat face or a bowl look alike: give a known viewpoint.

    Raises:
        BadArgument, TooFewPoints, SuspiciousScale: see `check_cloud`.

    >>> estimate_viewpoint(PointCloud(torch.rand(90, 3))).shape
    torch.Size([3])
    """
    points = remove_duplicates(cloud).points
    return guess_viewpoint(points.double(), fit_planes(points.double())[0]).to(points.dtype)


def guess_viewpoint(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "3"]:
    """Return the viewpoint [m] of `estimate_viewpoint`, for normals of unknown sign."""
    axes = torch.linalg.svd(points - points.mean(0), full_matrices=False).Vh  # independent of the frame
    along = points @ axes.T
    centre = (along.amax(0) + along.amin(0)) / 2 @ axes
    radius = torch.linalg.vector_norm(points - centre, dim=-1).max()
    bulge = (normals * (points - centre)).sum(-1)
    directions = fibonacci_sphere(400).to(points)  # about 10 degrees apart
    away = torch.linalg.vector_norm(centre)
    origin = -centre / away.clamp_min(1e-300)
    pieces = torch.cat([directions, origin[None]]).split(64)  # bounds the memory for whole depth images
    score = torch.cat([(bulge[:, None] * torch.tanh(normals @ piece.T / 0.3)).mean(0) for piece in pieces])
    best = score[:-1].argmax()
    in_camera_frame = (centre[2] > math.cos(math.pi / 4) * away) & (away > 2 * radius)
    if bool(in_camera_frame & (score[-1] >= 0.8 * score[best])):
        return torch.zeros_like(centre)
    return centre + 4 * radius * directions[best]


def orient_normals(normals: Float[Tensor, "n 3"], outward: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Return unit normals on the side of `outward` directions."""
    sign = torch.where((outward * normals).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    return unit(sign * normals)


def share_facing(
    points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], viewpoint: Float[Tensor, "*views 3"]
) -> float:
    """Return the share of normals that face the camera. A view has nearly 1, a whole surface half."""
    return float((((viewpoint - points) * normals).sum(-1) > 0).double().mean())
