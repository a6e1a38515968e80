"""The commands `torchgrasp hand new`, `check`, `sample` and `train`: from a published URDF to a
hand that grasps.
"""

import dataclasses
import math
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import torch
from tqdm import tqdm

from torchgrasp.app.author.draft import Wish, new_hand
from torchgrasp.app.author.fit_shapes import shape_points
from torchgrasp.app.author.unusual import find_unusual
from torchgrasp.app.cli.command import (
    Command,
    ForPrograms,
    answer,
    arguments,
    make_bar,
    naming,
    option,
    positional,
    required,
)
from torchgrasp.app.cli.described import locate_urdf
from torchgrasp.app.cli.inputs import (
    FINGERS_HELP,
    HAND_HELP,
    SEED_HELP,
    check_folder,
    holding,
    load_fingers,
)
from torchgrasp.app.report.stills import draw_hand, opposed_posture
from torchgrasp.data.shipped import load_object
from torchgrasp.files import format_columns, format_json, hold_file, render, write_file
from torchgrasp.foundation.base import count_status
from torchgrasp.foundation.errors import BadArgument, GraspError, OutputError, Status, one_line
from torchgrasp.foundation.rules import Range, Seed, check_suffix
from torchgrasp.geometry.linalg import dot, norm
from torchgrasp.hand.abilities import HandAbilities, hand_abilities, random_joints
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.hand_toml import read_hand_toml
from torchgrasp.hand.load import find_hand
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.planner.grasps import plan_grasps
from torchgrasp.planner.request import finger_sets
from torchgrasp.posture_model.dataset import write_samples
from torchgrasp.posture_model.mixture import GraspMixture, mixture_path
from torchgrasp.posture_model.sample import (
    HandSamples,
    SampleSpec,
    Sampling,
    can_close,
    sample_configurations,
)
from torchgrasp.posture_model.score import evaluate_mixture, growing_bic
from torchgrasp.posture_model.training import FitProgress, fit_mixture
from torchgrasp.testing import check_hand, find_faults, most_met


@dataclasses.dataclass(frozen=True)
class HandTrial:
    """Parameters of `hand check`: planning on shipped objects, and random postures to judge by."""

    objects: tuple[str, ...] = ("cylinder", "jug")  # names of the objects that are tried in turn
    starts: int = 100  # number of initial guesses for each object
    postures: int = 5000  # number of random postures
    # number of postures in which the pair of links that collides most often is sought
    some: int = 500
    # least share of the random postures without self-collision, for a hand with three fingers
    least_free: float = 0.2
    # least share of the postures in which a finger's pad faces the other pads
    least_facing: float = 0.02
    least_closing: float = 0.001  # least share of the postures that can hold an object
    # least cosine between the normal of a pad that faces the others and the direction to their
    # middle
    facing: float = 0.5


@dataclasses.dataclass(frozen=True)
class TrainNumbers:
    """Parameters of the fit of a posture model, a mixture of Gaussians."""

    # least gain [nats] of the mean log-likelihood in a step of EM after which EM goes on
    tolerance: float = 1e-3
    starts: int = 5  # number of k-means initialisations of the fit
    subset: int = 300  # number of postures for each Gaussian in the smallest subset that is fitted
    most: int = 64  # greatest number of Gaussians that are tried: the paper's figure ends at 60
    postures: int = 40_000  # number of postures by which the number of Gaussians is chosen


TRIAL = HandTrial()
TRAIN = TrainNumbers()
ABILITIES = "abilities.json"  # file beside the picture of `hand check`


