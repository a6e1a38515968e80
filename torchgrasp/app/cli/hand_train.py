"""`torchgrasp hand train`: learn the posture model of a hand."""

import dataclasses
import time
from pathlib import Path
from typing import Annotated

from tqdm import tqdm
from tyro.conf import Positional, arg

from torchgrasp.app.cli.common import check_seed, holding, naming
from torchgrasp.base import check_whole
from torchgrasp.errors import BadArgument
from torchgrasp.files import hold_file
from torchgrasp.hand.hand import Hand
from torchgrasp.posture_model.fit import Progress, fit_mixture
from torchgrasp.posture_model.mixture import GraspMixture, mixture_path
from torchgrasp.posture_model.sample import sample_configurations
from torchgrasp.posture_model.score import evaluate_mixture
from torchgrasp.posture_model.selection import bic_curve
from torchgrasp.testing import check_hand

CANDIDATES = tuple(range(5, 61, 5))
"""Numbers of Gaussians to choose from: the range of Fig. 6."""
SELECTION = 40_000
"""Postures of their own on which the number is chosen."""
STARTS, TOLERANCE = 5, 1e-3
"""Starts of k-means, and the mean log-likelihood [nats] a step must gain: the shipped models were fitted so."""


def train(
    hand: Annotated[Positional[str], arg(metavar="HAND")],
    /,
    n: int = 200_000,
    components: int | None = None,
    seed: int = 0,
    held_out: int = 20_000,
    workers: int = 1,
    checkpoint: Path | None = None,
    out: Path | None = None,
) -> int:
    """Learn the mixture of a hand: check the hand, sample, fit, evaluate and write. Only the paper's modes need it.

    Args:
        hand: name of a shipped hand, or the folder of another.
        n: postures to learn from, which can hold something where their tips have rolled.
        components: Gaussians; by default the number of least BIC among 5, 10, .. 60.
        seed: of postures and first start.
        held_out: further postures for the evaluation.
        workers: threads that sample.
        checkpoint: file that holds the fit after every step; a killed fit continues from it.
        out: file to write; by default mixture.safetensors in the hand's folder.
    """
    check_seed(seed)
    check_whole("--held-out", held_out, 2, 10**7)
    check_whole("--n", n, 1, 10**8)
    if out is not None and out.suffix != ".safetensors":
        raise BadArgument("--out", out, "a file ending in .safetensors")
    with naming(hand="HAND"):
        robot = check_hand(hand)
    written = out or mixture_path(hand)
    with holding("--out", written, hold_file), holding("--checkpoint", checkpoint, hold_file):
        begin = time.perf_counter()
        with tqdm(desc="postures", total=n + held_out, unit_scale=True, disable=None) as bar:
            samples = sample_configurations(robot, n + held_out, seed, workers, "grasping", bar.update)
        print(f"{robot.name}: {len(samples)} postures in {time.perf_counter() - begin:.0f} s")
        begin = time.perf_counter()
        m = _choose(robot, seed, workers) if components is None else components
        with tqdm(desc="EM", unit=" steps", disable=None) as bar:

            def show(progress: Progress) -> None:
                bar.update()
                bar.set_postfix(log_likelihood=f"{float(progress.log_likelihood[-1]):.4f}")

            with naming(components="--components", checkpoint="--checkpoint", path="--checkpoint"):
                mixture = fit_mixture(
                    samples[:n], m, seed, tolerance=TOLERANCE, starts=STARTS, checkpoint=checkpoint, observer=show
                )
        meta = mixture.meta
        print(
            f"{len(mixture.weights)} components in {meta['iterations']} steps (converged: {meta['converged']},"
            f" components placed anew: {meta['reseeded']}), {time.perf_counter() - begin:.0f} s,"
            f" added relative variance {mixture.regularisation:g}"
        )
        print(f"log-likelihood a posture: {meta['log_likelihood']} fitted; BIC {meta['bic']}")
        score = evaluate_mixture(mixture, samples[n:])
        print(score)
        mixture = dataclasses.replace(mixture, meta=meta | score.meta())
        with naming(path="--out"):
            mixture.save(written)
        print(f"written: {written}")
    return 0


def _choose(hand: Hand, seed: int, workers: int) -> int:
    """Return the number of Gaussians of least BIC on other postures, and print the curve."""
    apart = sample_configurations(hand, SELECTION, seed + 1, workers, "grasping")
    with tqdm(desc="components", total=len(CANDIDATES), disable=None) as bar:

        def show(m: int, mixture: GraspMixture) -> None:
            bar.update()

        curve = bic_curve(apart, CANDIDATES, observer=show, iterations=100)
    print(curve)
    return int(curve.components[curve.bic.argmin()])
