"""Import of grasps from other planners, from Isaac, and from our own JSON, as `Grasps`.

DexGraspBench's .npy is a pickle, which could run code when it is read, so it is rejected.
docs/exchange.md converts it.
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.safe_files import parse_npz, unread_arrays
from torchgrasp.contacts.certify import certify
from torchgrasp.control.law import damped_inverse
from torchgrasp.export.file_joints import (
    POSTURE,
    Column,
    reach_tips,
    read_columns,
    read_order,
    read_posture,
)
from torchgrasp.export.isaac import parse_isaac
from torchgrasp.export.other_formats import bench_frame
from torchgrasp.export.postures import CONVENTIONS, OWN_FORMAT, OWN_VERSION
from torchgrasp.files import Field, read_bounded, read_json
from torchgrasp.foundation.base import flatnonzero
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, GraspFileWarning, ModelFileError, Status
from torchgrasp.foundation.lazy import spatial
from torchgrasp.foundation.limits import CLOUD_BYTES
from torchgrasp.foundation.rules import Pose, Poses, Positive, SmallLength
from torchgrasp.foundation.told import warn_user
from torchgrasp.geometry.frames import apply, inverse, rigid, rotate
from torchgrasp.geometry.linalg import norm
from torchgrasp.geometry.plane import Plane, read_plane
from torchgrasp.hand.hand import Hand
from torchgrasp.values.planning import Contacts, Grasps
from torchgrasp.values.specs import ContactSpec

MOST_GRASPS = 100_000  # most grasps of a file: more are no plan of one object
FAR = 10_000.0  # largest number of a pose or posture [mm, rad] in a JSON file
ROUNDING = 1e-3  # largest error of a quaternion's length: that of a file of few digits
# distance [m] of opened fingertips from their contacts, and linear steps, which reach it to 1 mm
OPENED = 0.02
OPENING_STEPS = 4
FARTHEST = 10.0  # distance [m] of a hand from its object's frame: farther is in millimetres
FARTHEST_TABLE = 2.0  # greatest height [m] of all contacts above their table
LEAST = 1e-12  # least length [m] by which a position is divided


@dataclasses.dataclass(frozen=True)
class OrderNumbers:
    """Bounds by which the quaternions of a file are found to have another order (w first or last)
    than assumed. In the right order, the object's origin is on one side of most hands.
    """

    grasps: int = 8
    """Least number of grasps from which the order is judged: of fewer, one side may be chance."""
    one_side: float = 0.9
    """Length of a mean vector above which the object's origin is on one side of most hands. The
    vector is the mean over all grasps of the unit vector from the hand to this origin. It is in the
    hand's frame. The other order must exceed this length to be judged right.
    """
    any_side: float = 0.6
    """Length of this mean vector below which the origin is on any side. The assumed order must be
    below it to be judged wrong.
    """


ORDER = OrderNumbers()
POSE_NUMBERS = 7  # of a pose: a position and a quaternion
ROOTS = ("root_link", "base_link")  # names of the link whose poses a file has
# fields of a MultiGripperGrasp file: read, and those that we know and need not
GRIPPER_READ = ("gripper", "pose", "dofs", "obj_pose", *ROOTS)
GRIPPER_KNOWN = ("object_ID", "test_type", "controller", "test_duration", "physics_dt")
GRIPPER_TIMES = ("result_time", "runtime", "timestamp")  # known, too
# arrays of a DexGraspBench file: read, and those that we know and need not
BENCH_READ = ("grasp_qpos", "pregrasp_qpos", "obj_pose")
BENCH_NAMES = "joint_names"  # array with the names of the joints in the order of a posture
BENCH_KNOWN = ("obj_path", "obj_scale", "squeeze_qpos", BENCH_NAMES)
BENCH_FILE = "an .npz with 'grasp_qpos'"
MOST_JOINTS = 100  # most names of joints that are read
MOST_SHOWN = 200  # letters of these names in an error
_refuse = functools.partial(ModelFileError, "path")  # the error of a bad file of grasps
Quaternion = Literal["wxyz", "xyzw"]


class ForeignGrasps(NamedTuple):
    """The g grasps in another program's file, for a hand with h actuated joints; `read_foreign`
    returns them.

    Attributes:
        joints: positions (g, h) [rad or m] of the actuated joints, in the order of
            `hand.joint_names`.
        obj_from_hand: poses (g, 4, 4) [m] of the hand's root link in the object's frame.
        pregrasp: positions (g, h) [rad or m] of the opened hand's actuated joints; None if the file
            has none.
        table: the table under the object, in the object's frame; None if the file has none.
    """

    joints: Float[Tensor, "g h"]
    obj_from_hand: Float[Tensor, "g 4 4"]
    pregrasp: Float[Tensor, "g h"] | None
    table: Plane | None = None


@checked
def read_foreign(
    path: Path | str,
    hand: Hand,
    order: Sequence[str] = (),
    quaternion: Quaternion = "wxyz",
    unit_m: Positive = 1.0,
    root: str | Pose = "",
) -> ForeignGrasps:
    """Return joints and poses of grasps from another program's file, or from the JSON of
    `format_grasps`.

    The result has g grasps: `joints` (g, h) [rad or m], `obj_from_hand` (g, 4, 4) [m], and
    `pregrasp` (g, h) and `table`, or None. `grasps_from_joints` makes `Grasps` of them.

    | file | what is read |
    | --- | --- |
    | `.json` of `format_grasps` | joints by name, pose, pre-grasp, table |
    | `.json` with `pose`, `dofs` (MultiGripperGrasp) | position, quaternion, joints in `order` |
    | `.npz` with `grasp_qpos` (DexGraspBench) | lines of pose and joints; `pregrasp_qpos`, if any |
    | `.yaml` of `isaac_grasp` 1.0 | pose, joints by name, pre-grasp if any |

    If the file has an `obj_pose`, its poses are in the world, and are moved to the object's frame.
    DexGraspBench's hand may move from pre-grasp to grasp. Here it stays at the grasp. The joints of
    the pre-grasp are changed, so that its fingertips are where the file has them.
    MultiGripperGrasp's `dofs` are the joints with which its simulation starts. Its `final_dofs` and
    `result` are not read.

    Coupled joints, and joints of fingers that do not grasp, may differ in the file from the hand's.
    The condition is that this moves no fingertip by over 0.1 mm. A `GraspFileWarning` names values
    that are not kept. It names joints whose sign may be reversed, because they bend backward in
    every grasp. It also tells if an `isaac_grasp` file names no hand in its first line or in the
    gripper's path.

    Args:
        path: the file. Its angles are in radians, and its positions of sliding joints in metres.
        hand: the grasping hand. For the Allegro hand DexGraspBench's frame and joint order are
            known.
        order: the joint, by its name in the hand's URDF, of each number in a posture of the file.
            `JOINT:FACTOR` or `JOINT:FACTOR:OFFSET` converts a number of another sign, unit or zero
            position: the joint is at FACTOR x number + OFFSET [rad, or m for a sliding joint].
            Numbers under names that the hand does not have are not read. () is for files that name
            their joints, as by `joint_names`, and for the Allegro hand's files of DexGraspBench.
        quaternion: order of the four numbers after the position in a pose, "wxyz" or "xyzw". Files
            that name their numbers need none.
        unit_m: length [m] of one unit of the positions in the file.
        root: the frame on the hand that the file's poses belong to. It is the name of a link of the
            hand's URDF. Or it is the pose (4, 4) [m] of the hand's root link in this frame. ""
            means the link that the file names (`root_link`, `base_link`, or the end of Isaac's
            `gripper_frame_link`). If it names none, "" means the hand's root link, or
            DexGraspBench's frame of the Allegro hand.

    Raises:
        ModelFileError: the file is missing or malformed, or names another hand, or a root link that
            the hand does not have.
        ModelFileError: a joint is beyond its limits, and within them with the opposite sign.
        ModelFileError: coupled joints do not follow as in the hand, and move a fingertip by over
            0.1 mm.
        BadArgument: the `order` misses an actuated joint, has a name twice, or has a factor that is
            0 or no number.

    >>> import tempfile
    >>> from torchgrasp import load_hand
    >>> from torchgrasp.export import format_grasps
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> hand, grasp = load_hand("barrett"), load_shipped_grasp("jug", "barrett")
    >>> file = Path(tempfile.mkdtemp(), "grasps.json")
    >>> _ = file.write_text(format_grasps(hand, grasp))
    >>> torch.allclose(read_foreign(file, hand).joints, grasp.joints, atol=1e-5)
    True
    """
    path = Path(path)
    hand = hand.to("cpu", torch.float64)
    if path.suffix.lower() == ".npz":
        return _read_bench(path, hand, tuple(order), quaternion, unit_m, root)
    if path.suffix.lower() in (".yaml", ".yml"):
        return _read_isaac(path, hand, unit_m, root)
    file = read_json(path, _refuse, "a JSON file of grasps, .npz, or .yaml of isaac_grasp")
    fields = file.entries()
    if "grasps" in fields:
        return _read_own(fields, hand, unit_m, root)
    content = file.entries("pose", "dofs")
    _tell_unread(path, content, hand)
    columns = read_order(hand, order)
    pose = _table(content["pose"], POSE_NUMBERS)
    dofs = _table(content["dofs"], len(columns))
    if len(pose) != len(dofs):
        raise _refuse(f"{path}: {len(pose)} poses, {len(dofs)} postures", "as many of either")
    poses = read_poses(pose, quaternion, unit_m)
    if "obj_pose" in content:
        world = np.array([content["obj_pose"].numbers(POSE_NUMBERS, -FAR, FAR)])
        _tell_turned_objects(world, quaternion)
        poses = inverse(read_poses(world, quaternion, unit_m)) @ poses
    else:
        _tell_scattered_hands(pose, quaternion)
    joints = read_posture(hand, read_columns(hand, columns, dofs, _refuse), "grasp", _refuse)
    named = [content[name].text() for name in ROOTS if name in content]
    poses = poses @ _link_from_root(hand, joints, root if root != "" else "".join(named[:1]))
    return ForeignGrasps(joints, poses, None)


def _tell_unread(path: Path, content: dict[str, Field], hand: Hand) -> None:
    """Warn of fields of a MultiGripperGrasp file that are not read, and of another hand's name."""
    if others := sorted({*content} - {*GRIPPER_READ, *GRIPPER_KNOWN, *GRIPPER_TIMES}):
        warn_user(GraspFileWarning, f"{path.name}: not read: {', '.join(others)}")
    gripper = content["gripper"].value if "gripper" in content else None
    if not isinstance(gripper, str):
        return
    names = sorted((gripper.casefold(), hand.name.casefold()), key=len)
    if names[0] not in names[1]:
        told = f"{path.name}: grasps of the gripper {gripper}, read for the {hand.name} hand"
        warn_user(GraspFileWarning, told)


