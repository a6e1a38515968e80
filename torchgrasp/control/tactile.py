"""A tactile fingertip: what a controller may know of a contact, from the simulator's truth.

The force lags behind a 20 Hz low-pass and carries the noise of the paper's sensor (Sec. 6.5). The place of a contact is
known to 1.5 mm. On a round tip the place gives the normal, known to 1.5 mm over the tip's radius. A fingertip samples
at its own rate and holds the last sample in between. The contact flag switches with hysteresis on a slower average:
one noisy reading crosses 0.2 N twice a second.
"""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.linalg import unit

SAMPLING_RATE = 100.0
"""Of a fingertip [Hz]: one sample for each tick of a controller at 100 Hz."""

NOISE = 0.1
"""Standard deviation of the normal force [N] (Sec. 6.5)."""

TANGENTIAL_NOISE = 0.3
"""Standard deviation of each component of the force along the surface [N] (Sec. 6.5)."""

PLACE_NOISE = 1.5e-3
"""Standard deviation of a contact's place [m] in each direction along the fingertip: 7 degrees on 12 mm."""

FLAT_RADIUS = 0.012
"""Radius [m] that relates the noise of place and normal on a tip that is not round: that of the Allegro's round ones."""

CUTOFF = 20.0
"""Cut-off of the force's first-order low-pass [Hz]: a lag of 8 ms."""

FLAG_CUTOFF = 5.0
"""Cut-off of the average behind the contact flag [Hz]; it leaves 0.04 N of the noise at 100 Hz."""

TOUCH_ON = 0.2
"""A fingertip is in contact once the average exceeds this [N]: twice the noise, five times what the average leaves ..."""

TOUCH_OFF = 0.1
"""... and until it falls below this [N]."""


@dataclasses.dataclass(frozen=True)
class TipContact(Value):
    """True contacts of three fingertips, averaged over a tick, in any one frame.

    Args:
        normal_force: along the contact normals [N].
        forces: of the tips on the object [N], friction included.
        points: of contact [m]; NaN where nothing touches.
        normals: outward; NaN where nothing touches.
    """

    normal_force: Float[Tensor, "*b 3"]
    forces: Float[Tensor, "*b 3 3"]
    points: Float[Tensor, "*b 3 3"]
    normals: Float[Tensor, "*b 3 3"]


@dataclasses.dataclass(frozen=True)
class TactileState(Value):
    """What three fingertips report, and their memory.

    Args:
        reading: normal force of the last sample [N].
        forces: full force of the last sample [N].
        contact: whether each tip feels contact.
        points: sensed contacts [m]; NaN where nothing touched.
        normals: of the sensed contacts; NaN where nothing touched.
        lagged: normal force (first) and full force behind the low-pass [N].
        average: slow mean of the readings [N].
        age: time since the last sample [s].
    """

    reading: Float[Tensor, "*b 3"]
    forces: Float[Tensor, "*b 3 3"]
    contact: Bool[Tensor, "*b 3"]
    points: Float[Tensor, "*b 3 3"]
    normals: Float[Tensor, "*b 3 3"]
    lagged: Float[Tensor, "*b 3 4"]
    average: Float[Tensor, "*b 3"]
    age: float


def no_contact(*batch: int) -> TactileState:
    """Return the state of three fingertips in the air, due to sample.

    >>> no_contact().contact
    tensor([False, False, False])
    """
    lagged = torch.zeros(*batch, 3, 4, dtype=torch.float64)
    zero, vectors = lagged[..., 0], lagged[..., 1:]
    nothing = torch.full_like(vectors, torch.nan)
    return TactileState(zero, vectors, zero > 0, nothing, nothing, lagged, zero, 1 / SAMPLING_RATE)


def measure(
    tactile: TactileState,
    truth: TipContact,
    pads: Float[Tensor, "*#b 3 3"],
    radius: Float[Tensor, "3"],
    period: float,
    generator: torch.Generator | None = None,
) -> TactileState:
    """Return what the fingertips report one tick later.

    Args:
        tactile: their state before.
        truth: true contacts during the tick.
        pads: outward normals of a surface that the pads face; they direct the noise of a tip in the air.
        radius: of the tips [m]; 0: not round (`FLAT_RADIUS`).
        period: of the tick [s].
        generator: draws the noise; None: no noise.
    """
    force = torch.cat([truth.normal_force[..., None], truth.forces], dim=-1)
    lagged = tactile.lagged + low_pass(CUTOFF, period) * (force - tactile.lagged)
    age, interval = tactile.age + period, 1 / SAMPLING_RATE
    if age < interval - 1e-9:
        return dataclasses.replace(tactile, lagged=lagged, age=age)
    reading, forces = lagged[..., 0], lagged[..., 1:]
    points, normals = truth.points, truth.normals
    if generator is not None:
        along = torch.where(torch.isfinite(normals), normals, pads)
        noise = torch.randn(2, *forces.shape, generator=generator, dtype=forces.dtype)
        push = (noise[0] * along).sum(-1, keepdim=True)
        across = noise - (noise * along).sum(-1, keepdim=True) * along
        reading = reading + NOISE * push[..., 0]
        forces = forces - NOISE * push * along + TANGENTIAL_NOISE * across[0]
        curvature_radius = torch.where(radius > 0, radius, FLAT_RADIUS)[:, None]
        normals = unit(truth.normals + PLACE_NOISE / curvature_radius * across[1])
        points = truth.points + curvature_radius * (truth.normals - normals)
    average = tactile.average + low_pass(FLAG_CUTOFF, max(period, interval)) * (reading - tactile.average)
    contact = torch.where(tactile.contact, average > TOUCH_OFF, average > TOUCH_ON)
    age = min(max(age - interval, 0.0), interval)
    return TactileState(reading, forces, contact, points, normals, lagged, average, age)


def low_pass(cutoff: float, period: float) -> float:
    """Return the share of the new value in a first-order low-pass with a cut-off [Hz] and a period [s].

    >>> round(low_pass(20.0, 0.01), 3)
    0.715
    """
    return 1 - math.exp(-2 * math.pi * cutoff * period)
