"""Reading of a depth camera's pose, and checks that the pose is rigid and fits the camera's view."""

import contextlib
import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.safe_files import parse_npy, read_suffixed
from torchgrasp.files import explain
from torchgrasp.files.columns import read_lines
from torchgrasp.foundation.checks import check_tensor
from torchgrasp.foundation.errors import BadArgument, NoSupport
from torchgrasp.foundation.rules import RIGID, is_rigid
from torchgrasp.geometry.linalg import Points, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.support_planes import SupportPlane, find_table

UNIT = "depth in metres: depth_unit (--depth-unit) says how many metres a count is"


def check_rigid(name: str, pose: Tensor) -> Float[Tensor, "4 4"]:
    """Return the given pose if it is rigid to 1e-4; else raise `BadArgument`, which names the
    fault.
    """
    fixes = {
        (3, 4): "add the row 0 0 0 1",
        (16,): "reshape it to 4 x 4",
        (7,): "make a matrix of the quaternion",
    }
    if tuple(pose.shape) in fixes:
        raise BadArgument(
            name, f"shape {tuple(pose.shape)}", f"a 4 x 4 matrix: {fixes[tuple(pose.shape)]}"
        )
    check_tensor(name, pose, (4, 4))
    if not bool(is_rigid(pose)):
        raise BadArgument(name, f"{pose.tolist()}{_describe_fault(pose.double())}", RIGID)
    return pose


def _describe_fault(pose: Float[Tensor, "4 4"]) -> str:
    """Return, as the end of a sentence, why a matrix is no rigid transform, and the fix."""
    if bool(pose[3, :3].any()) and not bool(pose[:3, 3].any()):
        return ", a transposed pose: give its transpose"
    length = torch.linalg.vector_norm(pose[:3, :3], dim=0)
    side = torch.linalg.det(pose[:3, :3])
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
        read = torch.as_tensor(pose).double()
    except (TypeError, ValueError) as error:
        raise BadArgument("camera_pose", repr(pose)[:80], "a 4 x 4 matrix of numbers") from error
    read = check_rigid("camera_pose", read)
    check_distance(read, float(torch.linalg.vector_norm(read[:3, 3])), 100.0, "the camera")
    return read


def check_distance(pose: Float[Tensor, "4 4"], distance: float, most: float, what: str) -> None:
    """Refuse a pose as not in metres if `what`, such as the camera, is over `most` [m] from the
    frame's origin.
    """
    if abs(distance) > most:
        factor = 1000 if float(pose[:3, 3].abs().max()) > 200 else 100
        allowed = f"a pose in metres; in {'mm' if factor == 1000 else 'cm'}, divide camera_pose[:3, 3] by {factor}"
        raise BadArgument("camera_pose", f"{what} {distance:.4g} m from the origin", allowed)


def read_pose(name: str, path: Path | str) -> Float[Tensor, "4 4"]:
    """Return the rigid transform in a .npy file, or in a .txt file with four rows of four numbers."""
    data, suffix = read_suffixed(name, path, (".npy", ".txt"))
    try:
        table = parse_npy(data) if suffix == ".npy" else read_lines(data)
        pose = torch.from_numpy(np.array(table, dtype=np.float64))
    except Exception as error:
        raise BadArgument(
            name, f"{path}: {explain(error)}", f"a well-formed {suffix} file of 4 x 4 numbers"
        ) from error
    return check_rigid(name, pose)


def find_plausible(
    points: Points,
    pose: Float[Tensor, "4 4"],
    table: Plane | float | None,
    up: object,
    known_unit: bool,
) -> tuple[SupportPlane, ...]:
    """Return the planes on which objects may stand; refuse a pose or a depth unit that contradicts
    the view.
    """
    eye = pose[:3, 3]
    try:
        supports = find_table(points, eye, table, up)
    except NoSupport:
        middle = float(((points - eye) @ pose[:3, 2]).median())
        if table is None and not 0.15 < middle < 4.0:
            raise BadArgument(
                "depth", f"a median depth of {middle:.3g} m, and no table", UNIT
            ) from None
        if up is not None and table is None and not _is_own(pose):
            with contextlib.suppress(NoSupport):
                _check_normals(find_table(points, eye, None, None), pose, up)
        raise
    if table is None:
        _check_supports(supports, pose, up, known_unit)
    else:
        _check_given_table(points, supports[0].plane)
    return supports


def check_view(points: Points, pose: Float[Tensor, "4 4"], up: object, known_unit: bool) -> None:
    """Raise `BadArgument` if a table in the view contradicts the camera's pose or the unit of the
    depth.
    """
    with contextlib.suppress(NoSupport):
        _check_supports(find_table(points, pose[:3, 3], None, None), pose, up, known_unit)


def _is_own(pose: Float[Tensor, "4 4"]) -> bool:
    """Return whether a pose is nearly the identity, so that the frame is the camera's, where z need
    not be up.
    """
    return (
        float(torch.diagonal(pose[:3, :3]).min()) > 0.985
        and float(torch.linalg.vector_norm(pose[:3, 3])) < 0.1
    )