def _link_from_root(
    hand: Hand, joints: Float[Tensor, "g h"], root: str | Pose
) -> Float[Tensor, "*g 4 4"]:
    """Return the pose [m] of our root link in the frame `root` of a hand, given its joints [rad].

    Raises `ModelFileError` for the name of a link that the hand does not have.
    """
    if isinstance(root, Tensor):
        return root.double().cpu()
    if root == "":
        return torch.eye(4, dtype=torch.float64)
    links = hand.tree.link_names
    if root not in links:
        allowed = f"the pose of our root link in that one (--root), or one of {', '.join(links)}"
        raise _refuse(f"poses of the link {root}, which is none of ours", allowed)
    return inverse(hand.link_poses(joints)[:, links.index(root)])


def _read_isaac(path: Path, hand: Hand, unit_m: float, root: str | Pose) -> ForeignGrasps:
    """Return the grasps of an `isaac_grasp` file."""
    content = parse_isaac(path, hand, MOST_GRASPS, FAR, _refuse)
    joints = {
        name: read_posture(hand, values, name, _refuse) for name, values in content.postures.items()
    }
    # a path in the stage ends with the link's name
    named = content.gripper.rpartition("/")[2]
    link_from_root = _link_from_root(hand, joints["grasp"], root if root != "" else named)
    poses = read_poses(content.poses, "wxyz", unit_m) @ link_from_root
    return ForeignGrasps(joints["grasp"], poses, joints.get("pregrasp"))


