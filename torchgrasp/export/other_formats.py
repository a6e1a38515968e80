"""Export of grasps for DexGraspBench's evaluator and GraspGen's loader, and of surfaces as meshes.

DexGraspBench reads each grasp by NumPy's `load` with pickles allowed. The format exists only as a
pickle, and `save_dexgraspbench` is the one function of torchgrasp that writes one. No function of
torchgrasp reads a pickle.

Facts: https://github.com/JYChen18/DexGraspBench (README and src/util/hand_util.py) and
https://github.com/NVlabs/GraspGen (docs/GRASP_DATASET_FORMAT.md).
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.control.finger_forces import check_all_executable
from torchgrasp.export.postures import named_postures, quaternion
from torchgrasp.files import format_json, write_file
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.foundation.lazy import matplotlib, spatial, trimesh
from torchgrasp.foundation.rules import Force, Positive, check_suffix
from torchgrasp.geometry.frames import rigid, to_array
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.motion import opened_pose
from torchgrasp.shape.surface import Surface
from torchgrasp.values.planning import Grasps

# quantile of the standard deviations that is the largest colour, and its least value [m]
QUANTILE = 0.99
LEAST_STD = 1e-6
BRIGHTEST = 255  # of a colour channel
BENCH_HANDS = {"allegro": ([1.0, 0.0, 1.0, 0.0], tuple(f"joint_{k}" for k in range(16)))}
"""Hands that DexGraspBench has: rotation (x, y, z, w) of the root link in its hand frame, and
joints in its order.
"""


@checked
def save_dexgraspbench(
    hand: Hand,
    grasps: Grasps,
    folder: Path | str,
    object_path: str,
    force: Force = 4.0,
    kp: Positive = 5.0,
) -> list[Path]:
    """Write each grasp as a file for DexGraspBench's evaluator; return the paths of the files.

    The files are `folder/0.npy`, `folder/1.npy` and so on. A file is a pickled dictionary, because
    the evaluator accepts nothing else. It holds only arrays, numbers and a text: `obj_path`,
    `obj_scale` (1), `obj_pose` (identity), `pregrasp_qpos`, `grasp_qpos` and `squeeze_qpos`. Each
    `qpos` has 23 numbers: position [m] and quaternion (w, x, y, z) of the hand, then 16 joints
    [rad]. The joints of the squeeze are targets with which the fingers press.

    Args:
        hand: the Allegro hand, whose model DexGraspBench has.
        grasps: grasps planned for this hand.
        folder: folder to write: in DexGraspBench `output/NAME_allegro/graspdata/OBJECT`.
        object_path: the object's folder in DexGraspBench (`assets/...`). Its frame must be the
            frame of the planned cloud.
        force: normal force [N] of the strongest finger in the squeeze.
        kp: stiffness [N m/rad] of DexGraspBench's drives.

    Raises:
        BadArgument: the hand is not the Allegro hand, joints are of another hand, or grasps failed
            a check.
        OutputError: a file cannot be written.

    >>> import tempfile
    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> hand, grasp = load_hand("allegro"), load_shipped_grasp("jug", "allegro")
    >>> files = save_dexgraspbench(hand, grasp, tempfile.mkdtemp(), "assets/object/jug")
    >>> [file.name for file in files]
    ['0.npy']
    """
    bench_from_root, order = bench_frame(hand)
    if not order:
        known = f"one of {', '.join(BENCH_HANDS)}, whose frames in the bench are known"
        raise BadArgument("hand", repr(hand.name), known)
    check_all_executable(grasps)
    _, postures = named_postures(hand, grasps, force, kp)
    paths = list[Path]()
    closed = grasps.obj_from_hand.double().cpu()
    opened = opened_pose(hand.to("cpu"), grasps.pregrasp.cpu(), closed, grasps.table)
    for row in range(len(grasps)):
        content: dict[str, Any] = {"obj_path": object_path, "obj_scale": 1.0}
        content["obj_pose"] = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        for name, joints in postures.items():
            obj_from_hand = opened if name == "pregrasp" else closed
            obj_from_bench = obj_from_hand[row] @ bench_from_root.mT
            place = [*obj_from_bench[:3, 3].tolist(), *quaternion(obj_from_bench)]
            posture = [float(joints[joint][row]) for joint in order]
            content[f"{name}_qpos"] = np.array([*place, *posture])
        path = Path(folder) / f"{row}.npy"
        paths.append(write_file(path, lambda file, x=content: np.save(file, np.array(x))))
    return paths


@checked
def format_graspgen(grasps: Grasps, object_path: str) -> str:
    """Return grasps as the JSON text of a GraspGen data set.

    `transforms` [m] are poses of the hand's root link in the object's frame. `object_in_gripper`
    says which grasps are executable: they passed all checks. The fields `success` (predicted
    probability, null if unknown), `joints` [rad or m] and `joint_names` are additions of
    torchgrasp; `joint_names` is empty if `meta` of the grasps has none.

    Args:
        grasps: grasps, executable or not.
        object_path: path of the mesh in the data set. Its frame is the frame of the planned cloud,
            its scale 1.

    Raises `BadArgument` if `meta` of the grasps names more or fewer joints.

    >>> import json
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> text = format_graspgen(load_shipped_grasp("jug", "barrett"), "meshes/jug.obj")
    >>> json.loads(text)["object"]
    {'file': 'meshes/jug.obj', 'scale': 1.0}
    """
    rows = {
        "transforms": grasps.obj_from_hand.tolist(),
        "object_in_gripper": (grasps.status == Status.OK).tolist(),
        "success": grasps.success.tolist(),
        "joints": grasps.joints.tolist(),
    }
    named = grasps.meta.get("joint_names", "")
    joint_names = named.split(",") if named else []
    if named and len(joint_names) != grasps.joints.shape[-1]:
        found = f"{grasps.joints.shape[-1]} joints, of the names {named}"
        raise BadArgument("grasps", found, "a name for each joint, as plan_grasps writes")
    return format_json(
        {"object": {"file": object_path, "scale": 1.0}, "joint_names": joint_names, "grasps": rows}
    )


def bench_frame(hand: Hand) -> tuple[Float[Tensor, "4 4"], tuple[str, ...]]:
    """Return (pose, names) for DexGraspBench, which has a hand frame and a joint order of its own.

    The pose (4, 4) [m] is that of the hand's root link in DexGraspBench's hand frame. The names are
    those of the joints in its order. For a hand that DexGraspBench does not have, they are the
    identity and ().
    """
    turn, order = BENCH_HANDS.get(hand.name, ([0.0, 0.0, 0.0, 1.0], ()))
    rotation = torch.from_numpy(spatial.transform.Rotation.from_quat(turn).as_matrix())
    return rigid(rotation, torch.zeros_like(rotation[0])), order


@checked
def save_surface(surface: Surface, path: Path | str) -> Path:
    """Write an estimated surface, coloured by its uncertainty, as a .ply or .glb file; return the
    path.

    Violet marks a standard deviation of 0, yellow one of `largest_std(surface)` or more. A .ply
    file also has `std_m` [m] of each vertex.

    Args:
        surface: the surface, as `extract_surface` returns it.
        path: the file to write; its suffix selects the format.

    Raises `BadArgument` for another suffix, and `OutputError` if the file cannot be written.

    >>> import tempfile
    >>> from torchgrasp import fit_shape, load_object
    >>> from torchgrasp.shape import extract_surface
    >>> surface = extract_surface(fit_shape(load_object("jug").view), 24)
    >>> save_surface(surface, Path(tempfile.mkdtemp(), "jug.ply")).stat().st_size > 10_000
    True
    """
    path = check_surface_path(path)
    std = to_array(surface.std_m)
    shares = np.clip(std / largest_std(surface), 0.0, 1.0)
    # as in the report
    colors = BRIGHTEST * matplotlib.colormaps["viridis"](shares) + 0.5
    mesh = trimesh.Trimesh(
        to_array(surface.vertices),
        surface.faces.cpu().numpy(),
        vertex_normals=to_array(surface.normals),
        vertex_colors=colors.astype(np.uint8),
        process=False,
    )
    if path.suffix.lower() == ".ply":
        mesh.vertex_attributes["std_m"] = std.astype(np.float32)
    content = mesh.export(file_type=path.suffix.lower()[1:])
    assert isinstance(content, bytes)
    return write_file(path, content)


@checked
def largest_std(surface: Surface) -> float:
    """Return the standard deviation [m] at the upper end of the colour scale of `save_surface`.

    It is the 99 % quantile over the vertices of the surface, at least 1e-6 m. Reports use it, too.

    >>> from torchgrasp import fit_shape, load_object
    >>> from torchgrasp.shape import extract_surface
    >>> surface = extract_surface(fit_shape(load_object("jug").view), 24)
    >>> 0.001 < largest_std(surface) < 0.05
    True
    """
    std = surface.std_m.double()
    return max(float(std.quantile(QUANTILE)), LEAST_STD) if len(std) else LEAST_STD


@checked
def check_surface_path(path: Path | str) -> Path:
    """Return the path if it ends in .ply or .glb, as `save_surface` needs; else raise
    `BadArgument`.

    >>> check_surface_path("a.glb").suffix
    '.glb'
    """
    path = Path(path)
    check_suffix("path", path, ".ply", ".glb")
    return path
