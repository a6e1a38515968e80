"""The command `torchgrasp export`: grasps in the formats of other programs."""

import functools
import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from torchgrasp import export as formats
from torchgrasp.app.cli.command import (
    Command,
    arguments,
    check_kept,
    naming,
    option,
    positional,
    required,
)
from torchgrasp.app.cli.results import GRASPS, PLANNED_HELP, load_planned
from torchgrasp.app.report.glb import write_glb
from torchgrasp.cloud.agreement import check_contacts
from torchgrasp.export.foreign import read_poses
from torchgrasp.export.postures import follower_joints, stands_still
from torchgrasp.files import read_bytes, read_json, write_file
from torchgrasp.foundation.errors import BadArgument, ModelFileError
from torchgrasp.foundation.rules import Count, check_suffix
from torchgrasp.geometry.mesh import SUFFIXES, load_triangles, read_mesh
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import hand_of
from torchgrasp.values.planning import Grasps
from torchgrasp.values.specs import TrialSpec

TEXTS: dict[str, Callable[..., str]] = {
    "json": formats.format_grasps,
    "isaac": formats.format_isaac,
    "mujoco": formats.format_keyframes,
    "moveit": formats.format_moveit,
    "ros2": formats.format_trajectories,
}
"""Writers of formats that are one text file and do not name the object."""