def _read_own(
    fields: dict[str, Field], hand: Hand, unit_m: float, root: str | Pose
) -> ForeignGrasps:
    """Return the grasps of a file of `format_grasps`, given its fields."""
    _check_own(fields, unit_m)
    about = fields["hand"].entries() if "hand" in fields else {}
    if "name" in about and about["name"].text() != hand.name:
        raise about["name"].wrong(f"grasps of the {hand.name} hand, which is to read them")
    if root == "" and "root" in about:
        root = about["root"].text()
    renamed = fields["rename"].entries() if "rename" in fields else {}
    names = {x: renamed[x].text() if x in renamed else x for x in hand.tree.joint_names}
    needed = [names[x] for x in hand.joint_names]
    rows = fields["grasps"].items(MOST_GRASPS)
    postures: dict[str, list[dict[str, Field]]] = {"grasp": [], "pregrasp": []}
    poses = list[list[float]]()
    rises = list[list[float]]()
    for row in rows:
        content = row.entries("joints", "pose")
        found = content["joints"].entries(*postures)
        for name, taken in postures.items():
            taken.append(found[name].entries(*needed))
        place = content["pose"].entries("position", "quaternion_wxyz")
        position = place["position"].numbers(3, -FAR, FAR)
        turn = place["quaternion_wxyz"].numbers(4, -FAR, FAR)
        poses.append([*position, *turn])
        rises.append(content["rise"].numbers(3, -FAR, FAR) if "rise" in content else [0.0] * 3)
    joints = dict[str, Tensor]()
    for name, taken in postures.items():
        # a joint that some grasps lack is not compared
        given = [x for x, theirs in names.items() if all(theirs in row for row in taken)]
        values = {x: [row[names[x]].number(-FAR, FAR) for row in taken] for x in given}
        columns = {x: np.array(column, dtype=float) for x, column in values.items()}
        joints[name] = read_posture(hand, columns, name, _refuse)
    places = np.array(poses, dtype=float).reshape(-1, POSE_NUMBERS)
    table = _read_table(fields, np.array(rises), unit_m)
    placed = read_poses(places, "wxyz", unit_m) @ _link_from_root(hand, joints["grasp"], root)
    return ForeignGrasps(joints["grasp"], placed, joints["pregrasp"], table)


