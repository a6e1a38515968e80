"""Rates of fingertips, Jacobians and self-collision of the shipped hands, beside pytorch-kinematics and targets."""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import pytorch_kinematics
import torch
from torch import Tensor

from benchmarks.common import Options, Row, bench, least_seconds
from torchgrasp import load_hand
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.kinematics import chain_from_urdf
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.testing import random_joints

COLLISION_RATES = {"allegro": 1e5, "barrett": 2e5}
"""Least rates of self-collision [1/s], on two cores."""
ROWS_PER_CALL = 5000
"""Postures of one timed call."""


@bench("hand/fk")
def fk(o: Options) -> list[Row]:
    """Compare the times of fingertips and Jacobians with pytorch-kinematics."""
    types = (torch.float32, torch.float64)
    return [row for name in o.hands for dtype in types for row in _compare(load_hand(name), o.times(1_000_000), dtype)]


def _compare(hand: Hand, n: int, dtype: torch.dtype) -> Iterator[Row]:
    """Time n fingertips and n Jacobians of contact points beside the peer, which gets a tenth of the postures.

    Both couple the joints. The peer's Jacobian always has the three rows of rotation, too.
    """
    joints, some = random_joints(hand, n, 3).to(dtype), max(n // 10, 1)
    for what, ours, theirs, bar in zip(
        ("fingertips", "Jacobians"), (hand.fingertips, hand.jacobian), _peers(hand, dtype), (3.0, 6.0), strict=True
    ):
        mine, peer = _seconds(ours, joints) / n, _seconds(theirs, joints[:some]) / some
        told = f"{peer / mine:.1f}x: {1e6 * mine:.2f} s against {1e6 * peer:.1f} s for 10^6"
        title = f"{hand.name}: {what}, {dtype}, against pytorch-kinematics"
        yield Row(title, f">= {bar:g}x faster", told, peer / mine >= bar, {"ours": mine, "peer": peer})


def _peers(hand: Hand, dtype: torch.dtype) -> tuple[Callable[[Tensor], None], Callable[[Tensor], None]]:
    """Return how pytorch-kinematics computes fingertips and Jacobians of postures."""
    chain: Any = chain_from_urdf(read_urdf(hand.urdf_path), dtype)
    make: Any = pytorch_kinematics.SerialChain
    fingers = [make(chain, link, dtype=dtype) for link in hand.tips.links]
    order, *orders = (
        [hand.tree.joint_names.index(name) for name in one.get_joint_parameter_names()] for one in (chain, *fingers)
    )
    coupling, contact = hand.actuated.coupling.to(dtype), hand.tips.contact.to(dtype)

    def tips(rows: Tensor) -> None:
        poses = chain.forward_kinematics_tensor(hand.expand_joints(rows)[:, order])
        places = poses[[chain.frame_to_idx[link] for link in hand.tips.links]]
        torch.einsum("fnij,fj->nfi", places[..., :3, :3], contact) + places[..., :3, 3].transpose(0, 1)

    def jacobian(rows: Tensor) -> None:
        values = hand.expand_joints(rows)
        for k, finger in enumerate(fingers):
            finger.jacobian(values[:, orders[k]], locations=contact[k].expand(len(rows), 3)) @ coupling[orders[k]]

    return tips, jacobian


def _seconds(action: Callable[[Tensor], object], rows: Tensor) -> float:
    """Return the least time [s] of an action on all rows, some at a time."""
    with torch.no_grad():
        return least_seconds(lambda: [action(part) for part in rows.split(ROWS_PER_CALL)], 3, limit=60.0)


@bench("hand/collision")
def collision(o: Options) -> list[Row]:
    """Time self-collision."""
    n, rows = o.times(200_000), []
    for name in o.hands:
        hand, least = load_hand(name), COLLISION_RATES.get(name, 1e5)
        for dtype in (torch.float64, torch.float32):
            for what, below in (("distances", torch.inf), ("verdicts", 0.0)):
                action = functools.partial(hand.self_clearance, below=below)
                rate = n / _seconds(action, random_joints(hand, n, 5).to(dtype))
                title = f"{name}: self-collision, {what}, {dtype}, {o.threads} threads"
                bar = f">= {least:.0e} postures/s on two cores"
                rows.append(Row(title, bar, f"{rate:.2e} postures/s", rate >= least, {"rate": rate}))
    return rows