@arguments()
class HandNew(Command):
    """Write a first hand.toml for a published URDF, and a clean copy of the URDF where it needs
    repair.
    """

    urdf: Path = positional(
        "file of the hand, URDF or MJCF (.xml, extra `mujoco`), or its name in robot_descriptions"
    )
    tips: tuple[str, ...] = option(
        (),
        'links of three to five fingertips in grasp order, first the three of option "default". '
        'Options "four" and "five" add '
        "the next. By default the ends of the tree's branches, in the order in which their pads "
        "face best",
    )
    name: str | None = option(None, "name of the hand; by default the robot's")
    root: str = option("", "first link of the hand, where the URDF has an arm, too")
    meshes: Path | None = option(None, "folder of all meshes; by default the URDF's")
    visual: bool = option(
        False, "take the <visual> of links without <collision> as their collision shapes"
    )
    tip_offset: tuple[float, ...] = option(
        (),
        "lengths [m] of sensor tips that the URDF lacks, from the maker's tip outward. One, or with "
        "--tips one for each; docs/hands.md states the direction",
    )
    tip_radius: tuple[float, ...] = option(
        (), "radii [m] of sensor tips, likewise; by default those of the fingertips' balls"
    )
    out: Path | None = option(None, "folder to write; by default the URDF's")
    seed: Seed = option(0, "random seed of the postures from which pads and pairs are guessed")

    def run(self) -> int:
        """Draft, write and check the files of the hand; return the exit code.

        The draft is written even if it has faults, for the user to edit; the code is then 1.
        """
        urdf, meshes, out = locate_urdf(self.urdf, self.meshes, self.out)
        folder = urdf.parent if out is None else out
        check_folder(folder)
        # the published URDF is not overwritten
        taken = (folder / "hand.urdf").resolve() == urdf.resolve()
        clean = "hand_clean.urdf" if taken else "hand.urdf"
        wish = Wish(
            tips=self.tips,
            name=self.name or "",
            root=self.root,
            meshes=meshes,
            visual=self.visual,
            tip_offset=self.tip_offset,
            tip_radius=self.tip_radius,
        )
        draft = new_hand(urdf, wish, self.seed, clean)
        texts: dict[str, str | bytes] = {"hand.toml": draft.toml, **draft.meshes}
        if draft.urdf or out is not None:
            texts[clean if draft.urdf else urdf.name] = draft.urdf or urdf.read_text(
                encoding="utf-8"
            )
        for file in texts:
            if (folder / file).exists():
                raise OutputError(
                    "URDF",
                    f"{folder / file}, which exists",
                    "a folder without this file, as by --out",
                )
        for sentence in draft.repairs:
            print(f"repaired: {sentence}")
        for sentence in draft.warnings:
            print(f"warning: {sentence}")
        for file, text in texts.items():
            write_file(folder / file, text)
            if file not in draft.meshes:
                print(f"written: {folder / file}")
        if draft.meshes:
            print(f"written: {len(draft.meshes)} visual meshes for pictures")
        return self._judge(folder)

    def _judge(self, folder: Path) -> int:
        """Check the written files, and print what to do next; return the exit code."""
        # a plain name may be that of a shipped hand
        place = folder if folder.is_absolute() else f"./{folder}"
        next_step = f"torchgrasp hand check {place}"
        hand = _checked(folder)
        if hand is None:
            print(f"the draft has these faults: edit its files, then: {next_step}")
            return 1
        print(f"out of the palm: {[round(x, 2) for x in hand.approach.tolist()]}")
        print(describe_sets(hand))
        print(f"look over the lines of hand.toml marked CHECK, then: {next_step}")
        return 0


@arguments(path="out")
class HandCheck(ForPrograms):
    """List every fault of a hand. If there is none, describe and draw the hand, and plan on a
    shipped object.

    Ends with a table of the hand's abilities, which abilities.json beside the picture holds, too.
    These are spans of the fingertips, forces at the tips, widths that they can hold, and free
    postures.
    """

    hand: str = positional(HAND_HELP)
    fingers: str = option(
        "auto",
        f'{FINGERS_HELP}; "auto" describes the default, and tries every set that hand.toml '
        "declares",
    )
    out: Path = option(
        Path("hand.png"), "picture to write (.png): the pads, the frame of the palm, the limits"
    )

    def run(self) -> int:
        """Check, describe and draw the hand, and plan on a shipped object; return the exit code.

        It is 2 for a hand with faults, 1 if no grasp passed all checks, else 0.
        """
        check_suffix("--out", self.out, ".png")
        chosen = "default" if self.fingers == "auto" else self.fingers
        with make_bar(None, "step", desc="faults") as bar:
            faults = list_faults(self.hand, chosen)
            if faults:
                print_faults(faults)
                answer({"faults": faults, "able": False, "sets": []})
                return 2
            sound = check_hand(self.hand, chosen)
            check_folder(self.out.parent)
            joints = random_joints(sound, TRIAL.postures)
            self._describe(sound, joints, bar)
            hands = finger_sets(sound, "auto" if self.fingers == "auto" else None)
            bar.total = 1 + 2 * len(hands)
            bar.update()
            for one in hands:
                bar.set_description(f"postures of {one.source.option}")
                for warning in find_warnings(one, random_joints(one, len(joints))):
                    bar.write(f"warning: {one.source.option}: {warning}")
                bar.update()
            write_file(self.out, draw_hand(sound, opposed_posture(sound, joints)))
            bar.write(f"picture: {self.out}")
            able = False
            for one in hands:
                bar.set_description(f"grasps of {one.source.option}")
                able = _try_objects(one, bar) or able
                bar.update()
            abilities = [hand_abilities(one, TRIAL.postures) for one in hands]
        for known in abilities:
            print(describe_abilities(known))
        sets = [known.content() for known in abilities]
        file = self.out.with_name(ABILITIES)
        write_file(file, format_json({"sets": sets}))
        print(f"abilities: {file}")
        answer({"faults": [], "able": able, "picture": str(self.out), "sets": sets})
        if able:
            print("the hand can grasp")
        return 0 if able else 1

    def _describe(self, hand: Hand, joints: torch.Tensor, bar: tqdm) -> None:
        """Write what a hand without faults is above the progress `bar`.

        `joints` (n, h) are n random postures of the h actuated joints [rad].
        """
        bar.write(f"{describe(hand, joints)}\n{describe_sets(hand)}")
        for warning in list_unusual(hand):
            bar.write(f"warning: {warning}")
        model = find_hand(self.hand) / "mixture.safetensors"
        missing = f"none; only the modes of the paper need one: torchgrasp hand train {self.hand}"
        bar.write(f"learned model: {model if model.exists() else missing}")


