"""The probability that contacts have force closure although friction, finger placement and normals
are uncertain.

Contacts close where the friction coefficient exceeds the critical friction mu_c. To first order,
contacts that move by u_i and normals that turn by w_i, both along the surface, change mu_c by

    sum_i (f_i x y / r) . u_i + (mu_c s_i0 f_i - a_i s_i) . w_i

with the symbols of `torchgrasp.contacts.critical`, of the twist y only the rotation, and the
root-mean-square radius r of the contacts. An object that is displaced by v, and turned by z about
the centroid of its contacts p_i, moves all contacts together: u_i is the part of v + z x (p_i - p)
along the surface, with the centroid p. So Gaussian errors make mu_c Gaussian, with a standard
deviation s. Then the friction m suffices with the probability Phi((m - mu_c) / s), whose mean for m
in an interval [a, b] is

    s (Psi((b - mu_c) / s) - Psi((a - mu_c) / s)) / (b - a),    Psi(x) = x Phi(x) + Phi'(x).
"""

import math
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.contacts.certify import check_contacts, check_unit
from torchgrasp.contacts.critical import LeastBalance, least_balance
from torchgrasp.contacts.form_closure import Vectors, centre_and_radius
from torchgrasp.foundation.base import at_once, in_chunks
from torchgrasp.foundation.checks import check_tensor, checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Length, Range
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.geometry.frames import real
from torchgrasp.geometry.linalg import dot
from torchgrasp.values.distribution import Distribution, check_within
from torchgrasp.values.planning import Contacts
from torchgrasp.values.specs import FRICTIONS

TILTS = Range(0.0, math.pi)
"""The standard deviations [rad] of a normal that are possible."""
NARROW = 1e-4
"""An interval shorter than this, in standard deviations, counts as its middle: the difference of
Psi would be lost in rounding.
"""
PARTS = 2**20
"""Pairs of a contact set and a part of the distribution that are computed at a time."""


@checked
@single_threaded
def hold_probability(
    contacts: Contacts,
    friction: Annotated[float, FRICTIONS] | Distribution,
    placement: Length = 0.0,
    tilt: Annotated[float, TILTS] | Float[Tensor, "b f"] = 0.0,
    shift: Length = 0.0,
    turn: Annotated[float, TILTS] = 0.0,
) -> Float[Tensor, "b"]:
    """Return the probability (b,) that each contact set has force closure, for uncertain friction,
    finger placement, normals and object pose.

    If only the friction is uncertain, the result is exact. It then is the probability that the
    friction exceeds the `critical_friction`, and 0 where that is infinite. The other errors count
    to first order. So the result is mostly a little too high, since errors also raise the mean of
    the critical friction. Errors count too little where the critical friction has a kink, as for
    contacts that are exactly symmetric.

    Args:
        contacts: sets of 3 to 5 contacts (b, f, 3) [m] with outward unit normals.
        friction: coefficient of friction of all contacts, or its `Distribution`, in [0, 10].
        placement: standard deviation [m] of each fingertip's position along each of two
            perpendicular tangents. The normal stays as it is, as on a surface that is flat nearby.
        tilt: standard deviation [rad] of the angle of a normal about each of two perpendicular
            tangents. It is one number for all contacts, or one for each (b, f).
        shift: standard deviation [m] of the object's position along each of three axes. It moves
            all contacts together along the surface.
        turn: standard deviation [rad] of the object's rotation about each of three axes through the
            contacts' centroid.

    Raises `BadArgument` for:

    * sets of other than 3 to 5 contacts;
    * normals that are not of length 1 (to 1e-3);
    * numbers outside their range.

    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> contacts = load_shipped_grasp("jug", "allegro").contacts
    >>> friction = Distribution.between(0.0, 1.0)
    >>> hold_probability(contacts, friction, placement=0.002) > 0.5
    tensor([True])
    """
    points = check_contacts(contacts).points.double()
    normals = check_unit(contacts.normals.double())
    check_within("friction", friction, FRICTIONS)
    tilts = _tilts(tilt, points)
    rows, balance = least_balance(points, normals)
    moved, turned = sensitivities(points[rows], normals[rows], balance)
    errors = torch.stack([placement * moved, tilts[rows, :, None] * turned], 1)  # (k, 2, f, 3)
    arms = points[rows] - points[rows].mean(1, keepdim=True)
    together = torch.stack(
        [shift * moved.sum(1), turn * torch.linalg.cross(arms, moved).sum(1)], 1
    )  # (k, 2, 3)
    errors = torch.cat([errors.flatten(1), together.flatten(1)], 1)
    deviation = torch.linalg.vector_norm(errors, dim=1)
    found = exceeding(Distribution.of(friction), balance.friction, deviation)
    return points.new_zeros(len(points)).index_put((rows,), found).to(contacts.points)


