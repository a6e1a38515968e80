"""What a hand believes of the friction under its fingertips: a Gaussian, revised where a fingertip slides or sticks."""

import math

from torchgrasp.control.state import Part

SLIPPING, CREEPING, CREEP_CUTOFF = 0.008, 0.002, 1.0
"""Speeds [m/s] from which a fingertip counts as sliding: four standard deviations of its reading, and five of its slow
mean behind a cut-off [Hz]."""

PRIOR_STD = 0.2
"""Standard deviation of the planned friction: of household things from .4 to 1.0."""

LEAST_STD = 0.03
"""Standard deviation that stays: friction is not one number all over a surface."""

RATIO_NOISE = 0.4
"""Standard deviation [N] of a tangential force, as six correlated samples of a fingertip tell it."""

LEAST_FRICTION, MOST_FRICTION = 0.15, 1.5
"""Frictions that are believed."""


class FrictionBelief(Part):
    """Mean and standard deviation of the friction of all fingertips on the object.

    >>> belief = FrictionBelief(0.8)
    >>> for _ in range(10):
    ...     belief.slides(ratio=0.5, force=3.0)
    >>> round(belief.mean, 1), belief.std < 0.06
    (0.5, True)
    """

    def __init__(self, mean: float, std: float = PRIOR_STD) -> None:
        self.mean, self.std = mean, std

    def slides(self, ratio: float, force: float, lagging: bool = False) -> None:
        """Revise by tangential over normal force of a fingertip that slides: its friction.

        `force` [N] is its normal force. `lagging`: it slides since so short a time that the ratio lags.
        """
        noise = (1 + lagging) * RATIO_NOISE * math.hypot(1.0, ratio) / force
        weight = self.std**2 / (self.std**2 + noise**2)
        self.mean = min(max(self.mean + weight * (ratio - self.mean), LEAST_FRICTION), MOST_FRICTION)
        self.std = max(self.std * math.sqrt(1 - weight), LEAST_STD)

    @property
    def low(self) -> float:
        """A friction that is likely exceeded: a standard deviation below the mean."""
        return max(self.mean - self.std, LEAST_FRICTION)

    @property
    def high(self) -> float:
        """A friction that is likely not reached."""
        return self.mean + self.std