def _checked(folder: Path) -> Hand | None:
    """Return the hand in a folder; if it has faults, print them and return None."""
    faults = list_faults(folder)
    if not faults:
        try:
            return check_hand(folder)
        except GraspError as error:
            faults = (one_line(error),)
    print_faults(faults)
    return None


def print_faults(faults: Iterable[str]) -> None:
    """Print faults of a hand, a line for each."""
    for sentence in faults:
        print(f"wrong: {sentence}")


def list_faults(hand: str | Path, fingers: str = "default") -> tuple[str, ...]:
    """Return a sentence for every fault of a hand, each once.

    `hand` is a name or folder. The given `fingers` and all sets that hand.toml declares are
    checked. Raises `BadArgument` for fingers that the hand does not have.
    """
    try:
        options = read_hand_toml(find_hand(hand) / "hand.toml", fingers).options
        faults: list[GraspError] = [
            fault for some in (fingers, *options) for fault in find_faults(hand, some)
        ]
    except BadArgument as error:
        if error.argument == "fingers":
            raise
        faults = [error]
    return tuple(dict.fromkeys(map(one_line, faults)))


def list_unusual(hand: Hand) -> list[str]:
    """Return a warning for each kind of number in a hand's URDF that is outside the usual range.

    The kinds are sizes, distances, masses, densities, and the joints' ranges, efforts and
    velocities. One more warning names joints whose <safety_controller> has narrower limits, which
    the library ignores.
    """
    urdf = read_urdf(hand.urdf_path)
    return find_unusual(urdf, shape_points(urdf, urdf.path.parent))


def describe_sets(hand: Hand) -> str:
    """Return a text with a line for each set of grasping fingers that hand.toml declares."""
    rows = [(one.source.option, ", ".join(one.finger_names)) for one in finger_sets(hand, "auto")]
    return f"sets of fingers:\n{format_columns(rows, left={0, 1})}"


def describe_abilities(abilities: HandAbilities) -> str:
    """Return a text with the abilities of a hand with one set of fingers, as two tables.

    One has the force [N] of each fingertip, or "-" if it is unknown. The other has a line
    for each two fingertips: their least and greatest distance [m], and the widths [m] that they can
    hold.
    """
    widths = f"{abilities.least_width:.3f} to {abilities.greatest_width:.3f} m"
    # a hand of which no two tips ever face each other
    if not abilities.least_width <= abilities.greatest_width:
        widths = "none"
    rows = [("finger", "joints", "force [N]", "in 9 of 10 [N]")]
    for finger in abilities.fingers:
        force = _say_force(finger.force)
        sure = _say_force(finger.sure_force)
        rows.append((finger.name, str(finger.joints), force, sure))
    between = [("tips", "span [m]", "holds [m]", "face each other")]
    for pair in abilities.pairs:
        span = f"{pair.least_span:.3f} to {pair.greatest_span:.3f}"
        width = f"{pair.least_width:.3f} to {pair.greatest_width:.3f}" if pair.opposed else "-"
        between.append((" and ".join(pair.fingers), span, width, f"{pair.opposed:.1%}"))
    return (
        f"abilities of {abilities.option}: {abilities.free:.1%} of {abilities.postures} random "
        f"postures are free; two tips hold widths of {widths}\n"
        f"{format_columns(rows, left={0})}\n{format_columns(between, left={0})}"
    )