@arguments(
    path="out",
    folder="out",
    object_path="object",
    name="hand",
    fingers="grasps",
    object_id="object",
    mesh="object",
)
class Export(Command):
    """Write the best executable grasps of a file for other programs, with frames and the order of
    joints.
    """

    grasps: Path = positional(PLANNED_HELP)
    out: Path = required("file to write; for dexgraspbench, play-... and usd a folder")
    format: Literal[
        "json",
        "isaac",
        "mujoco",
        "moveit",
        "ros2",
        "dexgraspbench",
        "graspgen",
        "glb",
        "play-mujoco",
        "play-maniskill",
        "play-isaaclab",
        "play-newton",
        "usd",
    ] = option(
        "json",
        "json: frames, units, forces and torques. isaac: an isaac_grasp file (YAML) of Isaac Sim "
        "and Isaac ROS. mujoco: the hand as a model with keyframes. "
        "moveit: a list of "
        "moveit_msgs/Grasp in YAML. ros2: a JointTrajectory each. dexgraspbench, graspgen: files "
        "of these projects. "
        "glb: hand and object at the best grasp, for slides. play-..., usd: hand, object, motion, "
        "and a script to play",
    )
    hand: str | None = option(None, "name or folder of the hand; by default the name in the file")
    most: Count = option(20, "number of grasps, the best first")
    force: float | None = option(
        None,
        "normal force of the strongest finger [N] in the squeeze; by default 4, in play-... and "
        "usd as --mass needs",
    )
    kp: float | None = option(
        None,
        "stiffness of the joints under position control [N m/rad]; by default the hand's, or the "
        "bench's",
    )
    object: str | None = option(
        None,
        "dexgraspbench: its folder of the object; graspgen: the mesh in its data set; moveit, "
        "isaac: the object's id, or frame. For glb, play-..., usd a mesh, by default the "
        "estimated surface.ply of GRASPS",
    )
    mass: float | None = option(None, "play-..., usd: mass of the object [kg]; by default 0.1")
    friction: float | None = option(None, "play-..., usd: coefficient of friction; by default 0.8")
    rename: tuple[str, ...] = option(
        (),
        "json, isaac, moveit, ros2: the robot's joints, as URDF=ROBOT ..., in its order, or a "
        ".json file of such an object",
    )
    actuated: bool = option(
        False,
        "isaac, moveit, ros2: leave out the joints that follow others, and moveit's efforts, which "
        "ros2_control refuses",
    )
    flange: tuple[float, float, float, float, float, float, float] | None = option(
        None,
        "json, isaac, moveit: position [m] and quaternion wxyz of the robot's flange in the hand's "
        "frame, to write its pose",
    )
    gripper_link: str | None = option(
        None,
        "isaac: the gripper's frame, or its path in the stage; by default the hand's root link, or "
        "'flange'",
    )
    isaac_ros: bool = option(
        False, "isaac: write the names of Isaac ROS, object_frame and gripper_frame"
    )

    def run(self) -> int:
        """Load the grasps and write them in the chosen format; return 0, or 1 for no grasp."""
        planned, surface = load_planned(self.grasps)
        check_kept(self.out, surface.with_name(GRASPS), surface)
        replaced = (self._plays or self.format == "glb") and surface.is_file()
        if self._needs_object and self.object is None and not replaced:
            raise BadArgument("--object", None, f"a path with --format {self.format}")
        robot = self._robot_options()
        trial = _given(mass=self.mass, friction=self.friction)
        texts = inspect.signature(TEXTS[self.format]).parameters if self.format in TEXTS else ()
        taken = trial if self._plays else texts
        if unused := [name for name in (*robot, *trial) if name not in taken]:
            raise BadArgument(unused[0], f"--format {self.format}", "a format that it is for")
        if self.format == "glb":
            check_suffix("--out", self.out, ".glb")
        hand = hand_of(planned, self.hand)
        if planned.meta.get("hand_sha256") != hand.source.sha256:
            other = f"{hand.name}, whose files are not those that were planned with"
            raise BadArgument("--hand", other, "the same hand")
        best = self._choose(hand, planned)
        body = Path(self.object or surface)
        if self.format in ("graspgen", "dexgraspbench"):
            bench = body / "mesh" / "simplified.obj"
            _check_reached(best, bench if self.format == "dexgraspbench" else body)
        with naming(hand="--format"):
            self._write(hand, best, body, robot, trial)
        followers = follower_joints(hand) if "actuated" in texts and not self.actuated else ()
        if followers:
            print(
                f"note: joints that follow others are written: {', '.join(followers)}; "
                "--actuated leaves them out, as ros2_control needs"
            )
        print(f"{len(best)} grasp{'s' * (len(best) != 1)} of the {hand.name} hand: {self.out}")
        return 0 if len(best) else 1

    @property
    def _plays(self) -> bool:
        """Whether the format plays a closing in a simulator."""
        return self.format == "usd" or self.format.startswith("play-")

    @property
    def _needs_object(self) -> bool:
        """Whether the format needs the object itself, or names its file."""
        return self._plays or self.format in ("dexgraspbench", "graspgen", "glb")

    def _robot_options(self) -> dict[str, Any]:
        """Return the options of the robot that were given, by their names in the writers."""
        with naming(path="--flange"):
            flange = None if self.flange is None else read_poses(np.array([self.flange]), "wxyz")[0]
        return _given(
            rename=read_names(self.rename),
            flange=flange,
            object_id=None if self._needs_object else self.object,
            actuated=self.actuated or None,
            gripper_link=self.gripper_link,
            isaac_ros=self.isaac_ros or None,
        )

    def _choose(self, hand: Hand, planned: Grasps) -> Grasps:
        """Return the best executable grasps that the format can hold, at most `most`."""
        best = planned.executable
        if self.format in ("isaac", "moveit"):
            still = stands_still(hand, best)
            if falling := int((~still).sum()):
                print(
                    f"note: {falling} of {len(best)} grasps are left out: their hand goes down "
                    f"while it closes, and {self.format} has one pose"
                )
            best = best[still]
        return best[: 1 if self.format == "glb" else self.most]

    def _write(
        self, hand: Hand, best: Grasps, body: Path, robot: dict[str, Any], trial: dict[str, Any]
    ) -> None:
        """Write the chosen grasps; `body` is the mesh of the object, or of its surface."""
        force = 4.0 if self.force is None else self.force
        if self._plays and len(best):
            player: Any = self.format.removeprefix("play-")
            spec = TrialSpec(force=self.force, kp=self.kp, **trial)
            formats.save_play(hand, best, self.out, player, body, spec)
        elif self.format == "dexgraspbench":
            stiffness = _given(kp=self.kp)
            formats.save_dexgraspbench(hand, best, self.out, str(self.object), force, **stiffness)
        elif self.format == "glb":
            if len(best):
                write_glb(self.out, hand, best[0], read_mesh(body))
        elif self.format == "graspgen":
            write_file(self.out, formats.format_graspgen(best, str(self.object)))
        elif self.format in TEXTS:
            write_file(self.out, TEXTS[self.format](hand, best, force, self.kp, **robot))


def _given(**options: Any) -> dict[str, Any]:
    """Return the options that are not None."""
    return {name: value for name, value in options.items() if value is not None}


def _check_reached(grasps: Grasps, path: Path) -> None:
    """Refuse an object that a format names if its mesh is here, and the grasps do not touch it."""
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        return
    mesh = load_triangles(read_bytes(path), path.suffix.lower())
    with naming(mesh="--object"):
        check_contacts(grasps, mesh)


def read_names(words: Sequence[str]) -> dict[str, str] | None:
    """Return a dict from each URDF joint to the robot's name for it; None without `words`.

    `words` are texts URDF=ROBOT, or the path of one .json file with an object {URDF: ROBOT}. Raises
    `BadArgument` for a joint given twice, and `ModelFileError` for a malformed file.
    """
    if len(words) != 1 or "=" in words[0]:
        pairs = [(joint, name) for joint, _, name in (word.partition("=") for word in words)]
        if len(names := dict(pairs)) < len(pairs):
            raise BadArgument("rename", " ".join(words), "each joint once")
        return names or None
    file = read_json(
        Path(words[0]),
        functools.partial(ModelFileError, "rename"),
        "URDF=ROBOT, or a JSON file of names",
    )
    return {joint: name.text() for joint, name in file.entries().items()}
