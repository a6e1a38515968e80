"""Random postures of a hand without self-collision: the training data of its learned model (Sec.
4.1).

Round fingertips roll, so the contacts of "grasping" samples are off the centres of the pads. These
contacts must allow force closure.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.base import Batch, Value, flatnonzero
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Range, Seed
from torchgrasp.geometry.linalg import across, dot, fibonacci_sphere, unit
from torchgrasp.hand.hand import Hand
from torchgrasp.posture_model.mixture import describe_compatibility, encode_fingertips
from torchgrasp.values.specs import ContactSpec

ROLL = math.radians(25)  # standard deviation [rad] of both tilts of a contact from the pad's axis
# number of directions in the 3D space of internal forces that are tried: 0.25 rad apart
BALANCES = 200


def roll_contacts(
    hand: Hand, joints: Float[Tensor, "n h"], generator: np.random.Generator
) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3 3"]]:
    """Return (points, normals) of random contacts on the pads of three fingertips, off the pads'
    centres, in n postures.

    The points [m] and the fingertips' outward unit normals there are in the hand's frame. `joints`
    (n, h) [rad or m] are the postures. `generator` tilts each normal at random from the pad's axis.
    Both components of the tilt are Gaussian, with a deviation of 25 degrees (`ROLL`). The tilt is
    at most the half angle of the cone of the pad's normals. On a round fingertip the contact moves
    to the point of the sphere with this normal. On a flat pad it stays in place.
    """
    points, axes = hand.fingertips(joints)
    cone = hand.tips.cone.to(axes)
    radius = hand.tips.radius.to(axes)
    share, turn = torch.from_numpy(generator.random((2, len(joints), 3))).to(axes)
    # The angle has Rayleigh's law, cut off at the cone.
    within = -torch.expm1(-0.5 * (cone / ROLL) ** 2)
    angle = ROLL * torch.sqrt(-2 * torch.log1p(-share * within))
    first, second = across(axes)
    turn = 2 * math.pi * turn[..., None]
    tilt = torch.cos(turn) * first + torch.sin(turn) * second
    normals = torch.cos(angle)[..., None] * axes + torch.sin(angle)[..., None] * tilt
    return points + radius[:, None] * (normals - axes), normals


def can_close(points: Float[Tensor, "n f 3"], normals: Float[Tensor, "n f 3"]) -> Bool[Tensor, "n"]:
    """Return a mask (n,) of the postures in which three of the f contacts can have force closure,
    Eq. (13) of the paper.

    Three contacts have it if forces within their friction cones can be in balance. The friction
    coefficient is the default `ContactSpec().mean_friction`. The search tries a grid of forces
    along the sides of the contacts' triangle, and can miss marginal cases. `points` [m] are the
    contacts, and the unit `normals` there point into the object, all in one frame.
    """
    closed = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for three in itertools.combinations(range(points.shape[1]), 3):
        rows = flatnonzero(~closed)
        closed[rows] = _close_triples(points[rows][:, three], normals[rows][:, three])
    return closed


def _close_triples(
    points: Float[Tensor, "n 3 3"], normals: Float[Tensor, "n 3 3"]
) -> Bool[Tensor, "n"]:
    """Return a mask of the contact triples that can balance forces inside their friction cones."""
    spread = 1 + ContactSpec().mean_friction ** 2
    t12, t13, t23 = fibonacci_sphere(BALANCES).to(points).T
    e12, e13, e23 = (unit(points[:, j] - points[:, i]) for i, j in ((0, 1), (0, 2), (1, 2)))
    closed = torch.ones(len(points), BALANCES, dtype=torch.bool, device=points.device)
    pulls = ((e12, e13, t12, t13), (-e12, e23, t12, t23), (-e13, -e23, t13, t23))
    for inward, (a, b, ta, tb) in zip(normals.unbind(1), pulls, strict=True):
        into = dot(a, inward)[:, None] * ta + dot(b, inward)[:, None] * tb
        squared = ta**2 + tb**2 + 2 * dot(a, b)[:, None] * (ta * tb)
        closed = closed & (into > 0) & (squared <= spread * into**2)
    return closed.any(1)


CHUNK_POSTURES = 10_000  # postures kept from one generator; another number gives other postures
BLOCK_POSTURES = 2_000  # postures that a generator draws at a time; fixed for the same reason
MAX_SAMPLES = 10**8  # most postures of one set: a hundred times the paper's million (Sec. 6.3).
LEAST_KEPT = 1e-3
BLOCKS = 10
"""Least share of postures that are kept, and the number of blocks after which it is checked. With a
smaller share, a hand would draw for hours.
"""
Sampling = Literal["uniform", "grasping"]
"""Which of the random postures without self-collision are taken.

