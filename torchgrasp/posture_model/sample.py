"""Random postures of a hand that touch nothing of itself: what its model is learned from (Sec. 4.1)."""

import dataclasses
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Batch
from torchgrasp.errors import BadArgument
from torchgrasp.hand.hand import Hand
from torchgrasp.posture_model.compatibility import describe_compatibility
from torchgrasp.posture_model.encoding import encode_fingertips

CHUNK = 10_000
"""Free postures of one generator. It fixes what a seed means, so it is no argument."""
BLOCK = 2_000
"""Draws of a generator at a time. It fixes what a seed means as well."""
OPPOSED = -0.5
"""Largest cosine between the outward normals of two pads that face each other: at most 60 degrees from opposite."""
MAX_SAMPLES = 10**8

Sampling = Literal["uniform", "opposed"]


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


def sample_configurations(
    hand: Hand,
    n: int,
    seed: int = 0,
    workers: int = 1,
    sampling: Sampling = "uniform",
    observer: Callable[[int], None] = lambda count: None,
) -> HandSamples:
    """Draw postures uniformly within the joint limits and keep those free of self-collision (Sec. 6.3).

    Args:
        hand: the hand.
        n: how many free postures.
        seed: of the draws. Chunk i of 10^4 postures comes from (seed, i) alone, so that the result does not depend on
            `workers`, and that fewer samples are a prefix of more.
        workers: threads that draw at the same time.
        sampling: "uniform" as in the paper, or "opposed": of these only postures in which two pads face each other,
            as those that hold something do.
        observer: called after every chunk with the number of its postures, to show how far the draw is.

    Raises:
        BadArgument: n, seed, workers or sampling outside their range, or a hand of which hardly any posture is kept.

    >>> from torchgrasp.hand.load import load_hand
    >>> sample_configurations(load_hand("barrett"), 100).q.shape
    torch.Size([100, 6])
    """
    meta = check_sampling(hand, n, seed, workers, sampling)
    counts = chunk_counts(n)
    parts = []
    with ThreadPoolExecutor(workers) as pool:
        for part in pool.map(lambda i: draw_chunk(hand, seed, i, counts[i], sampling), range(len(counts))):
            parts.append(part)
            observer(len(part[0]))
    joints, q, _ = zip(*parts, strict=True)
    return HandSamples(torch.cat(joints), torch.cat(q), hand.joint_names, meta)


def check_sampling(hand: Hand, n: int, seed: int, workers: int, sampling: str) -> dict[str, str]:
    """Return what tells one set of samples from another, after checking what it is made by.

    Raises:
        BadArgument: a number outside its range, or another way of sampling.
    """
    limits = [("n", n, 1, MAX_SAMPLES), ("seed", seed, 0, 2**63 - 1), ("workers", workers, 1, 1024)]
    for name, value, low, high in limits:
        if not low <= value <= high or value != int(value):
            raise BadArgument(name, value, f"a whole number in [{low}, {high}]")
    if sampling not in get_args(Sampling):
        raise BadArgument("sampling", repr(sampling), f"one of {get_args(Sampling)}")
    return {**describe_compatibility(hand), "seed": str(seed), "sampling": sampling}


def chunk_counts(n: int) -> list[int]:
    """Return how many postures each chunk has: 10^4, the last one what is left."""
    return [min(CHUNK, n - first) for first in range(0, n, CHUNK)]


def draw_chunk(
    hand: Hand, seed: int, chunk: int, count: int, sampling: Sampling
) -> tuple[Float[Tensor, "n h"], Float[Tensor, "n 6"], int]:
    """Return the first `count` kept postures of one chunk, their codes, and how many postures were drawn for them."""
    kept = list(_blocks(hand, seed, chunk, count, sampling))
    joints, q = (torch.cat(parts)[:count] for parts in zip(*kept, strict=True))
    return joints, q, BLOCK * len(kept)


def _blocks(
    hand: Hand, seed: int, chunk: int, count: int, sampling: Sampling
) -> Iterator[tuple[Float[Tensor, "n h"], Float[Tensor, "n 6"]]]:
    """Yield the kept postures of one block of draws after another, until there are `count`."""
    generator, have, drawn = np.random.default_rng((seed, chunk)), 0, 0
    lower, upper = hand.lower.double(), hand.upper.double()
    while have < count:
        uniform = torch.from_numpy(generator.random((BLOCK, hand.dof))).to(lower.device)
        joints = torch.lerp(lower, upper, uniform)
        joints = joints[hand.self_clearance(joints, below=0.0) > 0]
        points, normals = hand.fingertips(joints)
        if sampling == "opposed":
            facing = opposed(points, normals)
            joints, points, normals = joints[facing], points[facing], normals[facing]
        yield joints, encode_fingertips(points, normals)
        have, drawn = have + len(joints), drawn + BLOCK
        if have < 1e-3 * drawn and drawn >= 10 * BLOCK:
            raise BadArgument("hand", f"{have} kept of {drawn} postures", "a hand that can move freely")


def opposed(points: Float[Tensor, "n 3 3"], normals: Float[Tensor, "n 3 3"]) -> Bool[Tensor, " n"]:
    """Tell where two pads face each other: normals nearly opposite, each towards the other pad."""
    found = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        way = points[:, j] - points[:, i]
        ahead, back = (normals[:, i] * way).sum(-1) > 0, (normals[:, j] * way).sum(-1) < 0
        found |= ahead & back & ((normals[:, i] * normals[:, j]).sum(-1) < OPPOSED)
    return found