def _check_own(fields: dict[str, Field], unit_m: float) -> None:
    """Raise `ModelFileError` if a file says that it has another format, version or units than the
    files of `format_grasps`. Raise it for a `unit_m` that contradicts these units, too.
    """
    if "format" in fields and fields["format"].value != OWN_FORMAT:
        raise fields["format"].wrong(OWN_FORMAT)
    if "version" in fields:
        fields["version"].number(1.0, float(OWN_VERSION))
    units = fields["units"].entries() if "units" in fields else {}
    for name, unit in CONVENTIONS["units"].items():
        if name in units and units[name].value != unit:
            raise units[name].wrong(unit)
    if "length" in units and unit_m != 1.0:
        found = f"positions in units of {unit_m:g} m, in a file that names metres"
        raise units["length"].refuse(found, "the unit of the file, m")


def _read_table(fields: dict[str, Field], rises: np.ndarray, unit_m: float) -> Plane | None:
    """Return the table of a file of `format_grasps`, which raises opened hands; tell of `rises`
    (g, 3) without one. One unit of lengths is `unit_m` [m].
    """
    provenance = fields["provenance"].entries() if "provenance" in fields else {}
    text = provenance["table"].text() if "table" in provenance else "none"
    if text != "none":
        table = read_plane(text)
        edge = table.edge and Plane(table.edge.normal, unit_m * table.edge.offset)
        return Plane(table.normal, unit_m * table.offset, edge)
    if rises.any():
        warn_user(
            GraspFileWarning,
            "opened hands that the file raises start at the grasp's pose: it names no table",
        )
    return None


