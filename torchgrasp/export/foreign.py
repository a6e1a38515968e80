"""Import of grasps from other planners and from our own JSON, as `Grasps`.

DexGraspBench's .npy is a pickle, which could run code when it is read, so it is rejected.
docs/exchange.md converts it.
"""

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.safe_files import parse_npz
from torchgrasp.contacts.certify import certify
from torchgrasp.control.law import damped_inverse
from torchgrasp.export.other_formats import bench_frame
from torchgrasp.files import Field, is_file, read_bytes, read_json
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, ModelFileError, Status
from torchgrasp.foundation.lazy import spatial
from torchgrasp.foundation.limits import CLOUD_BYTES
from torchgrasp.foundation.rules import Length, Poses
from torchgrasp.geometry.frames import apply, rigid, rotate
from torchgrasp.hand.hand import Hand
from torchgrasp.values.planning import Contacts, Grasps
from torchgrasp.values.specs import ContactSpec

MOST_GRASPS = 100_000  # most grasps of a file: more are no plan of one object
FAR = 10_000.0  # largest number of a pose or posture [mm, rad] in a JSON file
ROUNDING = 1e-3  # largest error of a quaternion's length: that of a file of few digits
# distance [m] of opened fingertips from their contacts, and linear steps, which reach it to 1 mm
OPENED = 0.02
OPENING_STEPS = 4
_refuse = functools.partial(ModelFileError, "path")  # the error of a bad file of grasps
Quaternion = Literal["wxyz", "xyzw"]


class ForeignGrasps(NamedTuple):
    """Imported grasps of a hand, g in number.

    `joints` [rad] are the actuated joints, in the order of `hand.joint_names`. `obj_from_hand` [m]
    are the poses of the hand's root link in the object's frame. `pregrasp` [rad] are the joints of
    the opened hand, or None if the file has none.
    """

    joints: Float[Tensor, "g h"]
    obj_from_hand: Float[Tensor, "g 4 4"]
    pregrasp: Float[Tensor, "g h"] | None


