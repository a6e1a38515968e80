"""The closing control law (Eqs. 25-28): position control far from a contact, force control near it.

The gains are inverse to the uncertainty of shape and force. All functions are pure and batched over leading axes.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.geometry.linalg import cholesky, limit_norm, squared_mahalanobis

POSITION_FLOOR = 0.005
"""Isotropic standard deviation [m] of Sigma_cov: errors of hand pose and joint zeros; it keeps Eq. (27) finite."""

POSITION_RATE = 4.0  # largest position gain [1/s]: alpha_p = POSITION_RATE * POSITION_FLOOR**2

FORCE_BANDWIDTH = 15.0  # bandwidth [rad/s] of the most certain force loop; the lag of the sensor's filter bounds it

FORCE_FLOOR = 0.3  # isotropic standard deviation [N] of Sigma_fd: the tactile sensor's noise along the surface

MAX_SPEED = 0.04  # largest speed [m/s] of a fingertip

MAX_STEP = 0.05  # largest change [rad] of a joint in one tick; it bounds steps near a singular posture


def surface_covariance(normals: Float[Tensor, "*b 3"], std_m: Float[Tensor, "*b"]) -> Float[Tensor, "*b 3 3"]:
    """Return Sigma_cov of Eq. (27) [m^2]: the shape's variance along the normal plus an isotropic floor."""
    return _normal_covariance(normals, std_m, POSITION_FLOOR)


def force_covariance(
    forces: Float[Tensor, "*b 3"], normals: Float[Tensor, "*b 3"], deviation: Float[Tensor, "*b"] | None = None
) -> Float[Tensor, "*b 3 3"]:
    """Return Sigma_fd of Eq. (28) [N^2]: the variance of the normal force along the normal, plus an isotropic floor.

    `deviation` [N] is the standard deviation of each normal force; by default a tenth of the force.
    """
    std = 0.1 * (forces * normals).sum(-1) if deviation is None else deviation
    return _normal_covariance(normals, std, FORCE_FLOOR)


def _normal_covariance(normals: Float[Tensor, "*b 3"], std: Float[Tensor, "*b"], floor: float) -> Tensor:
    """Return covariances (3, 3) with standard deviation `std` along the normal, plus an isotropic `floor`."""
    along = normals[..., :, None] * normals[..., None, :] * std[..., None, None] ** 2
    return along + floor**2 * torch.eye(3, dtype=normals.dtype, device=normals.device)


def blend(error: Float[Tensor, "*b 3"], covariance: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Return lambda of Eq. (26): 1 at the contact, near 0 where the error [m] exceeds the shape's uncertainty."""
    factor = cholesky(covariance, "the covariance of a contact", "add an isotropic floor")
    return torch.exp(-0.5 * squared_mahalanobis(error, factor))


def position_gain(covariance: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Return the diagonal of K_P [1/s] of Eq. (27): alpha_p [m^2/s] over the diagonal of Sigma_cov."""
    return POSITION_RATE * POSITION_FLOOR**2 / covariance.diagonal(dim1=-2, dim2=-1)


def force_gain(covariance: Float[Tensor, "*b 3 3"], alpha_f: Float[Tensor, "*b"] | float) -> Float[Tensor, "*b 3"]:
    """Return the diagonal of C_F [m/(s N)] of Eq. (28): alpha_f [m N/s] over the diagonal of Sigma_fd [N^2]."""
    diagonal = covariance.diagonal(dim1=-2, dim2=-1)
    return alpha_f[..., None] / diagonal if isinstance(alpha_f, Tensor) else alpha_f / diagonal


def damped_inverse(jacobian: Float[Tensor, "*b m h"], damping: float = 1e-5) -> Float[Tensor, "*b h m"]:
    """Return the damped inverse J^T (J J^T + damping I)^-1 of a Jacobian; `damping` is in m^2."""
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
    together: bool = False,
) -> Float[Tensor, "*b 3"]:
    """Return the velocity [m/s] of each fingertip, the bracket of Eq. (25), limited to `MAX_SPEED`.

    `together` scales all fingers by one factor, so that the ratios of their speeds stay those of Eq. (25).
    """
    share = blend[..., None]
    velocity = (1 - share) * position_gain * position_error + share * force_gain * force_error
    if not together:
        return limit_norm(velocity, MAX_SPEED)
    fastest = torch.linalg.vector_norm(velocity, dim=-1).amax(-1)
    return velocity * (MAX_SPEED / fastest.clamp_min(MAX_SPEED))[..., None, None]


def stay_above(
    velocity: Float[Tensor, "*b 3"], height: Float[Tensor, "*b"], up: Float[Tensor, "3"]
) -> Float[Tensor, "*b 3"]:
    """Return fingertip velocities [m/s], slowed downwards so that tips at `height` [m] stay above the table."""
    lacking = -POSITION_RATE * height.clamp_min(0.0) - velocity @ up
    return velocity + lacking.clamp_min(0.0)[..., None] * up


def joint_step(
    jacobian: Float[Tensor, "*b f 3 h"],
    velocity: Float[Tensor, "*b f 3"],
    period: float,
    posture_error: Float[Tensor, "*b h"] | None = None,
    damping: float = 1e-5,
) -> Float[Tensor, "*b h"]:
    """Return the change of the joints [rad] in one tick, Eq. (25), by damped least squares over all fingers.

    The paper's J^-1 does not exist for coupled fingers or few joints. In the null space of the Jacobian the joints move
    towards the planned posture: `posture_error` [rad] is the planned minus the present joints.
    """
    stacked = jacobian.flatten(-3, -2)
    inverse_jacobian = damped_inverse(stacked, damping)
    step = (inverse_jacobian @ (velocity.flatten(-2) * period)[..., None])[..., 0]
    if posture_error is not None:
        correction = POSITION_RATE * period * posture_error
        step = step + correction - (inverse_jacobian @ (stacked @ correction[..., None]))[..., 0]
    largest = step.abs().amax(-1, keepdim=True)
    return step * (MAX_STEP / largest.clamp_min(MAX_STEP))
