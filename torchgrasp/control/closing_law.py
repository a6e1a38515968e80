"""The closing law (Eqs. 25-28): position control far from a contact, force control near it, weighted by uncertainty.

Everything here is pure and batched over leading axes. Gains are rates (position gain in 1/s, force gain in m/s per
newton) and `joint_step` takes the control period, so that the same gains mean the same motion at 100 and at 250 Hz.
"""

from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import check_tensor
from torchgrasp.control.adaptive.stability import load_stability
from torchgrasp.control.forces import desired_forces, force_covariance
from torchgrasp.errors import BadArgument
from torchgrasp.frames import apply as move
from torchgrasp.frames import inverse, rotate
from torchgrasp.hand.hand import Hand
from torchgrasp.linalg import cholesky, squared_mahalanobis
from torchgrasp.values import ClosingGains, Grasps

POSITION_FLOOR = 0.005
"""Isotropic standard deviation [m] that is added to the one along the normal. Eq. (27) needs it: for a normal along
an axis two diagonal entries of Sigma_cov are 0 and their inverse is infinite. 5 mm is the accuracy of the rest of the
chain (hand pose, joint zeros)."""

POSITION_RATE = 4.0
"""Position gain [1/s] of a contact without uncertainty: alpha_p = POSITION_RATE * POSITION_FLOOR**2."""

FORCE_BANDWIDTH = 15.0
"""Bandwidth [rad/s] of the force loop of a force without uncertainty: alpha_f is this times the fingertip's
compliance times FORCE_FLOOR**2. The 20 Hz filter of the sensor keeps 15 rad/s stable."""

FORCE_FLOOR = 0.3
"""Isotropic standard deviation [N] of the desired force: the tactile sensor's accuracy along the surface."""

MAX_SPEED = 0.04
"""Largest speed [m/s] of a fingertip under the law."""

MAX_STEP = 0.05
"""Largest change [rad] of any joint in one tick."""

DAMPING = 1e-5
"""Damping [m^2] of the inverse Jacobian; a finger's own J J^T is of the order 1e-3 m^2."""


def surface_covariance(
    normals: Float[Tensor, "*b 3"], std_m: Float[Tensor, "*b"], floor: float = POSITION_FLOOR
) -> Float[Tensor, "*b 3 3"]:
    """Return Sigma_cov of Eq. (27) [m^2]: the shape's deviation along the normal over an isotropic floor [m].

    >>> surface_covariance(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(0.01), floor=0.002).diagonal() * 1e6
    tensor([  4.,   4., 104.])
    """
    along = normals[..., :, None] * normals[..., None, :] * std_m[..., None, None] ** 2
    return along + floor**2 * torch.eye(3, dtype=normals.dtype, device=normals.device)


