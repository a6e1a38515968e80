"""A tactile fingertip: what a controller knows of a contact.

The force lags behind a low-pass and is noisy. So is the place of a contact, and with it the normal
of a round tip. Samples come at the sensor's own rate.
"""

import dataclasses
import math
from typing import Annotated, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import FINGERTIPS, Value, check_device
from torchgrasp.checks import ANY, Count, Range, checked
from torchgrasp.geometry.linalg import unit

SAMPLING_RATE = 100.0
"""Of a fingertip [Hz]: one sample for each tick of a controller at 100 Hz."""

NOISE, TANGENTIAL_NOISE = 0.1, 0.3
"""Standard deviation of the normal force, and of each component across it [N] (Sec. 6.5)."""

PLACE_NOISE, FLAT_RADIUS = 1.5e-3, 0.012
"""Standard deviation of a contact's place along the tip [m]: 7 degrees of its normal on the Allegro's radius [m], which
also stands for tips that are not round."""

CUTOFF, FLAG_CUTOFF = 20.0, 5.0
"""Cut-off of the force's low-pass [Hz], a lag of 8 ms; of the average behind the contact flag: 0.04 N of noise pass."""

SLIDE_NOISE = 2e-3
"""Standard deviation of the speed at which a fingertip slides [m/s]. Behind the low-pass a slide of 20 mm/s is told
from it within 10 ms; piezoelectric skins tell the onset of slip within 20 ms (arXiv 2602.16127)."""

TOUCH_ON, TOUCH_OFF = 0.2, 0.1
"""Averages [N] at which the contact flag switches: a single noisy reading crosses 0.2 N twice a second."""


@checked
@dataclasses.dataclass(frozen=True)
class TipContact(Value):
    """True contacts of f fingertips, averaged over a tick.

    `forces` [N] act on the object, friction included. `points` [m] and outward `normals` are NaN without contact.
    `sliding` [m/s] is the speed of the tip along the surface; None: no tip slides.

    >>> normals, pressed = torch.eye(3), torch.tensor([2.0, 0.0, 1.0])  # [N]
    >>> truth = TipContact(pressed, -pressed[:, None] * normals, 0.03 * normals, normals)
    >>> truth.forces[0]
    tensor([-2., -0., -0.])
    """

    normal_force: Float[Tensor, "*b f"]
    forces: Float[Tensor, "*b f 3"]
    points: Annotated[Float[Tensor, "*b f 3"], ANY]
    normals: Annotated[Float[Tensor, "*b f 3"], ANY]
    sliding: Float[Tensor, "*b f"] | None = None


@checked
@dataclasses.dataclass(frozen=True)
class TactileState(Value):
    """What f fingertips report, and their memory.

    `reading` [N] is the normal force, `forces` [N] the full one. `points` [m] and `normals` are NaN without contact.
    `lagged` is normal force and full force [N], and the speed of sliding [m/s], behind the low-pass. `average` [N] is
    the slow mean of the readings, `sliding` [m/s] the reading of that speed. `age` [s] counts from the last sample.

    >>> in_air = no_contact()
    >>> in_air.reading, in_air.points[0]
    (tensor([0., 0., 0.], dtype=torch.float64), tensor([nan, nan, nan], dtype=torch.float64))
    """

    reading: Float[Tensor, "*b f"]
    forces: Float[Tensor, "*b f 3"]
    contact: Bool[Tensor, "*b f"]
    points: Annotated[Float[Tensor, "*b f 3"], ANY]
    normals: Annotated[Float[Tensor, "*b f 3"], ANY]
    lagged: Float[Tensor, "*b f 5"]
    average: Float[Tensor, "*b f"]
    sliding: Float[Tensor, "*b f"]
    age: float


@checked
def no_contact(*batch: Count, fingers: Annotated[int, Range(*FINGERTIPS)] = 3) -> TactileState:
    """Return the state of fingertips in the air, due to sample.

    >>> no_contact().contact
    tensor([False, False, False])
    """
    lagged = torch.zeros(*batch, fingers, 5, dtype=torch.float64)
    zero, vectors = lagged[..., 0], lagged[..., 1:4]
    nothing = torch.full_like(vectors, torch.nan)
    return TactileState(zero, vectors, zero > 0, nothing, nothing, lagged, zero, zero, 1 / SAMPLING_RATE)