def _say_force(force: float) -> str:
    """Return a force [N] as text; "-" for NaN, an unknown one."""
    return "-" if math.isnan(force) else f"{force:.1f}"


def find_warnings(hand: Hand, joints: torch.Tensor) -> list[str]:
    """Return warnings about a hand whose files have no errors, each a sentence with its fix.

    A warning is given if too few postures are free of self-collision. With three fingers that is
    fewer than 20 % (`TRIAL.least_free`). With f fingers the bound is this share to the power f / 3.
    Another is given if fewer than 0.1 % of the free postures can hold an object. Another names each
    fingertip pad that faces the others in fewer than 2 % of the free postures. `joints` (n, h) are
    n random postures of the h actuated joints [rad].
    """
    warnings = []
    free = hand.self_clearance(joints) > 0
    named = f"[options.{hand.source.option}]"
    share = float(free.double().mean())
    # each further finger makes a free posture rarer
    if share < TRIAL.least_free ** (len(hand.tips) / 3):
        one, two = most_met(hand, joints[: TRIAL.some])
        warnings.append(
            f"only {share:.0%} of random postures are free. Most often {one} meets {two}: if this "
            "is impossible, make their collision shapes smaller, or take the pair out of "
            "[self_collision]"
        )
    points, normals = hand.fingertips(joints[free])
    inward = points.mean(1, keepdim=True) - points
    cosine = dot(normals, inward) / norm(inward)  # (n, f)
    facing = (cosine > TRIAL.facing).double().mean(0)
    for name, seen in zip(hand.finger_names, facing.tolist(), strict=True):
        if seen < TRIAL.least_facing:
            warnings.append(
                f"the pad of {name} faces the others in {seen:.1%} of free postures. If its arrow "
                "in the picture points the wrong way, turn contact and normal in hand.toml. Or "
                f"name other fingers in {named}"
            )
    closing = float(can_close(points, normals).double().mean()) if len(points) else 0.0
    if closing < TRIAL.least_closing:
        fix = f"give {named} the thumb and fingers that it faces"
        warnings.append(f"{closing:.2%} of free postures can hold an object: {fix}")
    return warnings


def _try_objects(hand: Hand, bar: tqdm) -> bool:
    """Plan grasps of shipped objects in turn until an object has an executable grasp; return
    whether one has.

    A line on each object is written above the progress `bar`.
    """
    for name in TRIAL.objects:
        grasps = plan_grasps(load_object(name).view, hand, starts=TRIAL.starts)
        count = count_status(grasps.status)
        good = count.get(Status.OK, 0)
        lost = ", ".join(f"{number} {status.name.lower()}" for status, number in count.items())
        found = f"no executable grasp ({lost})"
        if good:
            found = f"{good} of {len(grasps)} grasps executable"
        bar.write(f"{hand.source.option} on the shipped {name}: {found}")
        if good:
            return True
    return False


def describe(hand: Hand, joints: torch.Tensor) -> str:
    """Return a text about a hand: its joints, its fingers, and statistics of random postures.

    The statistics are the shares free of self-collision and able to hold an object, and the
    distances of the fingertips. `joints` (n, h) are n random postures of the h actuated joints
    [rad].
    """
    points, normals = hand.fingertips(joints)
    free = hand.self_clearance(joints) > 0
    found = {
        "free": float(free.double().mean()),
        "closing": float(can_close(points[free], normals[free]).double().mean()),
        "sides": 1e3 * norm(points - points.roll(1, 1))[free],
    }
    path = Path(__file__).parent / "templates" / "hand.txt.jinja"
    return render(path, hand=hand, count=len(joints), **found).rstrip("\n")


