"""Desired fingertip forces and their covariance: what Eq. (28) weights force errors by."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.plan.internal_forces import least_friction_forces

FORCE_SPREAD = 0.1
"""Relative standard deviation of the desired normal force, where no model of stable grasps gives that of Eq. (28)."""


def desired_forces(
    points: Float[Tensor, "*b 3 3"],
    normals: Float[Tensor, "*b 3 3"],
    strongest: float = 4.0,
    wish: Float[Tensor, "*#b 3"] | None = None,
) -> Float[Tensor, "*b 3 3"]:
    """Return `least_friction_forces`, or `strongest` along the normals where no balanced set presses at all contacts."""
    balanced = least_friction_forces(points, normals, strongest, wish)
    return torch.where(torch.isfinite(balanced), balanced, -strongest * normals)


def force_covariance(
    forces: Float[Tensor, "*b 3"],
    normals: Float[Tensor, "*b 3"],
    floor: float,
    deviation: Float[Tensor, "*b"] | None = None,
) -> Float[Tensor, "*b 3 3"]:
    """Return Sigma_fd of Eq. (28) [N^2]: the normal force's deviation along the normal over an isotropic floor.

    Args:
        forces: desired [N].
        normals: outward unit normals.
        floor: standard deviation in every direction [N].
        deviation: of the normal forces [N], from the model of stable grasps; None: the analytic stand-in, by which a
            stronger force is less certain in proportion (`FORCE_SPREAD`).
    """
    deviation = FORCE_SPREAD * (forces * normals).sum(-1) if deviation is None else deviation
    along = normals[..., :, None] * normals[..., None, :] * deviation[..., None, None] ** 2
    return along + floor**2 * torch.eye(3, dtype=forces.dtype, device=forces.device)
