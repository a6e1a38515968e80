"""From a hand's URDF to its learned model: hand.toml if there is none, checks, postures, fit, errors, file.

python scripts/make_hand.py hands/allegro                  a hand with its hand.toml
python scripts/make_hand.py mine/hand.urdf --tips a b c    a URDF alone: a hand.toml is written beside it first
"""

import dataclasses
import sys
import time
from pathlib import Path
from typing import Annotated

import torch
import tyro
from tqdm import tqdm

from torchgrasp.errors import BadArgument, GraspError
from torchgrasp.files import write_file
from torchgrasp.hand.draft import draft_hand
from torchgrasp.posture_model.em import Progress
from torchgrasp.posture_model.evaluate import evaluate_mixture
from torchgrasp.posture_model.fit import fit_mixture
from torchgrasp.posture_model.mixture import mixture_path
from torchgrasp.posture_model.sample import sample_configurations
from torchgrasp.testing import check_hand

PAPER_COMPONENTS = {"allegro": 41, "barrett": 36}
"""The paper's numbers of Gaussians (Sec. 6.3); 40 for any other hand."""


def main(
    hand: Annotated[str, tyro.conf.Positional],
    tips: tuple[str, ...] = (),
    n: int = 400_000,
    components: int | None = None,
    seed: int = 0,
    starts: int = 5,
    tolerance: float = 1e-3,
    held_out: int = 20_000,
    workers: int = 1,
    checkpoint: Path | None = None,
    out: Path | None = None,
) -> None:
    """Check, sample, fit, judge and write.

    Args:
        hand: name of a shipped hand, the folder of another, or a URDF.
        tips: links of the fingertips as for `torchgrasp hand new`, where the URDF has no hand.toml beside it.
        n: free postures to learn from; the paper's number.
        components: Gaussians; default: the paper's number for its hands, 40 for others.
        seed: of postures and start.
        starts: of the fit, of which the likeliest goes on.
        tolerance: of the mean log-likelihood [nats] at which the fit stops.
        held_out: further postures to judge by.
        workers: threads that sample.
        checkpoint: file in which the fit is kept after every step, and from which it goes on if it was killed.
        out: file to write; default: mixture.safetensors in the hand's folder.
    """
    if held_out < 2:
        raise BadArgument("held_out", held_out, "at least 2 postures")
    hand = folder_of(hand, tips)
    robot = check_hand(hand)
    begin = time.perf_counter()
    with tqdm(desc="postures", total=n + held_out, unit_scale=True, disable=None) as bar:

        def count(more: int) -> None:
            bar.update(more)

        samples = sample_configurations(robot, n + held_out, seed, workers, observer=count)
    print(f"{robot.name}: {len(samples)} free postures in {time.perf_counter() - begin:.0f} s")
    begin = time.perf_counter()
    m = PAPER_COMPONENTS.get(robot.name, 40) if components is None else components
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
    judged = evaluate_mixture(mixture, samples[n:])
    print(judged)
    mixture = dataclasses.replace(mixture, meta=meta | judged.meta())
    print(f"written: {mixture.save(out or mixture_path(hand))}")


def folder_of(hand: str, tips: tuple[str, ...]) -> str:
    """Return the folder of a URDF after writing a hand.toml there if there is none; any other name as it is."""
    if Path(hand).suffix != ".urdf":
        return hand
    target = Path(hand).parent / "hand.toml"
    if not target.exists():
        text = draft_hand(hand, tips)
        write_file(target, text)
        print(f"written: {target}; look over the lines marked CHECK")
    return str(target.parent)


if __name__ == "__main__":
    torch.set_num_threads(1)  # small products: further threads only spin
    try:
        tyro.cli(main)
    except GraspError as error:
        sys.exit(f"make_hand: {error}")