@arguments(folder="out", path="out")
class HandSample(Command):
    """Write random postures without self-collision, with their fingertip codes; continue an
    unfinished folder.
    """

    hand: str = required(HAND_HELP)
    out: Path = required("folder to write")
    n: int = option(1_000_000, "number of postures; the paper has 1,000,000")
    fingers: str = option("default", FINGERS_HELP)
    sampling: Sampling = option(
        "uniform", "uniform as in the paper; grasping: postures that can hold an object"
    )
    workers: int = option(1, "threads that sample")
    seed: Seed = option(0, SEED_HELP)

    def run(self) -> int:
        """Draw random postures and write them; return the exit code 0."""
        hand, _ = load_fingers(self.hand, self.fingers)
        begin = time.perf_counter()
        with make_bar(self.n, "posture", unit_scale=True) as bar:
            write_samples(
                hand,
                SampleSpec(self.n, self.seed, self.sampling),
                self.out,
                self.workers,
                bar.update,
            )
        print(
            f"{self.n} {self.sampling} postures of {hand.name} in {self.out}, "
            f"{time.perf_counter() - begin:.0f} s"
        )
        return 0


@arguments()
class HandTrain(Command):
    """Learn the posture model of a hand: check, sample, fit, evaluate and write. Only the paper's
    modes need it.
    """

    hand: str = positional(HAND_HELP)
    n: Annotated[int, Range(1, 10**8)] = option(
        200_000, "postures to learn from, all of which can hold an object"
    )
    components: int | None = option(
        None, "Gaussians; by default the number with the least BIC among 1 to 64"
    )
    seed: Seed = option(0, "random seed of postures and of the first start")
    held_out: Annotated[int, Range(2, 10**7)] = option(
        20_000, "further postures for the evaluation"
    )
    workers: int = option(1, "threads that sample")
    checkpoint: Path | None = option(
        None, "file that holds the fit after every step; a killed fit continues from it"
    )
    out: Path | None = option(
        None, "file to write; by default mixture.safetensors in the hand's folder"
    )

    def run(self) -> int:
        """Sample postures, fit and evaluate the model, and write it; return the exit code 0."""
        if self.out is not None:
            check_suffix("--out", self.out, ".safetensors")
        hand = check_hand(self.hand)
        out = self.out or mixture_path(self.hand)
        with holding("--out", out, hold_file), holding("--checkpoint", self.checkpoint, hold_file):
            begin = time.perf_counter()
            count = self.n + self.held_out
            with make_bar(count, "posture", unit_scale=True, desc="postures") as bar:
                samples = sample_configurations(
                    hand, count, self.seed, self.workers, "grasping", bar.update
                )
            print(f"{hand.name}: {len(samples)} postures in {time.perf_counter() - begin:.0f} s")
            begin = time.perf_counter()
            components = self.components or choose_components(hand, self.seed, self.workers)
            mixture = self._fit(samples[: self.n], components)
            meta = mixture.meta
            spent = time.perf_counter() - begin
            print(
                f"{len(mixture.weights)} components in {meta['iterations']} steps (converged: "
                f"{meta['converged']}, "
                f"components placed anew: {meta['reseeded']}), {spent:.0f} s, "
                f"added relative variance {mixture.regularisation:g}"
            )
            print(
                f"log-likelihood of a posture: {meta['log_likelihood']} fitted; BIC {meta['bic']}"
            )
            score = evaluate_mixture(mixture, samples[self.n :])
            print(score)
            with naming(path="--out"):
                dataclasses.replace(mixture, meta=meta | score.meta()).save(out)
            print(f"written: {out}")
        return 0

    def _fit(self, samples: HandSamples, components: int) -> GraspMixture:
        """Return a mixture of Gaussians that is fitted to samples of postures."""
        with make_bar(None, "step", desc="EM") as bar, naming(path="--checkpoint"):

            def show(progress: FitProgress) -> None:
                bar.update()
                bar.set_postfix(log_likelihood=f"{float(progress.log_likelihood[-1]):.4f}")

            return fit_mixture(
                samples,
                components,
                self.seed,
                tolerance=TRAIN.tolerance,
                starts=TRAIN.starts,
                subset=TRAIN.subset * components,
                checkpoint=self.checkpoint,
                observer=show,
            )


def choose_components(hand: Hand, seed: int, workers: int) -> int:
    """Return the number of Gaussians of a hand's posture model with the least Bayesian information
    criterion (BIC).

    Numbers up to 64 (`TRAIN.most`) are compared on random postures apart from those of the fit. The
    BIC curve is printed. The postures are drawn with the random seed `seed` + 1. `workers` is the
    number of threads that sample them.
    """
    apart = sample_configurations(hand, TRAIN.postures, seed + 1, workers, "grasping")
    with make_bar(TRAIN.most, "fit", desc="components") as bar:
        curve = growing_bic(apart, TRAIN.most, observer=lambda m: bar.update())
    print(curve)
    return int(curve.components[curve.bic.argmin()])
