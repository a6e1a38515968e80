"""The command `torchgrasp hand check`: faults of a hand, warnings with fixes, a picture, and a trial plan."""

from pathlib import Path

import torch
from tqdm import tqdm

from torchgrasp.app.cli.command import Command, arguments, make_bar, option, positional
from torchgrasp.app.cli.inputs import FINGERS_HELP, HAND_HELP, check_folder
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
from torchgrasp.posture_model.sample import can_close
from torchgrasp.testing import check_hand, find_faults, most_met, random_joints

TRIAL_STARTS = 100  # initial guesses with which a hand is tried on a shipped object


@arguments(path="out")
class HandCheck(Command):
    """Name every fault of a hand; describe and draw a sound hand, and plan on a shipped object."""

    hand: str = positional(HAND_HELP)
    fingers: str = option(
        "auto", f'{FINGERS_HELP}; "auto" describes the default, and tries every set that hand.toml declares'
    )
    out: Path = option(Path("hand.png"), "picture to write (.png): the pads, the frame of the palm, the limits")

    def run(self) -> int:
        """Check, describe and draw the hand, and plan on a shipped object; return the exit code."""
        if self.out.suffix.lower() != ".png":
            raise BadArgument("--out", self.out, "a file ending in .png")
        chosen = "default" if self.fingers == "auto" else self.fingers
        with make_bar(None, "step", desc="faults") as bar:
            if print_faults(self.hand, chosen):
                return 2
            sound = check_hand(self.hand, chosen)
            check_folder(self.out.parent)
            joints = random_joints(sound, 5000)
            bar.write(f"{describe(sound, joints)}\n{describe_sets(sound)}")
            model = find_hand(self.hand) / "mixture.safetensors"
            missing = f"none; only the modes of the paper need one: torchgrasp hand train {self.hand}"
            bar.write(f"learned model: {model if model.exists() else missing}")
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
        if able:
            print("the hand can grasp")
        return 0 if able else 1


def print_faults(hand: str | Path, fingers: str = "default") -> bool:
    """Print every fault of a hand, for the given fingers and all declared sets; return whether there is any."""
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
    """Return a text that lists the sets of fingers that a hand declares."""
    rows = [(one.source.option, ", ".join(one.finger_names)) for one in finger_sets(hand, "auto")]
    return f"sets of fingers:\n{format_columns(rows, left={0, 1})}"


def find_warnings(hand: Hand, joints: torch.Tensor) -> list[str]:
    """Return warnings about a hand without faults, each with its fix, from random postures (n, h) [rad]."""
    # Least shares of random postures that are free, face a pad to the others, and can hold an object; three fingers
    least_free, least_facing, least_closing = 0.2, 0.02, 0.001
    warnings, free, named = [], hand.self_clearance(joints) > 0, f"[options.{hand.source.option}]"
    share = float(free.double().mean())
    if share < least_free ** (len(hand.tips) / 3):
        one, two = most_met(hand, joints[:500])
        warnings.append(
            f"only {share:.0%} of random postures are free, most often {one} meets {two}: if this is impossible, make "
            "their collision shapes smaller, or take the pair out of [self_collision]"
        )
    points, normals = hand.fingertips(joints[free])
    inward = points.mean(1, keepdim=True) - points
    facing = ((normals * inward).sum(-1) / torch.linalg.vector_norm(inward, dim=-1) > 0.5).double().mean(0)
    for name, seen in zip(hand.finger_names, facing.tolist(), strict=True):
        if seen < least_facing:
            warnings.append(
                f"the pad of {name} faces the others in {seen:.1%} of free postures: if its arrow in the picture "
                f"points the wrong way, turn contact and normal in hand.toml; or name other fingers in {named}"
            )
    closing = float(can_close(points, normals).double().mean()) if len(points) else 0.0
    if closing < least_closing:
        warnings.append(
            f"{closing:.2%} of free postures can hold an object: give {named} the thumb and fingers that it faces"
        )
    return warnings


def _try_objects(hand: Hand, bar: tqdm) -> bool:
    """Plan on the shipped objects until one is graspable; return whether any is."""
    for name in ("cylinder", "jug"):
        grasps = plan_grasps(load_object(name).view, hand, starts=TRIAL_STARTS)
        count = count_status(grasps.status)
        good = count.get(Status.OK, 0)
        lost = ", ".join(f"{number} {status.name.lower()}" for status, number in count.items())
        found = f"{good} of {len(grasps)} grasps executable" if good else f"no executable grasp ({lost})"
        bar.write(f"{hand.source.option} on the shipped {name}: {found}")
        if good:
            return True
    return False


def describe(hand: Hand, joints: torch.Tensor) -> str:
    """Return a text about a hand: its joints, its fingers, and statistics of random postures (n, h) [rad]."""
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
    lines.append(f"{closing:.1%} of the free ones can hold an object between the middles of their pads (friction 0.8)")
    lines.append(f"fingertips are {sides.quantile(0.01):.0f} to {sides.quantile(0.99):.0f} mm apart")
    return "\n".join(lines)