def _table(field: Field, width: int) -> np.ndarray:
    """Return a field as an array (n, width); raise an error for anything but a list of lists of
    numbers.
    """
    rows = [row.numbers(width, -FAR, FAR) for row in field.items(MOST_GRASPS)]
    return np.array(rows).reshape(-1, width)


def _read_bench(
    path: Path,
    hand: Hand,
    order: tuple[str, ...],
    quaternion: Quaternion,
    unit_m: float,
    root: str | Pose,
) -> ForeignGrasps:
    """Return the grasps of an .npz file in DexGraspBench's format: one grasp, or a line for each of
    several.
    """
    bench_from_root, known = bench_frame(hand)
    data = read_bounded(path, CLOUD_BYTES, BENCH_FILE, _refuse)
    order = order or _bench_joints(path, data, hand)
    # the signs of a hand whose frame is known are known, too
    columns = read_order(hand, order) if order else tuple(Column(x, turned=True) for x in known)
    if not columns:
        columns = read_order(hand, ())
    rows = _bench_tables(path, data, POSE_NUMBERS + len(columns))
    poses = dict[str, Tensor]()
    joints = dict[str, Tensor]()
    for name, table in rows.items():
        pose = table[:, :POSE_NUMBERS]
        poses[name] = read_poses(pose, quaternion, unit_m)
        if name == "obj_pose":
            _tell_turned_objects(pose, quaternion)
            continue
        if "obj_pose" not in rows:
            _tell_scattered_hands(pose, quaternion)
        values = read_columns(hand, columns, table[:, POSE_NUMBERS:], _refuse)
        joints[name] = read_posture(hand, values, name.removesuffix("_qpos"), _refuse)
    placed = {name: poses[name] @ bench_from_root for name in joints}
    if root != "":
        placed = {name: poses[name] @ _link_from_root(hand, joints[name], root) for name in joints}
    if "obj_pose" in poses:
        placed = {name: inverse(poses["obj_pose"]) @ pose for name, pose in placed.items()}
    opened = None
    if "pregrasp_qpos" in joints:
        wrist = inverse(placed["grasp_qpos"]) @ placed["pregrasp_qpos"]
        opened = _at_rest(hand, joints["pregrasp_qpos"], wrist)
    return ForeignGrasps(joints["grasp_qpos"], placed["grasp_qpos"], opened)


def _bench_joints(path: Path, data: bytes, hand: Hand) -> tuple[str, ...]:
    """Return the names of the joints in the order of the file's postures, () if it has none.

    Raises `ModelFileError` for names that are not those of the hand, as their order is then
    unknown.
    """
    try:
        names = parse_npz(data, (BENCH_NAMES,)).get(BENCH_NAMES)
    except Exception as error:  # zlib, zipfile and NumPy each raise their own
        raise _refuse(f"{path}: {error}", BENCH_FILE) from error
    if names is None:
        return ()
    found = tuple(str(name) for name in names.ravel()[:MOST_JOINTS])
    if names.dtype.kind != "U" or not {*hand.joint_names} <= {*found}:
        shown = f"{path}: {BENCH_NAMES} {' '.join(found)[:MOST_SHOWN]}"
        raise _refuse(shown, "the joints of our hand in this order: give them with --joints")
    return found


