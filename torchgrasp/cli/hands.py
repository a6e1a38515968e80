"""`torchgrasp hand`: draft a hand.toml, check a hand, sample its postures."""

import tempfile
import time
from pathlib import Path
from typing import Annotated

import torch
from tqdm import tqdm
from tyro.conf import Positional, arg

from torchgrasp.base import count_status
from torchgrasp.cli.common import check_folder, check_seed, naming
from torchgrasp.errors import BadArgument, GraspError, OutputError, Status
from torchgrasp.files import write_file
from torchgrasp.hand.draft import Wish, new_hand
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import find_hand, load_hand
from torchgrasp.objects import load_object
from torchgrasp.pipeline.grasps import plan_grasps
from torchgrasp.posture_model.dataset import write_samples
from torchgrasp.posture_model.sample import SampleSpec, Sampling
from torchgrasp.posture_model.touch import can_close
from torchgrasp.report.hands import draw_hand, opposed_posture
from torchgrasp.testing import check_hand, find_faults, random_joints

FREE, FACING, CLOSING = 0.2, 0.02, 0.001
"""Shares of random postures below which a hand is doubtful; sound public hands have 0.27, 0.05 and 0.004."""
TRIAL_STARTS = 100
"""Starts of the planner with which a hand is tried on a shipped object: some seconds."""


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
    """Write a first hand.toml for a URDF as it is published, and a clean copy of the URDF where it needs mending.

    Args:
        urdf: the hand, with or without meshes.
        tips: links of the three grasping fingertips in grasp order, then of fingers to park; by default the ends of the
            tree's branches, first the three whose pads best face each other.
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
    with tempfile.TemporaryDirectory() as trial:
        for file, text in ({urdf.name: urdf.read_text(encoding="utf-8")} | texts).items():
            write_file(Path(trial) / file, text)
        if _print_faults(trial, "default"):
            print(f"nothing is written; mend {urdf} and try again")
            return 2
        hand = check_hand(trial)
    for sentence in draft.mended:
        print(f"mended: {sentence}")
    for file, text in texts.items():
        write_file(folder / file, text)
        print(f"written: {folder / file}")
    print(f"grasping fingers: {', '.join(hand.finger_names)}; approach {[round(x) for x in hand.approach.tolist()]}")
    place = folder if folder.is_absolute() else f"./{folder}"  # a bare name may be that of a shipped hand
    print(f"look over the lines of hand.toml marked CHECK, then: torchgrasp hand check {place}")
    return 0


def check(
    hand: Annotated[Positional[str], arg(metavar="HAND")], /, fingers: str = "default", out: Path = Path("hand.png")
) -> int:
    """Name every fault of a hand; draw a sound one.

    Args:
        hand: name of a shipped hand, or the folder of another.
        fingers: the finger option of its hand.toml.
        out: picture to write (.png): the pads, the frame of the palm, the limits.
    """
    if out.suffix.lower() != ".png":
        raise BadArgument("--out", out, "a file ending in .png")
    with naming(fingers="--fingers", hand="HAND", path="--out"):
        if _print_faults(hand, fingers):
            return 2
        sound = check_hand(hand, fingers)
        check_folder(out.parent)
    joints = random_joints(sound, 5000)  # shares vary by 1 %
    print(describe(sound, joints))
    model = find_hand(hand) / "mixture.safetensors"
    missing = f"none; only the modes of the paper need one: torchgrasp hand train {hand}"
    print(f"learned model: {model if model.exists() else missing}")
    for doubt in find_doubts(sound, joints):
        print(f"doubtful: {doubt}")
    write_file(out, draw_hand(sound, opposed_posture(sound, joints)))
    print(f"picture: {out}")
    return _try_objects(sound)


def find_doubts(hand: Hand, joints: torch.Tensor) -> list[str]:
    """Say what of a sound hand is doubtful, judged by random postures `joints` (n, h) [rad], and how to mend it."""
    doubts, free = [], hand.self_clearance(joints) > 0
    share = float(free.double().mean())
    if share < FREE:
        met = hand.self_collision.separations(hand.tree.frames(hand.expand_joints(joints[:500]).T.contiguous()), 0.0)
        links = hand.self_collision.link[hand.self_collision.pairs[int((met < 0).sum(1).argmax())]]
        one, two = (hand.tree.link_names[int(k)] for k in links)
        doubts.append(
            f"only {share:.0%} of random postures are free, most often {one} meets {two}: if that cannot be, make "
            "their collision shapes smaller, or take the pair out of [self_collision]"
        )
    points, normals = hand.fingertips(joints[free])
    inward = points.mean(1, keepdim=True) - points
    facing = ((normals * inward).sum(-1) / torch.linalg.vector_norm(inward, dim=-1) > 0.5).double().mean(0)
    for name, seen in zip(hand.finger_names, facing.tolist(), strict=True):
        if seen < FACING:
            doubts.append(
                f"the pad of {name} faces the others in {seen:.1%} of free postures: if its arrow in the picture "
                "points the wrong way, turn contact and normal in hand.toml, or name other fingers in [options.default]"
            )
    closing = float(can_close(points, normals).double().mean()) if len(points) else 0.0
    if closing < CLOSING:
        doubts.append(
            f"{closing:.2%} of free postures can hold something: give [options.default] the thumb and two fingers that "
            "it faces"
        )
    return doubts


def _try_objects(hand: Hand) -> int:
    """Plan on shipped objects until one is graspable; return the exit code."""
    for name in ("cylinder", "jug"):
        grasps = plan_grasps(load_object(name).view, hand, starts=TRIAL_STARTS)
        count = count_status(grasps.status)
        good = count.get(Status.OK, 0)
        if good:
            print(f"on the shipped {name}: {good} of {len(grasps)} grasps executable; the hand can grasp")
            return 0
        lost = ", ".join(f"{number} {status.name.lower()}" for status, number in count.items())
        print(f"on the shipped {name}: no executable grasp ({lost})")
    return 1


def describe(hand: Hand, joints: torch.Tensor) -> str:
    """Describe a hand: its joints, its fingers, and its random postures `joints` (n, h) [rad]."""
    tips = hand.tips
    lines = [f"{hand.name}, option {hand.source.option}: {hand.dof} actuated of {len(hand.tree.joint_names)} joints"]
    for name, low, high in zip(hand.joint_names, hand.lower.rad2deg(), hand.upper.rad2deg(), strict=True):
        lines.append(f"  {name:24} {low:7.1f} to {high:6.1f} degrees")
    for k, finger in enumerate(tips.names):
        radius = float(tips.radius[k])
        tip = f"a sphere of {1e3 * radius:.1f} mm" if radius else "a point"
        contact, normal = (", ".join(f"{x:.4g}" for x in v[k].tolist()) for v in (tips.contact, tips.normal))
        lines += [f"finger {finger}: {tip} on {tips.links[k]}", f"  contact [{contact}] m, normal [{normal}]"]
    for name, row, offset in zip(hand.tree.joint_names, hand.actuated.coupling, hand.actuated.offset, strict=True):
        source = int(row.abs().argmax())
        if not row[source]:
            lines.append(f"joint {name} is parked at {offset:.4g}")
        elif hand.joint_names[source] != name:
            lines.append(f"joint {name} = {row[source]:.4g} {hand.joint_names[source]} + {offset:.4g}")
    points, normals = hand.fingertips(joints)
    free = hand.self_clearance(joints) > 0
    sides = 1e3 * torch.linalg.vector_norm(points - points.roll(1, 1), dim=-1)[free]
    closing = can_close(points[free], normals[free]).double().mean()
    lines.append(f"{1 - free.double().mean():.1%} of {len(joints)} random postures collide with themselves")
    lines.append(f"{closing:.1%} of the free ones can hold something between the middles of their pads (friction 0.8)")
    lines.append(f"fingertips are {sides.quantile(0.01):.0f} to {sides.quantile(0.99):.0f} mm apart")
    return "\n".join(lines)


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


def _print_faults(hand: str | Path, fingers: str) -> int:
    """Print every fault of a hand; return the exit code."""
    try:
        faults: list[GraspError] = list(find_faults(hand, fingers))
    except BadArgument as error:
        if error.argument == "fingers":
            raise
        faults = [error]
    for fault in faults:
        print(f"wrong: {' '.join(str(fault).split())}")
    return 2 if faults else 0
