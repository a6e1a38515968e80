"""`torchgrasp export`: planned grasps in the formats of others."""

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from torchgrasp.base import check_whole
from torchgrasp.cli.common import naming
from torchgrasp.errors import BadArgument, Status
from torchgrasp.export import format_grasps, format_keyframes
from torchgrasp.files import write_file
from torchgrasp.hand.load import hand_of
from torchgrasp.values import load_grasps


def export(
    grasps: Annotated[Positional[Path], arg(metavar="GRASPS")],
    /,
    out: Path,
    format: Literal["json", "mujoco"] = "json",
    hand: str | None = None,
    most: int = 20,
    force: float = 4.0,
    kp: float | None = None,
) -> int:
    """Write the best executable grasps of a file for replay, with joints by name.

    Args:
        grasps: grasps.safetensors of `torchgrasp grasp`, or a file of the folder grasps of `torchgrasp evaluate`.
        out: file to write.
        format: JSON with frames, units, forces and torques, or the hand as a MuJoCo model with keyframes.
        hand: name or folder of the hand; by default the name in the file.
        most: how many grasps, the best first.
        force: normal force of the strongest finger [N] in the squeeze.
        kp: stiffness of the joints under the robot's own position control [N m/rad]; by default the hand's.
    """
    with naming(path="GRASPS"):
        planned = load_grasps(grasps)
    with naming(hand="--hand", name="--hand", grasps="GRASPS", fingers="GRASPS"):
        robot = hand_of(planned, hand)
    if planned.meta.get("hand_sha256") != robot.source.sha256:
        raise BadArgument("--hand", f"{robot.name}, whose files are not those that were planned with", "the same hand")
    check_whole("--most", most, 1, 1_000_000)
    best = planned[planned.status == Status.OK][:most]
    with naming(force="--force", kp="--kp", path="--out"):
        write_file(out, (format_grasps if format == "json" else format_keyframes)(robot, best, force, kp))
    print(f"{len(best)} grasps of the {robot.name} hand: {out}")
    return 0 if len(best) else 1
