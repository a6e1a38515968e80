"""The commands `torchgrasp hand new`, `sample` and `train`: a first hand.toml, random postures, the posture model."""

import dataclasses
import time
from pathlib import Path
from typing import Annotated

from torchgrasp.app.author.draft import Wish, new_hand
from torchgrasp.app.cli.command import Command, arguments, make_bar, naming, option, positional, required
from torchgrasp.app.cli.hand_check import describe_sets, print_faults
from torchgrasp.app.cli.inputs import FINGERS_HELP, HAND_HELP, SEED_HELP, check_folder, holding, load_fingers
from torchgrasp.checks import Range, Seed
from torchgrasp.errors import BadArgument, OutputError
from torchgrasp.files import hold_file, temporary_folder, write_file
from torchgrasp.hand.hand import Hand
from torchgrasp.posture_model.dataset import write_samples
from torchgrasp.posture_model.fit import Progress, fit_mixture
from torchgrasp.posture_model.mixture import GraspMixture, mixture_path
from torchgrasp.posture_model.sample import SampleSpec, Sampling, sample_configurations
from torchgrasp.posture_model.score import bic_curve, evaluate_mixture
from torchgrasp.testing import check_hand

STARTS = 5  # starts of k-means, as for the shipped models


@arguments()
class HandNew(Command):
    """Write a first hand.toml for a published URDF, and a clean copy of the URDF where it needs repair."""

    urdf: Path = positional("the hand, with or without meshes")
    tips: tuple[str, ...] = option(
        (),
        'links of three to five fingertips in grasp order, first the three of option "default"; "four" and "five" add '
        "the next. By default the ends of the tree's branches, in the order in which their pads face best",
    )
    name: str | None = option(None, "name of the hand; by default the robot's")
    root: str = option("", "first link of the hand, where the URDF has an arm, too")
    meshes: Path | None = option(None, "folder of all meshes; by default the URDF's")
    out: Path | None = option(None, "folder to write; by default the URDF's")
    seed: Seed = option(0, "random seed of the postures from which pads and pairs are guessed")

    def run(self) -> int:
        """Draft, check and write the files of the hand; return the exit code."""
        folder = self.urdf.parent if self.out is None else self.out
        check_folder(folder)
        clean = "hand.urdf" if (folder / "hand.urdf").resolve() != self.urdf.resolve() else "hand_clean.urdf"
        draft = new_hand(self.urdf, Wish(self.tips, self.name or "", self.root, self.meshes), self.seed, clean)
        texts = {"hand.toml": draft.toml}
        if draft.urdf or self.out is not None:
            texts[clean if draft.urdf else self.urdf.name] = draft.urdf or self.urdf.read_text(encoding="utf-8")
        for file in texts:
            if (folder / file).exists():
                raise OutputError("URDF", f"{folder / file}, which exists", "a folder without this file, as by --out")
        with temporary_folder() as trial:
            for file, text in ({self.urdf.name: self.urdf.read_text(encoding="utf-8")} | texts).items():
                write_file(trial / file, text)
            if print_faults(trial):
                print(f"nothing is written; repair {self.urdf} and try again")
                return 2
            hand = check_hand(trial)
            sets = describe_sets(hand)
        for sentence in draft.repairs:
            print(f"repaired: {sentence}")
        for file, text in texts.items():
            write_file(folder / file, text)
            print(f"written: {folder / file}")
        print(f"out of the palm: {[round(x, 2) for x in hand.approach.tolist()]}")
        print(sets)
        place = folder if folder.is_absolute() else f"./{folder}"  # a plain name may be that of a shipped hand
        print(f"look over the lines of hand.toml marked CHECK, then: torchgrasp hand check {place}")
        return 0


