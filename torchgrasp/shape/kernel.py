"""Radial kernels k(r): the paper's thin plate, Matern 5/2, the squared exponential, or your own.

Autograd of the scalar profile gives the derivatives. A closed form may be registered as a speed-up.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.checks import LEAST, Positive, Range, checked

Profile = Callable[[Tensor], Tensor]
"""A radial kernel k(r), elementwise and three times differentiable where r > 0, with k'(0) = 0."""
KernelName = Literal["thin_plate", "matern52", "rbf"]

NEAR = 1e-5
"""Below this distance k'(r)/r is k''(r/2), its midpoint rule: exact for the thin plate, and no 0/0."""
LEAST_PSI = 4.0 / 3.0
"""psi over the diameter of a ball in which the thin plate kernel is positive definite (dense limit: 1.313)."""


Orders = Annotated[int, Range(1, 4)]
"""How many of k and its derivatives: three derivatives are the most that are used."""


@checked
@dataclasses.dataclass(frozen=True)
class Kernel:
    """A radial kernel k(r) of normalised distances.

    Args:
        profile: k(r); the covariances of distances and normals follow from it by autograd.
        diameter: of the ball, normalised, within which k is a covariance; infinite if it is one everywhere.
        remedy: what to do when the covariance is not positive definite.
        closed_form: a faster `differentiate` of this profile, called with `r` and `count`; None: autograd.

    >>> kernel = Kernel(lambda r: (1 + r) * torch.exp(-r))
    >>> [round(float(s), 4) for s in kernel.derivatives(torch.ones(1, dtype=torch.float64), 4)]
    [0.7358, -0.3679, 0.3679, -0.7358]
    """

    profile: Profile
    diameter: Annotated[float, Range(LEAST, math.inf)] = math.inf
    remedy: str = "use more noise, or a shorter length of the kernel"
    closed_form: Callable[[Tensor, int], tuple[Tensor, ...]] | None = None

    @checked(gradients=True)
    def derivatives(self, r: Float[Tensor, "*s"], count: Orders) -> tuple[Float[Tensor, "*s"], ...]:
        """Return the first `count` of k and its derivatives in r^2 / 2; see `differentiate`."""
        return differentiate(self.profile, r, count) if self.closed_form is None else self.closed_form(r, count)


def differentiate(profile: Profile, r: Float[Tensor, "*s"], count: int) -> tuple[Float[Tensor, "*s"], ...]:
    """Return k and its derivatives in u = r^2 / 2 by autograd, `count` in all, at most 4.

    dk/du is k'(r)/r, which tends to k''(0). Higher derivatives are 0 at r = 0, where they may be infinite. In every
    covariance a factor vanishes faster.

    >>> differentiate(lambda r: torch.exp(-(r**2)), torch.zeros(1), 2)
    (tensor([1.]), tensor([-2.]))
    """
    k, *by_r = _differentiate_by_distance(profile, r, max(count - 1, 1))
    *_, midpoint = _differentiate_by_distance(profile, r / 2, 2)
    positive = torch.where(r > 0, r, 1.0)
    values = [k, torch.where(r < NEAR, midpoint, by_r[0] / positive)]
    if count > 2:
        values.append(torch.where(r > 0, (by_r[1] - values[1]) / positive**2, 0.0))
    if count > 3:
        third = (by_r[2] / positive - 3.0 * values[2]) / positive**2
        values.append(torch.where(r < NEAR, 0.0, third))
    return tuple(values[:count])


def thin_plate(r: Float[Tensor, "*s"], psi: float) -> Float[Tensor, "*s"]:
    """Return the thin plate kernel 2 r^3 - 3 psi r^2 + psi^3, Eq. (6).

    The kernel and its slope vanish at r = psi. It is a covariance only within a ball of diameter 3/4 psi. With the
    paper's psi, the longest distance of the data, three points and two normals may have a negative eigenvalue.

    >>> thin_plate(torch.tensor([0.0, 2.0]), psi=2.0)
    tensor([8., 0.])
    """
    # Not factored as (psi - r)^2 (psi + 2 r): its derivative would cancel at r -> 0, where normals need it.
    return r * r * (2.0 * r - 3.0 * psi) + psi**3


@checked
def thin_plate_kernel(psi: Positive) -> Kernel:
    """Return the thin plate kernel with the closed form of its derivatives.

    >>> kernel = thin_plate_kernel(psi=2.0)
    >>> kernel.diameter
    1.5
    """
    remedy = "use a psi_scale of at least 1.34: the thin plate kernel is a covariance only within 3/4 psi"
    return Kernel(partial(thin_plate, psi=psi), psi / LEAST_PSI, remedy, partial(_differentiate_thin_plate, psi))


@checked
def matern52_kernel(length: Positive, variance: Positive = 1.0) -> Kernel:
    """Return Matern 5/2: variance (1 + s + s^2 / 3) exp(-s) with s = sqrt(5) r / length.

    >>> float(matern52_kernel(1.0).profile(torch.zeros(())))
    1.0
    """

    def profile(r: Tensor) -> Tensor:
        s = (math.sqrt(5.0) / length) * r
        return variance * (1.0 + s + s * s / 3.0) * torch.exp(-s)

    return Kernel(profile)


@checked
def rbf_kernel(length: Positive, variance: Positive = 1.0) -> Kernel:
    """Return the squared exponential kernel: variance exp(-r^2 / (2 length^2)).

    >>> float(rbf_kernel(1.0).profile(torch.zeros(())))
    1.0
    """
    return Kernel(lambda r: variance * torch.exp(r * r * (-0.5 / length**2)))


@checked
def kernel_by_name(name: KernelName, psi: Positive) -> Kernel:
    """Return "thin_plate", "matern52" or "rbf" with k(0) = psi^3 and k''(0) = -6 psi, as the thin plate has.

    The lengths are psi / sqrt(6) for "rbf" and sqrt(5/18) psi for "matern52".

    Raises:
        BadArgument: another name.

    >>> wide = kernel_by_name("rbf", psi=2.0).profile(torch.tensor([0.0, 1.0]))
    >>> wide[0]  # psi^3
    tensor(8.)
    """
    if name == "thin_plate":
        return thin_plate_kernel(psi)
    if name == "matern52":
        return matern52_kernel(psi * math.sqrt(5.0 / 18.0), psi**3)
    return rbf_kernel(psi / math.sqrt(6.0), psi**3)


def _differentiate_by_distance(profile: Profile, r: Tensor, order: int) -> list[Tensor]:
    """Return the profile and its derivatives in r up to an order, elementwise."""
    with torch.enable_grad():
        r = r.detach().requires_grad_()
        values = [profile(r)]
        for _ in range(order):
            value = values[-1] + 0.0 * r  # a constant would have no graph
            values += torch.autograd.grad(value.sum(), r, create_graph=True)
    return [value.detach() for value in values]


def _differentiate_thin_plate(psi: float, r: Tensor, count: int) -> tuple[Tensor, ...]:
    """Return what `differentiate` does for the thin plate, in closed form."""
    values = [(2.0 * r).sub_(3.0 * psi).mul_(r).mul_(r).add_(psi**3), (6.0 * r).sub_(6.0 * psi)]
    if count > 2:
        inverse = torch.reciprocal(r).masked_fill_(r == 0, 0.0)
        values.append(6.0 * inverse)
        if count > 3:
            values.append((inverse * inverse).mul_(inverse).mul_(-6.0))
    return tuple(values)
