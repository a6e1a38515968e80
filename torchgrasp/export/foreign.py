"""Grasps of other planners: joints and poses of the hand become `Grasps`."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.checks import Length, Poses, checked
from torchgrasp.control.law import damped_inverse
from torchgrasp.errors import Status
from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.hand.hand import Hand
from torchgrasp.plan.certify import certify
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Contacts, Grasps

OPENING, OPENING_STEPS = 0.02, 4
"""How far [m] fingertips stand off where no pre-grasp is given, and in how many linear steps: within 1 mm."""


@checked
def grasps_from_joints(
    hand: Hand,
    joints: Float[Tensor, "g h"],
    obj_from_hand: Poses,
    pregrasp: Float[Tensor, "g h"] | None = None,
    spec: ContactSpec | None = None,
    std_m: Length | None = None,
) -> Grasps:
    """Return grasps of any origin as `Grasps`, so that `certify`, `close_hand`, `evaluate` and the exports take them.

    Contacts are where the pads' middles are, with normals against the pads. Certificates are of these contacts; a row
    that is not closed gets `Status.NOT_CLOSED`. Who knows the surface replaces both by its points and normals.
    `clearance` is that of the links from each other, since no object is known. `score` is 0: nothing is predicted. The
    hand comes along its own approach.

    Args:
        hand: that grasps.
        joints: actuated joints [rad], in the order of `hand.joint_names`.
        obj_from_hand: poses of the root link of the hand's URDF.
        pregrasp: joints of the opened hand; None: each tip 20 mm off its contact, or as far as limits allow.
        spec: friction and edges of the certificate; `ContactSpec()` by default.
        std_m: standard deviation [m] of the surface at each contact that a closing under uncertainty shall assume.

    Raises:
        BadArgument: wrong shapes, joints outside the limits, poses that are not rigid.

    >>> from torchgrasp import load_hand
    >>> hand = load_hand("barrett")
    >>> joints = torch.tensor([[0.0, 1.2, 1.2, 1.2]], dtype=torch.float64)
    >>> grasps_from_joints(hand, joints, torch.eye(4, dtype=torch.float64)[None]).contacts.points.shape
    torch.Size([1, 3, 3])
    """
    hand, joints, pose = hand.to("cpu", torch.float64), joints.double().cpu(), obj_from_hand.double().cpu()
    hand.check_joints(joints)
    pads, pad_normals = hand.fingertips(joints)
    normals = -rotate(pose, pad_normals)
    std = None if std_m is None else torch.full_like(normals[..., 0], std_m)
    contacts = Contacts(apply(pose, pads), normals, std_m=std)
    certificate = certify(contacts, ContactSpec() if spec is None else spec)
    opened = _open(hand, joints, -pad_normals) if pregrasp is None else hand.check_joints(pregrasp.double().cpu())
    g, f = len(joints), len(hand.tips)
    return Grasps(
        joints=joints,
        pregrasp=opened,
        approach=rotate(pose, hand.approach.expand(g, 1, 3))[:, 0],
        obj_from_hand=pose,
        contacts=contacts,
        permutation=torch.arange(f).expand(g, f).clone(),
        tip_error=torch.zeros(g, f, dtype=torch.float64),
        clearance=hand.self_clearance(joints),
        normal_angle=torch.zeros(g, f, dtype=torch.float64),
        certificate=certificate,
        score=torch.zeros(g, dtype=torch.float64),
        status=torch.where(certificate.closed, int(Status.OK), int(Status.NOT_CLOSED)),
        meta={
            "hand": hand.name,
            "hand_sha256": hand.source.sha256,
            "joint_names": ",".join(hand.joint_names),
            "finger_names": ",".join(hand.finger_names),
            "units": "metre, radian",
        },
    )


def _open(hand: Hand, joints: Float[Tensor, "g h"], away: Float[Tensor, "g f 3"]) -> Float[Tensor, "g h"]:
    """Return joints whose fingertips stand off along the contacts' normals, within the limits."""
    for _ in range(OPENING_STEPS):
        jacobian = hand.jacobian(joints).flatten(1, 2)
        step = damped_inverse(jacobian) @ (OPENING / OPENING_STEPS * away).flatten(1)[..., None]
        joints = torch.minimum(torch.maximum(joints + step[..., 0], hand.lower), hand.upper)
    return joints
