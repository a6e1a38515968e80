"""Radial kernels of the shape by name: the thin plate of the paper, Matern 5/2, the squared exponential, any other."""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.errors import BadArgument
from torchgrasp.shape.kernel import NEAR, Profile, radial_derivatives, thin_plate

KernelName = Literal["thin_plate", "matern52", "rbf"]
LEAST_PSI = 4.0 / 3.0
"""psi over the diameter of a ball on which the thin plate kernel is positive definite (dense limit 1.313)."""
PLATE_REMEDY = "use a psi_scale of at least 1.34: the thin plate kernel is a covariance only within 3/4 psi"
NOISE_REMEDY = "use more noise, or a shorter length of the kernel"


@dataclasses.dataclass(frozen=True)
class Kernel:
    """A radial kernel k(r) of normalised distances, with what the posterior's fast path needs of it.

    With u = r^2 / 2, `slopes(r, 4)` returns (k, dk/du, d2k/du2, d3k/du3) and `slopes(r, 2)` the first two. Every
    derivative of the posterior mean up to the Hessian is a polynomial in them and in the difference of two points. A
    third or fourth number that is infinite at r = 0 is 0 there: the differences that multiply it vanish faster.

    Args:
        profile: k(r), elementwise and differentiable; the covariance is derived from it by autograd.
        slopes: see above; `Kernel.from_profile` derives them.
        diameter: of the ball, normalised, within which k is a covariance; infinite if it is everywhere.
        remedy: what to do when the covariance is not positive definite.
    """

    profile: Profile
    slopes: Callable[[Tensor, int], tuple[Tensor, ...]]
    diameter: float = math.inf
    remedy: str = NOISE_REMEDY

    @classmethod
    def from_profile(cls, profile: Profile, diameter: float = math.inf) -> "Kernel":
        """Return the kernel of any profile, thrice differentiable by autograd where r > 0, with k'(0) = 0.

        >>> kernel = Kernel.from_profile(lambda r: (1 + r) * torch.exp(-r))
        >>> [round(float(s), 4) for s in kernel.slopes(torch.ones(1, dtype=torch.float64), 4)]
        [0.7358, -0.3679, 0.3679, -0.7358]
        """
        return cls(profile, partial(differentiate_profile, profile), diameter)


def kernel_by_name(name: str, psi: float) -> Kernel:
    """Return a kernel whose prior variances of distance and normal are those of the thin plate with this psi.

    k(0) is psi^3 and k''(0) is -6 psi for all three. The squared exponential then has the length psi / sqrt(6), and
    Matern 5/2 has sqrt(5/18) psi.

    Args:
        name: "thin_plate", "matern52" or "rbf".
        psi: normalised.

    Raises:
        BadArgument: another name.
    """
    if name == "thin_plate":
        plate = partial(thin_plate, psi=psi)
        return Kernel(plate, partial(_slopes_of_plate, psi), psi / LEAST_PSI, PLATE_REMEDY)
    if name == "matern52":
        return matern52_kernel(psi * math.sqrt(5.0 / 18.0), psi**3)
    if name == "rbf":
        return rbf_kernel(psi / math.sqrt(6.0), psi**3)
    raise BadArgument("kernel", repr(name), "'thin_plate', 'matern52', 'rbf' or a Kernel")


def matern52_kernel(length: float, variance: float = 1.0) -> Kernel:
    """Return the Matern kernel v (1 + s + s^2 / 3) exp(-s) with s = sqrt(5) r / length, v = `variance`.

    >>> float(matern52_kernel(1.0).profile(torch.zeros(())))
    1.0
    """
    _check_positive(length, variance)
    rate = math.sqrt(5.0) / length

    def profile(r: Tensor) -> Tensor:
        s = rate * r
        return variance * (1.0 + s + s * s / 3.0) * torch.exp(-s)

    def slopes(r: Tensor, count: int) -> tuple[Tensor, ...]:
        s = rate * r
        decay = (variance * rate**2 / 3.0) * torch.exp(-s)
        found = [decay * (3.0 + 3.0 * s + s * s) / rate**2, -decay * (1.0 + s)]
        if count > 2:
            found += [rate**2 * decay, -(rate**3) * decay * torch.where(r > 0, 1.0 / r, 0.0)]
        return tuple(found[:count])

    return Kernel(profile, slopes)


def rbf_kernel(length: float, variance: float = 1.0) -> Kernel:
    """Return the squared exponential kernel v exp(-r^2 / (2 length^2)), v = `variance`.

    >>> float(rbf_kernel(1.0).profile(torch.zeros(())))
    1.0
    """
    _check_positive(length, variance)

    def profile(r: Tensor) -> Tensor:
        return variance * torch.exp(r * r * (-0.5 / length**2))

    def slopes(r: Tensor, count: int) -> tuple[Tensor, ...]:
        k = profile(r)
        return tuple(k * (-1.0 / length**2) ** i for i in range(count))

    return Kernel(profile, slopes)


def differentiate_profile(profile: Profile, r: Float[Tensor, "*s"], count: int) -> tuple[Float[Tensor, "*s"], ...]:
    """Return k and its first derivatives in r^2 / 2, `count` in all, by autograd; see `Kernel` for r = 0."""
    k, slope, _ = radial_derivatives(profile, r)
    near = r < NEAR
    with torch.enable_grad():
        u = torch.where(near, 1.0, 0.5 * r.detach() ** 2).requires_grad_()
        found = profile(torch.sqrt(2.0 * u))
        higher: list[Tensor] = []
        for _ in range(3):
            (found,) = torch.autograd.grad(found.sum(), u, create_graph=True, materialize_grads=True)
            higher.append(found.detach().masked_fill(near, 0.0))
    return (k, slope, *higher[1:])[:count]


def _slopes_of_plate(psi: float, r: Tensor, count: int) -> tuple[Tensor, ...]:
    """Return the slopes of the thin plate; the last two are infinite at r = 0, and given as 0."""
    found = [(2.0 * r).sub_(3.0 * psi).mul_(r).mul_(r).add_(psi**3), (6.0 * r).sub_(6.0 * psi)]
    if count > 2:
        inverse = torch.reciprocal(r).masked_fill_(r == 0, 0.0)
        found.append(6.0 * inverse)
        if count > 3:
            found.append((inverse * inverse).mul_(inverse).mul_(-6.0))
    return tuple(found)


def _check_positive(length: float, variance: float) -> None:
    """Refuse a length or a variance that is no positive number."""
    for name, value in (("length", length), ("variance", variance)):
        if not 0.0 < value < math.inf:
            raise BadArgument(name, value, "a positive number, normalised")