* "uniform": all postures are taken, as in the paper. Their contacts are at the
  centres of the pads.
* "grasping": postures are taken whose random contacts, those of `roll_contacts`, can have force
  closure.
"""


@checked
@dataclasses.dataclass(frozen=True)
class HandSamples(Batch):
    """n sampled postures of one hand; `sample_configurations` and `SampleFolder.read` return them.

    Attributes:
        joints: positions (n, h) [rad or m] of the h actuated joints.
        q: contact codes (n, q) of the f fingertips (`encode`). First come their f distances [m]
            from the centroid, then the cosines between all pairs of normals. So q is 6 for three
            fingers, 10 for four and 15 for five. With the sampling "uniform" they are of the pads'
            contact points. With "grasping" they are of the random contacts on the pads.
        joint_names: names of the h joints, in the order of the columns of `joints`.
        meta: texts that describe hand, seed and sampling.

    >>> from torchgrasp import load_hand
    >>> samples = sample_configurations(load_hand("barrett"), 50)
    >>> samples.joints.shape, samples.rows().shape, samples.meta["hand"]
    (torch.Size([50, 4]), torch.Size([50, 10]), 'barrett')
    """

    joints: Float[Tensor, "n h"]
    q: Float[Tensor, "n q"]
    joint_names: tuple[str, ...]
    meta: dict[str, str] = dataclasses.field(default_factory=dict[str, str])

    def rows(self) -> Float[Tensor, "n d"]:
        """Return the samples that a mixture is fitted to: the joints [rad or m] and the contact
        code of each posture, side by side, (n, h + q).
        """
        return torch.cat([self.joints, self.q], dim=-1)


@checked
@dataclasses.dataclass(frozen=True)
class SampleSpec(Value):
    """The settings by which `write_samples` draws `n` postures without self-collision.

    With the same seed and sampling, a smaller `n` gives the first postures of a larger `n`.

    Args:
        n: number of postures, 1 to 100,000,000.
        seed: seed of the draws.
        sampling: which postures are kept.
            "uniform": all without self-collision, as in the paper.
            "grasping": of these, only postures in which contacts at random places on the pads can
              have force closure. A pad is the part of a fingertip that touches objects.

    Raises `BadArgument` for values out of range.

    >>> from torchgrasp import load_hand
    >>> SampleSpec(1000, seed=7).meta(load_hand("barrett"))["seed"]
    '7'
    """

    n: Annotated[int, Range(1, MAX_SAMPLES)]
    seed: Seed = 0
    sampling: Sampling = "uniform"

    @checked
    def meta(self, hand: Hand) -> dict[str, str]:
        """Return texts by name that identify a hand and this spec's seed and sampling, but not the
        number of postures.
        """
        return {**describe_compatibility(hand), "seed": str(self.seed), "sampling": self.sampling}


@checked
def sample_configurations(
    hand: Hand,
    n: Annotated[int, Range(1, MAX_SAMPLES)],
    seed: Seed = 0,
    workers: Annotated[int, Range(1, 1024)] = 1,
    sampling: Sampling = "uniform",
    observer: Callable[[int], object] = lambda count: None,
) -> HandSamples:
    """Return `n` random postures within the joint limits and without self-collision, with their
    contact codes (Sec. 6.3 of the paper).

    The result has `joints` (n, h) [rad or m], the positions of the h actuated joints. It also has
    the contact codes `q` (n, q) of the fingertips, explained in `HandSamples`. With the same `seed`
    and `sampling`, a smaller `n` gives the first postures of a larger `n`.

    Args:
        hand: the hand.
        n: number of postures, 1 to 100,000,000.
        seed: seed of the draws.
        workers: number of threads that draw at the same time, 1 to 1024.
        sampling: which postures are kept.
            "uniform": all without self-collision.
            "grasping": of these, only postures in which contacts at random places on the pads can
              have force closure. A pad is the part of a fingertip that touches objects. It needs a
              hand with three fingers.
        observer: function that is called after each chunk of up to 10,000 postures, with the number
            of postures in this chunk.

    Raises:
        BadArgument: an argument out of range; "grasping" with another number of fingers.
        BadArgument: a hand of which almost no random posture is kept.

    >>> from torchgrasp.hand.load import load_hand
    >>> samples = sample_configurations(load_hand("barrett"), 100)
    >>> samples.joints.shape, samples.q.shape
    (torch.Size([100, 4]), torch.Size([100, 6]))
    """
    spec = SampleSpec(n, seed, sampling)
    if sampling == "grasping":
        hand.require_three("sampling", "'grasping'")
    parts = []
    with ThreadPoolExecutor(workers) as pool:
        for part in pool.map(partial(draw_chunk, hand, spec), range(len(chunk_sizes(n)))):
            parts.append(part)
            observer(len(part[0]))
    joints, q, _ = zip(*parts, strict=True)
    return HandSamples(torch.cat(joints), torch.cat(q), hand.joint_names, spec.meta(hand))


def chunk_sizes(n: int) -> list[int]:
    """Return the number of postures in each chunk (file) that n postures are split into.

    It is 10,000 (`CHUNK_POSTURES`); the last chunk has the rest.
    """
    return [min(CHUNK_POSTURES, n - first) for first in range(0, n, CHUNK_POSTURES)]


def draw_chunk(
    hand: Hand, spec: SampleSpec, i: int
) -> tuple[Float[Tensor, "n h"], Float[Tensor, "n q"], int]:
    """Draw the n postures of chunk i, counted from 0; return (joints, codes, drawn).

    `joints` (n, h) [rad or m] are the postures that were kept, and `codes` (n, q) their contact
    codes. `drawn` is the number of postures that were drawn for them. `spec` says which are kept.
    Raises `BadArgument` if less than one in a thousand (`LEAST_KEPT`) is kept.
    """
    count = chunk_sizes(spec.n)[i]
    parts = []
    kept = 0
    blocks = _draw_blocks(hand, np.random.default_rng((spec.seed, i)), spec.sampling)
    while kept < count:
        parts.append(next(blocks))
        kept = kept + len(parts[-1][0])
        drawn = BLOCK_POSTURES * len(parts)
        if kept < LEAST_KEPT * drawn and len(parts) >= BLOCKS:
            found = f"{kept} kept of {drawn} postures"
            raise BadArgument("hand", found, "a hand that can move freely")
    joints, q = (torch.cat(tensors)[:count] for tensors in zip(*parts, strict=True))
    return joints, q, BLOCK_POSTURES * len(parts)


def _draw_blocks(
    hand: Hand, generator: np.random.Generator, sampling: Sampling
) -> Iterator[tuple[Float[Tensor, "n h"], Float[Tensor, "n q"]]]:
    """Yield blocks of random postures without self-collision, without end: joints [rad] and contact
    codes.
    """
    lower = hand.lower.double()
    upper = hand.upper.double()
    while True:
        uniform = torch.from_numpy(generator.random((BLOCK_POSTURES, hand.dof))).to(lower.device)
        joints = torch.lerp(lower, upper, uniform)
        joints = joints[hand.self_clearance(joints, below=0.0) > 0]
        if sampling == "uniform":
            yield joints, encode_fingertips(*hand.fingertips(joints))
        else:
            points, normals = roll_contacts(hand, joints, generator)
            closed = can_close(points, normals)
            yield joints[closed], encode_fingertips(points[closed], normals[closed])
