"""The probability that contacts have force closure although friction, finger placement and normals
are uncertain.

Contacts close where the friction coefficient exceeds the critical friction mu_c. Contacts may move
by u_i and normals turn by w_i, both along the surface. To first order this changes mu_c by

    sum_i (f_i x y / r) . u_i + (mu_c s_i0 f_i - a_i s_i) . w_i

with the symbols of `torchgrasp.contacts.critical`, of the twist y only the rotation, and the
root-mean-square radius r of the contacts. An object that is displaced by v, and turned by z about a
point p, moves all contacts together. Here p is the centroid of its contacts p_i. Then u_i is the
part of v + z x (p_i - p) along the surface. Under a weight w, the mass may change by the share e,
and the centre of mass by d. This changes mu_c by

    e y . w + (w_f x y / r) . d,    w_f the force of w.

An interval of masses is split into ranges, each of which counts as a Gaussian error. So small
Gaussian errors make mu_c Gaussian, with a standard deviation s. Then the friction m suffices with
the probability Phi((m - mu_c) / s). Its mean for m in an interval [a, b] is

    s (Psi((b - mu_c) / s) - Psi((a - mu_c) / s)) / (b - a),    Psi(x) = x Phi(x) + Phi'(x).

Planned contacts are near kinks of mu_c, where first order is good for small errors alone. So the
errors e are a mixture: e = e_k + h e', with h e' small. Here e_k is one of a fixed set of points
that are spread as sqrt(1 - h^2) e. First order counts around each point, and the result is the
mean.
"""

import dataclasses
import functools
import math
import statistics
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.contacts.certify import check_contacts, check_unit
from torchgrasp.contacts.closure_probability import drawn_contacts, line_posterior
from torchgrasp.contacts.critical import LeastBalance, least_balance
from torchgrasp.contacts.form_closure import Vectors, centre_and_radius, with_torque
from torchgrasp.foundation.base import Value, at_once, in_chunks, row_numbers
from torchgrasp.foundation.checks import check_tensor, checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import LEAST, Force, Range, Seed, SmallLength, is_known
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.geometry.frames import real
from torchgrasp.geometry.linalg import UNIT_TOLERANCE, dot, eye_like, norm, perpendicular, unit
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.values.distribution import Distribution, check_within
from torchgrasp.values.planning import Contacts
from torchgrasp.values.specs import FRICTIONS, GRAVITY, MASSES

TILTS = Range(0.0, math.pi / 4)
"""The standard deviations [rad] of a normal, or of the object, that are taken. A greater one leaves
no side of the object certain, and is one in degrees.
"""


@dataclasses.dataclass(frozen=True)
class HoldProbabilityNumbers:
    """Parameters of `hold_probability`, the probability that contacts hold an object despite
    errors.
    """

    points: int = 64
    """Number of samples of the errors around which the critical friction is found and linearised.
    """
    local: float = 0.2
    """Standard deviation of the errors around each sample, as a share of that of all errors. Where
    the critical friction has a kink, the result is too high by about as much.
    """
    rows: int = 2**15
    """Number of contact sets with one error each (rows) that are computed at a time, which bounds
    the memory.
    """
    narrow: float = 1e-4
    """Length of an interval of frictions, in standard deviations, below which it counts as its
    middle. The difference of an integral at its ends would be lost in rounding.
    """
    parts: int = 2**20
    """Number of pairs of a contact set and a part of the distribution that are computed at a time.
    """
    farthest: float = 2.0
    """Greatest distance [m] of a centre of mass from the contacts, and of a contact from the middle
    of its set: no hand carries larger things.
    """
    masses: int = 9
    """Number of ranges of an uncertain mass, in each of which the critical friction is linear."""


