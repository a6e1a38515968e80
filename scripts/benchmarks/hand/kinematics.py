"""Kinematics, self-collision and samples of the shipped hands beside their bars.

Rates count the rows of all threads. Every thread takes its own rows, as when samples are drawn.
"""

import functools
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_kinematics
import torch
from torch import Tensor

from benchmarks.common import Options, Row, bench
from torchgrasp import load_hand
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.kinematics import chain_from_urdf
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.posture_model.dataset import load_samples
from torchgrasp.testing import random_joints, reference_poses

HANDS = ("allegro", "barrett")
POSTURES = 1000
"""Random postures in which poses are compared."""
RATE = {"allegro": 1e5, "barrett": 2e5}
"""Least rate of self-collision [1/s]."""
SECONDS = {"allegro": 60.0, "barrett": 30.0}
"""Most time for 10^6 samples on disk [s], on two cores."""
ROWS_PER_CALL = 5000
"""Rows of one timed call."""


@bench("hand/fk")
def fk(o: Options) -> list[Row]:
    """Compare poses with pytorch-kinematics and pinocchio, and times with pytorch-kinematics."""
    n, threads, rows = o.times(1_000_000), o.threads, []
    for name in HANDS:
        hand = load_hand(name)
        rows += [_exactness(name, hand), _differentiable(name, hand)]
        for dtype in (torch.float32, torch.float64):
            rows += _speed(name, hand, n, threads, dtype)
    return rows


def _exactness(name: str, hand: Hand) -> Row:
    """Compare every link's pose with two other readers, by joint name."""
    joints = random_joints(hand, POSTURES, 1)
    found = hand.link_poses(joints)
    model = pinocchio.buildModelFromUrdf(str(hand.urdf_path))
    data, every = model.createData(), {k: v.tolist() for k, v in hand.expand(joints).items()}
    frames = [model.getFrameId(link) for link in hand.tree.link_names]
    exact = torch.zeros_like(found)
    for row in range(len(joints)):
        pinocchio.framesForwardKinematics(model, data, np.array([every[n][row] for n in list(model.names)[1:]]))
        exact[row] = torch.from_numpy(np.stack([data.oMf[frame].homogeneous for frame in frames]))
    peers = {
        "pytorch-kinematics": reference_poses(read_urdf(hand.urdf_path), hand.expand_joints(joints)),
        "pinocchio": exact,
    }
    worst = {peer: _worst(found, poses) for peer, poses in peers.items()}
    told = "; ".join(f"{peer} {move:.1e} m, {turn:.1e} rad" for peer, (move, turn) in worst.items())
    met = max(max(errors) for errors in worst.values()) <= 1e-6
    return Row(f"{name}: poses of all links, {POSTURES} postures", "<= 1e-6 m, 1e-6 rad", told, met, worst)


def _worst(found: Tensor, truth: Tensor) -> tuple[float, float]:
    """Return the largest difference in position [m] and angle [rad]."""
    turn = found[..., :3, :3].mT @ truth[..., :3, :3]
    skew = (turn - turn.mT) / 2
    sine = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1).norm(dim=-1)
    return float((found - truth)[..., :3, 3].norm(dim=-1).max()), float(sine.max())


def _differentiable(name: str, hand: Hand) -> Row:
    """Check first and second derivatives against finite differences."""
    joints = random_joints(hand, 1, 2).requires_grad_()
    met = all(check(hand.fingertips, joints) for check in (torch.autograd.gradcheck, torch.autograd.gradgradcheck))
    return Row(f"{name}: gradcheck and gradgradcheck of the fingertips", "pass", "pass" if met else "fail", met, {})