def _tilts(tilt: float | Tensor, points: Vectors) -> Float[Tensor, "b f"]:
    """Return the standard deviation [rad] of each normal; raise `BadArgument` if there is not one
    for each contact, or one is out of range.
    """
    if not isinstance(tilt, Tensor):
        return torch.full_like(points[..., 0], tilt)
    check_tensor("tilt", tilt, tuple(points.shape[:2]))
    wrong = tilt[(tilt < TILTS.low) | (tilt > TILTS.high)]
    if len(wrong):
        allowed = f"angles in [{TILTS.low:g}, {TILTS.high:.4g}] rad"
        raise BadArgument("tilt", f"{float(wrong[0]):g}", allowed)
    return tilt.to(points)


def sensitivities(
    points: Vectors, normals: Vectors, balance: LeastBalance
) -> tuple[Vectors, Vectors]:
    """Return the derivatives of the critical friction by points [1/m] and by normals, along the
    surface; `balance` is that of the contacts.
    """
    _, radius = centre_and_radius(points)
    rotation = balance.twist[:, None, 3:].expand_as(points)
    moved = torch.linalg.cross(balance.forces, rotation) / radius
    push = -dot(balance.forces, normals, keepdim=True)
    pressed = (balance.friction[:, None] * balance.press)[..., None] * balance.forces
    turned = pressed - push * balance.slide
    moved, turned = (x - dot(x, normals, keepdim=True) * normals for x in (moved, turned))
    return moved, turned


def exceeding(
    law: Distribution, mean: Float[Tensor, "k"], deviation: Float[Tensor, "k"]
) -> Float[Tensor, "k"]:
    """Return the probability that a number exceeds each of k Gaussian numbers, independent of it.

    `law` is the distribution of the number. A Gaussian number of `deviation` 0 is its `mean`.
    """
    ends = real(law.parts).to(mean)
    shares = real(law.shares).to(mean)

    def blurred(both: Float[Tensor, "k 2"]) -> tuple[Float[Tensor, "k"]]:
        middle, spread = both[..., None].unbind(1)
        low = (ends[:, 0] - middle) / spread  # (k, parts)
        high = (ends[:, 1] - middle) / spread
        length = high - low
        within = (_mean_positive(high) - _mean_positive(low)) / length
        at_middle = torch.special.ndtr((low + high) / 2)
        return (torch.where(length > NARROW, within, at_middle) @ shares,)

    size = at_once(mean, max(PARTS // len(ends), 1))
    (uncertain,) = in_chunks(blurred, torch.stack([mean, deviation], 1), size)
    return torch.where(deviation > 0, uncertain, 1 - law.cdf(mean)).clamp(0, 1)


def _mean_positive(x: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Return Psi(x), the mean of the positive part of Gaussian numbers with the mean x and the
    standard deviation 1.
    """
    density = torch.exp(-(x**2) / 2) / math.sqrt(2 * math.pi)
    return x * torch.special.ndtr(x) + density