HOLD = HoldProbabilityNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class CarriedWeight(Value):
    """The weight of an object that contacts carry, for `hold_probability`.

    The acceleration of gravity is 9.81 m/s^2.

    Args:
        mass: mass [kg] of the object, 0.001 to 10, or its `Distribution`.
        center: centre of mass (3,) [m] in the frame of the contacts. Or (b, 3) [m], one for each of
            b contact sets.
        press: mean of the normal forces [N] with which the fingers press at the contacts.
        up: unit vector against gravity in the frame of the contacts; None means z.
        center_std: standard deviation [m] of the centre of mass along each of three axes, 0 to 0.1.

    Raises `BadArgument` for a number outside its range, or an `up` that is not of length 1.

    >>> weight = CarriedWeight(Distribution.between(0.1, 0.4), torch.zeros(3), press=5.0)
    """

    mass: Annotated[float, MASSES] | Distribution
    center: Float[Tensor, "3"] | Float[Tensor, "b 3"]
    press: Force
    up: Float[Tensor, "3"] | None = None
    center_std: SmallLength = 0.0

    def __post_init__(self) -> None:
        check_within("mass", self.mass, MASSES)
        if self.up is not None and is_known(self.up):
            length = float(norm(self.up.detach()))
            if not abs(length - 1) <= UNIT_TOLERANCE:
                raise BadArgument("up", f"a length of {length:.4g}", "a unit vector (to 1e-3)")


@checked(gradients=True)
@single_threaded
def hold_probability(
    contacts: Contacts,
    friction: Annotated[float, FRICTIONS] | Distribution,
    placement: SmallLength = 0.0,
    tilt: Annotated[float, TILTS] | Float[Tensor, "b f"] = 0.0,
    shift: SmallLength = 0.0,
    turn: Annotated[float, TILTS] = 0.0,
    weight: CarriedWeight | None = None,
    shape: ShapeGP | None = None,
    draws: Annotated[int, Range(1, 10**6)] = 200,
    seed: Seed = 0,
) -> Float[Tensor, "b"]:
    """Return the probability (b,) that each contact set has force closure, for uncertain friction,
    finger placement, normals and object pose.

    With a `weight`, the result is the probability that forces in the friction cones balance it. The
    mean normal force is then `weight.press`. With a `shape`, the result is the mean over random
    surfaces.

    If only the friction is uncertain, the result is exact. It is the probability that the friction
    exceeds the `critical_friction`, and 0 where that is infinite. For the other errors, the result
    is the mean over a fixed set of 64 samples of them. The rest of the error around each sample is
    included to first order. An uncertain mass is split into about 9 ranges, and included to first
    order in each. The result is 0 for the few sets for which the method does not converge. Most of
    these carry a load far below the normal forces.

    Args:
        contacts: sets of 3 to 5 contacts (b, f, 3) [m] with outward unit normals.
        friction: coefficient of friction of all contacts, or its `Distribution`, in [0, 10].
        placement: standard deviation [m] of each fingertip's position along each of two
            perpendicular tangents, 0 to 0.1. The normal stays as it is, as on a surface that is
            flat nearby.
        tilt: standard deviation [rad] of the angle of a normal about each of two perpendicular
            tangents, 0 to pi / 4. It is one number for all contacts, or one for each (b, f).
        shift: standard deviation [m] of the object's position along each of three axes, 0 to 0.1.
            Such an error moves all contacts together along the surface.
        turn: standard deviation [rad] of the object's rotation about each of three axes, 0 to
            pi / 4. The axes pass through the contacts' centroid.
        weight: the weight that the contacts carry. None means that they must resist any load, with
            normal forces as large as needed.
        shape: the uncertain shape in the frame of the contacts. Random surfaces are drawn from it
            as in `closure_probability`. One sample of the other errors is used with each surface.
            None means that the planned contacts lie on the true surface.
        draws: number of random surfaces, if there is a `shape`.
        seed: random seed of the surfaces.

    Raises `BadArgument` for:

    * sets of other than 3 to 5 contacts;
    * normals that are not of length 1 (to 1e-3);
    * numbers outside their range;
    * a contact more than 2 m from the centroid of its set, as in millimetres;
    * a `weight.center` more than 2 m from this centroid, or not one for each set;
    * contacts outside the domain of the `shape`, or within 12 mm (`FOOTPRINT`) of its edge. The
      domain is the ball in which the posterior is valid;
    * normals that on average point into the `shape`.

    The result is differentiable twice in contacts, `tilt` and `weight.center`. All contact sets
    use the same random numbers.

    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> contacts = load_shipped_grasp("jug", "allegro").contacts
    >>> friction = Distribution.between(0.0, 1.0)
    >>> hold_probability(contacts, friction, placement=0.002) > 0.5
    tensor([True])
    """
    points = check_contacts(contacts).points.double()
    normals = check_unit(contacts.normals.double())
    check_within("friction", friction, FRICTIONS)
    _check_metres(points)
    center = points.new_zeros(len(points), 3) if weight is None else _center(weight, points)
    apart = 0.0 if weight is None else weight.center_std
    errors = _Errors(placement, _tilts(tilt, points)[:, None], shift, turn, apart)
    points, normals, center = (x[:, None] for x in (points, normals, center))
    certain = not isinstance(tilt, Tensor) and placement == tilt == shift == turn == apart == 0
    count = 1 if certain else HOLD.points
    missed = None
    if shape is not None:
        count = draws
        touched, slopes = drawn_contacts(line_posterior(shape, contacts), draws, seed)
        touched = shape.metres(touched).to(points)  # (b, n, f, 3)
        # where a finger meets no surface, the planned contacts stand in, and the result is 0
        missed = ~torch.isfinite(touched).flatten(2).all(2)
        each = missed[..., None, None]
        points = torch.where(each, points, touched)
        normals = torch.where(each, normals, slopes.to(points))
    # the errors that count to first order are those around the fixed ones
    if not certain:
        points, normals, center = errors.displaced(points, normals, center, count)
        errors = errors.times(HOLD.local)
    points, normals, center, tilts = (
        x.expand(-1, count, *x.shape[2:]).flatten(0, 1)
        for x in (points, normals, center, errors.tilt)
    )
    law = Distribution.of(friction)

    def held(rows: Tensor) -> tuple[Tensor]:
        """Return the probability for some rows, which are sets with one of their errors."""
        parts = law, points[rows], normals[rows], dataclasses.replace(errors, tilt=tilts[rows])
        if weight is None:
            return (_held(*parts),)
        found = points.new_zeros(len(rows))
        for mass, width, share in _mass_ranges(Distribution.of(weight.mass)):
            burden = _Burden(_force(weight, mass, points), center[rows], width / mass)
            found = found + share * _held(*parts, burden)
        return (found,)

    (found,) = in_chunks(held, row_numbers(points), at_once(points, HOLD.rows))
    found = found.unflatten(0, (-1, count))
    if missed is not None:
        found = torch.where(missed, 0.0, found)
    return found.mean(1).to(contacts.points)


