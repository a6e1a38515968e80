"""`torchgrasp hand check`: every fault of a hand by name, what is doubtful with its mend, a picture, and a trial."""

from pathlib import Path
from typing import Annotated

import torch
from tyro.conf import Positional, arg

from torchgrasp.app.cli.common import check_folder, naming
from torchgrasp.app.report.stills import draw_hand, opposed_posture
from torchgrasp.base import count_status
from torchgrasp.data.shipped import load_object
from torchgrasp.errors import BadArgument, GraspError, Status
from torchgrasp.files import format_columns, write_file
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.hand_toml import read_hand_toml
from torchgrasp.hand.load import find_hand
from torchgrasp.planner.grasps import plan_grasps
from torchgrasp.planner.problem import finger_sets
from torchgrasp.posture_model.touch import can_close
from torchgrasp.testing import check_hand
from torchgrasp.testing.hands import find_faults, most_met, random_joints

FREE, FACING, CLOSING = 0.2, 0.02, 0.001
"""Shares of random postures below which three fingers are doubtful; sound public hands have 0.27, 0.05 and 0.004. Of
more fingers less is free, LEAP's four 0.16: the share is taken as a product over fingers."""
TRIAL_STARTS = 100
"""Starts of the planner with which a hand is tried on a shipped object: some seconds."""


def check(
    hand: Annotated[Positional[str], arg(metavar="HAND")], /, fingers: str = "auto", out: Path = Path("hand.png")
) -> int:
    """Name every fault of a hand; describe and draw a sound one, and plan on a shipped object.

    Args:
        hand: name of a shipped hand, or the folder of another.
        fingers: which grasp, as for `grasp`; "auto" describes the default, and tries every set that hand.toml declares.
        out: picture to write (.png): the pads, the frame of the palm, the limits.
    """
    if out.suffix.lower() != ".png":
        raise BadArgument("--out", out, "a file ending in .png")
    chosen = "default" if fingers == "auto" else fingers
    with naming(fingers="--fingers", hand="HAND", path="--out"):
        if print_faults(hand, chosen):
            return 2
        sound = check_hand(hand, chosen)
        check_folder(out.parent)
    joints = random_joints(sound, 5000)  # shares vary by 1 %
    print(describe(sound, joints))
    print(describe_sets(sound))
    model = find_hand(hand) / "mixture.safetensors"
    missing = f"none; only the modes of the paper need one: torchgrasp hand train {hand}"
    print(f"learned model: {model if model.exists() else missing}")
    hands = finger_sets(sound, "auto" if fingers == "auto" else None)
    for one in hands:
        for doubt in find_doubts(one, random_joints(one, len(joints))):
            print(f"doubtful: {one.source.option}: {doubt}")
    write_file(out, draw_hand(sound, opposed_posture(sound, joints)))
    print(f"picture: {out}")
    able = [_try_objects(one) for one in hands]
    if any(able):
        print("the hand can grasp")
    return 0 if any(able) else 1


def print_faults(hand: str | Path, fingers: str = "default") -> bool:
    """Print every fault of a hand with its fingers, and with every set that it declares; tell whether there are any."""
    try:
        options = read_hand_toml(find_hand(hand) / "hand.toml", fingers).options
        faults: list[GraspError] = [fault for some in (fingers, *options) for fault in find_faults(hand, some)]
    except BadArgument as error:
        if error.argument == "fingers":
            raise
        faults = [error]
    for sentence in dict.fromkeys(" ".join(str(fault).split()) for fault in faults):
        print(f"wrong: {sentence}")
    return bool(faults)


def describe_sets(hand: Hand) -> str:
    """List the sets of fingers that a hand declares."""
    rows = [(one.source.option, ", ".join(one.finger_names)) for one in finger_sets(hand, "auto")]
    return f"sets of fingers:\n{format_columns(rows, left={0, 1})}"


def find_doubts(hand: Hand, joints: torch.Tensor) -> list[str]:
    """Say what of a sound hand is doubtful, judged by random postures `joints` (n, h) [rad], and how to mend it."""
    doubts, free, named = [], hand.self_clearance(joints) > 0, f"[options.{hand.source.option}]"
    share = float(free.double().mean())
    if share < FREE ** (len(hand.tips) / 3):
        one, two = most_met(hand, joints[:500])
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
                f"points the wrong way, turn contact and normal in hand.toml; or name other fingers in {named}"
            )
    closing = float(can_close(points, normals).double().mean()) if len(points) else 0.0
    if closing < CLOSING:
        doubts.append(
            f"{closing:.2%} of free postures can hold something: give {named} the thumb and fingers that it faces"
        )
    return doubts


def _try_objects(hand: Hand) -> bool:
    """Plan on shipped objects until one is graspable; tell whether one is."""
    for name in ("cylinder", "jug"):
        grasps = plan_grasps(load_object(name).view, hand, starts=TRIAL_STARTS)
        count = count_status(grasps.status)
        good = count.get(Status.OK, 0)
        lost = ", ".join(f"{number} {status.name.lower()}" for status, number in count.items())
        found = f"{good} of {len(grasps)} grasps executable" if good else f"no executable grasp ({lost})"
        print(f"{hand.source.option} on the shipped {name}: {found}")
        if good:
            return True
    return False


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