@arguments(folder="out", path="out")
class HandSample(Command):
    """Write random postures without self-collision, with their codes; continue an unfinished folder."""

    hand: str = required(HAND_HELP)
    out: Path = required("folder to write")
    n: int = option(1_000_000, "number of postures; the paper has 1,000,000")
    fingers: str = option("default", FINGERS_HELP)
    sampling: Sampling = option("uniform", "uniform as in the paper; grasping: postures that can hold an object")
    workers: int = option(1, "threads that sample")
    seed: Seed = option(0, SEED_HELP)

    def run(self) -> int:
        """Draw random postures and write them; return the exit code."""
        hand, _ = load_fingers(self.hand, self.fingers)
        begin = time.perf_counter()
        spec = SampleSpec(self.n, self.seed, self.sampling)
        with make_bar(self.n, "posture", unit_scale=True) as bar:
            write_samples(hand, spec, self.out, self.workers, bar.update)
        seconds = time.perf_counter() - begin
        print(f"{self.n} {self.sampling} postures of {hand.name} in {self.out}, {seconds:.0f} s")
        return 0


@arguments()
class HandTrain(Command):
    """Learn the posture model of a hand: check, sample, fit, evaluate and write. Only the paper's modes need it."""

    hand: str = positional(HAND_HELP)
    n: Annotated[int, Range(1, 10**8)] = option(200_000, "postures to learn from, all of which can hold an object")
    components: int | None = option(None, "Gaussians; by default the number with the least BIC among 5, 10, .. 60")
    seed: Seed = option(0, "random seed of postures and of the first start")
    held_out: Annotated[int, Range(2, 10**7)] = option(20_000, "further postures for the evaluation")
    workers: int = option(1, "threads that sample")
    checkpoint: Path | None = option(None, "file that holds the fit after every step; a killed fit continues from it")
    out: Path | None = option(None, "file to write; by default mixture.safetensors in the hand's folder")

    def run(self) -> int:
        """Sample postures, fit and evaluate the model, and write it; return the exit code."""
        if self.out is not None and self.out.suffix != ".safetensors":
            raise BadArgument("--out", self.out, "a file ending in .safetensors")
        hand = check_hand(self.hand)
        out = self.out or mixture_path(self.hand)
        with holding("--out", out, hold_file), holding("--checkpoint", self.checkpoint, hold_file):
            begin, count = time.perf_counter(), self.n + self.held_out
            with make_bar(count, "posture", unit_scale=True, desc="postures") as bar:
                samples = sample_configurations(hand, count, self.seed, self.workers, "grasping", bar.update)
            print(f"{hand.name}: {len(samples)} postures in {time.perf_counter() - begin:.0f} s")
            begin = time.perf_counter()
            components = self.components or choose_components(hand, self.seed, self.workers)
            with make_bar(None, "step", desc="EM") as bar, naming(path="--checkpoint"):

                def show(progress: Progress) -> None:
                    bar.update()
                    bar.set_postfix(log_likelihood=f"{float(progress.log_likelihood[-1]):.4f}")

                # The tolerance is the mean log-likelihood [nats] that a step must gain.
                mixture = fit_mixture(
                    samples[: self.n], components, self.seed, tolerance=1e-3, starts=STARTS,
                    checkpoint=self.checkpoint, observer=show,
                )  # fmt: skip
            meta = mixture.meta
            print(
                f"{len(mixture.weights)} components in {meta['iterations']} steps (converged: {meta['converged']},"
                f" components placed anew: {meta['reseeded']}), {time.perf_counter() - begin:.0f} s,"
                f" added relative variance {mixture.regularisation:g}"
            )
            print(f"log-likelihood of a posture: {meta['log_likelihood']} fitted; BIC {meta['bic']}")
            score = evaluate_mixture(mixture, samples[self.n :])
            print(score)
            with naming(path="--out"):
                dataclasses.replace(mixture, meta=meta | score.meta()).save(out)
            print(f"written: {out}")
        return 0


def choose_components(hand: Hand, seed: int, workers: int) -> int:
    """Return the number of Gaussians with the least BIC on separate random postures; print the BIC curve."""
    candidates = range(5, 61, 5)  # as in Fig. 6
    apart = sample_configurations(hand, 40_000, seed + 1, workers, "grasping")
    with make_bar(len(candidates), "fit", desc="components") as bar:

        def show(m: int, mixture: GraspMixture) -> None:
            bar.update()

        curve = bic_curve(apart, tuple(candidates), observer=show, iterations=100)
    print(curve)
    return int(curve.components[curve.bic.argmin()])
