"""What a hand that holds an object estimates of it: friction, load and mass.

A load is a wrench of force [N] and torque [N m] about the centroid of the contacts, in the hand's
frame.
"""

import dataclasses
import math

import numpy as np
import torch

from torchgrasp.control.law import TINY
from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.tactile import smooth
from torchgrasp.geometry.frames import apply, inverse
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.specs import GRAVITY


@dataclasses.dataclass(frozen=True)
class FrictionNumbers:
    """Parameters of `FrictionEstimate`, the running estimate of the friction coefficient."""

    mean: float = 0.8
    """Coefficient of friction that is estimated at the start, if the grasp was planned for a single
    one.
    """
    std: float = 0.2
    """Standard deviation of this first estimate."""
    least_std: float = 0.03
    """Lower bound of the estimate's standard deviation. With a larger bound, later readings change
    the estimate more.
    """
    least: float = 0.15
    """Lower bound of the coefficient at the start; a finger that sticks raises it."""
    most: float = 1.5
    """Largest coefficient that is estimated."""
    noise: float = 0.4
    """Standard deviation [N] of a fingertip's force. Divided by the normal force, it is that of the
    ratio of tangential to normal force.
    """
    sure: float = 2.0
    """Number of standard deviations within which a coefficient is likely."""


@dataclasses.dataclass(frozen=True)
class FeltLoadNumbers:
    """Parameters of `LoadEstimate`, the running estimate of the load."""

    lifted: float = 0.35
    """Force [N] on the fingertips above which the object counts as lifted."""
    cutoff: float = 3.0
    """Cut-off frequency [Hz] of the low-pass filter of the sensed load."""
    carried: float = 0.7
    """Cut-off frequency [Hz] of the low-pass filter of the load that counts as carried; a higher
    one rocks the object.
    """
    lever: float = 0.1
    """Longest lever [m] at which weight and pushes may turn the object."""
    growth: float = 1.05
    """Ratio to the largest load so far, above which a load counts as new."""
    steady: float = 0.3
    """Time [s] without a new load after which the load is steady."""
    turned: float = 0.05
    """Angle [rad] by which a hand turns until its load is weighed anew."""


@dataclasses.dataclass(frozen=True)
class WeightNumbers:
    """Values from which the likely weight of an object is estimated."""

    density: float = 1000.0
    """Density [kg/m^3]: that of water."""
    mass: float = 0.4
    """Least mass [kg]: a small thing may be of metal."""
    noise: float = 0.5
    """Standard deviation [N] of the load that the fingertips feel in one tick."""
    share: float = 0.05
    """Standard deviation of the mean load that motion and oblique contacts cause, as a share of
    this load.
    """
    sure: float = 2.0
    """Number of standard deviations within which a mass is likely."""
    most: float = 10.0
    """Largest mass [kg] of an object."""


FRICTION = FrictionNumbers()
LOAD = FeltLoadNumbers()
WEIGHT = WeightNumbers()


class FrictionEstimate:
    """A running estimate of the friction coefficient, common to all fingertips.

    `mean` is the estimate, `std` its standard deviation, and `least` a lower bound of the
    coefficient. `most` is the largest coefficient that is believed.

    Args:
        prior: the coefficient that the grasp was planned for. A `Distribution` gives `mean` and
            `std` at the start. With a number, `mean` starts at 0.8 and `std` at 0.2.
    """

    def __init__(self, prior: float | Distribution) -> None:
        self.prior = Distribution.of(prior)
        self.mean = FRICTION.mean
        self.std = FRICTION.std
        self.least = FRICTION.least
        self.most = FRICTION.most
        if self.prior.least < self.prior.most:
            self.mean = self.prior.mean
            self.std = max(self.prior.std, FRICTION.least_std)
            self.least = min(self.prior.least, FRICTION.least)
            self.most = max(self.prior.most, FRICTION.most)
        self.held = 0.0  # lower bound that sticking fingertips have surely shown
        self.slid = False

    def update(self, ratio: float, force: float, slides: bool = True) -> None:
        """Update the estimate by the sensed force of one fingertip.

        `ratio` is its tangential over its normal force, `force` [N] its normal force, and `slides`
        says whether it slides. A fingertip that sticks shows that friction is at least its ratio. A
        slide with a ratio below `least` is taken for a spin about the normal, and ignored. A ratio
        above `most` is that of a finger behind an edge, and counts as `most`.
        """
        ratio = min(ratio, self.most)
        noise = FRICTION.noise * math.hypot(1.0, ratio) / force
        if not slides:
            self.held = max(self.held, ratio - FRICTION.sure * noise)
            self.least = max(self.least, ratio - noise)
            self.mean = max(self.mean, self.least)
        elif ratio + noise > self.least:
            weight = self.std**2 / (self.std**2 + noise**2)
            mean = self.mean + weight * (ratio - self.mean)
            self.mean = min(max(mean, self.least), self.most)
            self.std = max(self.std * math.sqrt(1 - weight), FRICTION.least_std)
            self.slid = True

    @property
    def posterior(self) -> Distribution:
        """The distribution of the friction coefficient: the prior, within bounds from the touches.

        A fingertip that sticks bounds the coefficient below; one that slides bounds it above. If
        the prior excludes all values within these bounds, the bounds alone count.
        """
        around = FRICTION.sure * self.std
        high = self.mean + around if self.slid else math.inf
        if self.prior.share(self.held, high) > 0.0:
            return self.prior.given(self.held, high)
        if self.slid:
            return Distribution.between(max(self.mean - around, self.held), high)
        return Distribution.of(self.held)

    @property
    def high(self) -> float:
        """An upper bound of the friction coefficient: the mean plus one standard deviation."""
        return self.mean + self.std


