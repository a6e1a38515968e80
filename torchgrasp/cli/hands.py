"""`torchgrasp hand`: draft a hand.toml, check a hand, sample its postures."""

import time
from pathlib import Path
from typing import Annotated

import torch
from tqdm import tqdm
from tyro.conf import Positional, arg

from torchgrasp.cli.common import check_folder, check_seed, naming
from torchgrasp.errors import BadArgument, GraspError, OutputError
from torchgrasp.files import write_file
from torchgrasp.hand.draft import draft_hand
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import find_hand, load_hand
from torchgrasp.posture_model.dataset import write_samples
from torchgrasp.posture_model.sample import SampleSpec, Sampling
from torchgrasp.posture_model.touch import can_close
from torchgrasp.report.hands import draw_hand, opposed_posture
from torchgrasp.testing import check_hand, find_faults, random_joints


def new(
    urdf: Annotated[Positional[Path], arg(metavar="URDF")],
    /,
    tips: tuple[str, ...] = (),
    name: str | None = None,
    seed: int = 0,
) -> int:
    """Write a first hand.toml beside a URDF: fingers, pads, coupling, pairs of links.

    Args:
        urdf: the hand: boxes, cylinders and spheres as collision shapes, masses, limits, drives.
        tips: links of the three grasping fingertips in grasp order, then of fingers to park; by default the ends of the
            tree's three branches.
        name: of the hand; by default the robot's.
        seed: of the random postures from which pads and pairs are guessed.
    """
    check_seed(seed)
    target = urdf.parent / "hand.toml"
    if target.exists():
        raise OutputError("URDF", f"{target}, which exists", "a folder without a hand.toml")
    with naming(tips="--tips", urdf="URDF"):
        text = draft_hand(urdf, tips, name, seed)
    write_file(target, text)
    print(f"written: {target}; look over the lines marked CHECK, then: torchgrasp hand check {target.parent}")
    return _print_faults(target.parent, "default")


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
    print(f"learned model: {model if model.exists() else f'none; learn it by scripts/train.py posture-model {hand}'}")
    write_file(out, draw_hand(sound, opposed_posture(sound, joints)))
    print(f"picture: {out}")
    return 0


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
