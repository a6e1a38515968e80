"""Given normals: whether their signs agree with each other, and which of them look flipped."""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.cloud.check import check_cloud
from torchgrasp.cloud.neighbours import nearest
from torchgrasp.errors import BadArgument
from torchgrasp.linalg import unit
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
