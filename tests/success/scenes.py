"""A ball of 80 mm, contacts on it, grasps of any hand, and models of success that read one feature."""

import functools

import torch

from tests.make import ball, load_hand, real
from torchgrasp import fit_shape
from torchgrasp.geometry.frames import rotate
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.shape.surface import collision_field, extract_mesh
from torchgrasp.success.body import EstimatedBody
from torchgrasp.success.features import FEATURES
from torchgrasp.success.model import SuccessModel
from torchgrasp.values.planning import Certificate, Contacts, Grasps

RADIUS = 0.04


@functools.cache
def whole_ball():
    """The posterior of a ball that was seen from all sides."""
    return fit_shape(ball(600, RADIUS))


def ball_body(vertices, shape=None):
    """The ball as an estimated body, with other vertices."""
    shape = whole_ball() if shape is None else shape
    return EstimatedBody.around(shape, vertices, collision_field(shape, extract_mesh(shape)))


UNEVEN = (0.3, 2.4, 4.6, 5.4, 1.3)
"""Angles [rad] of contacts whose triangle has one longest side."""


def around(*heights, angles=UNEVEN[:3]):
    """One set of contacts around z at each height [m] on the ball."""
    angle = real(angles)
    height = real([heights]).T
    level = (RADIUS**2 - height**2).sqrt()
    points = torch.stack(
        [level * angle.cos(), level * angle.sin(), height.expand(-1, len(angle))], -1
    )
    return Contacts(
        points,
        unit(points),
        std_m=real([0.001, 0.003, 0.002, 0.001, 0.002])[: len(angle)].expand(points.shape[:2]),
    )


def grasps_at(contacts, name="allegro", opens=0.9, score=None, status=None):
    """Grasps of a hand at contacts, as if it reached them, half closed; their opened fingers are
    `opens` as closed.
    """
    hand = load_hand(name, contacts.fingertips)
    n = len(contacts)
    joints = torch.lerp(
        hand.lower, hand.upper, torch.linspace(0.35, 0.6, hand.dof, dtype=torch.float64)
    ).repeat(n, 1)
    pose = torch.eye(4, dtype=torch.float64).repeat(n, 1, 1)
    fingers = torch.zeros_like(contacts.points[..., 0])
    one = torch.ones(n, dtype=torch.float64)
    certificate = Certificate(
        0.01 * one, one, 0 * one, one.bool(), torch.zeros(n, 6, dtype=torch.float64)
    )
    return hand, Grasps(
        joints=joints,
        pregrasp=opens * joints,
        approach=rotate(pose, hand.approach.double().expand(n, 1, 3))[:, 0],
        obj_from_hand=pose,
        contacts=contacts,
        permutation=torch.arange(contacts.fingertips).repeat(n, 1),
        tip_error=fingers,
        clearance=0.005 * one,
        normal_angle=fingers + real([0.1, 0.3, 0.2, 0.1, 0.2][: contacts.fingertips]),
        certificate=certificate,
        score=one if score is None else real(score),
        status=torch.zeros(n, dtype=torch.int64) if status is None else torch.tensor(status),
        meta={"hand": name, "table": Plane.horizontal(-RADIUS).describe(), "friction": "0.6"},
    )


def stump(feature, threshold, below, above):
    """A model of one tree: its log-odds are `below` where a feature is at most the threshold, else
    `above`.
    """
    bands = real([[-5.0, 0.1, 0.3], [0.0, 0.4, 0.6], [5.0, 0.9, 1.0]])
    most = torch.full((len(FEATURES),), 10.0, dtype=torch.float64)
    return SuccessModel(
        torch.tensor([[FEATURES.index(feature), 0, 0]]),
        real([[threshold, 0, 0]]),
        torch.tensor([[[1, 2], [1, 1], [2, 2]]]),
        real([[0, below, above]]),
        real(0.0),
        torch.stack([-most, most], -1),
        0 * most,
        bands,
        torch.zeros(0, 3, dtype=torch.float64),
    )