@checked
def read_foreign(
    path: Path | str, hand: Hand, order: Sequence[str] = (), quaternion: Quaternion = "wxyz"
) -> ForeignGrasps:
    """Return joints and poses of grasps from the file of another program, or from our own JSON.

    | file | what is read |
    | --- | --- |
    | `.json` of `format_grasps` | joints by name, pose, pre-grasp |
    | `.json` with `pose` and `dofs` (MultiGripperGrasp) | lists of 7 numbers, joints in `order` |
    | `.npz` with `grasp_qpos` (DexGraspBench) | lines of pose and joints; `pregrasp_qpos`, if any |

    Args:
        path: the file. Its lengths are in metres, its angles in radians.
        hand: the grasping hand. For the Allegro hand DexGraspBench's frame and joint order are
            known.
        order: names (as in the hand's URDF) of the joints in the file; other names are ignored.
        quaternion: order of the four numbers after the position in a pose.

    Raises `ModelFileError` for a missing or malformed file, and `BadArgument` for an order that
    misses a joint.

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
    if path.suffix.lower() == ".npz":
        return _read_bench(path, hand, tuple(order), quaternion)
    file = read_json(path, _refuse, "a JSON file of grasps, or .npz")
    fields = file.entries()
    if "grasps" in fields:
        renamed = fields["rename"].entries() if "rename" in fields else {}
        names = [renamed[x].text() if x in renamed else x for x in hand.joint_names]
        return _read_own(fields["grasps"], hand, names)
    content = file.entries("pose", "dofs")
    places = _places(hand, tuple(order))
    pose = _table(content["pose"], 7)
    dofs = _table(content["dofs"], len(order))
    if len(pose) != len(dofs):
        raise _refuse(f"{path}: {len(pose)} poses, {len(dofs)} postures", "as many of either")
    return ForeignGrasps(torch.tensor(dofs[:, places]), read_poses(pose, quaternion), None)


def _read_own(rows: Field, hand: Hand, names: list[str]) -> ForeignGrasps:
    """Return the grasps of a file of `format_grasps`, whose actuated joints have `names`."""
    joints = list[list[float]]()
    opened = list[list[float]]()
    poses = list[list[float]]()
    for row in rows.items(MOST_GRASPS):
        fields = row.entries("joints", "pose")
        postures = fields["joints"].entries("grasp", "pregrasp")
        pose = fields["pose"]
        for name, values in (("grasp", joints), ("pregrasp", opened)):
            posture = postures[name].entries(*names)
            values.append([posture[joint].number(-FAR, FAR) for joint in names])
        place = pose.entries("position", "quaternion_wxyz")
        position = place["position"].numbers(3, -FAR, FAR)
        turn = place["quaternion_wxyz"].numbers(4, -FAR, FAR)
        poses.append([*position, *turn])
    closed = torch.tensor(joints, dtype=torch.float64).reshape(-1, hand.dof)
    pregrasp = torch.tensor(opened, dtype=torch.float64).reshape(-1, hand.dof)
    places = np.array(poses, dtype=float).reshape(-1, 7)
    return ForeignGrasps(closed, read_poses(places, "wxyz"), pregrasp)


def _table(field: Field, width: int) -> np.ndarray:
    """Return a field as an array (n, width); raise an error for anything but a list of lists of
    numbers.
    """
    rows = [row.numbers(width, -FAR, FAR) for row in field.items(MOST_GRASPS)]
    return np.array(rows).reshape(-1, width)


def _read_bench(
    path: Path, hand: Hand, order: tuple[str, ...], quaternion: Quaternion
) -> ForeignGrasps:
    """Return the grasps of an .npz file in DexGraspBench's format: one grasp, or a line for each of
    several.
    """
    bench_from_root, known = bench_frame(hand)
    order = order or known
    places = _places(hand, order)
    width = 7 + len(order)
    try:
        if not is_file(path) or path.stat().st_size > CLOUD_BYTES:
            raise ValueError("no file, or a larger one")
        tables = parse_npz(read_bytes(path), ("grasp_qpos", "pregrasp_qpos"), "grasp_qpos")
    except Exception as error:  # zlib, zipfile and NumPy each raise their own
        raise _refuse(f"{path}: {error}", "an .npz of at most 512 MiB with 'grasp_qpos'") from error
    for name, table in tables.items():
        good = table.dtype.kind == "f" and table.ndim in (1, 2) and table.shape[-1] == width
        if not good or table.size > MOST_GRASPS * width or not np.isfinite(table).all():
            found = f"{path}: {name} of shape {table.shape}, {table.dtype}"
            allowed = f"finite numbers (g, {width}): seven of the pose, {len(order)} joints"
            raise _refuse(found, allowed)
    rows = {name: table.reshape(-1, width).astype(float) for name, table in tables.items()}
    if len({len(table) for table in rows.values()}) != 1:
        counts = ", ".join(f"{len(x)} of {name}" for name, x in rows.items())
        raise _refuse(f"{path}: {counts}", "as many of either")
    grasp = rows["grasp_qpos"]
    joints = {name: torch.tensor(x[:, 7:][:, places]) for name, x in rows.items()}
    poses = read_poses(grasp[:, :7], quaternion) @ bench_from_root
    return ForeignGrasps(joints["grasp_qpos"], poses, joints.get("pregrasp_qpos"))


def _places(hand: Hand, order: tuple[str, ...]) -> list[int]:
    """Return the index in a file's joint `order` of each actuated joint; refuse an order that lacks
    one.
    """
    missing = [name for name in hand.joint_names if name not in order]
    if missing or len(set(order)) != len(order):
        found = "a name twice"
        if missing:
            found = f"{len(order)} names without {', '.join(missing[:4])}"
        raise BadArgument("order", found, f"each of {', '.join(hand.joint_names)} once")
    return [order.index(name) for name in hand.joint_names]


def read_poses(numbers: np.ndarray, quaternion: Quaternion) -> Float[Tensor, "g 4 4"]:
    """Return pose matrices [m] from `numbers` (g, 7): a position [m], then a unit quaternion in the
    given order.

    Raises `ModelFileError` for a quaternion that is not of length 1.
    """
    turns = numbers[:, 3:] if quaternion == "xyzw" else numbers[:, [4, 5, 6, 3]]
    far = np.abs(np.linalg.norm(turns, axis=1) - 1) > ROUNDING
    if far.any():
        length = float(np.linalg.norm(turns[far][0]))
        found = f"pose {int(np.argmax(far))} with a quaternion of length {length:.4g}"
        raise _refuse(found, "length 1")
    matrices = np.zeros((0, 3, 3))
    if len(turns):
        matrices = spatial.transform.Rotation.from_quat(turns).as_matrix()
    return rigid(torch.tensor(matrices), torch.tensor(numbers[:, :3]))


@checked
def grasps_from_joints(
    hand: Hand,
    joints: Float[Tensor, "g h"],
    obj_from_hand: Poses,
    pregrasp: Float[Tensor, "g h"] | None = None,
    spec: ContactSpec | None = None,
    std_m: Length | None = None,
) -> Grasps:
    """Return imported joints and poses as `Grasps`, for `certify`, `close_hand`, `evaluate` and the
    exporters.

    Contacts are at the middle of each pad, with normals opposite to the pads'. Certificates are for
    these contacts; a grasp without force closure gets `Status.NOT_CLOSED`. Replace contacts and
    certificate if you know the surface. `clearance` is that of self-collision, and success is
    unknown, because no object is known. The approach is the hand's own approach axis.

    Args:
        hand: the hand.
        joints: actuated joints [rad], in the order of `hand.joint_names`.
        obj_from_hand: poses [m] of the root link of the hand's URDF, in the object's frame.
        pregrasp: actuated joints [rad] of the opened hand; None means that each tip moves 20 mm off
            its contact, or as far as limits allow.
        spec: friction and number of cone edges of the certificate; None means `ContactSpec()`.
        std_m: standard deviation [m] of the surface at each contact, for closing controllers that
            use it; None if it is unknown.

    Raises `BadArgument` for wrong shapes, joints outside the limits, or poses that are not rigid.

    >>> from torchgrasp import load_hand
    >>> hand = load_hand("barrett")
    >>> joints = torch.tensor([[0.0, 1.2, 1.2, 1.2]], dtype=torch.float64)
    >>> pose = torch.eye(4, dtype=torch.float64)[None]
    >>> grasps_from_joints(hand, joints, pose).contacts.points.shape
    torch.Size([1, 3, 3])
    """
    hand = hand.to("cpu", torch.float64)
    joints = joints.double().cpu()
    pose = obj_from_hand.double().cpu()
    hand.check_joints(joints)
    pads, pad_normals = hand.fingertips(joints)
    normals = -rotate(pose, pad_normals)
    std = None if std_m is None else torch.full_like(normals[..., 0], std_m)
    contacts = Contacts(apply(pose, pads), normals, std_m=std)
    certificate = certify(contacts, spec)
    if pregrasp is None:
        opened = _open(hand, joints, -pad_normals)
    else:
        opened = hand.check_joints(pregrasp.double().cpu())
    g, f = normals.shape[:2]
    zeros = torch.zeros(g, f, dtype=torch.float64)
    meta = {"hand": hand.name, "hand_sha256": hand.source.sha256, "units": "metre, radian"}
    meta |= {"joint_names": ",".join(hand.joint_names), "finger_names": ",".join(hand.finger_names)}
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
        joints = torch.minimum(torch.maximum(joints + step[..., 0], hand.lower), hand.upper)
    return joints