def blend(error: Float[Tensor, "*b 3"], covariance: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Return lambda of Eq. (26): 1 at the contact, falling to 0 as the error [m] exceeds the shape's uncertainty.

    Raises:
        IndefiniteCovariance: a covariance is not positive definite.

    >>> blend(torch.zeros(3), torch.eye(3))
    tensor(1.)
    """
    factor = cholesky(covariance, "the covariance of a contact", "add an isotropic floor")
    return torch.exp(-0.5 * squared_mahalanobis(error, factor))


def position_gain(covariance: Float[Tensor, "*b 3 3"], alpha_p: float | None = None) -> Float[Tensor, "*b 3"]:
    """Return the diagonal of K_P [1/s] of Eq. (27): alpha_p [m^2/s] over the diagonal of Sigma_cov.

    With the default alpha_p a contact of no uncertainty has the gain `POSITION_RATE`, and none exceeds it.

    >>> position_gain(POSITION_FLOOR**2 * torch.eye(3))
    tensor([4., 4., 4.])
    """
    alpha_p = POSITION_RATE * POSITION_FLOOR**2 if alpha_p is None else alpha_p
    return alpha_p / covariance.diagonal(dim1=-2, dim2=-1)


def force_gain(covariance: Float[Tensor, "*b 3 3"], alpha_f: Float[Tensor, "*b"] | float) -> Float[Tensor, "*b 3"]:
    """Return the diagonal of C_F [m/(s N)] of Eq. (28): alpha_f [m N/s] over the diagonal of Sigma_fd [N^2]."""
    diagonal = covariance.diagonal(dim1=-2, dim2=-1)
    return alpha_f[..., None] / diagonal if isinstance(alpha_f, Tensor) else alpha_f / diagonal


def damped_inverse(jacobian: Float[Tensor, "*b m h"], damping: float = DAMPING) -> Float[Tensor, "*b h m"]:
    """Return J^T (J J^T + damping I)^-1, by whichever of the two normal matrices is smaller."""
    m, h = jacobian.shape[-2:]
    transposed = jacobian.transpose(-1, -2)
    if m <= h:
        normal = jacobian @ transposed + damping * torch.eye(m, dtype=jacobian.dtype, device=jacobian.device)
        return torch.linalg.solve(normal, jacobian).transpose(-1, -2)
    normal = transposed @ jacobian + damping * torch.eye(h, dtype=jacobian.dtype, device=jacobian.device)
    return torch.linalg.solve(normal, transposed)


def tip_velocity(
    position_error: Float[Tensor, "*b 3"],
    force_error: Float[Tensor, "*b 3"],
    blend: Float[Tensor, "*b"],
    position_gain: Float[Tensor, "*b 3"],
    force_gain: Float[Tensor, "*b 3"],
    max_speed: float = MAX_SPEED,
) -> Float[Tensor, "*b 3"]:
    """Return the bracket of Eq. (25) [m/s] for each fingertip, no faster than `max_speed`; the direction is kept."""
    share = blend[..., None]
    velocity = (1 - share) * position_gain * position_error + share * force_gain * force_error
    speed = torch.linalg.vector_norm(velocity, dim=-1, keepdim=True)
    return velocity * (max_speed / speed.clamp_min(max_speed))


def joint_step(
    jacobian: Float[Tensor, "*b 3 3 h"],
    velocity: Float[Tensor, "*b 3 3"],
    period: float,
    posture_error: Float[Tensor, "*b h"] | None = None,
    damping: float = DAMPING,
    max_step: float = MAX_STEP,
) -> Float[Tensor, "*b h"]:
    """Return the change of the joints [rad] in one tick, Eq. (25), by damped least squares over all three fingers.

    The paper's J^-1 does not exist for fingers of four joints, nor for coupled ones. Motions of the joints that move
    no fingertip follow `posture_error` [rad] with POSITION_RATE, so that the links stay where they were planned.

    Args:
        jacobian: of the three fingertips [m/rad].
        velocity: of the three fingertips [m/s] (`tip_velocity`).
        period: of the controller [s].
        posture_error: planned minus present joints, or None.
        damping: of the inverse [m^2].
        max_step: the whole step is shortened so that no joint moves further [rad].

    >>> joint_step(torch.zeros(3, 3, 4), torch.ones(3, 3), 0.01)
    tensor([0., 0., 0., 0.])
    """
    stacked = jacobian.flatten(-3, -2)
    inverse_jacobian = damped_inverse(stacked, damping)
    step = (inverse_jacobian @ (velocity.flatten(-2) * period)[..., None])[..., 0]
    if posture_error is not None:
        wish = POSITION_RATE * period * posture_error
        step = step + wish - (inverse_jacobian @ (stacked @ wish[..., None]))[..., 0]
    largest = step.abs().amax(-1, keepdim=True)
    return step * (max_step / largest.clamp_min(max_step))


def drive_stiffness(hand: Hand, kp: float | None = None) -> Float[Tensor, "j"]:
    """Return the stiffness [N m/rad] of the drive of every joint of the URDF: the hand's own, or `kp` of all."""
    every = [hand.actuators[name].kp if kp is None else kp for name in hand.tree.joint_names]
    return torch.tensor(every, dtype=torch.float64)


def actuated_stiffness(coupling: Float[Tensor, "j h"], kp: Float[Tensor, " j"]) -> Float[Tensor, "h"]:
    """Return the stiffness [N m/rad] of each actuated joint: that of its drive and of the joints that follow it.

    >>> actuated_stiffness(torch.tensor([[1.0], [0.5]]), torch.tensor([4.0, 4.0]))
    tensor([5.])
    """
    return (coupling**2 * kp[:, None]).sum(0)


def joint_stiffness(hand: Hand, kp: float | None = None) -> Float[Tensor, "h"]:
    """Return the stiffness [N m/rad] of each actuated joint of a hand (`actuated_stiffness`).

    Args:
        hand: the hand.
        kp: of every drive [N m/rad]; None: the hand's own.
    """
    return actuated_stiffness(hand.actuated.coupling, drive_stiffness(hand, kp).to(hand.actuated.coupling))


def tip_compliance(
    hand: Hand, joints: Float[Tensor, "*b h"], normals: Float[Tensor, "*b 3 3"]
) -> Float[Tensor, "*b 3"]:
    """Return how far each fingertip yields [m/N] along its normal when its joints are driven with the hand's kp."""
    along = torch.einsum("...cih,...ci->...ch", hand.jacobian(joints), normals)
    return (along**2 / joint_stiffness(hand).to(joints)).sum(-1)


ForceSource = Literal["analytic", "learned"]
"""Where desired forces come from: the balanced set of least friction, with a deviation in proportion; or the hand's
model of stable grasps (`stable.load_stability`), whose proportions decide between sets that need nearly as little."""


def closing_gains(grasps: Grasps, hand: Hand, force: float = 4.0, forces: ForceSource = "analytic") -> ClosingGains:
    """Return target, gains and desired force of each finger for one grasp, in the hand's frame (Eqs. 26-28).

    Desired forces are balanced. Contacts at which no balanced set presses (a certified grasp has none) are pressed
    along their normals, each with `force`.

    Args:
        grasps: one row.
        hand: the hand that the grasp was planned for.
        force: normal force of the strongest finger [N].
        forces: where the desired forces and their covariance come from; the gains tell it.

    Raises:
        BadArgument: not exactly one row, joints of another hand, a force that is not positive, numbers in the
            grasp that are not finite, an unknown source of forces, or a hand without a model of stable grasps.
    """
    if forces not in get_args(ForceSource):
        raise BadArgument("forces", repr(forces), f"one of {', '.join(get_args(ForceSource))}")
    if len(grasps) != 1:
        raise BadArgument("grasps", f"{len(grasps)} rows", "exactly one: index the grasps, as in grasps[0]")
    if grasps.joints.shape[-1] != len(hand.joint_names):
        raise BadArgument("grasps", f"{grasps.joints.shape[-1]} joints", f"the {len(hand.joint_names)} of {hand.name}")
    if not 0.0 < force < 1e3:
        raise BadArgument("force", force, "a number in (0, 1000) [N]")
    h = len(hand.joint_names)
    check_tensor("grasps.joints", grasps.joints, (1, h))
    check_tensor("grasps.obj_from_hand", grasps.obj_from_hand, (1, 4, 4))
    check_tensor("grasps.contacts.points", grasps.contacts.points, (1, 3, 3))
    check_tensor("grasps.contacts.normals", grasps.contacts.normals, (1, 3, 3))
    std = check_tensor("grasps.contacts.std_m", grasps.contacts.std_m, (1, 3))
    joints, contacts = grasps.joints.double(), grasps.contacts.to(torch.float64)
    hand_from_obj = inverse(grasps.obj_from_hand.double())
    target, normals = move(hand_from_obj, contacts.points), rotate(hand_from_obj, contacts.normals)
    covariance = surface_covariance(normals, std.double())
    wish, deviation = None, None
    if forces == "learned":
        model = load_stability(hand)
        if model is None:
            raise BadArgument("forces", f"'learned' for {hand.name}, which has no stability.safetensors", "'analytic'")
        wish = model.wish(target[0] + hand.tip_radius.to(normals)[:, None] * normals[0], force)
        deviation = wish.covariance.diagonal()[None].sqrt()
    desired = desired_forces(target, normals, force, None if wish is None else wish.forces[None])
    spread = force_covariance(desired, normals, FORCE_FLOOR, deviation)
    alpha_f = FORCE_BANDWIDTH * FORCE_FLOOR**2 * tip_compliance(hand, joints, normals)
    return ClosingGains(
        target=target[0],
        covariance=covariance[0],
        position_gain=position_gain(covariance)[0],
        force_gain=force_gain(spread, alpha_f)[0],
        desired_force=desired[0],
        force_source=forces,
    )