def _check_supports(
    supports: tuple[SupportPlane, ...], pose: Float[Tensor, "4 4"], up: object, known_unit: bool
) -> None:
    """Refuse a pose that contradicts the planes on which objects stand, or a camera too high above
    the first one.
    """
    plane = supports[0].plane
    if not _is_own(pose):
        _check_normals(supports, pose, up)
        check_distance(pose, plane.offset, 10.0, "a table")
    height = float(plane.height(pose[:3, 3]))
    if height > (10.0 if known_unit else 4.0):
        raise BadArgument("depth", f"a camera {height:.3g} m above the table", UNIT)


def _check_normals(
    supports: tuple[SupportPlane, ...], pose: Float[Tensor, "4 4"], up: object
) -> None:
    """Refuse a pose with the table upside down, or tilted where another pose convention would make
    it level.
    """
    sky = (
        torch.tensor([0.0, 0.0, 1.0]).double()
        if up is None
        else unit(torch.as_tensor(up).double().cpu())
    )
    normals = torch.stack([support.plane.normal.double() for support in supports])
    tilt = math.degrees(math.acos(min(1.0, max(-1.0, float((normals @ sky).max())))))
    if tilt < 3.0:
        return
    turn = pose[:3, :3]
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0]).double())
    optical = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]).double()
    mirror, upset = (
        torch.diag(torch.tensor(signs).double()) for signs in ([-1.0, 1.0, 1.0], [1.0, -1.0, 1.0])
    )
    meant = {
        "camera_pose @ diag(1, -1, -1, 1), if it is OpenGL's (y up, z backward)": turn @ flip,
        "the inverse of camera_pose, if it is camera_from_world": turn.T,
        "inv(camera_pose) @ diag(1, -1, -1, 1), if it is OpenGL's view matrix": turn.T @ flip,
        "the pose of the optical frame, if it is of ROS's camera_link (x forward, z up)": turn
        @ optical,
        "depth[::-1], if the image is upside down": turn @ upset,
        "depth[:, ::-1], if the image is mirrored": turn @ mirror,
    }
    seen = turn.T @ normals[0]
    level = math.cos(math.radians(min(5.0, tilt / 3)))
    fixes = [fix for fix, world in meant.items() if float(world @ seen @ sky) > level]
    cosine = float(normals[0] @ sky)
    if not fixes and (tilt < 15.0 or cosine > -math.cos(math.radians(15.0))):
        return  # a frame that is tilted
    angle = math.degrees(math.acos(max(-1.0, cosine)))
    other = "`up`, if z is not up" if up is None else "another `up`"
    normal = ", ".join(f"{x:.2f}" for x in normals[0].tolist())
    allowed = f"a pose in which the table's normal points up: {' or '.join([*fixes[:3], other])}"
    raise BadArgument(
        "camera_pose", f"a table whose normal ({normal}) is {angle:.0f} degrees from up", allowed
    )


def _check_given_table(points: Points, plane: Plane) -> None:
    """Refuse a given table that the camera did not see: it is above most points, or far below all
    points.
    """
    height = plane.height(points[:: 1 + len(points) // 20_000].double())
    low = float(torch.quantile(height, 0.01))
    middle = float(height.median())
    if float((height.abs() < 0.03).double().mean()) < 0.001 and (middle < 0 or low > 0.5):
        found = f"one that no point is near: they are {middle:.3g} m above it, in the middle"
        raise BadArgument(
            "table",
            found,
            "the table in the frame of a camera_pose in metres, whose z looks forward",
        )


def check_sizes(
    points: Points, labels: Tensor, pose: Float[Tensor, "4 4"], plane: Plane
) -> tuple[str, ...]:
    """Refuse a depth unit that makes objects too large or small for a hand; return a note if the
    camera is high.
    """
    parts = [points[labels == k] for k in labels.unique().tolist() if k > 0]
    sizes = sorted(float((part.amax(0) - part.amin(0)).max()) for part in parts if len(part) >= 100)
    height = float(plane.height(pose[:3, 3]))
    above_origin = float(plane.normal @ pose[:3, 3])
    # Counts of 0.25 mm read as millimetres put the camera four times too high above a table near z
    # = 0.
    scaled = plane.offset < -0.5 and any(
        abs(above_origin - factor * height) < 0.05 for factor in (0.25, 0.1)
    )
    found = f"a camera {height:.3g} m above the table"
    if sizes:
        most = sizes[len(sizes) // 5]  # nearly all objects are larger
        large = (most > 0.2 and height > 1.5) or (
            scaled and not _is_own(pose) and most > 0.12 and height > 1.0
        )
        if large or (most > 0.5 and height > 1.0) or (sizes[-1] < 0.03 and height < 0.12):
            raise BadArgument(
                "depth", f"{found} and objects of {sizes[0]:.2g} to {sizes[-1]:.2g} m", UNIT
            )
    return (
        f"{found}: if it was not so high, depth_unit (--depth-unit) says the metres of a count",
    ) * (height > 1.0)
