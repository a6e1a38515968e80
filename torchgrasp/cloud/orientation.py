"""Which side of a surface is outside: the signs of given normals, and a camera that was or can have been there."""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.cloud.check import check_cloud, remove_duplicates
from torchgrasp.cloud.neighbours import fit_planes, nearest
from torchgrasp.errors import BadArgument
from torchgrasp.linalg import fibonacci_sphere, unit
from torchgrasp.values import PointCloud

N_NEIGHBOURS = 8
"""Neighbours that a normal is compared with: enough for a majority, near enough to share a side."""
MIN_COSINE = 0.7
"""Least cosine, of either sign, of normals that are compared: 45 degrees; across an edge signs say nothing."""
MAX_HEIGHT = 0.3
"""Greatest height over the tangent plane, per distance; a higher neighbour may be the other side of a thin wall."""
MAX_OPPOSED = 0.35
"""Share of opposite pairs from which on signs say nothing: random ones make .5 of them, 10 % of flips .18."""
MIN_PAIRS = 20
"""Fewest pairs that can tell random signs: of fewer a share of .35 may be chance."""
UNIT_TOLERANCE = 1e-3
"""Deviation of a unit normal's length: a text file rounds to three digits."""
N_DIRECTIONS = 400
"""Directions tried for an unknown viewpoint, about 10 degrees apart: finer than normals tell."""
SOFTNESS = 0.3
"""Cosine over which a normal's vote changes from away to towards: normals near the rim, of either side, count little."""


@dataclasses.dataclass(frozen=True)
class NormalCheck(Value):
    """What given normals are worth.

    Args:
        flipped: which normals oppose most of their neighbours'.
        opposed: share of opposite normals among pairs of neighbours.
        oriented: whether the signs can be trusted.
        scaled: number of normals that are not of unit length; functions that use normals normalise them.
    """

    flipped: Bool[Tensor, "n"]
    opposed: float
    oriented: bool
    scaled: int


def check_normals(cloud: PointCloud) -> NormalCheck:
    """Compare the given normals of neighbouring points; nothing is changed.

    Raises:
        BadArgument: a cloud without normals; see also `check_cloud`.
        TooFewPoints, SuspiciousScale: see `check_cloud`.

    >>> ball = unit(torch.randn(500, 3))
    >>> check_normals(PointCloud(0.05 * ball, ball)).oriented
    True
    """
    cloud = check_cloud(cloud)
    if cloud.normals is None:
        raise BadArgument("cloud", "no normals", "a cloud with normals")
    return compare_normals(cloud.points.double(), cloud.normals.double())


def compare_normals(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> NormalCheck:
    """Compare the normals of neighbouring points, of any length but zero."""
    distance, index = nearest(points, N_NEIGHBOURS + 1)
    directions = unit(normals)
    cosine = (directions[:, None] * directions[index[:, 1:]]).sum(-1)
    height = ((points[index[:, 1:]] - points[:, None]) * directions[:, None]).sum(-1).abs()
    compared = (cosine.abs() > MIN_COSINE) & (height <= MAX_HEIGHT * distance[:, 1:])
    against = compared & (cosine < 0)
    pairs = int(compared.sum())
    opposed = int(against.sum()) / pairs if pairs >= MIN_PAIRS else 0.0
    return NormalCheck(
        flipped=2 * against.sum(-1) > compared.sum(-1),
        opposed=opposed,
        oriented=opposed < MAX_OPPOSED,
        scaled=int(((torch.linalg.vector_norm(normals, dim=-1) - 1).abs() > UNIT_TOLERANCE).sum()),
    )


def estimate_viewpoint(cloud: PointCloud) -> Float[Tensor, "3"]:
    """Return a camera position [m] from which the cloud can have been seen in a single view.

    All normals of a view point into the camera's hemisphere, and an object bulges away from the centre of its box
    (along the principal axes). Among 400 directions v the best maximises sum_i w_i tanh(n_i.v / 0.3) with
    w_i = n_i.(p_i - centre), the same for either sign of n_i. The camera is 4 radii of the cloud away.

    The origin wins where it scores at least 0.8 times as much and the cloud looks as if in its camera's frame:
    within 45 degrees of z and more than 2 radii away.

    On noisy views of eight objects 99.9 % of the normals come out as with the true camera. A single flat face, or the
    inside of a bowl, does not tell its two sides apart: give the viewpoint you know.

    Args:
        cloud: points [m] of one object, seen from one side.

    Raises:
        BadArgument, TooFewPoints, SuspiciousScale: see `check_cloud`.

    >>> estimate_viewpoint(PointCloud(torch.rand(90, 3))).shape
    torch.Size([3])
    """
    points = remove_duplicates(cloud).points
    return guess_viewpoint(points.double(), fit_planes(points.double())[0]).to(points.dtype)


def guess_viewpoint(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "3"]:
    """Return the viewpoint [m] that best explains normals of unknown sign; see `estimate_viewpoint`."""
    # The box along the principal axes: a box along the frame's axes would make the guess depend on the frame.
    axes = torch.linalg.svd(points - points.mean(0), full_matrices=False).Vh
    along = points @ axes.T
    centre = (along.amax(0) + along.amin(0)) / 2 @ axes
    radius = torch.linalg.vector_norm(points - centre, dim=-1).max()
    bulge = (normals * (points - centre)).sum(-1)
    directions = fibonacci_sphere(N_DIRECTIONS).to(points)
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


def orient_normals(normals: Float[Tensor, "n 3"], outward: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Return unit normals on the side of `outward` directions."""
    sign = torch.where((outward * normals).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    return unit(sign * normals)


def share_facing(
    points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], viewpoint: Float[Tensor, "*views 3"]
) -> float:
    """Return the share of outward normals that face the camera: nearly 1 of a view, about half of a whole surface."""
    return float((((viewpoint - points) * normals).sum(-1) > 0).double().mean())
