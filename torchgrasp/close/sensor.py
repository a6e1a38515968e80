"""A tactile fingertip: what the controller may know of the contact forces.

Only the normal force is sensed (Sec. 6.5). The reading lags by a 20 Hz low-pass and carries white noise of 0.1 N; the
contact flag switches with hysteresis on a slower average, because a single noisy reading crosses 0.2 N twice a second.
"""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value

NOISE = 0.1
"""Standard deviation of a reading of the normal force [N] (Sec. 6.5)."""

CUTOFF = 20.0
"""Cut-off of the reading's first-order low-pass [Hz]: a lag of 8 ms."""

FLAG_CUTOFF = 5.0
"""Cut-off of the average behind the contact flag [Hz]; it leaves 0.04 N of the noise at 100 Hz."""

TOUCH_ON = 0.2
"""A fingertip is in contact once the average exceeds this [N] ..."""

TOUCH_OFF = 0.1
"""... and until it falls below this [N]."""


@dataclasses.dataclass(frozen=True)
class Touch(Value):
    """What the fingertips report: the `reading` of the normal force [N] and whether they are in `contact`.

    `filtered` is the low-passed force before noise and `average` the slow mean of the readings: the sensor's memory.
    """

    reading: Float[Tensor, "*b 3"]
    contact: Bool[Tensor, "*b 3"]
    filtered: Float[Tensor, "*b 3"]
    average: Float[Tensor, "*b 3"]


def untouched(*batch: int) -> Touch:
    """Return the state of three fingertips in the air.

    >>> untouched().contact
    tensor([False, False, False])
    """
    zero = torch.zeros(*batch, 3, dtype=torch.float64)
    return Touch(zero, torch.zeros(*batch, 3, dtype=torch.bool), zero, zero)


def sense(touch: Touch, force: Float[Tensor, "*b 3"], period: float, generator: torch.Generator | None = None) -> Touch:
    """Return what the fingertips report one tick later.

    Args:
        touch: their state before.
        force: the true normal forces [N], averaged over the tick.
        period: of the tick [s].
        generator: draws the noise; None: no noise.
    """
    filtered = touch.filtered + low_pass(CUTOFF, period) * (force - touch.filtered)
    reading = filtered
    if generator is not None:
        reading = filtered + NOISE * torch.randn(filtered.shape, generator=generator, dtype=filtered.dtype)
    average = touch.average + low_pass(FLAG_CUTOFF, period) * (reading - touch.average)
    contact = torch.where(touch.contact, average > TOUCH_OFF, average > TOUCH_ON)
    return Touch(reading, contact, filtered, average)


def low_pass(cutoff: float, period: float) -> float:
    """Return the share of the new value in a first-order low-pass of a cut-off [Hz] sampled with a period [s].

    >>> round(low_pass(20.0, 0.01), 3)
    0.715
    """
    return 1 - math.exp(-2 * math.pi * cutoff * period)