def _bench_tables(path: Path, data: bytes, width: int) -> dict[str, np.ndarray]:
    """Return the tables (g, `width`) of grasps in an .npz file of DexGraspBench, and its `obj_pose`
    (1 or g, 7), by name.

    `data` are the bytes of the file.
    """
    try:
        tables = parse_npz(data, BENCH_READ, "grasp_qpos")
        others = unread_arrays(data, (*BENCH_READ, *BENCH_KNOWN))
    except Exception as error:  # zlib, zipfile and NumPy each raise their own
        raise _refuse(f"{path}: {error}", BENCH_FILE) from error
    if others:
        warn_user(GraspFileWarning, f"{path.name}: not read: {', '.join(others)}")
    for name, table in tables.items():
        wanted = POSE_NUMBERS if name == "obj_pose" else width
        kinds = "fiu" if name == "obj_pose" else "f"
        good = table.dtype.kind in kinds and table.ndim in (1, 2) and table.shape[-1] == wanted
        if not good or table.size > MOST_GRASPS * wanted or not np.isfinite(table).all():
            found = f"{path}: {name} of shape {table.shape}, {table.dtype}"
            joints = f", {width - POSE_NUMBERS} joints" * (name != "obj_pose")
            raise _refuse(found, f"finite numbers (g, {wanted}): seven of the pose{joints}")
    rows = {
        name: table.reshape(-1, table.shape[-1]).astype(float) for name, table in tables.items()
    }
    counts = {name: len(table) for name, table in rows.items()}
    if counts.get("obj_pose") == 1:
        del counts["obj_pose"]
    if len(set(counts.values())) != 1:
        found = ", ".join(f"{count} of {name}" for name, count in counts.items())
        raise _refuse(f"{path}: {found}", "as many of either")
    return rows


def _at_rest(
    hand: Hand, joints: Float[Tensor, "g h"], wrist: Float[Tensor, "g 4 4"]
) -> Float[Tensor, "g h"]:
    """Return joints [rad] of opened hands at the grasp's pose. Their fingertips are where `joints`
    have them at the pose `wrist` [m] in the grasp's frame of the hand.

    Where fingers do not reach, they come as near as they can, and a warning says so.
    """
    still = (wrist - torch.eye(4, dtype=wrist.dtype)).abs().amax((1, 2)) < POSTURE.rounding
    tips = apply(wrist, hand.fingertips(joints)[0])
    inside = joints.clamp(hand.lower, hand.upper)
    reached, left = reach_tips(hand, inside, tips)
    far = (left > POSTURE.same_tip) & ~still
    if far.any():
        rows = flatnonzero(far).tolist()
        warn_user(
            GraspFileWarning,
            f"pregrasp of {len(rows)} of {len(joints)} grasps, the first {rows[0]}: the wrist "
            "moves to the grasp, ours does not. Fingertips are up to "
            f"{1000 * float(left.max()):.1f} mm off the file's",
        )
    return torch.where(still[:, None], joints, reached)


def read_poses(
    numbers: np.ndarray, quaternion: Quaternion, unit_m: float = 1.0
) -> Float[Tensor, "g 4 4"]:
    """Return the rigid transforms (g, 4, 4) [m] that `numbers` (g, 7) describe. Each row holds a
    position, then a unit quaternion in the order `quaternion`, "wxyz" or "xyzw".

    One unit of the positions is `unit_m` [m].

    Raises `ModelFileError` for a quaternion that is not of length 1.
    """
    lengths = np.linalg.norm(numbers[:, 3:], axis=1)
    far = np.abs(lengths - 1) > ROUNDING
    if far.any():
        length = float(lengths[far][0])
        found = f"pose {int(np.argmax(far))} with a quaternion of length {length:.4g}"
        raise _refuse(found, "length 1")
    return rigid(
        torch.tensor(_matrices(numbers, quaternion)), torch.tensor(unit_m * numbers[:, :3])
    )


def _matrices(numbers: np.ndarray, quaternion: Quaternion) -> Float[np.ndarray, "g 3 3"]:
    """Return the rotations of poses (g, 7), whose quaternions have an order."""
    if not len(numbers):
        return np.zeros((0, 3, 3))
    first = quaternion == "wxyz"
    return spatial.transform.Rotation.from_quat(numbers[:, 3:], scalar_first=first).as_matrix()


def _other(quaternion: Quaternion) -> Quaternion:
    """Return the other order of a quaternion."""
    return "wxyz" if quaternion == "xyzw" else "xyzw"


