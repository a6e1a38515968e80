"""The closing law (Eqs. 25-28): position control far from a contact, force control near it, weighted by uncertainty.

All functions are pure and batched over leading axes. Position gains are in 1/s, force gains in m/s per newton.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.geometry.linalg import cholesky, limit_norm, squared_mahalanobis

POSITION_FLOOR = 0.005
"""Isotropic standard deviation [m] of Sigma_cov: the accuracy of hand pose and joint zeros. Without it the inverse in
Eq. (27) is infinite for a normal along an axis."""

POSITION_RATE = 4.0
"""Position gain [1/s] of a contact without uncertainty, the largest: alpha_p = POSITION_RATE * POSITION_FLOOR**2."""

FORCE_BANDWIDTH = 15.0
"""Bandwidth [rad/s] of the most certain force loop: alpha_f is this times the fingertip's compliance times the least
variance, FORCE_FLOOR**2 without a model. The sensor's 20 Hz filter leaves 15 rad/s stable."""

FORCE_FLOOR = 0.3
"""Isotropic standard deviation [N] of Sigma_fd: the tactile sensor's accuracy along the surface."""

MAX_SPEED = 0.04
"""Largest speed [m/s] of a fingertip under the law: 0.4 mm between two samples of its sensor."""

MAX_STEP = 0.05
"""Largest change [rad] of any joint in one tick: it scales steps near a singular posture."""

DAMPING = 1e-5
"""Damping [m^2] of the inverse Jacobian; a finger's own J J^T is of the order 1e-3 m^2."""


def surface_covariance(
    normals: Float[Tensor, "*b 3"], std_m: Float[Tensor, "*b"], floor: float = POSITION_FLOOR
) -> Float[Tensor, "*b 3 3"]:
    """Return Sigma_cov of Eq. (27) [m^2]: the shape's variance along the normal plus that of an isotropic floor [m].

    >>> surface_covariance(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(0.01), floor=0.002).diagonal() * 1e6
    tensor([  4.,   4., 104.])
    """
    along = normals[..., :, None] * normals[..., None, :] * std_m[..., None, None] ** 2
    return along + floor**2 * torch.eye(3, dtype=normals.dtype, device=normals.device)


def blend(error: Float[Tensor, "*b 3"], covariance: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Return lambda of Eq. (26): 1 at the contact, near 0 where the error [m] exceeds the shape's uncertainty.

    Raises:
        IndefiniteCovariance: a covariance is not positive definite.

    >>> blend(torch.zeros(3), torch.eye(3))
    tensor(1.)
    """
    factor = cholesky(covariance, "the covariance of a contact", "add an isotropic floor")
    return torch.exp(-0.5 * squared_mahalanobis(error, factor))


def position_gain(covariance: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Return the diagonal of K_P [1/s] of Eq. (27): alpha_p [m^2/s] over the diagonal of Sigma_cov.

    >>> position_gain(POSITION_FLOOR**2 * torch.eye(3))
    tensor([4., 4., 4.])
    """
    return POSITION_RATE * POSITION_FLOOR**2 / covariance.diagonal(dim1=-2, dim2=-1)


def force_gain(covariance: Float[Tensor, "*b 3 3"], alpha_f: Float[Tensor, "*b"] | float) -> Float[Tensor, "*b 3"]:
    """Return the diagonal of C_F [m/(s N)] of Eq. (28): alpha_f [m N/s] over the diagonal of Sigma_fd [N^2]."""
    diagonal = covariance.diagonal(dim1=-2, dim2=-1)
    return alpha_f[..., None] / diagonal if isinstance(alpha_f, Tensor) else alpha_f / diagonal


def damped_inverse(jacobian: Float[Tensor, "*b m h"], damping: float = DAMPING) -> Float[Tensor, "*b h m"]:
    """Return J^T (J J^T + damping I)^-1."""
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
    """Return the bracket of Eq. (25) [m/s] for each fingertip, shortened to `MAX_SPEED`.

    `together` shortens all fingers (the last axis of `blend`) by one factor: their gains still tell who is faster.
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
    """Return velocities [m/s] of fingertips at a height [m] above a table: they sink ever slower, and not below it.

    >>> stay_above(torch.tensor([0.01, 0.0, -0.02]), torch.tensor(0.0), torch.tensor([0.0, 0.0, 1.0]))
    tensor([0.0100, 0.0000, 0.0000])
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
    """Return the change of the joints [rad] in one tick, Eq. (25), by damped least squares over all fingers.

    The paper's J^-1 does not exist for coupled fingers, nor for four joints. Joint motions that move no fingertip
    reduce `posture_error` at `POSITION_RATE`.

    Args:
        jacobian: of the f fingertips [m/rad].
        velocity: of the fingertips [m/s] (`tip_velocity`).
        period: of the controller [s].
        posture_error: planned minus present joints [rad]; None: ignored.
        damping: of the inverse [m^2].

    >>> joint_step(torch.zeros(3, 3, 4), torch.ones(3, 3), 0.01)
    tensor([0., 0., 0., 0.])
    """
    stacked = jacobian.flatten(-3, -2)
    inverse_jacobian = damped_inverse(stacked, damping)
    step = (inverse_jacobian @ (velocity.flatten(-2) * period)[..., None])[..., 0]
    if posture_error is not None:
        correction = POSITION_RATE * period * posture_error
        step = step + correction - (inverse_jacobian @ (stacked @ correction[..., None]))[..., 0]
    largest = step.abs().amax(-1, keepdim=True)
    return step * (MAX_STEP / largest.clamp_min(MAX_STEP))