@dataclasses.dataclass(frozen=True)
class _Errors:
    """Standard deviations of placement [m], normals [rad], position [m] and rotation [rad], and of
    the centre of mass [m].
    """

    placement: float
    tilt: Float[Tensor, "*b f"]
    shift: float
    turn: float
    center: float

    def times(self, share: float) -> "_Errors":
        """Return a share of the errors."""
        others = (share * x for x in (self.shift, self.turn, self.center))
        return _Errors(share * self.placement, share * self.tilt, *others)

    def displaced(
        self,
        points: Float[Tensor, "b _ f 3"],
        normals: Float[Tensor, "b _ f 3"],
        center: Float[Tensor, "b _ 3"],
        count: int,
    ) -> tuple[Float[Tensor, "b n f 3"], Float[Tensor, "b n f 3"], Float[Tensor, "b n 3"]]:
        """Return contacts and centres of mass under n = `count` errors, which are those of all
        contact sets.
        """
        f = points.shape[2]
        away = real(_spread_evenly(count, 6 * f + 9)).to(points).unflatten(1, (-1, 3))
        placed, tilted, (moved, turned, apart) = away[:, :f], away[:, f:-3], away[:, -3:].unbind(1)
        points = points.expand(-1, count, f, 3)
        arms = points - points.mean(2, keepdim=True)
        motion = self.placement * placed + self.shift * moved[:, None]
        motion = motion + self.turn * torch.linalg.cross(turned[:, None].expand_as(arms), arms)
        # a contact stays on the surface, and a normal keeps its length
        points = points + perpendicular(motion, normals)
        normals = unit(normals + perpendicular(self.tilt[..., None] * tilted, normals))
        return points, normals, center + self.center * apart