class LoadEstimate:
    """A running estimate of the load with which the object bears on the fingertips.

    A load is a wrench (6,): force [N], then torque [N m] about the contacts' centroid, in the
    hand's frame. `wrench` (6,) is the low-passed load, and `carried` (6,) the part of it that
    changes slowly. Once the lifted load has been steady (`settles`), its mean force gives the mass.

    Args:
        up: unit vector (3,) that points up in the hand's frame, such as the table's normal. The
            object's weight acts against it. None means that the whole load may be due to the object.
        push: largest force [N] by which something else may push at the lifted object.
    """

    def __init__(self, up: np.ndarray | None, push: float) -> None:
        self.up = up
        self.level = up  # up when the load began to be weighed
        self.push = push
        self.wrench = np.zeros(6)
        self.carried = np.zeros(6)
        self.most = 0.0  # largest load [N] so far
        self.since = 0.0  # time [s] since it was felt
        self.steady = False  # whether the lifted load has been steady
        self.weighed = np.zeros(3)  # mean force [N] from then on
        self.weighings = 0  # ticks in this mean

    def update(self, felt: np.ndarray, period: float) -> None:
        """Update the estimate by the wrench `felt` (6,) [N, N m] that the fingertips sense in a
        control period of `period` [s].
        """
        load = self._possible(felt)
        self.wrench = smooth(self.wrench, load, LOAD.cutoff, period)
        self.carried = smooth(self.carried, load, LOAD.carried, period)
        if self.steady:
            self.weighings += 1
            self.weighed = self.weighed + (load[:3] - self.weighed) / self.weighings

    def turn(self, up: np.ndarray) -> None:
        """Take the unit vector `up` (3,), which points up in the frame of a hand that has turned.

        If the hand has turned by more than 0.05 rad (`LOAD.turned`), the weighing begins anew.
        """
        self.up = up
        if self.level is None or float(up @ self.level) < math.cos(LOAD.turned):
            self.level = up
            self.weighed = np.zeros(3)
            self.weighings = 0

    def settles(self, period: float) -> bool:
        """Return whether the object is lifted, and its load has not grown for 0.3 s
        (`LOAD.steady`).

        It is lifted at a force of 0.35 N or more (`LOAD.lifted`). The load grows where it exceeds
        1.05 times the largest load so far. Call it once in each control period of `period` [s]: the
        call adds this time.
        """
        if self.weight > LOAD.growth * self.most:
            self.most = self.weight
            self.since = 0.0
        self.since += period
        settled = self.since >= LOAD.steady and self.weight >= LOAD.lifted
        self.steady = self.steady or settled
        return settled

    @property
    def weight(self) -> float:
        """Magnitude [N] of the force in the low-passed load (`wrench`) on the fingertips."""
        return float(np.linalg.norm(self.wrench[:3]))

    @property
    def mass(self) -> Distribution | None:
        """The `Distribution` of the object's mass [kg], from the mean of the steady load. None if
        no load was steady yet, or the object is no longer lifted.
        """
        load = float(np.linalg.norm(self.weighed))
        if min(load, self.weight) < LOAD.lifted:
            return None
        std = math.hypot(WEIGHT.noise / math.sqrt(self.weighings), WEIGHT.share * load)
        around = WEIGHT.sure * std
        low = max(load - around, 0.0) / GRAVITY
        return Distribution.between(low, (load + around) / GRAVITY)

    @property
    def exceeded(self) -> Distribution:
        """The `Distribution` of the mass [kg] of an object that is heavier than the largest load so
        far: from that load's mass, less its error, to 10 kg (`WEIGHT.most`).
        """
        carried = (1 - WEIGHT.sure * WEIGHT.share) * self.most / GRAVITY
        return Distribution.between(min(carried, WEIGHT.most), WEIGHT.most)

    def _possible(self, felt: np.ndarray) -> np.ndarray:
        """Return the part (6,) of the wrench `felt` that weight and, once lifted, pushes can cause."""
        if self.up is None:
            return felt
        rise = float(felt[:3] @ self.up)
        lifted = max(rise, 0.0)
        most = self.push if self.steady else 0.0
        side = _limited(felt[:3] - rise * self.up, most)
        torque = _limited(felt[3:], LOAD.lever * (lifted + most))
        return np.concatenate([lifted * self.up + side, torque])


def likely_body(reference: ClosingReference) -> tuple[np.ndarray, float]:
    """Return an object's likely centre (3,) [m] in the hand's frame, and its largest likely weight
    [N].

    The weight is that of water in the volume of the estimated surface. Without a surface, a ball as
    wide as the contacts replaces it. It is at least that of 0.4 kg (`WEIGHT.mass`): a small thing
    may be of metal.
    """
    field = reference.surface
    points = reference.gains.target
    if field is None or not (field.values < 0).any():
        ball = math.pi / 6 * float(torch.cdist(points, points).max()) ** 3
        centre = points.mean(0)
        mass = WEIGHT.density * ball
    else:
        shell = (field.values.abs() < field.spacing).nonzero()
        inside = (field.values < 0).nonzero()
        # farther than the shell the sign may be wrong
        known = (inside >= shell.amin(0)) & (inside <= shell.amax(0))
        inside = inside[known.all(-1)]
        middle = field.origin + field.spacing * inside.double().mean(0)
        centre = apply(inverse(reference.obj_from_hand), middle[None])[0]
        mass = WEIGHT.density * len(inside) * field.spacing**3
    return centre.numpy(), GRAVITY * max(mass, WEIGHT.mass)


def _limited(vector: np.ndarray, most: float) -> np.ndarray:
    """Return the `vector` (3,), shortened to the length `most` if it is longer."""
    return vector * min(1.0, most / max(float(np.linalg.norm(vector)), TINY))
