"""A tactile fingertip: what the controller may know of a contact, from the simulator's truth.

The force lags by a 20 Hz low-pass and carries white noise of the paper's size (Sec. 6.5), 0.1 N along the normal and
0.3 N across it. The place of a contact on the tip is known to 1.5 mm; on a round tip the place is the normal, which is
then known to 1.5 mm over the tip's radius (7 degrees on 12 mm). A fingertip samples at a rate of its own and holds the
last sample in between. The contact flag switches with hysteresis on a slower average, because a single noisy reading
crosses 0.2 N twice a second.
"""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.linalg import unit

RATE = 100.0
"""Samples a second [Hz] of a fingertip."""

NOISE = 0.1
"""Standard deviation of a reading of the normal force [N] (Sec. 6.5)."""

TANGENTIAL_NOISE = 0.3
"""Standard deviation of each component of the force along the surface [N] (Sec. 6.5)."""

PLACE_NOISE = 1.5e-3
"""Standard deviation of a contact's place on the fingertip [m], in each direction along its surface."""

FLAT_RADIUS = 0.012
"""Radius [m] by which the noise of the place becomes that of the normal on a tip that is not round (radius 0)."""

CUTOFF = 20.0
"""Cut-off of the force's first-order low-pass [Hz]: a lag of 8 ms."""

FLAG_CUTOFF = 5.0
"""Cut-off of the average behind the contact flag [Hz]; it leaves 0.04 N of the noise at 100 Hz."""

TOUCH_ON = 0.2
"""A fingertip is in contact once the average exceeds this [N] ..."""

TOUCH_OFF = 0.1
"""... and until it falls below this [N]."""


@dataclasses.dataclass(frozen=True)
class TipContact(Value):
    """The truth of three fingertips, averaged over a tick, in any one frame.

    `normal_force` [N] is along the contact normals, `forces` [N] all that the tips exert on the object. `points` [m]
    and outward `normals` of the contacts are NaN where nothing touches.
    """

    normal_force: Float[Tensor, "*b 3"]
    forces: Float[Tensor, "*b 3 3"]
    points: Float[Tensor, "*b 3 3"]
    normals: Float[Tensor, "*b 3 3"]


@dataclasses.dataclass(frozen=True)
class TactileState(Value):
    """What the fingertips report: the last sample of the force and of the contact, and whether there is one.

    `reading` [N] is the normal force, `forces` [N] the full one, `points` [m] and `normals` the sensed contact, NaN
    where nothing touched. The sensor's memory: `lagged` [N] are normal force (first) and full force behind the
    low-pass, `average` [N] the slow mean of the readings, `age` [s] the time since the sample.
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
    return TactileState(zero, vectors, zero > 0, nothing, nothing, lagged, zero, 1 / RATE)


def measure(
    tactile: TactileState,
    press: TipContact,
    pads: Float[Tensor, "*#b 3 3"],
    radius: Float[Tensor, "3"],
    period: float,
    generator: torch.Generator | None = None,
) -> TactileState:
    """Return what the fingertips report one tick later.

    Args:
        touch: their state before.
        press: the truth, averaged over the tick.
        pads: outward normals of a surface that the pads face: what is along and what across a force in the air.
        radius: of the tips [m]; 0: not round (`FLAT_RADIUS`).
        period: of the tick [s].
        generator: draws the noise; None: no noise.
    """
    force = torch.cat([press.normal_force[..., None], press.forces], dim=-1)
    lagged = tactile.lagged + low_pass(CUTOFF, period) * (force - tactile.lagged)
    age = tactile.age + period
    if age < 1 / RATE - 1e-9:
        return dataclasses.replace(tactile, lagged=lagged, age=age)
    reading, forces = lagged[..., 0], lagged[..., 1:]
    points, normals = press.points, press.normals
    if generator is not None:
        along = torch.where(torch.isfinite(normals), normals, pads)
        drawn = torch.randn(2, *forces.shape, generator=generator, dtype=forces.dtype)
        push = (drawn[0] * along).sum(-1, keepdim=True)
        across = drawn - (drawn * along).sum(-1, keepdim=True) * along
        reading = reading + NOISE * push[..., 0]
        forces = forces - NOISE * push * along + TANGENTIAL_NOISE * across[0]
        bend = torch.where(radius > 0, radius, FLAT_RADIUS)[:, None]
        normals = unit(press.normals + PLACE_NOISE / bend * across[1])
        points = press.points + bend * (press.normals - normals)
    average = tactile.average + low_pass(FLAG_CUTOFF, max(period, 1 / RATE)) * (reading - tactile.average)
    contact = torch.where(tactile.contact, average > TOUCH_OFF, average > TOUCH_ON)
    return TactileState(
        reading, forces, contact, points, normals, lagged, average, min(max(age - 1 / RATE, 0.0), 1 / RATE)
    )


def low_pass(cutoff: float, period: float) -> float:
    """Return the share of the new value in a first-order low-pass of a cut-off [Hz] sampled with a period [s].

    >>> round(low_pass(20.0, 0.01), 3)
    0.715
    """
    return 1 - math.exp(-2 * math.pi * cutoff * period)