def _tell_turned_objects(numbers: np.ndarray, quaternion: Quaternion) -> None:
    """Warn of objects' poses (g, 7) that are all half turns, and no turns if their quaternions have
    the other order.
    """
    other = _other(quaternion)
    still = np.abs(numbers[:, 3 if other == "wxyz" else 6]) > 1 - ROUNDING
    if len(still) and still.all():
        _warn_of_order(quaternion, "half turns", "no turns")


def _tell_scattered_hands(numbers: np.ndarray, quaternion: Quaternion) -> None:
    """Warn if hands' poses (g, 7) seem to have another order of quaternions. In it alone the
    object, which is at the origin, is on one side of the hand.
    """
    if len(numbers) < ORDER.grasps or _one_side(numbers, quaternion) >= ORDER.any_side:
        return
    if _one_side(numbers, _other(quaternion)) > ORDER.one_side:
        place = "with the object's origin on"
        _warn_of_order(quaternion, f"hands {place} any side", f"hands {place} one side")


def _warn_of_order(quaternion: Quaternion, found: str, otherwise: str) -> None:
    """Warn that quaternions are `found` in their order, and what they are in the other one."""
    other = _other(quaternion)
    text = f"quaternions as {quaternion} are {found}, and {otherwise} as {other}"
    warn_user(GraspFileWarning, f"{text}: if they are {other}, say so (--quaternion {other})")


def _one_side(numbers: np.ndarray, quaternion: Quaternion) -> float:
    """Return how alike the direction of the origin is in the frames of hands, from 0 to 1.

    `numbers` are their poses (g, 7).
    """
    away = numbers[:, :3] / np.linalg.norm(numbers[:, :3], axis=1, keepdims=True).clip(LEAST)
    inside = np.einsum("gij,gi->gj", _matrices(numbers, quaternion), away)
    return float(np.linalg.norm(inside.mean(0))) if len(inside) else 0.0


def check_places(grasps: Grasps) -> None:
    """Raise `BadArgument` for hands far from the origin, or a table that the contacts cannot have.

    A hand may be up to 10 m (`FARTHEST`) from the origin. A table may be up to 2 m
    (`FARTHEST_TABLE`) below all contacts. Some contacts may be below the table, beyond its edge.
    """
    if not len(grasps):
        return
    away = float(norm(grasps.obj_from_hand[:, :3, 3]).amax())
    if away > FARTHEST:
        found = f"a hand {away:.4g} m from the object's origin"
        raise BadArgument("obj_from_hand", found, f"poses within {FARTHEST:g} m, in metres")
    if grasps.table is None:
        return
    height = grasps.table.height(grasps.contacts.points)
    if float(height.amax()) <= 0 or float(height.amin()) > FARTHEST_TABLE:
        found = f"one with all contacts {float(height.amin()):.4g} to {float(height.amax()):.4g} m"
        allowed = "the table under the object, in the object's frame, in metres, its normal upward"
        raise BadArgument("table", f"{found} above it", allowed)


@checked
def grasps_from_joints(
    hand: Hand,
    joints: Float[Tensor, "g h"],
    obj_from_hand: Poses,
    pregrasp: Float[Tensor, "g h"] | None = None,
    table: Plane | None = None,
    spec: ContactSpec | None = None,
    std_m: SmallLength | None = None,
) -> Grasps:
    """Return imported joints and poses as `Grasps`, for `certify`, `close_hand` and the exporters.

    Since no object is known, each contact is the contact point of a fingertip's pad, the part that
    touches objects. Its normal is opposite to the pad's normal. Certificates are for these
    contacts. A grasp gets `Status.NOT_CLOSED` without frictional form closure: its contacts cannot
    resist every load. Replace contacts and certificate if you know the surface.

    `clearance` is that between links alone, and the predicted success is unknown (NaN). `approach`
    is the hand's approach axis.

    Args:
        hand: the hand.
        joints: positions (g, h) [rad or m] of the actuated joints, in the order of
            `hand.joint_names`.
        obj_from_hand: poses (g, 4, 4) [m] of the hand's root link in the object's frame.
        pregrasp: positions (g, h) [rad or m] of the opened hand's joints. None means that each tip
            moves 20 mm off its contact, or as far as limits allow.
        table: the table under the object, in the object's frame; the opened hand stays above it.
            None means that there is no table, or that it is unknown.
        spec: friction and number of cone edges of the certificate; None means `ContactSpec()`.
        std_m: standard deviation [m] of the surface at each contact, 0 to 0.1, for closing modes
            that use it. None means unknown.

    Raises `BadArgument` for wrong shapes, joints outside their limits, or poses that are not rigid.
    It is raised for a hand more than 10 m (`FARTHEST`) from the origin, which is in millimetres. It
    is also raised for a table above all contacts, or more than 2 m (`FARTHEST_TABLE`) below them.

    >>> from torchgrasp import load_hand
    >>> hand = load_hand("barrett")
    >>> joints = torch.tensor([[0.0, 1.2, 1.2, 1.2]], dtype=torch.float64)
    >>> pose = torch.eye(4, dtype=torch.float64)[None]
    >>> grasps_from_joints(hand, joints, pose).contacts.points.shape
    torch.Size([1, 3, 3])
    """
    grasps = place_joints(hand, joints, obj_from_hand, pregrasp, table, spec, std_m)
    check_places(grasps)
    return grasps


