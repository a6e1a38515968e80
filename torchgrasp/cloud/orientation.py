"""Given normals: whether their signs agree with each other, and which of them look flipped."""

import dataclasses

import torch
from jaxtyping import Bool
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.cloud.check import check_cloud
from torchgrasp.cloud.filter import nearest
from torchgrasp.errors import BadArgument
from torchgrasp.linalg import unit
from torchgrasp.values import PointCloud

NEIGHBOURS = 8
"""Neighbours whose normals a normal is compared with."""
PARALLEL = 0.7
"""Least cosine, of either sign, at which two normals are compared; across an edge there is nothing to compare."""
OUT_OF_PLANE = 0.3
"""A neighbour that lies higher over the tangent plane, over its distance, may be the other side of a thin wall."""
UNORIENTED = 0.35
"""Share of opposite pairs from which on the signs say nothing: random ones make .5 of them, 10 % of flips .18."""
LEAST_PAIRS = 20
"""Pairs below which nothing is said."""


@dataclasses.dataclass(frozen=True)
class NormalCheck(Value):
    """What the normals of a cloud are worth.

    `flipped` marks normals against most of their neighbours', `opposed` is the share of opposite ones among pairs of
    neighbours, and `oriented` tells whether the signs can be believed. `scaled` counts normals that are not of unit
    length (to 1e-3); they are normalised wherever they are used.
    """

    flipped: Bool[Tensor, "n"]
    opposed: float
    oriented: bool
    scaled: int


def check_normals(cloud: PointCloud) -> NormalCheck:
    """Compare the given normals of neighbouring points, and report what does not fit; nothing is changed.

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
    points, normals = cloud.points.double(), unit(cloud.normals.double())
    distance, index = nearest(points, NEIGHBOURS + 1)
    cosine = (normals[:, None] * normals[index[:, 1:]]).sum(-1)
    height = ((points[index[:, 1:]] - points[:, None]) * normals[:, None]).sum(-1).abs()
    compared = (cosine.abs() > PARALLEL) & (height <= OUT_OF_PLANE * distance[:, 1:])
    against = compared & (cosine < 0)
    pairs = int(compared.sum())
    opposed = int(against.sum()) / pairs if pairs >= LEAST_PAIRS else 0.0
    length = torch.linalg.vector_norm(cloud.normals.double(), dim=-1)
    return NormalCheck(
        flipped=2 * against.sum(-1) > compared.sum(-1),
        opposed=opposed,
        oriented=opposed < UNORIENTED,
        scaled=int(((length - 1).abs() > 1e-3).sum()),
    )


def drop_unoriented(cloud: PointCloud) -> PointCloud:
    """Return the cloud, without its normals if their signs are random, as those of many programs are.

    A single view whose normals point anywhere would be taken for a whole surface.

    Raises:
        BadArgument, TooFewPoints, SuspiciousScale: see `check_cloud`.

    >>> ball = unit(torch.randn(500, 3))
    >>> drop_unoriented(PointCloud(0.05 * ball, torch.randn(500, 1).sign() * ball)).normals is None
    True
    """
    cloud = check_cloud(cloud)
    if cloud.normals is None or check_normals(cloud).oriented:
        return cloud
    return PointCloud(cloud.points, None, cloud.viewpoint)
