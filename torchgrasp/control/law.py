"""The closing control law (Eqs. 25-28 of the paper): position control far from a contact, force
control near it.

The gains are inverse to the uncertainty of shape and force. All functions are pure. `*b` stands for
leading axes, of which the last is usually that of the f fingers. Normals are outward unit vectors,
and all vectors of a call are in one frame, usually the hand's.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.geometry.linalg import cholesky, dot, limit_norm, norm, squared_mahalanobis

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


def surface_covariance(
    normals: Float[Tensor, "*b 3"], std_m: Float[Tensor, "*b"]
) -> Float[Tensor, "*b 3 3"]:
    """Return the covariance [m^2] of each contact's position in the closing mode "uncertainty".

    It is n n^T s^2 + floor^2 I. Here n is the contact's normal, from `normals`, and s its standard
    deviation `std_m` [m]. The floor of 5 mm (`POSITION_FLOOR`) covers the hand's own errors, which
    are equal in all directions. `*b` stands for any leading axes.
    """
    return _normal_covariance(normals, std_m, POSITION_FLOOR)


def printed_covariance(
    normals: Float[Tensor, "*b 3"], distance_variance: Float[Tensor, "*b"]
) -> Float[Tensor, "*b 3 3"]:
    """Return the covariance [m^2] of each contact's position that Eq. (27) of the paper prints:
    Sigma_cov = diag(|R f_cov n|).

    `distance_variance` [m^2] is f_cov, the variance of the signed distance. `normals` are R n, in
    the hand's frame. A normal across an axis makes Sigma_cov singular. So each diagonal entry is at
    least (0.1 mm)^2 (`PRINTED_FLOOR`). `*b` stands for any leading axes.
    """
    entries = (distance_variance[..., None] * normals).abs()
    return torch.diag_embed(entries.clamp_min(PRINTED_FLOOR**2))


def force_covariance(
    forces: Float[Tensor, "*b 3"],
    normals: Float[Tensor, "*b 3"],
    deviation: Float[Tensor, "*b"] | None = None,
) -> Float[Tensor, "*b 3 3"]:
    """Return the covariance [N^2] of each contact force (Sigma_fd, Eq. 28 of the paper).

    It is the variance of the normal force along the normal, plus the sensor's variance, equal in
    all directions. `forces` [N] are the desired forces, and `normals` the unit normals of the
    contacts, in the same frame. `*b` stands for any leading axes. `deviation` [N] is the standard
    deviation of each normal force; None means a tenth of the force.
    """
    if deviation is None:
        deviation = FORCE_SHARE * dot(forces, normals)
    return _normal_covariance(normals, deviation, FORCE_FLOOR)


def _normal_covariance(
    normals: Float[Tensor, "*b 3"], std: Float[Tensor, "*b"], floor: float
) -> Tensor:
    """Return covariances (*b, 3, 3): the variance `std`^2 along the normal, plus `floor`^2 in all
    directions.
    """
    along = normals[..., :, None] * normals[..., None, :] * std[..., None, None] ** 2
    return along + floor**2 * torch.eye(3, dtype=normals.dtype, device=normals.device)


def blend(error: Float[Tensor, "*b 3"], covariance: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Return each finger's share of force control, from 0 to 1: lambda = exp(-e^T Sigma_cov^-1 e /
    2), Eq. (26).

    `error` [m] is e, from the fingertip to its contact, and `covariance` [m^2] is Sigma_cov. The
    share is 1 at the contact, and near 0 where the error exceeds the shape's uncertainty. Both are
    in one frame. `*b` stands for any leading axes.
    """
    factor = cholesky(covariance, "the covariance of a contact", "add an isotropic floor")
    return torch.exp(-0.5 * squared_mahalanobis(error, factor))