@checked
def place_joints(
    hand: Hand,
    joints: Float[Tensor, "g h"],
    obj_from_hand: Poses,
    pregrasp: Float[Tensor, "g h"] | None = None,
    table: Plane | None = None,
    spec: ContactSpec | None = None,
    std_m: SmallLength | None = None,
) -> Grasps:
    """Return the result of `grasps_from_joints`, wherever hands and table are.

    So a command can tell with which unit or quaternion they would be at the object.
    """
    hand = hand.to("cpu", torch.float64)
    # copies: the caller may read the next grasp into the same memory
    joints = joints.to("cpu", torch.float64, copy=True)
    pose = obj_from_hand.to("cpu", torch.float64, copy=True)
    hand.check_joints(joints)
    pads, pad_normals = hand.fingertips(joints)
    normals = -rotate(pose, pad_normals)
    std = None if std_m is None else torch.full_like(normals[..., 0], std_m)
    contacts = Contacts(apply(pose, pads), normals, std_m=std)
    certificate = certify(contacts, spec)
    if pregrasp is None:
        opened = _open(hand, joints, -pad_normals)
    else:
        opened = hand.check_joints(pregrasp.to("cpu", torch.float64, copy=True))
    g, f = normals.shape[:2]
    zeros = torch.zeros(g, f, dtype=torch.float64)
    meta = {"hand": hand.name, "hand_sha256": hand.source.sha256, "units": "metre, radian"}
    meta |= {"joint_names": ",".join(hand.joint_names), "finger_names": ",".join(hand.finger_names)}
    if table is not None:
        meta["table"] = table.describe()
    return Grasps(
        joints,
        opened,
        rotate(pose, hand.approach.expand(g, 1, 3))[:, 0],
        pose,
        contacts,
        permutation=torch.arange(f).expand(g, f).clone(),
        tip_error=zeros,
        clearance=hand.self_clearance(joints),
        normal_angle=zeros,
        certificate=certificate,
        score=torch.zeros(g, dtype=torch.float64),
        status=torch.where(certificate.closed, int(Status.OK), int(Status.NOT_CLOSED)),
        meta=meta,
        known=torch.zeros(g, dtype=torch.bool),
        interval=torch.tensor([[0.0, 1.0]], dtype=torch.float64).repeat(g, 1),
    )


def _open(
    hand: Hand, joints: Float[Tensor, "g h"], away: Float[Tensor, "g f 3"]
) -> Float[Tensor, "g h"]:
    """Return joints [rad] at which each fingertip has moved 20 mm off its contact along `away`, if
    joint limits allow.
    """
    for _ in range(OPENING_STEPS):
        jacobian = hand.jacobian(joints).flatten(1, 2)  # (g, 3 f, h)
        step = damped_inverse(jacobian) @ (OPENED / OPENING_STEPS * away).flatten(1)[..., None]
        joints = (joints + step[..., 0]).clamp(hand.lower, hand.upper)
    return joints
