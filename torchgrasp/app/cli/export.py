"""`torchgrasp export` and `torchgrasp import`: grasps in the formats of others, written and read."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from torchgrasp.app.cli.common import naming
from torchgrasp.base import check_whole
from torchgrasp.errors import BadArgument, Status
from torchgrasp.export import (
    format_graspgen,
    format_grasps,
    format_keyframes,
    format_moveit,
    format_trajectories,
    grasps_from_joints,
    read_foreign,
    save_dexgraspbench,
)
from torchgrasp.files import write_file
from torchgrasp.hand.load import hand_of, load_hand
from torchgrasp.planner.problem import digest
from torchgrasp.specs import ContactSpec
from torchgrasp.values import load_grasps

Format = Literal["json", "mujoco", "moveit", "ros2", "dexgraspbench", "graspgen"]
TEXTS: dict[str, Callable[..., str]] = {
    "json": format_grasps,
    "mujoco": format_keyframes,
    "moveit": format_moveit,
    "ros2": format_trajectories,
}
"""Formats of one text file that need no name of the object."""


def export(
    grasps: Annotated[Positional[Path], arg(metavar="GRASPS")],
    /,
    out: Path,
    format: Format = "json",
    hand: str | None = None,
    most: int = 20,
    force: float = 4.0,
    kp: float | None = None,
    object: str | None = None,
) -> int:
    """Write the best executable grasps of a file for other programs; each file says its frames and order of joints.

    Args:
        grasps: grasps.safetensors of `torchgrasp grasp`, or a file of the folder grasps of `torchgrasp evaluate`.
        out: file to write; for dexgraspbench a folder, with one file for each grasp.
        format: json: frames, units, forces and torques. mujoco: the hand as a model with keyframes. moveit: a list of
            moveit_msgs/Grasp in YAML. ros2: a JointTrajectory each. dexgraspbench, graspgen: files of these projects.
        hand: name or folder of the hand; by default the name in the file.
        most: how many grasps, the best first.
        force: normal force of the strongest finger [N] in the squeeze.
        kp: stiffness of the joints under the robot's own position control [N m/rad]; by default the hand's, in
            dexgraspbench the bench's 5.
        object: where dexgraspbench has its folder of the object, or a GraspGen data set the mesh; of these alone.
    """
    if (object is None) == (format in ("dexgraspbench", "graspgen")):
        raise BadArgument("--object", object, "a path with --format dexgraspbench or graspgen, and with these alone")
    with naming(path="GRASPS"):
        planned = load_grasps(grasps)
    with naming(hand="--hand", name="--hand", grasps="GRASPS", fingers="GRASPS"):
        robot = hand_of(planned, hand)
    if planned.meta.get("hand_sha256") != robot.source.sha256:
        raise BadArgument("--hand", f"{robot.name}, whose files are not those that were planned with", "the same hand")
    check_whole("--most", most, 1, 1_000_000)
    best = planned[planned.status == Status.OK][:most]
    with naming(force="--force", kp="--kp", path="--out", folder="--out", object_path="--object", hand="--format"):
        if format == "dexgraspbench":
            save_dexgraspbench(robot, best, out, str(object), force, **({} if kp is None else {"kp": kp}))
        elif format == "graspgen":
            write_file(out, format_graspgen(best, str(object)))
        else:
            write_file(out, TEXTS[format](robot, best, force, kp))
    print(f"{len(best)} grasp{'s' * (len(best) != 1)} of the {robot.name} hand: {out}")
    return 0 if len(best) else 1


def import_grasps(
    file: Annotated[Positional[Path], arg(metavar="FILE")],
    /,
    hand: str,
    out: Path,
    fingers: str = "default",
    joints: tuple[str, ...] = (),
    quaternion: Literal["wxyz", "xyzw"] = "wxyz",
    cloud: Path | None = None,
    friction: float = 0.8,
    std: float = 0.003,
) -> int:
    """Read grasps of another program, prove which are closed, and write them as grasps.safetensors.

    `torchgrasp export` and `torchgrasp evaluate --planned` take the file. What is read: our JSON, JSON with "pose" and
    "dofs" (MultiGripperGrasp), and .npz with DexGraspBench's names.

    Args:
        file: the grasps, in the frame of the object.
        hand: name or folder of the hand.
        out: file to write.
        fingers: which fingers grasp, as for `torchgrasp grasp`.
        joints: names of the joints in the order of the file, where it names none.
        quaternion: order of the numbers of a rotation in the file.
        cloud: the view that the grasps are of, for `torchgrasp evaluate --planned`.
        friction: of the certificates.
        std: standard deviation of the surface [m] that a closing under uncertainty shall assume at each contact.
    """
    from torchgrasp.cloud import read_cloud

    with naming(name_or_path="--hand", hand="--hand", fingers="--fingers"):
        robot = load_hand(hand, fingers)
    with naming(path="FILE", order="--joints"):
        read = read_foreign(file, robot, joints, quaternion)
    with naming(joints="FILE", pregrasp="FILE", obj_from_hand="FILE", friction="--friction", std_m="--std"):
        spec = ContactSpec(friction=friction, friction_margin=1.0)
        grasps = grasps_from_joints(robot, *read, spec, std)
    if cloud is not None:
        with naming(path="--cloud"):
            grasps.meta["cloud_sha256"] = digest(read_cloud(cloud))
    with naming(path="--out"):
        grasps.save(out)
    closed = int((grasps.status == Status.OK).sum())
    print(f"{len(grasps)} grasps of the {robot.name} hand, {closed} closed at friction {friction:g}: {out}")
    return 0 if closed else 1
