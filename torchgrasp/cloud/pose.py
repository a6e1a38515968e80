"""The pose of a depth camera: read, rigid, and not contradicted by what the camera sees."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.checks import RIGID, check_tensor, is_rigid
from torchgrasp.cloud.tables import parse_npy, read_lines, read_suffixed
from torchgrasp.errors import BadArgument


def check_rigid(name: str, pose: Tensor) -> Float[Tensor, "4 4"]:
    """Return a transform that is rigid to 1e-4; refuse others, and say what they are."""
    fixes = {(3, 4): "add the row 0 0 0 1", (16,): "reshape it to 4 x 4", (7,): "make a matrix of the quaternion"}
    if tuple(pose.shape) in fixes:
        raise BadArgument(name, f"shape {tuple(pose.shape)}", f"a 4 x 4 matrix: {fixes[tuple(pose.shape)]}")
    check_tensor(name, pose, (4, 4))
    if not bool(is_rigid(pose)):
        raise BadArgument(name, f"{pose.tolist()}{_describe_fault(pose.double())}", RIGID)
    return pose


def _describe_fault(pose: Float[Tensor, "4 4"]) -> str:
    """Say why a matrix is no rigid transform, and what mends it."""
    if bool(pose[3, :3].any()) and not bool(pose[:3, 3].any()):
        return ", a transposed pose: give its transpose"
    length, side = torch.linalg.vector_norm(pose[:3, :3], dim=0), torch.linalg.det(pose[:3, :3])
    if not bool((length > 0).all()) or pose[3].tolist() != [0, 0, 0, 1]:
        return ""
    axes = pose[:3, :3] / length
    error = float((axes.T @ axes - torch.eye(3).to(axes)).abs().max())
    if float(side) < 0:
        return ", a mirrored rotation: its axes are left-handed"
    if error < 1e-4 and float(length.max() / length.min()) < 1.0001:
        return f", a rotation times {float(length[0]):.4g}: divide it by its scale"
    return f", axes of length {length.tolist()} that are {error:.2g} from orthogonal: take U @ Vh of its SVD"


def read_camera_pose(pose: Tensor | np.ndarray) -> Float[Tensor, "4 4"]:
    """Return the pose of a camera in float64; refuse a pose that is not rigid or of another unit."""
    try:
        read = check_rigid("camera_pose", torch.as_tensor(pose).double())
    except (TypeError, ValueError) as error:
        raise BadArgument("camera_pose", repr(pose)[:80], "a 4 x 4 matrix of numbers") from error
    check_distance(read, float(torch.linalg.vector_norm(read[:3, 3])), 100.0, "the camera")
    return read


def check_distance(pose: Float[Tensor, "4 4"], distance: float, most: float, what: str) -> None:
    """Refuse a pose in another unit, by a distance [m] from the frame's origin."""
    if abs(distance) > most:
        factor = 1000 if float(pose[:3, 3].abs().max()) > 200 else 100
        allowed = f"a pose in metres; in {'mm' if factor == 1000 else 'cm'}, divide camera_pose[:3, 3] by {factor}"
        raise BadArgument("camera_pose", f"{what} {distance:.4g} m from the origin", allowed)


def read_pose(name: str, path: Path | str) -> Float[Tensor, "4 4"]:
    """Return the rigid transform in a file: .npy, or .txt with four rows of four numbers.

    Raises:
        BadArgument: no such file, another suffix, malformed content, or no rigid transform.
    """
    data, suffix = read_suffixed(name, path, (".npy", ".txt"))
    try:
        table = parse_npy(data) if suffix == ".npy" else read_lines(data)
        pose = torch.from_numpy(np.array(table, dtype=np.float64))
    except Exception as error:
        raise BadArgument(name, f"{path}: {error!r}", f"a well-formed {suffix} file of 4 x 4 numbers") from error
    return check_rigid(name, pose)
