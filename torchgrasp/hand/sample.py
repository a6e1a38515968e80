"""Random postures of a hand that touch nothing of itself: what its model is learned from (Sec. 4.1)."""

import dataclasses
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import count

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Batch
from torchgrasp.errors import BadArgument
from torchgrasp.hand.code import hand_code
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.identity import describe_hand

CHUNK = 10_000
"""Postures drawn from one generator. It fixes what a seed means, so it is no argument."""


@dataclasses.dataclass(frozen=True)
class HandSamples(Batch):
    """Postures `joints` [rad] of one hand and their codes `q` (Eq. 18); `meta` tells hand, fingers, hash and seed."""

    joints: Float[Tensor, "n h"]
    q: Float[Tensor, "n 6"]
    joint_names: tuple[str, ...]
    meta: dict[str, str] = dataclasses.field(default_factory=dict[str, str])

    def rows(self) -> Float[Tensor, "n d"]:
        """Return joints and codes side by side, as the mixture models them."""
        return torch.cat([self.joints, self.q], dim=-1)


def sample_configurations(hand: Hand, n: int, seed: int = 0, workers: int = 1) -> HandSamples:
    """Draw postures uniformly within the joint limits and keep those free of self-collision (Sec. 6.3).

    Args:
        hand: the hand.
        n: how many free postures.
        seed: of the draws. Chunk i of 10^4 draws comes from (seed, i) alone, so that the result does not depend on
            `workers`, and that fewer samples are a prefix of more.
        workers: threads that draw at the same time.

    Raises:
        BadArgument: n, seed or workers outside their range, or a hand of which hardly any posture is free.

    >>> from torchgrasp.hand.load import load_hand
    >>> sample_configurations(load_hand("barrett"), 100).q.shape
    torch.Size([100, 6])
    """
    for name, value, low, high in [("n", n, 1, 10**9), ("seed", seed, 0, 2**63), ("workers", workers, 1, 1024)]:
        if not low <= value <= high or value != int(value):
            raise BadArgument(name, value, f"a whole number in [{low}, {high}]")
    found: list[Tensor] = []
    have = 0
    for i, free in enumerate(_chunks(hand, seed, workers)):
        found.append(free)
        have += len(free)
        if have >= n:
            break
        if i >= 9 and have < 1e-3 * (i + 1) * CHUNK:
            raise BadArgument("hand", f"{have} free of {(i + 1) * CHUNK} postures", "a hand that can move freely")
    joints = torch.cat(found)[:n]
    q = torch.cat([hand_code(*hand.fingertips(part)) for part in joints.split(CHUNK)])
    return HandSamples(joints, q, hand.joint_names, describe_hand(hand) | {"seed": str(seed)})


def _chunks(hand: Hand, seed: int, workers: int) -> Iterator[Tensor]:
    """Yield the free postures of each chunk, in order, `workers` of them under way at a time."""
    if workers == 1:
        yield from (_draw(hand, seed, i) for i in count())
        return
    with ThreadPoolExecutor(workers) as pool:
        for first in count(0, workers):
            yield from pool.map(lambda i: _draw(hand, seed, i), range(first, first + workers))


def _draw(hand: Hand, seed: int, chunk: int) -> Float[Tensor, "n h"]:
    """Draw one chunk and drop the postures in collision."""
    uniform = np.random.default_rng((seed, chunk)).random((CHUNK, len(hand.joint_names)))
    lower, upper = hand.lower.double(), hand.upper.double()
    joints = lower + (upper - lower) * torch.from_numpy(uniform).to(lower.device)
    return joints[hand.self_clearance(joints) > 0]
