"""From a hand's URDF to its learned model: a hand.toml if there is none, checks, postures, fit, errors, file."""

import dataclasses
import time
from pathlib import Path
from typing import Annotated

import torch
import tyro
from tqdm import tqdm

from torchgrasp.errors import BadArgument
from torchgrasp.files import write_file
from torchgrasp.hand.draft import draft_hand
from torchgrasp.hand.hand import Hand
from torchgrasp.posture_model import Progress, fit_mixture, sample_configurations
from torchgrasp.posture_model.mixture import mixture_path
from torchgrasp.testing import check_hand
from train.mixture_score import evaluate_mixture
from train.model_selection import bic_curve

CANDIDATES = tuple(range(5, 61, 5))
"""Numbers of Gaussians to choose from: the range of Fig. 6."""
SELECTION = 40_000
"""Postures of their own on which the number is chosen."""


def posture_model(
    hand: Annotated[str, tyro.conf.Positional],
    tips: tuple[str, ...] = (),
    n: int = 200_000,
    components: int | None = None,
    seed: int = 0,
    starts: int = 5,
    tolerance: float = 1e-3,
    held_out: int = 20_000,
    workers: int = 1,
    checkpoint: Path | None = None,
    out: Path | None = None,
) -> None:
    """Learn the mixture of a hand: check the hand, sample, fit, evaluate and write.

    Args:
        hand: name of a shipped hand, the folder of another, or a URDF.
        tips: links of the fingertips as for `torchgrasp hand new`, for a URDF without a hand.toml beside it.
        n: postures to learn from, which can hold something where their tips have rolled.
        components: Gaussians; default: the number of least BIC among `CANDIDATES`.
        seed: of postures and first start.
        starts: k-means starts of the fit, of which the likeliest continues.
        tolerance: of the mean log-likelihood [nats] at which the fit stops.
        held_out: further postures for the evaluation.
        workers: threads that sample.
        checkpoint: file that holds the fit after every step; a killed fit continues from it.
        out: file to write; default: mixture.safetensors in the hand's folder.
    """
    if held_out < 2:
        raise BadArgument("held_out", held_out, "at least 2 postures")
    torch.set_num_threads(1)  # the products are small: more threads only spin
    folder = prepare_folder(hand, tips)
    robot = check_hand(folder)
    begin = time.perf_counter()
    with tqdm(desc="postures", total=n + held_out, unit_scale=True, disable=None) as bar:
        samples = sample_configurations(robot, n + held_out, seed, workers, "grasping", bar.update)
    print(f"{robot.name}: {len(samples)} postures in {time.perf_counter() - begin:.0f} s")
    begin = time.perf_counter()
    m = choose(robot, seed, workers) if components is None else components
    with tqdm(desc="EM", unit=" steps", disable=None) as bar:

        def show(progress: Progress) -> None:
            bar.update()
            bar.set_postfix(log_likelihood=f"{float(progress.log_likelihood[-1]):.4f}")

        mixture = fit_mixture(
            samples[:n], m, seed, tolerance=tolerance, starts=starts, checkpoint=checkpoint, observer=show
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
    print(f"written: {mixture.save(out or mixture_path(folder))}")


def choose(hand: Hand, seed: int, workers: int) -> int:
    """Return the number of Gaussians of least BIC on other postures, and print the curve."""
    apart = sample_configurations(hand, SELECTION, seed + 1, workers, "grasping")
    with tqdm(desc="components", total=len(CANDIDATES), disable=None) as bar:
        curve = bic_curve(apart, CANDIDATES, observer=lambda m, mixture: bar.update() and None, iterations=100)
    print(curve)
    return int(curve.components[curve.bic.argmin()])


def prepare_folder(hand: str, tips: tuple[str, ...]) -> str:
    """Return the folder of a URDF, with a drafted hand.toml if there was none; any other name as it is."""
    if Path(hand).suffix != ".urdf":
        return hand
    target = Path(hand).parent / "hand.toml"
    if not target.exists():
        write_file(target, draft_hand(hand, tips))
        print(f"written: {target}; look over the lines marked CHECK")
    return str(target.parent)