@checked
def measure(
    tactile: TactileState,
    truth: TipContact,
    pads: Float[Tensor, "*#b f 3"],
    radius: Float[Tensor, "f"],
    period: Annotated[float, Range(1e-06, 1.0)],
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

    Raises:
        BadArgument: true contacts on another device than the state.

    >>> normals, pressed = torch.eye(3).double(), torch.tensor([2.0, 0.0, 1.0]).double()  # [N]
    >>> truth = TipContact(pressed, -pressed[:, None] * normals, 0.03 * normals, normals)
    >>> felt = measure(no_contact(), truth, normals, torch.full((3,), 0.012).double(), period=0.01)
    >>> felt.contact, felt.reading  # behind the low-pass
    (tensor([ True, False, False]), tensor([1.4308, 0.0000, 0.7154], dtype=torch.float64))
    """
    return sample(tactile, truth, pads, radius, period, None if generator is None else Noise(generator))


class Noise(NamedTuple):
    """What draws the noise, and how many times the usual it is."""

    generator: torch.Generator
    scale: float = 1.0


def sample(
    tactile: TactileState,
    truth: TipContact,
    pads: Float[Tensor, "*#b f 3"],
    radius: Float[Tensor, "f"],
    period: float,
    noise: Noise | None,
) -> TactileState:
    """Return what the fingertips report one tick later, as in `measure`."""
    check_device("truth", truth.forces.device, "the tactile state", tactile.lagged.device)
    sliding = torch.zeros_like(truth.normal_force) if truth.sliding is None else truth.sliding
    force = torch.cat([truth.normal_force[..., None], truth.forces, sliding[..., None]], dim=-1)
    lagged = tactile.lagged + low_pass(CUTOFF, period) * (force - tactile.lagged)
    age, interval = tactile.age + period, 1 / SAMPLING_RATE
    if age < interval - 1e-9:
        return dataclasses.replace(tactile, lagged=lagged, age=age)
    reading, forces, sliding = lagged[..., 0], lagged[..., 1:4], lagged[..., 4]
    points, normals = truth.points, truth.normals
    if noise is not None:
        along = torch.where(torch.isfinite(normals), normals, pads)
        drawn = noise.scale * torch.randn(2, *forces.shape, generator=noise.generator, dtype=forces.dtype)
        normal_part = (drawn * along).sum(-1, keepdim=True)
        push, across = normal_part[0], drawn - normal_part * along
        reading = reading + NOISE * push[..., 0]
        sliding = sliding + SLIDE_NOISE * normal_part[1, ..., 0]
        forces = forces - NOISE * push * along + TANGENTIAL_NOISE * across[0]
        curvature_radius = torch.where(radius > 0, radius, FLAT_RADIUS)[:, None]
        normals = unit(truth.normals + PLACE_NOISE / curvature_radius * across[1])
        points = truth.points + curvature_radius * (truth.normals - normals)
    average = tactile.average + low_pass(FLAG_CUTOFF, max(period, interval)) * (reading - tactile.average)
    contact = flag(tactile.contact, average, 1.0 if noise is None else max(noise.scale, 1.0))
    age = min(max(age - interval, 0.0), interval)
    return TactileState(reading, forces, contact, points, normals, lagged, average, sliding, age)


def flag(before: Bool[Tensor, "*b f"], average: Float[Tensor, "*b f"], doubt: Float[Tensor, "f"] | float) -> Tensor:
    """Return contact flags by averages [N], as many times the usual ones as the sensor is noisier (`doubt`)."""
    return torch.where(before, average > TOUCH_OFF * doubt, average > TOUCH_ON * doubt)


def low_pass(cutoff: float, period: float) -> float:
    """Return the new value's share in a first-order low-pass, by cut-off [Hz] and period [s].

    >>> round(low_pass(20.0, 0.01), 3)
    0.715
    """
    return 1 - math.exp(-2 * math.pi * cutoff * period)