@functools.lru_cache(maxsize=16)
def _spread_evenly(count: int, numbers: int) -> list[list[float]]:
    """Return a fixed set of `count` errors, each of some normal numbers. Every number takes each of
    `count` equally likely values once (Latin hypercube sampling).

    What is left to the errors around them is not in it.
    """
    normal = statistics.NormalDist()
    values = np.array([normal.inv_cdf((k + 0.5) / count) for k in range(count)])
    size = math.sqrt(1 - HOLD.local**2) / max(values.std(), LEAST)
    orders = np.tile(size * values, (numbers, 1))
    return np.random.default_rng(0).permuted(orders, axis=1).T.tolist()


@dataclasses.dataclass(frozen=True)
class _Burden:
    """A weight that contacts carry.

    `force` is over the mean normal force, and `center` [m] is the centre of mass for each contact
    set. `of_mass` is the standard deviation of the mass over the mass.
    """

    force: Float[Tensor, "3"]
    center: Float[Tensor, "b 3"]
    of_mass: float

    def wrench(self, points: Vectors) -> Float[Tensor, "b 6"]:
        """Return the load of `least_balance`."""
        centroid, radius = centre_and_radius(points)
        arm = self.center - centroid[:, 0]
        return with_torque(self.force.expand_as(arm), arm / radius[:, 0])


def _held(
    law: Distribution,
    points: Vectors,
    normals: Vectors,
    errors: _Errors,
    burden: _Burden | None = None,
) -> Float[Tensor, "b"]:
    """Return the probability that each contact set balances, with a friction of the distribution
    `law`. It is 0 for sets that cannot.
    """
    load = None if burden is None else burden.wrench(points)
    rows, balance = least_balance(points, normals, load)
    balanced = ~balance.friction.isnan()  # inside torch.vmap there are sets that cannot balance
    balance = balance._replace(friction=torch.where(balanced, balance.friction, 1.0))
    known = points[rows]
    moved, turned = sensitivities(known, normals[rows], balance)
    arms = known - known.mean(1, keepdim=True)
    parts = [
        (errors.placement * moved).flatten(1),
        (errors.tilt[rows, :, None] * turned).flatten(1),
        errors.shift * moved.sum(1),
        errors.turn * torch.linalg.cross(arms, moved).sum(1),
    ]
    if burden is not None and load is not None:
        _, radius = centre_and_radius(known)
        push = burden.force.expand_as(balance.twist[:, 3:])
        by_center = torch.linalg.cross(push, balance.twist[:, 3:]) / radius[:, 0]
        by_mass = dot(balance.twist, load[rows], keepdim=True)
        parts += [errors.center * by_center, burden.of_mass * by_mass]
    square = (torch.cat(parts, 1) ** 2).sum(1)
    # without errors the derivative of the root would be NaN
    deviation = torch.where(square > 0, square, 1.0).sqrt() * (square > 0)
    found = torch.where(balanced, exceeding(law, balance.friction, deviation), 0.0)
    return points.new_zeros(len(points)).index_put((rows,), found)


def _mass_ranges(law: Distribution) -> list[tuple[float, float, float]]:
    """Return the masses that stand for a distribution: mass, standard deviation around it [kg], and
    probability of each.
    """
    if len(law.parts) > HOLD.masses:
        numbers, shares = law.nodes(HOLD.masses)
        return [(x, 0.0, p) for x, p in zip(numbers.tolist(), shares.tolist(), strict=True)]
    found = list[tuple[float, float, float]]()
    for (low, high), share in zip(law.parts, law.shares, strict=True):
        count = 1 if low == high else max(1, round(HOLD.masses * share))
        width = (high - low) / count
        for k in range(count):
            found.append((low + (k + 0.5) * width, width / math.sqrt(12), share / count))
    return found


def _force(weight: CarriedWeight, mass: float, like: Tensor) -> Float[Tensor, "3"]:
    """Return the weight of a `mass` [kg] as a force, over the mean normal force."""
    up = eye_like(3, like)[2] if weight.up is None else weight.up.to(like)
    return -mass * GRAVITY / weight.press * up


def _center(weight: CarriedWeight, points: Vectors) -> Float[Tensor, "b 3"]:
    """Return the centre of mass [m] of each contact set; raise `BadArgument` if there is not one
    for each, or if it is far from them.
    """
    if weight.center.ndim == 2:
        check_tensor("weight.center", weight.center, (len(points), 3))
    center = weight.center.to(points).expand(len(points), 3)
    if is_known(center) and is_known(points):
        away = norm((center - points.mean(1)).detach())
        if bool((away > HOLD.farthest).any()):
            found = f"a centre {float(away.max()):.3g} m off the contacts"
            allowed = f"one within {HOLD.farthest:g} m, in metres and in the frame of the contacts"
            raise BadArgument("weight.center", found, allowed)
    return center


