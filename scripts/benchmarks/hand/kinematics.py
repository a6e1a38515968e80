"""Rates of fingertips, Jacobians and self-collision of the shipped hands, beside pytorch-kinematics
and targets.
"""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import pytorch_kinematics
import torch
from torch import Tensor

from benchmarks.common import Options, Row, bench, least_seconds
from torchgrasp import load_hand
from torchgrasp.hand.hand import Hand
from torchgrasp.testing import random_joints

COLLISION_RATES = {"allegro": 1e5, "barrett": 2e5}
"""Least rates of self-collision [1/s], on two cores."""
ROWS_PER_CALL = 5000
"""Postures of one timed call."""


@bench("hand/fk")
def fk(o: Options) -> list[Row]:
    """Compare the numbers and times of fingertips and Jacobians with those of pytorch-kinematics."""
    types = (torch.float32, torch.float64)
    return [
        row
        for name in o.hands
        for dtype in types
        for row in _compare(load_hand(name), o.times(100_000), dtype)
    ]


def _compare(hand: Hand, n: int, dtype: torch.dtype) -> Iterator[Row]:
    """Compare n fingertips and n Jacobians of contact points by both backends; the greatest
    difference is of 1000.

    The library's Jacobian always has the three rows of rotation, too.
    """
    hand, joints, most = hand.to(dtype), random_joints(hand, n, 3).to(dtype), 1e-6
    peers = (
        functools.partial(hand.fingertips, backend="pytorch_kinematics"),
        _library_jacobian(hand),
    )
    for what, action, theirs in zip(
        ("fingertips", "Jacobians"), (hand.fingertips, hand.jacobian), peers, strict=True
    ):
        one, other = (
            torch.cat([x.flatten() for x in _parts(f(joints[:1000]))]) for f in (action, theirs)
        )
        error = float((one - other).abs().max())
        title = f"{hand.name}: {what}, {dtype}, against pytorch-kinematics"
        yield Row(
            f"{title}, difference",
            f"<= {most:g}",
            f"{error:.1e}",
            error <= most,
            {"difference": error},
        )
        mine = _seconds(action, joints)
        peer = _seconds(theirs, joints)
        told = f"{peer / mine:.1f}x: {1e3 * mine:.0f} ms against {1e3 * peer:.0f} ms for {n}"
        yield Row(title, ">= 3x faster", told, peer / mine >= 3.0, {"ours": mine, "peer": peer})


def _library_jacobian(hand: Hand) -> Callable[[Tensor], Tensor]:
    """Return how pytorch-kinematics computes the Jacobians of contact points of postures, by a
    chain of each finger.
    """
    make: Any = pytorch_kinematics.SerialChain
    chains = [make(hand.chain, link, dtype=hand.chain.dtype) for link in hand.tips.links]
    columns = [
        [hand.tree.joint_names.index(name) for name in x.get_joint_parameter_names()]
        for x in chains
    ]

    def jacobian(rows: Tensor) -> Tensor:
        values = hand.expand_joints(rows)
        moved = []
        for chain, column, contact in zip(chains, columns, hand.tips.contact, strict=True):
            found = chain.jacobian(values[:, column], locations=contact.expand(len(rows), 3))
            moved.append(found[:, :3] @ hand.actuated.coupling[column])
        return torch.stack(moved, 1)

    return jacobian


def _parts(value: Tensor | tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    return value if isinstance(value, tuple) else (value,)


def _seconds(action: Callable[[Tensor], object], rows: Tensor) -> float:
    """Return the least time [s] of an action on all rows, some at a time."""
    with torch.no_grad():
        return least_seconds(
            lambda: [action(part) for part in rows.split(ROWS_PER_CALL)], 3, limit=60.0
        )


@bench("hand/collision")
def collision(o: Options) -> list[Row]:
    """Time self-collision."""
    n = o.times(200_000)
    rows = []
    for name in o.hands:
        hand = load_hand(name)
        least = COLLISION_RATES.get(name, 1e5)
        for dtype in (torch.float64, torch.float32):
            for what, below in (("distances", torch.inf), ("verdicts", 0.0)):
                action = functools.partial(hand.self_clearance, below=below)
                rate = n / _seconds(action, random_joints(hand, n, 5).to(dtype))
                title = f"{name}: self-collision, {what}, {dtype}, {o.threads} threads"
                bar = f">= {least:.0e} postures/s on two cores"
                rows.append(
                    Row(title, bar, f"{rate:.2e} postures/s", rate >= least, {"rate": rate})
                )
    return rows
