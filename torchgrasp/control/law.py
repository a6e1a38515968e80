"""The closing control law (Eqs. 25-28 of the paper): position control far from a contact, force
control near it.

The gains are inverse to the uncertainty of shape and force. All functions are pure and batched over
leading axes.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.geometry.linalg import cholesky, limit_norm, squared_mahalanobis

Vectors = Float[Tensor, "*b 3"]
Numbers = Float[Tensor, "*b"]
Matrices = Float[Tensor, "*b 3 3"]
POSITION_FLOOR = 0.005
"""Standard deviation [m], in all directions, of errors of hand pose and joint zeros; it keeps Eq.
(27) finite.
"""
POSITION_RATE = 4.0  # largest position gain [1/s]: alpha_p = POSITION_RATE * POSITION_FLOOR**2
# bandwidth [rad/s] of the most certain force loop; the lag of the sensor's filter bounds it
FORCE_BANDWIDTH = 15.0
# isotropic standard deviation [N] of Sigma_fd: the tactile sensor's noise along the surface
FORCE_FLOOR = 0.3
FORCE_SHARE = 0.1  # standard deviation of a normal force, as a share of the force
PRINTED_FLOOR = 1e-4  # least standard deviation [m] of Sigma_cov as the paper prints it
DAMPING = 1e-5  # damping [m^2] of the inverse Jacobian
MAX_SPEED = 0.04  # largest speed [m/s] of a fingertip
TINY = 1e-9  # least length by which a vector is divided
# largest change [rad] of a joint in one tick; it bounds steps near a singular posture
MAX_STEP = 0.05


def surface_covariance(normals: Vectors, std_m: Numbers) -> Matrices:
    """Return the covariance [m^2] of each contact's position in the closing "uncertainty": n n^T
    s^2 + floor^2 I.

    n is the contact's normal, s the shape's deviation `std_m`; the floor is the hand's, equal in
    all directions.
    """
    return _normal_covariance(normals, std_m, POSITION_FLOOR)


def printed_covariance(normals: Vectors, distance_variance: Numbers) -> Matrices:
    """Return the covariance [m^2] that Eq. (27) of the paper prints: Sigma_cov = diag(|R f_cov n|).

    `distance_variance` [m^2] is f_cov, the variance of the signed distance. `normals` are R n, in
    the hand's frame. A normal across an axis makes Sigma_cov singular, so each entry is at least
    the square of `PRINTED_FLOOR`.
    """
    entries = (distance_variance[..., None] * normals).abs()
    return torch.diag_embed(entries.clamp_min(PRINTED_FLOOR**2))


def force_covariance(
    forces: Vectors, normals: Vectors, deviation: Numbers | None = None
) -> Matrices:
    """Return the covariance [N^2] of each contact force (Sigma_fd, Eq. 28 of the paper).

    It is the variance of the normal force along the normal, plus the sensor's variance, equal in
    all directions. `deviation` [N] is the standard deviation of each normal force; by default a
    tenth of the force.
    """
    if deviation is None:
        deviation = FORCE_SHARE * (forces * normals).sum(-1)
    return _normal_covariance(normals, deviation, FORCE_FLOOR)


def _normal_covariance(normals: Vectors, std: Numbers, floor: float) -> Tensor:
    """Return covariances (3, 3): the variance `std`^2 along the normal, plus `floor`^2 in all
    directions.
    """
    along = normals[..., :, None] * normals[..., None, :] * std[..., None, None] ** 2
    return along + floor**2 * torch.eye(3, dtype=normals.dtype, device=normals.device)


def blend(error: Vectors, covariance: Matrices) -> Numbers:
    """Return each finger's share of force control, from 0 to 1: lambda = exp(-e^T Sigma_cov^-1 e /
    2), Eq. (26).

    It is 1 at the contact, and near 0 where the position error [m] exceeds the shape's uncertainty.
    """
    factor = cholesky(covariance, "the covariance of a contact", "add an isotropic floor")
    return torch.exp(-0.5 * squared_mahalanobis(error, factor))


def position_gain(covariance: Matrices) -> Vectors:
    """Return the position gain [1/s] on each axis: a constant over the axis's variance, Eq. (27) of
    the paper.
    """
    return POSITION_RATE * POSITION_FLOOR**2 / covariance.diagonal(dim1=-2, dim2=-1)


def force_gain(covariance: Matrices, alpha_f: Numbers | float) -> Vectors:
    """Return the force gain [m/(s N)] on each axis: alpha_f [m N/s] over the axis's variance, Eq.
    (28) of the paper.
    """
    diagonal = covariance.diagonal(dim1=-2, dim2=-1)
    return alpha_f[..., None] / diagonal if isinstance(alpha_f, Tensor) else alpha_f / diagonal


def damped_inverse(
    jacobian: Float[Tensor, "*b m h"], damping: float = DAMPING
) -> Float[Tensor, "*b h m"]:
    """Return the damped inverse J^T (J J^T + damping I)^-1 of a Jacobian; `damping` is in m^2."""
    m, h = jacobian.shape[-2:]
    eye = torch.eye(min(m, h), dtype=jacobian.dtype, device=jacobian.device)
    transposed = jacobian.transpose(-1, -2)
    # the smaller of both products is solved
    if m <= h:
        normal = jacobian @ transposed + damping * eye
        return torch.linalg.solve(normal, jacobian).transpose(-1, -2)
    normal = transposed @ jacobian + damping * eye
    return torch.linalg.solve(normal, transposed)


def tip_velocity(
    position_error: Vectors,
    force_error: Vectors,
    blend: Numbers,
    position_gain: Vectors,
    force_gain: Vectors,
    together: bool = False,
) -> Vectors:
    """Return the commanded velocity [m/s] of each fingertip, at most `MAX_SPEED`: the bracket in
    Eq. (25) of the paper.

    The share `blend` of the velocity is force control, the rest position control. With `together`,
    the limit scales all fingers by one factor, which keeps the ratios of their speeds.
    """
    share = blend[..., None]
    velocity = (1 - share) * position_gain * position_error + share * force_gain * force_error
    if not together:
        return limit_norm(velocity, MAX_SPEED)
    fastest = torch.linalg.vector_norm(velocity, dim=-1).amax(-1)
    return velocity * (MAX_SPEED / fastest.clamp_min(MAX_SPEED))[..., None, None]


def stay_above(velocity: Vectors, height: Numbers, up: Float[Tensor, "3"]) -> Vectors:
    """Return fingertip velocities [m/s], slowed downwards so that tips at `height` [m] over the
    table stay above it.
    """
    lacking = -POSITION_RATE * height.clamp_min(0.0) - velocity @ up
    return velocity + lacking.clamp_min(0.0)[..., None] * up


def joint_step(
    jacobian: Float[Tensor, "*b f 3 h"],
    velocity: Float[Tensor, "*b f 3"],
    period: float,
    posture_error: Float[Tensor, "*b h"] | None = None,
    damping: float = DAMPING,
) -> Float[Tensor, "*b h"]:
    """Return the change of the joints [rad] in one tick, which moves the fingertips with the given
    velocities [m/s].

    Damped least squares over all fingers replace the inverse Jacobian in Eq. (25) of the paper,
    which coupled fingers lack. Motions that leave the fingertips at rest bring the joints towards
    the planned posture: `posture_error` [rad] is the planned minus the present joints.
    """
    stacked = jacobian.flatten(-3, -2)
    inverse_jacobian = damped_inverse(stacked, damping)
    step = (inverse_jacobian @ (velocity.flatten(-2) * period)[..., None])[..., 0]
    if posture_error is not None:
        correction = POSITION_RATE * period * posture_error
        step = step + correction - (inverse_jacobian @ (stacked @ correction[..., None]))[..., 0]
    largest = step.abs().amax(-1, keepdim=True)
    return step * (MAX_STEP / largest.clamp_min(MAX_STEP))