def _check_metres(points: Vectors) -> None:
    """Raise `BadArgument` for contacts [m] so far apart that they are in another unit: errors in
    metres would not count.
    """
    if not (is_known(points) and len(points)):
        return
    away = norm((points - points.mean(1, keepdim=True)).detach())
    if bool((away > HOLD.farthest).any()):
        found = f"a contact {float(away.max()):.3g} m off the middle of its set"
        allowed = f"contacts within {HOLD.farthest:g} m of it, in metres"
        raise BadArgument("contacts.points", found, allowed)


def _tilts(tilt: float | Tensor, points: Vectors) -> Float[Tensor, "b f"]:
    """Return the standard deviation [rad] of each normal. Raise `BadArgument` if there is not one
    for each contact, or one is out of range.
    """
    if not isinstance(tilt, Tensor):
        return torch.full_like(points[..., 0], tilt)
    check_tensor("tilt", tilt, tuple(points.shape[:2]))
    if not is_known(tilt):
        return tilt.to(points)
    wrong = tilt[(tilt < TILTS.low) | (tilt > TILTS.high)]
    if len(wrong):
        allowed = f"angles in [{TILTS.low:g}, {TILTS.high:.4g}] rad"
        raise BadArgument("tilt", f"{float(wrong[0]):g}", allowed)
    return tilt.to(points)


def sensitivities(
    points: Vectors, normals: Vectors, balance: LeastBalance
) -> tuple[Vectors, Vectors]:
    """Return the derivatives of the critical friction with respect to points [1/m] and normals (no
    unit).

    They have the shape (b, f, 3), and are projected on the surface's tangent planes. `points` [m]
    and outward unit `normals` are in one frame. `balance` holds the contacts' forces of least
    friction.
    """
    _, radius = centre_and_radius(points)
    rotation = balance.twist[:, None, 3:].expand_as(points)
    moved = torch.linalg.cross(balance.forces, rotation) / radius
    push = -dot(balance.forces, normals, keepdim=True)
    pressed = (balance.friction[:, None] * balance.press)[..., None] * balance.forces
    turned = pressed - push * balance.slide
    return perpendicular(moved, normals), perpendicular(turned, normals)


def exceeding(
    law: Distribution, mean: Float[Tensor, "k"], deviation: Float[Tensor, "k"]
) -> Float[Tensor, "k"]:
    """Return the probability (k,) that a random number with the distribution `law` exceeds each of
    k Gaussian numbers.

    The two numbers are independent. The Gaussian numbers have the given `mean` (k,) and standard
    `deviation` (k,). One with the deviation 0 is its mean.
    """
    ends = real(law.parts).to(mean)
    shares = real(law.shares).to(mean)

    def blurred(both: Float[Tensor, "k 2"]) -> tuple[Float[Tensor, "k"]]:
        middle, spread = both[..., None].unbind(1)
        low = (ends[:, 0] - middle) / spread  # (k, parts)
        high = (ends[:, 1] - middle) / spread
        length = high - low
        wide = length > HOLD.narrow
        within = _mean_positive(high) - _mean_positive(low)
        within = within / torch.where(wide, length, 1.0)
        at_middle = torch.special.ndtr((low + high) / 2)
        return (torch.where(wide, within, at_middle) @ shares,)

    size = at_once(mean, max(HOLD.parts // len(ends), 1))
    certain = deviation == 0
    spread = torch.where(certain, 1.0, deviation)
    (uncertain,) = in_chunks(blurred, torch.stack([mean, spread], 1), size)
    return torch.where(certain, 1 - law.cdf(mean), uncertain).clamp(0, 1)


def _mean_positive(x: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Return Psi(x), the mean of the positive part of Gaussian numbers with the mean x and the
    standard deviation 1.
    """
    density = torch.exp(-(x**2) / 2) / math.sqrt(2 * math.pi)
    return x * torch.special.ndtr(x) + density
