"""The commands `torchgrasp export` and `torchgrasp import`: grasps in the formats of other
programs.
"""

import functools
import inspect
import itertools
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from torch import Tensor

from torchgrasp import export as formats
from torchgrasp.app.cli.command import Command, arguments, naming, option, positional, required
from torchgrasp.app.cli.inputs import FINGERS_HELP, HAND_HELP, load_fingers
from torchgrasp.app.cli.results import SURFACE
from torchgrasp.app.report.glb import write_glb
from torchgrasp.cloud.agreement import check_contacts, check_seen
from torchgrasp.cloud.read import read_cloud
from torchgrasp.data.shards import load_grasps
from torchgrasp.evaluation.touch import TOUCH, Touch, measure_touch
from torchgrasp.export.foreign import POSE_NUMBERS, Quaternion, read_poses
from torchgrasp.export.postures import follower_joints, stands_still
from torchgrasp.files import format_columns, format_json, read_bytes, read_json, write_file
from torchgrasp.foundation.errors import BadArgument, ModelFileError, Status
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.foundation.rules import Count
from torchgrasp.geometry.mesh import SUFFIXES, load_triangles, read_mesh
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import hand_of
from torchgrasp.planner.objects import digest
from torchgrasp.values.planning import Grasps, PointCloud
from torchgrasp.values.specs import ContactSpec, TrialSpec

Unit = Literal["m", "cm", "mm"]
UNITS: dict[Unit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}  # [m]
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

    grasps: Path = positional(
        "grasps.safetensors of `torchgrasp grasp`, or a file of the folder grasps of `evaluate`"
    )
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
        "isaac: the object's id, or frame; "
        "glb, play-..., usd: a mesh; by default the estimated surface.ply of GRASPS",
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
        """Load the grasps and write them in the chosen format; return the exit code."""
        surface = self.grasps.with_name(SURFACE)
        replaced = (self._plays or self.format == "glb") and surface.is_file()
        if self._needs_object and self.object is None and not replaced:
            raise BadArgument("--object", None, f"a path with --format {self.format}")
        robot = self._robot_options()
        trial = _given(mass=self.mass, friction=self.friction)
        texts = inspect.signature(TEXTS[self.format]).parameters if self.format in TEXTS else ()
        taken = trial if self._plays else texts
        if unused := [name for name in (*robot, *trial) if name not in taken]:
            raise BadArgument(unused[0], f"--format {self.format}", "a format that it is for")
        with naming(path="GRASPS"):
            planned = load_grasps(self.grasps)
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
        best = planned[planned.status == Status.OK]
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
    """Refuse an object that a format names if its mesh is on this machine, and the grasps do not
    touch it.
    """
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


SHOWN = 20  # most grasps whose gaps are printed
FARTHEST = 10  # of a hand from the object's frame [m]: farther is another unit


