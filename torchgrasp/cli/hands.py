"""`torchgrasp hand`: a first hand.toml for a URDF, what is wrong with a hand or what it is like, and its postures."""

import time
from pathlib import Path
from typing import Annotated

import torch
import tyro
from tqdm import tqdm

from torchgrasp.cli.common import check_folder, check_seed, naming
from torchgrasp.errors import BadArgument, GraspError, OutputError
from torchgrasp.files import write_file
from torchgrasp.hand.draft import draft_hand
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import find_hand, load_hand
from torchgrasp.posture_model.dataset import write_samples
from torchgrasp.posture_model.sample import OPPOSED_COSINE, SampleSpec, Sampling
from torchgrasp.report.hands import draw_hand, opposed_posture
from torchgrasp.testing import check_hand, find_faults, random_joints

POSTURES = 5000
"""Random postures that tell what a hand is like."""


def new(
    urdf: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="URDF")],
    /,
    tips: tuple[str, ...] = (),
    name: str | None = None,
    seed: int = 0,
) -> int:
    """Write a first hand.toml beside a URDF: fingers, pads, coupling and pairs of links that can meet.

    Args:
        urdf: the hand: boxes, cylinders and spheres as collision shapes, masses, limits, drives.
        tips: links of the three grasping fingertips in grasp order, then those of fingers to park; by default the
            ends of the tree's branches, where they are three.
        name: of the hand; by default the robot's.
        seed: of the random postures by which pads and pairs are guessed.
    """
    check_seed(seed)
    target = urdf.parent / "hand.toml"
    if target.exists():
        raise OutputError("URDF", f"{target}, which exists", "a folder without a hand.toml")
    with naming("--tips", "tips"), naming("URDF", "urdf"):
        text = draft_hand(urdf, tips, name, seed)
    write_file(target, text)
    print(f"written: {target}; look over the lines marked CHECK, then: torchgrasp hand check {target.parent}")
    return _print_faults(target.parent, "default")


def check(
    hand: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="HAND")],
    /,
    fingers: str = "default",
    out: Path = Path("hand.png"),
) -> int:
    """Say by name what is wrong with a hand; a sound one is described and drawn.

    Args:
        hand: name of a shipped hand, or the folder of another.
        fingers: the finger option of its hand.toml.
        out: picture to write (.png): the pads, the frame of the palm, the limits.
    """
    if out.suffix.lower() != ".png":
        raise BadArgument("--out", out, "a file ending in .png")
    with naming("--fingers", "fingers"), naming("HAND", "hand"):
        if _print_faults(hand, fingers):
            return 2
        sound = check_hand(hand, fingers)
    with naming("--out", "path"):
        check_folder(out.parent)
    joints = random_joints(sound, POSTURES)
    print(describe(sound, joints))
    modelled = find_hand(hand) / "mixture.safetensors"
    none = f"none; python scripts/train.py posture-model {hand} learns it"
    print(f"learned model: {modelled if modelled.exists() else none}")
    write_file(out, draw_hand(sound, opposed_posture(sound, joints)))
    print(f"picture: {out}")
    return 0


def describe(hand: Hand, joints: torch.Tensor) -> str:
    """Return what a hand is like: its fingers, and what it does in random postures.

    Args:
        hand: the hand.
        joints: postures (n, h) [rad], uniform within the limits.
    """
    lines = [f"{hand.name}, option {hand.source.option}: {hand.dof} actuated of {len(hand.tree.joint_names)} joints"]
    ends = torch.rad2deg(torch.stack([hand.lower, hand.upper], 1)).tolist()
    lines += [
        f"  {n:24} {low:7.1f} to {high:6.1f} degrees" for n, (low, high) in zip(hand.joint_names, ends, strict=True)
    ]
    tips = hand.tips
    for k, finger in enumerate(tips.names):
        radius = float(tips.radius[k])
        tip = f"a sphere of {1e3 * radius:.1f} mm" if radius else "a point"
        contact, normal = (", ".join(f"{x:.4g}" for x in v[k].tolist()) for v in (tips.contact, tips.normal))
        lines.append(f"finger {finger}: {tip} on {tips.links[k]}")
        lines.append(f"  contact [{contact}] m, normal [{normal}]")
    for j, name in enumerate(hand.tree.joint_names):
        row, offset = hand.actuated.coupling[j], float(hand.actuated.offset[j])
        sources = torch.nonzero(row)[:, 0].tolist()
        if not sources:
            lines.append(f"joint {name} is parked at {offset:.4g}")
        elif hand.joint_names[sources[0]] != name:
            lines.append(f"joint {name} = {float(row[sources[0]]):.4g} {hand.joint_names[sources[0]]} + {offset:.4g}")
    points, normals = hand.fingertips(joints)
    free = hand.self_clearance(joints) > 0
    sides = torch.linalg.vector_norm(points - points.roll(1, 1), dim=-1)[free]
    pairs = (normals * normals.roll(1, 1)).sum(-1)[free]
    share, opposed = 1 - float(free.double().mean()), float((pairs < OPPOSED_COSINE).any(1).double().mean())
    lines.append(f"{share:.1%} of {len(joints)} random postures collide with themselves")
    lines.append(f"{opposed:.1%} of the free ones have two pads face to face (an angle above 120 degrees)")
    least, most = (1e3 * float(sides.quantile(q)) for q in (0.01, 0.99))
    lines.append(f"fingertips are {least:.0f} to {most:.0f} mm apart")
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
    """Write random postures of a hand that touch nothing of itself, with their codes; continues what was begun.

    Args:
        hand: name of a shipped hand, or the folder of another.
        out: folder to write.
        n: how many postures; the paper has 1,000,000.
        fingers: which fingers grasp, one of the hand's options.
        sampling: uniform as in the paper, or opposed: only postures in which two pads face each other.
        workers: threads that draw at the same time.
        seed: of every random draw.
    """
    check_seed(seed)
    with naming("--hand", "hand"), naming("--fingers", "fingers"):
        robot = load_hand(hand, fingers)
    begin = time.perf_counter()
    with naming("--out", "folder", "path"), naming("--n", "n"), naming("--workers", "workers"):
        spec = SampleSpec(n, seed, sampling)
        with tqdm(total=n, unit="posture", unit_scale=True, disable=None, leave=False) as bar:
            write_samples(robot, spec, out, workers, bar.update)
    print(f"{n} {sampling} postures of {robot.name} in {out}, {time.perf_counter() - begin:.0f} s")
    return 0


def _print_faults(hand: str | Path, fingers: str) -> int:
    """Print what is wrong with a hand's files, one line each; return 0 for nothing, else the exit code 2."""
    try:
        faults: list[GraspError] = list(find_faults(hand, fingers))
    except BadArgument as error:
        if error.argument == "fingers":
            raise
        faults = [error]
    for fault in faults:
        print(f"wrong: {' '.join(str(fault).split())}")
    return 2 if faults else 0
