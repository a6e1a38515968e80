"""The command `torchgrasp import`: grasps of other programs, proved and checked against the object."""

import itertools
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from torch import Tensor

from torchgrasp import export as formats
from torchgrasp.app.cli.command import Command, arguments, naming, option, positional, required
from torchgrasp.app.cli.inputs import FINGERS_HELP, HAND_HELP, load_fingers
from torchgrasp.cloud.agreement import check_contacts, check_seen
from torchgrasp.cloud.read import read_cloud
from torchgrasp.evaluation.touch import TOUCH, Touch, measure_touch
from torchgrasp.export.foreign import (
    FARTHEST,
    POSE_NUMBERS,
    Quaternion,
    check_places,
    place_joints,
    read_poses,
)
from torchgrasp.files import format_columns, format_json, write_file
from torchgrasp.foundation.errors import BadArgument, ModelFileError, Status
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.geometry.mesh import read_mesh
from torchgrasp.hand.hand import Hand
from torchgrasp.planner.objects import digest
from torchgrasp.values.planning import Grasps, PointCloud
from torchgrasp.values.specs import ContactSpec

Unit = Literal["m", "cm", "mm"]
UNITS: dict[Unit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}  # [m]
SHOWN = 20  # most grasps whose gaps are printed


@arguments(
    order="joints", pregrasp="file", obj_from_hand="file", std_m="std", mesh="mesh", limit="gap"
)
class Import(Command):
    """Read grasps of another program, prove which have force closure, and write them as
    grasps.safetensors.

    `torchgrasp export` and `torchgrasp evaluate --planned` accept the file. The input is JSON of
    `torchgrasp export`, or JSON with "pose" and "dofs" (MultiGripperGrasp). It may be .npz with
    DexGraspBench's names, or .yaml of isaac_grasp 1.0.
    """

    file: Path = positional("the grasps, in the frame of the object")
    hand: str = required(HAND_HELP)
    out: Path = required("file to write")
    fingers: str = option("default", FINGERS_HELP)
    joints: tuple[str, ...] = option(
        (),
        "names of the joints in the order of the file, where the file has no names. JOINT:-1 turns "
        "a sign, JOINT:FACTOR:OFFSET [rad] converts",
    )
    quaternion: Quaternion = option("wxyz", "order of the numbers of a rotation in the file")
    unit: Unit = option("m", "unit of the positions in the file")
    root: tuple[str, ...] = option(
        (),
        "the hand's frame in the file: a link of our URDF, or position [m] and quaternion wxyz of "
        "our root link in it. By default it is what the file names, or our root link",
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
        """Read the grasps of another program, certify and write them; return the exit code.

        It is 0 if any grasp has force closure, else 1.
        """
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
                wanted = f"hands within {FARTHEST:g} m of the object's frame: --unit"
                raise BadArgument("FILE", f"a hand {far:.0f} m off", wanted)
        with naming(table="FILE"):
            check_places(grasps)
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
            return place_joints(hand, *read, spec, self.std)

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
                try:
                    other = self._read(hand, quaternion, unit)
                except ModelFileError:
                    continue  # the file names another unit
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
