"""The covariance of observations with normals anywhere, by autograd of the kernel's profile: the reference of tests."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.shape.gradient_kernel import cross_covariance
from torchgrasp.shape.kernel import Kernel, Profile


def covariance(
    x: Float[Tensor, "n 3"],
    other: Float[Tensor, "m 3"],
    has_normal: Bool[Tensor, "n"],
    other_has_normal: Bool[Tensor, "m"],
    profile: Profile,
) -> Float[Tensor, "rows columns"]:
    """Return the covariance of observations, Eqs. (2)-(5): all d, then w1, w2, w3 of the points with normals."""
    # Detached as the derivatives of the profile are: a gradient through one factor alone would be wrong.
    blocks = cross_covariance(Kernel(profile), x.detach(), other.detach(), len(other)).flatten(0, 1)
    rows, columns = (torch.cat([torch.ones_like(mask), mask.repeat(3)]) for mask in (has_normal, other_has_normal))
    return blocks[rows][:, columns]