def position_gain(covariance: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Return the position gain [1/s] on each axis: a constant divided by the axis's variance, Eq.
    (27) of the paper.

    The gain is 4 / s (`POSITION_RATE`) at a standard deviation of 5 mm (`POSITION_FLOOR`).
    `covariance` [m^2] is that of the contact's position. `*b` stands for any leading axes.
    """
    return POSITION_RATE * POSITION_FLOOR**2 / covariance.diagonal(dim1=-2, dim2=-1)


def force_gain(
    covariance: Float[Tensor, "*b 3 3"], alpha_f: Float[Tensor, "*b"] | float
) -> Float[Tensor, "*b 3"]:
    """Return the force gain [m/(s N)] on each axis, Eq. (28) of the paper. It is `alpha_f` [m N/s]
    divided by the axis's variance.

    `covariance` [N^2] is that of the contact force. `*b` stands for any leading axes.
    """
    diagonal = covariance.diagonal(dim1=-2, dim2=-1)
    return alpha_f[..., None] / diagonal if isinstance(alpha_f, Tensor) else alpha_f / diagonal


def damped_inverse(
    jacobian: Float[Tensor, "*b m h"], damping: float = DAMPING
) -> Float[Tensor, "*b h m"]:
    """Return the damped inverse J^T (J J^T + damping I)^-1 of a `jacobian` [m/rad], in rad/m.
    `damping` is in m^2, m counts coordinates of points, and h counts joints. `*b` stands for any
    leading axes.
    """
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
    position_error: Float[Tensor, "*b 3"],
    force_error: Float[Tensor, "*b 3"],
    blend: Float[Tensor, "*b"],
    position_gain: Float[Tensor, "*b 3"],
    force_gain: Float[Tensor, "*b 3"],
    together: bool = False,
) -> Float[Tensor, "*b 3"]:
    """Return the commanded velocity [m/s] of each fingertip, the bracket in Eq. (25) of the paper.

    It is (1 - lambda) K_P e_x + lambda C_F e_f, shortened to at most 0.04 m/s (`MAX_SPEED`). Here
    e_x and e_f are the errors of position and of force. All vectors are in one frame. `*b` stands
    for any leading axes, of which the last is that of the fingers.

    Args:
        position_error: e_x, from each fingertip to its contact [m].
        force_error: e_f, desired minus sensed force on the object [N].
        blend: lambda, the share of force control, from 0 to 1; the rest is position control.
        position_gain: diagonal of K_P, the gain on each axis [1/s].
        force_gain: diagonal of C_F, the gain on each axis [m/(s N)].
        together: whether the limit scales all fingers by one factor, which keeps the ratios of
            their speeds.
    """
    share = blend[..., None]
    velocity = (1 - share) * position_gain * position_error + share * force_gain * force_error
    if not together:
        return limit_norm(velocity, MAX_SPEED)
    moving = torch.where((velocity == 0).all(-1, keepdim=True), velocity.detach(), velocity)
    fastest = norm(moving).amax(-1)
    return velocity * (MAX_SPEED / fastest.clamp_min(MAX_SPEED))[..., None, None]


def stay_above(
    velocity: Float[Tensor, "*b 3"], height: Float[Tensor, "*b"], up: Float[Tensor, "3"]
) -> Float[Tensor, "*b 3"]:
    """Return each fingertip's `velocity` [m/s], limited so that no fingertip enters the table.

    Its component along the table's unit normal `up` is raised to at least -r h. Here r is 4 / s
    (`POSITION_RATE`), and h = max(`height`, 0). The `height` [m] is that of each fingertip's lowest
    point over the table. Velocities and `up` are in one frame. `*b` stands for any leading axes.
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
    """Return the change [rad] of the actuated joints in one control period that moves the
    fingertips with a `velocity` [m/s].

    Damped least squares over all fingers replace the inverse Jacobian in Eq. (25) of the paper,
    which coupled fingers lack. If a joint would change by more than 0.05 rad (`MAX_STEP`), all
    changes are scaled down by one factor. `*b` stands for any leading axes.

    Args:
        jacobian: Jacobian [m/rad] of the f fingertips with respect to the h actuated joints.
        velocity: commanded velocity [m/s] of each fingertip, in the frame of the Jacobian.
        period: control period [s].
        posture_error: planned minus present joints [rad]. Joint motions that leave the fingertips
            at rest reduce it. None means that no such motion is added.
        damping: damping of the inverse [m^2].
    """
    stacked = jacobian.flatten(-3, -2)
    inverse_jacobian = damped_inverse(stacked, damping)
    step = (inverse_jacobian @ (velocity.flatten(-2) * period)[..., None])[..., 0]
    if posture_error is not None:
        correction = POSITION_RATE * period * posture_error
        step = step + correction - (inverse_jacobian @ (stacked @ correction[..., None]))[..., 0]
    largest = step.abs().amax(-1, keepdim=True)
    return step * (MAX_STEP / largest.clamp_min(MAX_STEP))