def _speed(name: str, hand: Hand, n: int, threads: int, dtype: torch.dtype) -> list[Row]:
    """Time n fingertips and n Jacobians of contact points beside pytorch-kinematics; both couple the joints.

    The peer's Jacobian always has the three rows of rotation, too.
    """
    joints, some = random_joints(hand, n, 3).to(dtype), n // 10  # the peer's time is as long for each row
    chain: Any = chain_from_urdf(read_urdf(hand.urdf_path), dtype)
    make: Any = pytorch_kinematics.SerialChain
    fingers = [make(chain, link, dtype=dtype) for link in hand.tips.links]
    order = [hand.tree.joint_names.index(x) for x in chain.get_joint_parameter_names()]
    orders = [[hand.tree.joint_names.index(x) for x in f.get_joint_parameter_names()] for f in fingers]
    coupling, contact = hand.actuated.coupling.to(dtype), hand.tips.contact.to(dtype)

    def peers_tips(rows: Tensor) -> None:
        poses = chain.forward_kinematics_tensor(hand.expand_joints(rows)[:, order])
        tips = poses[[chain.frame_to_idx[link] for link in hand.tips.links]]
        torch.einsum("fnij,fj->nfi", tips[..., :3, :3], contact) + tips[..., :3, 3].transpose(0, 1)

    def peers_jacobian(rows: Tensor) -> None:
        values = hand.expand_joints(rows)
        for k, finger in enumerate(fingers):
            finger.jacobian(values[:, orders[k]], locations=contact[k].expand(len(rows), 3)) @ coupling[orders[k]]

    rows = []
    actions = [("fingertips", hand.fingertips, peers_tips, 3.0), ("Jacobians", hand.jacobian, peers_jacobian, 6.0)]
    for what, ours, theirs, bar in actions:
        mine = _seconds(ours, joints, threads) / n
        peer = _seconds(theirs, joints[:some], threads) / some
        told = f"{peer / mine:.1f}x: {1e6 * mine:.2f} s against {1e6 * peer:.1f} s for 10^6"
        numbers = {"ours": mine, "peer": peer, "threads": threads}
        title = f"{name}: {what}, {str(dtype).split('.')[-1]}, against pytorch-kinematics"
        rows.append(Row(title, f">= {bar:g}x faster", told, peer / mine >= bar, numbers))
    return rows


def _seconds(action: Callable[[Tensor], object], rows: Tensor, threads: int, repeats: int = 3) -> float:
    """Return the least time [s] of an action on all rows, split over threads; one thread counts processor time."""
    parts = rows.split(ROWS_PER_CALL)
    torch.set_num_threads(1)
    clock = time.process_time if threads == 1 else time.perf_counter

    def run(part: Tensor) -> None:
        with torch.no_grad():  # which is set for each thread
            action(part)

    times = []
    with ThreadPoolExecutor(threads) as pool:
        for _ in range(repeats + 1):
            began = clock()
            list(pool.map(run, parts))
            times.append(clock() - began)
    torch.set_num_threads(threads)
    return min(times[1:])


@bench("hand/collision")
def collision(o: Options) -> list[Row]:
    """Time self-collision."""
    n, threads, rows = o.times(200_000), o.threads, []
    for name in HANDS:
        hand = load_hand(name)
        for dtype in (torch.float64, torch.float32):
            for what, below in (("distances", torch.inf), ("verdicts", 0.0)):
                action = functools.partial(hand.self_clearance, below=below)
                rate = n / _seconds(action, random_joints(hand, n, 5).to(dtype), threads)
                title = f"{name}: self-collision, {what}, {str(dtype).split('.')[-1]}, {threads} threads"
                bar = f">= {RATE[name]:.0e} postures/s on two cores"
                rows.append(Row(title, bar, f"{rate:.2e} postures/s", rate >= RATE[name], {"rate": rate}))
    return rows


@bench("hand/samples")
def samples(o: Options) -> list[Row]:
    """Write samples by the command in another process: time, memory, and the same bytes by one worker."""
    n, threads, rows = max(100, o.times(1_000_000)), o.threads, []
    for name in HANDS:
        with tempfile.TemporaryDirectory() as folder:
            both = [Path(folder) / "one", Path(folder) / "all"]
            seconds, peak = _command(name, n, both[1], threads)
            _command(name, n // 10, both[0], 1)
            whole = all(len(chunk) for chunk in load_samples(both[1])) and len(load_samples(both[1])) == n
            names = [path.name for path in both[0].glob("chunk-*")]
            same = all((both[0] / x).read_bytes() == (both[1] / x).read_bytes() for x in names)
        per_million = 1e6 * seconds / n
        bar = f"<= {SECONDS[name]:.0f} s for 10^6, <= 2 GiB on two cores, same bytes for any number of workers"
        told = f"{per_million:.0f} s for 10^6, {peak:.2f} GiB, {'the same' if same else 'other'} bytes by one worker"
        met = whole and same and per_million <= SECONDS[name] and peak <= 2
        numbers = {"seconds": seconds, "n": n, "peak_gib": peak, "same": same, "workers": threads}
        rows.append(Row(f"{name}: {n} free samples with codes on disk, {threads} workers", bar, told, met, numbers))
    return rows


def _command(name: str, n: int, out: Path, workers: int) -> tuple[float, float]:
    """Run `torchgrasp hand sample`; return its time [s] and the peak of memory so far [GiB]."""
    arguments = ["hand", "sample", "--hand", name, "--n", str(n), "--out", str(out), "--workers", str(workers)]
    code = f"import sys; from torchgrasp.app.cli import main; sys.exit(main({arguments!r}))"
    began = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)
    took = time.perf_counter() - began
    return took, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
