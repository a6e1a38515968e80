"""Learn the model of a hand: sample free postures, fit the mixture, judge it on held-out postures, write it."""

import dataclasses
import sys
import time
from pathlib import Path
from typing import Annotated

import torch
import tyro

from torchgrasp.errors import BadArgument, GraspError
from torchgrasp.hand.fit import bic, fit_mixture
from torchgrasp.hand.load import load_hand
from torchgrasp.hand.mixture import DEFAULT_REACH, PAPER_REACH, GraspMixture, mixture_path
from torchgrasp.hand.sample import HandSamples, sample_configurations

PAPER_COMPONENTS = {"allegro": 41, "barrett": 36}
"""The paper's numbers of Gaussians (Sec. 6.3); 40 for any other hand."""


def report_held_out(mixture: GraspMixture, held_out: HandSamples) -> dict[str, str]:
    """Print the errors of Eq. (23) on postures that the fit has not seen; return what goes into the file."""
    error = (mixture.joints(held_out.q) - held_out.joints).abs()
    best = (mixture.modes(held_out.q, 4)[0] - held_out.joints[:, None]).abs().mean(-1).amin(-1)
    print(f"mean absolute error on {len(held_out)} held-out postures [rad]: Eq. (23) +- deviation over postures")
    for name, mean, deviation in zip(held_out.joint_names, error.mean(0).tolist(), error.std(0).tolist(), strict=True):
        print(f"  {name:20s} {mean:.3f} +- {deviation:.3f}")
    print(f"  {'all joints':20s} {float(error.mean()):.3f}; the nearest of 4 modes {float(best.mean()):.3f}")
    reach = mixture.reach(held_out.q)
    paper, default = (float((reach < threshold).double().mean()) for threshold in (PAPER_REACH, DEFAULT_REACH))
    print(f"within reach: {paper:.4f} at the paper's {PAPER_REACH:g}, {default:.4f} at the default {DEFAULT_REACH:.3f}")
    per_sample = float(mixture.log_prob(held_out.rows()).mean())
    print(f"log-likelihood a posture: {mixture.meta['log_likelihood']} fitted, {per_sample:.6f} held out")
    return {
        "held_out": str(len(held_out)),
        "acceptance_paper_reach": f"{paper:.4f}",
        "acceptance_default_reach": f"{default:.4f}",
        "mean_absolute_error": f"{float(error.mean()):.4f}",
    }


def main(
    hand: Annotated[str, tyro.conf.Positional],
    n: int = 200_000,
    components: int | None = None,
    seed: int = 0,
    tolerance: float = 1e-3,
    held_out: int = 20_000,
    workers: int = 1,
    out: Path | None = None,
) -> None:
    """Sample, fit, judge and write.

    Args:
        hand: name of a shipped hand, or the folder of another.
        n: free postures to learn from; the paper has 400000.
        components: Gaussians; default: the paper's number for its hands, 40 for others.
        seed: of postures and start.
        tolerance: of the mean log-likelihood [nats] at which the fit stops.
        held_out: further postures to judge by.
        workers: threads that sample.
        out: file to write; default: mixture.safetensors in the hand's folder.
    """
    if held_out < 2:
        raise BadArgument("held_out", held_out, "at least 2 postures")
    robot = load_hand(hand)
    begin = time.perf_counter()
    samples = sample_configurations(robot, n + held_out, seed=seed, workers=workers)
    print(f"{robot.name}: {len(samples)} free postures in {time.perf_counter() - begin:.0f} s")
    begin = time.perf_counter()
    m = PAPER_COMPONENTS.get(robot.name, 40) if components is None else components
    mixture = fit_mixture(samples[:n], m, seed=seed, tolerance=tolerance)
    meta = mixture.meta
    print(
        f"{len(mixture.weights)} components in {meta['iterations']} steps (converged: {meta['converged']}),"
        f" {time.perf_counter() - begin:.0f} s, added relative variance {mixture.regularisation:g}"
    )
    print(f"BIC {meta['bic']} fitted, {bic(mixture, samples[n:]):.1f} held out")
    mixture = dataclasses.replace(mixture, meta={**meta, **report_held_out(mixture, samples[n:])})
    print(f"written: {mixture.save(out or mixture_path(hand))}")


if __name__ == "__main__":
    torch.set_num_threads(1)  # small products: further threads only spin
    try:
        tyro.cli(main)
    except GraspError as error:
        sys.exit(f"make_hand: {error}")