@arguments(
    order="joints", pregrasp="file", obj_from_hand="file", std_m="std", mesh="mesh", limit="gap"
)
class Import(Command):
    """Read grasps of another program, prove which have force closure, and write them as
    grasps.safetensors.

    `torchgrasp export` and `torchgrasp evaluate --planned` accept the file. The input is JSON of
    `torchgrasp export`, JSON with "pose" and "dofs" (MultiGripperGrasp), .npz with DexGraspBench's
    names, or .yaml of isaac_grasp 1.0.
    """

    file: Path = positional("the grasps, in the frame of the object")
    hand: str = required(HAND_HELP)
    out: Path = required("file to write")
    fingers: str = option("default", FINGERS_HELP)
    joints: tuple[str, ...] = option(
        (),
        "names of the joints in the order of the file, where the file has no names; JOINT:-1 turns "
        "a sign, JOINT:FACTOR:OFFSET [rad] converts",
    )
    quaternion: Quaternion = option("wxyz", "order of the numbers of a rotation in the file")
    unit: Unit = option("m", "unit of the positions in the file")
    root: tuple[str, ...] = option(
        (),
        "the hand's frame in the file: a link of our URDF, or position [m] and quaternion wxyz of "
        "our root link in it; by default what the file names, or our root link",
    )
    cloud: Path | None = option(
        None,
        "the view for which the grasps are, for `torchgrasp evaluate --planned`; the contacts "
        "must lie on it",
    )
    mesh: Path | None = option(
        None,
        "the object's closed mesh [m], in the frame of the grasps; the contacts must lie on it",
    )
    gap: float = option(
        TOUCH.limit,
        "with --mesh or --cloud: greatest gap of a fingertip that touches before any force [m]",
    )
    touch: Path | None = option(
        None, "with --mesh or --cloud: JSON file to write, with the gaps of each grasp"
    )
    friction: float = option(0.8, "coefficient of friction of the certificates")
    std: float = option(
        0.003, "standard deviation of the surface [m] that a closing assumes at each contact"
    )

    def run(self) -> int:
        """Read the grasps of another program, certify and write them; return the exit code."""
        hand, _ = load_fingers(self.hand, self.fingers)
        if self.touch is not None and self.cloud is None and self.mesh is None:
            raise BadArgument("--touch", self.touch, "a surface: --mesh or --cloud")
        surface: trimesh.Trimesh | PointCloud | None = None
        grasps = self._read(hand, self.quaternion, self.unit)
        if self.cloud is not None:
            with naming(path="--cloud"):
                surface = read_cloud(self.cloud)
            self._check(hand, grasps, surface)
            grasps.meta["cloud_sha256"] = digest(surface)
        if self.mesh is not None:
            with naming(mesh="--mesh"):
                surface = read_mesh(self.mesh)
            self._check(hand, grasps, surface)
        if surface is None and len(grasps):
            far = float(grasps.obj_from_hand[:, :3, 3].abs().max())
            if far > FARTHEST:
                wanted = f"hands within {FARTHEST} m of the object's frame: --unit"
                raise BadArgument("FILE", f"a hand {far:.0f} m off", wanted)
        with naming(path="--out"):
            grasps.save(self.out)
        closed = int((grasps.status == Status.OK).sum())
        some = f"{len(grasps)} grasps of the {hand.name} hand"
        print(f"{some}, {closed} closed at friction {self.friction:g}: {self.out}")
        if surface is not None:
            self._tell_touch(measure_touch(hand, grasps, surface, self.gap))
        return 0 if closed else 1

    def _tell_touch(self, touch: Touch) -> None:
        """Print which grasps touch before any force; write the JSON file that was asked for."""
        largest = (1000 * touch.largest).tolist()
        deepest = (1000 * touch.deepest).tolist()
        rows = list(zip(largest, deepest, touch.verdicts, strict=True))
        if self.touch is not None:
            names = ("gap_mm", "deepest_mm", "touch")
            content = {
                "limit_mm": 1000 * self.gap,
                "grasps": [dict(zip(names, row, strict=True)) for row in rows],
            }
            with naming(path="--touch"):
                write_file(self.touch, format_json(content))
        table = [("grasp", "largest gap [mm]", "deepest [mm]", "before any force")]
        for number, (gap, depth, verdict) in enumerate(rows[:SHOWN]):
            table.append((str(number), f"{gap:.1f}", f"{depth:.1f}", verdict))
        print(format_columns(table, left={3}))
        counts = Counter(touch.verdicts).most_common()
        told = ", ".join(f"{n} {name}" for name, n in counts)
        print(f"before any force, within {1000 * self.gap:g} mm: {told or 'no grasp'}")

    def _read(self, hand: Hand, quaternion: Quaternion, unit: Unit) -> Grasps:
        """Read the grasps in a given quaternion order and unit, and certify their contacts."""
        with naming(path="FILE"):
            root = _read_root(self.root)
            read = formats.read_foreign(self.file, hand, self.joints, quaternion, UNITS[unit], root)
        with naming(joints="FILE"):
            spec = ContactSpec(friction=self.friction, friction_margin=1.0)
            return formats.grasps_from_joints(hand, *read, spec, self.std)

    def _check(self, hand: Hand, grasps: Grasps, surface: "trimesh.Trimesh | PointCloud") -> None:
        """Refuse grasps that are not on the object; the error names options that put them there,
        if any do.
        """
        error = _contradiction(grasps, surface)
        if error is None:
            return
        for unit, quaternion in itertools.product(get_args(Unit), get_args(Quaternion)):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the first reading told them
                other = self._read(hand, quaternion, unit)
            if _contradiction(other, surface) is None:
                mend = f"{error.allowed}, as with --quaternion {quaternion} --unit {unit}"
                raise BadArgument("FILE", error.found, mend)
        raise error


def _read_root(words: Sequence[str]) -> str | Tensor:
    """Return the link, or the pose (4, 4) [m], that the words of --root give; "" for none."""
    if len(words) < 2:
        return "".join(words)
    try:
        numbers = np.array([[float(word) for word in words]])
    except ValueError:
        numbers = np.zeros((1, 0))
    if numbers.shape[1] != POSE_NUMBERS:
        raise BadArgument("root", " ".join(words), "a link, or X Y Z QW QX QY QZ")
    with naming(path="--root"):
        return read_poses(numbers, "wxyz")[0]


def _contradiction(grasps: Grasps, surface: "trimesh.Trimesh | PointCloud") -> BadArgument | None:
    """Return the error to raise if grasps are not on the object, else None."""
    try:
        if isinstance(surface, PointCloud):
            check_seen(grasps, surface, "FILE")
        else:
            check_contacts(grasps, surface)
    except BadArgument as error:
        return error
    return None
