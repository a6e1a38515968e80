"""`torchgrasp hand`: a draft of hand.toml for any URDF, and random postures."""

import time
from pathlib import Path
from typing import Annotated

from tqdm import tqdm
from tyro.conf import Positional, arg

from torchgrasp.app.author.draft import Wish, new_hand
from torchgrasp.app.cli.common import check_folder, check_seed, naming
from torchgrasp.app.cli.hand_check import describe_sets, print_faults
from torchgrasp.errors import OutputError
from torchgrasp.files import temporary_folder, write_file
from torchgrasp.hand.load import load_hand
from torchgrasp.posture_model.dataset import write_samples
from torchgrasp.posture_model.sample import SampleSpec, Sampling
from torchgrasp.testing import check_hand


def new(
    urdf: Annotated[Positional[Path], arg(metavar="URDF")],
    /,
    tips: tuple[str, ...] = (),
    name: str | None = None,
    root: str = "",
    meshes: Path | None = None,
    out: Path | None = None,
    seed: int = 0,
) -> int:
    """Write a first hand.toml for a URDF as it is published, and a clean copy of the URDF where it needs repair.

    Args:
        urdf: the hand, with or without meshes.
        tips: links of three to five fingertips in grasp order, first the three of option "default"; "four" and "five"
            add the next. By default the ends of the tree's branches, in the order in which their pads face best.
        name: of the hand; by default the robot's.
        root: link from which on the URDF is the hand, where it hangs on an arm.
        meshes: folder in which all meshes lie; by default the URDF's.
        out: folder to write; by default the URDF's.
        seed: of the random postures from which pads and pairs are guessed.
    """
    check_seed(seed)
    folder = urdf.parent if out is None else out
    with naming(path="--out"):
        check_folder(folder)
    clean = "hand.urdf" if (folder / "hand.urdf").resolve() != urdf.resolve() else "hand_clean.urdf"
    with naming(tips="--tips", root="--root", urdf="URDF"):
        draft = new_hand(urdf, Wish(tips, name or "", root, meshes), seed, clean)
    texts = {"hand.toml": draft.toml}
    if draft.urdf or out is not None:
        texts[clean if draft.urdf else urdf.name] = draft.urdf or urdf.read_text(encoding="utf-8")
    for file in texts:
        if (folder / file).exists():
            raise OutputError("URDF", f"{folder / file}, which exists", "a folder without one, as by --out")
    with temporary_folder() as trial:
        for file, text in ({urdf.name: urdf.read_text(encoding="utf-8")} | texts).items():
            write_file(trial / file, text)
        if print_faults(trial):
            print(f"nothing is written; repair {urdf} and try again")
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
    place = folder if folder.is_absolute() else f"./{folder}"  # a bare name may be that of a shipped hand
    print(f"look over the lines of hand.toml marked CHECK, then: torchgrasp hand check {place}")
    return 0


def sample(
    hand: str,
    out: Path,
    n: int = 1_000_000,
    fingers: str = "default",
    sampling: Sampling = "uniform",
    workers: int = 1,
    seed: int = 0,
) -> int:
    """Write random postures without self-collision, with their codes; continue an unfinished folder.

    Args:
        hand: name of a shipped hand, or the folder of another.
        out: folder to write.
        n: how many postures; the paper has 1,000,000.
        fingers: which fingers grasp, one of the hand's options.
        sampling: uniform as in the paper, or grasping: only postures that can hold something.
        workers: threads that draw at the same time.
        seed: of every random draw.
    """
    check_seed(seed)
    with naming(hand="--hand", fingers="--fingers"):
        robot = load_hand(hand, fingers)
    begin = time.perf_counter()
    with naming(folder="--out", path="--out", n="--n", workers="--workers"):
        spec = SampleSpec(n, seed, sampling)
        with tqdm(total=n, unit="posture", unit_scale=True, disable=None, leave=False) as bar:
            write_samples(robot, spec, out, workers, bar.update)
    print(f"{n} {sampling} postures of {robot.name} in {out}, {time.perf_counter() - begin:.0f} s")
    return 0
