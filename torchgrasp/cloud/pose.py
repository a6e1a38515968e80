"""Reading of a depth camera's pose, and checks that the pose is rigid and fits the camera's view.

The pose obj_from_camera (4, 4) [m] leads from the camera's frame (x right, y down, z forward).
"""

import contextlib
import dataclasses
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
from torchgrasp.foundation.errors import BadArgument, MendedInput, NoSupport
from torchgrasp.foundation.limits import SHOWN_LETTERS
from torchgrasp.foundation.rules import RIGID, is_rigid, nearest_rotation
from torchgrasp.foundation.told import warn_user
from torchgrasp.geometry.linalg import Points, Vector, norm, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.plane_fit import PLANES
from torchgrasp.geometry.support_planes import SupportPlane
from torchgrasp.geometry.support_search import Target, find_table

Transform = Float[Tensor, "4 4"]
UNIT = "depth in metres: depth_unit (--depth-unit) says how many metres a count is"
FIXES = {
    (3, 4): "add the row 0 0 0 1",
    (4 * 4,): "reshape it to 4 x 4",
    (7,): "make a matrix of the quaternion",
}
"""How to make a 4 x 4 pose of an array with another shape, by its shape."""
FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
OPTICAL = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]).double()
"""Rotation (3, 3) from a camera's axes (x right, y down, z forward) to those of ROS's camera_link.
`FLIP` leads to them from the axes of OpenGL's camera.
"""


@dataclasses.dataclass(frozen=True)
class PoseNumbers:
    """Bounds beyond which a view contradicts the pose of its camera, or the unit of its depths."""

    rounded: float = 0.1
    """Greatest angle [deg] of a matrix from the nearest rotation, which is then taken: twice that
    of three decimals.
    """
    scaled: float = 1e-4
    """Greatest deviation of a scaled rotation matrix from orthogonal axes, and greatest relative
    difference of their lengths.
    """
    farthest: float = 100.0
    """Greatest distance [m] of a camera from the origin: a pose with a greater one is not in
    metres.
    """
    farthest_table: float = 10.0
    """Greatest distance [m] of a table from the origin along its normal. A pose with a greater one
    is not in metres. A camera so far off gives a note.
    """
    millimetres: float = 200.0
    """Coordinate of a position that is too far, above which it is in mm; else it is in cm."""
    shallow: float = 0.15
    """Least median depth [m] of a view in which a table should have been found."""
    deep: float = 4.0
    """Greatest median depth [m] of a view in which a table should have been found."""
    roll: float = 20.0
    """Least roll [deg] of a camera whose inverse pose is suggested if it has none. Cameras roll by
    less, hang upside down, or lie on their side.
    """
    upright: float = 2.0
    """Greatest roll [deg] of a camera that stands upright, as most do."""
    turn: float = 0.985
    """Least entry on the diagonal of a rotation matrix above which it is nearly the identity: about
    10 degrees.
    """
    shift: float = 0.1
    """Length [m] of a shift below which it is nearly none: the colour camera stands beside the
    depth camera.
    """
    high: float = 4.0
    """Greatest height [m] of a camera above the table if the unit of the depth is assumed."""
    highest: float = 10.0
    """Greatest height [m] of a camera above the table if the unit of the depth is given."""
    wall: float = 0.5
    """Component along z of the normal of a plane, beside a level support, below which the plane is
    a wall.
    """
    tilt: float = 3.0
    """Greatest tilt of a table [deg] that needs no explanation."""
    level: float = 5.0
    """Greatest tilt of a table [deg] under another pose at which that pose is suggested. The tilt
    must also be less than a third of the present one.
    """
    told: float = 5.0
    """Least tilt of a table [deg] for a note."""
    upturned: float = 0.5
    """Component of a table's normal along y of the camera's own frame, which points down. Above
    this, the camera hangs upside down. With such a component along x it lies on its side.
    """
    sloped: float = 15.0
    """Tilt of a table [deg], from upright or from upside down, below which the table may be a
    slope.
    """
    drawn: int = 20_000
    """Number of points, about, by which a given table is found to be seen."""
    on_table: float = 0.03
    """Greatest distance [m] from the table of points that count as on it."""
    seen: float = 0.001
    """Least share of all points on a given table at which the camera counts as having seen it."""
    lowest: float = 0.01
    """Share of the points that may be lower than all of the objects."""
    above: float = 0.5
    """Height [m] of all points above a given table, without points on it, beyond which the table is
    wrong.
    """


@dataclasses.dataclass(frozen=True)
class SizeNumbers:
    """Bounds on heights of a camera and sizes of objects [m] by which a depth's unit is checked."""

    points: int = 100
    """Least number of points of an object whose size counts."""
    smaller: int = 5
    """Reciprocal of the share of objects that may be smaller than the size that is compared with
    the bounds.
    """
    low_table: float = -0.5
    """Offset [m] of a table along its normal below which a wrong unit may have moved it down."""
    near: float = 0.005
    """Greatest difference [m] of a camera's height from the height that a known wrong unit gives. A
    greater bound would refuse right poses in the frame of a camera's start, which is near the
    camera.
    """
    units: tuple[float, ...] = (0.25, 0.1)
    """Numbers of millimetres in one count of the depth that are often read as one millimetre."""
    high: float = 1.0
    """Height [m] of a camera above which it is high: a note says so, and the sizes of objects are
    checked.
    """
    large_scaled: float = 0.12
    """Size [m] of objects above which they are too large, if the table's height is that of a wrong
    unit.
    """
    higher: float = 1.5
    """Height [m] of a camera above which some objects must be smaller than `large`."""
    large: float = 0.2
    """Size [m] of objects above which they are too large under a camera higher than `higher`."""
    furniture: float = 0.6
    """Diagonal [m] of the box of an object from which on it is furniture: its support is no table.
    """
    ends: float = 0.02
    """Share of an object's points, at each end along an axis, that may be flying pixels and do not
    count.
    """
    huge: float = 0.5
    """Size [m] of objects above which they are too large under any high camera."""
    low: float = 0.12
    """Height [m] of a camera below which some object must be larger than `small`."""
    close: float = 0.2
    """Height [m] of a camera below which a note names the unit, if all objects are tiny."""
    tiny: float = 0.05
    """Size [m] of all objects below which they are tiny: counts of 1/256 m give them, read as
    millimetres.
    """
    small: float = 0.03
    """Size [m] of all objects below which they are too small under a camera lower than `low`."""


@dataclasses.dataclass(frozen=True)
class LayerNumbers:
    """Bounds of a layer of points that is perhaps the table, beside the table that was given."""

    half: float = 0.005
    """Half the thickness of the layer [m]: the noise of a near depth camera."""
    beside: float = 0.008
    """Least distance [m] of the layer from the table. Objects lose their lowest points to a table
    that is too high, and rise from one that is too low.
    """
    above: float = 0.1
    """Greatest height [m] of the table above the layer: a floor is farther below a table."""
    below: float = 0.5
    """Greatest height [m] of the layer above the table."""
    share: float = 0.2
    """Least share of all points that lie in the layer."""
    own: float = 0.25
    """Greatest ratio of the number of points on the given table to that in the layer."""
    standing: float = 0.01
    """Least share of all points that are higher than a layer above the table. Over the flat top of
    an object there are none.
    """


LAYER = LayerNumbers()
POSE = PoseNumbers()
SIZES = SizeNumbers()


def check_rigid(name: str, pose: Tensor) -> Transform:
    """Return the given pose if it is rigid to 1e-4, or the nearest rigid one within 0.1 degrees.

    A pose that is replaced, such as one of three decimals, raises the warning `MendedInput`. Any
    other pose raises `BadArgument`, which names its fault. Messages call the argument `name`.
    """
    if fix := FIXES.get(tuple(pose.shape)):
        raise BadArgument(name, f"shape {tuple(pose.shape)}", f"a 4 x 4 matrix: {fix}")
    check_tensor(name, pose, (4, 4))
    if is_rigid(pose):
        return pose
    nearest, angle = nearest_rotation(pose[:3, :3])
    mended = torch.cat([torch.cat([nearest.to(pose), pose[:3, 3:]], -1), pose[3:]])
    if angle > POSE.rounded or not is_rigid(mended):
        raise BadArgument(name, f"{pose.tolist()}{_describe_fault(pose.double())}", RIGID)
    fault = f"{name}: its rotation is rounded, {angle:.1g} degrees from the nearest"
    warn_user(MendedInput, f"{fault}, which is taken; write six decimals")
    return mended


def _describe_fault(pose: Transform) -> str:
    """Return, as the end of a sentence, why a matrix is no rigid transform, and the fix."""
    if pose[3, :3].any() and not pose[:3, 3].any():
        return ", a transposed pose: give its transpose"
    turn = pose[:3, :3]
    length = torch.linalg.vector_norm(turn, dim=0)
    if not (length > 0).all() or pose[3].tolist() != [0, 0, 0, 1]:
        return ""
    if float(torch.linalg.det(turn)) < 0:
        return ", a mirrored rotation: its axes are left-handed"
    axes = turn / length
    error = float((axes.T @ axes - torch.eye(3).to(axes)).abs().max())
    if error < POSE.scaled and float(length.max() / length.min()) < 1 + POSE.scaled:
        return f", a rotation times {float(length[0]):.4g}: divide it by its scale"
    angle = nearest_rotation(turn)[1]
    found = f", axes that are {error:.2g} from orthogonal, {angle:.2g} degrees from a rotation"
    return f"{found}, of at most {POSE.rounded:g}: write six decimals, or take U @ Vh of its SVD"


def read_camera_pose(pose: Tensor | np.ndarray) -> Transform:
    """Return a copy of the pose obj_from_camera (4, 4) [m] of a camera in float64, after checks.

    A rotation within 0.1 degrees of a rigid one is replaced by it, and `MendedInput` warns. Raises
    `BadArgument` for another pose that is not rigid, or more than 100 m from the origin.
    """
    try:
        # a copy: programs change one array for the pose of each image
        read = torch.as_tensor(pose, dtype=torch.float64).clone()
    except (TypeError, ValueError) as error:
        found = repr(pose)[:SHOWN_LETTERS]
        raise BadArgument("camera_pose", found, "a 4 x 4 matrix of numbers") from error
    read = check_rigid("camera_pose", read)
    distance = float(norm(read[:3, 3]))
    _check_distance(read, distance, POSE.farthest, "the camera")
    return read


def tell_far(pose: Transform) -> tuple[str, ...]:
    """Return one note, a sentence, if a camera is over 10 m from its frame's origin, else none.

    Its pose obj_from_camera (4, 4) may then be in cm. The bound is `POSE.farthest_table`.
    """
    distance = float(norm(pose[:3, 3]))
    if distance <= POSE.farthest_table:
        return ()
    fix = "if camera_pose is in cm, divide camera_pose[:3, 3] by 100"
    return (f"the camera is {distance:.3g} m from the origin of its frame: {fix}",)


def tell_inverse(pose: Transform) -> tuple[str, ...]:
    """Return one note, a sentence, if the `pose` of a camera was perhaps given as its inverse, else
    none.

    It was if the camera is rolled by 20 to 70 degrees, but by less than 2 with the inverse. The
    pose obj_from_camera (4, 4) leads to a frame whose z points up. Without a table in view, nothing
    else shows an inverse pose.
    """
    roll = math.degrees(math.asin(min(1.0, abs(float(pose[2, 0])))))
    other = math.degrees(math.asin(min(1.0, abs(float(pose[0, 2])))))
    rolled = POSE.roll < roll < 90.0 - POSE.roll
    # y of the camera, which is down in the image, is down by the inverse pose
    upright = other < POSE.upright and float(pose[1, 2]) < 0
    if not rolled or not upright:
        return ()
    found = f"the camera is rolled by {roll:.0f} degrees, and by the inverse of its pose by none"
    return (f"{found}: give its inverse, if it leads to the camera's frame",)


def _check_distance(pose: Transform, distance: float, most: float, what: str) -> None:
    """Refuse a pose as not in metres if `what`, such as the camera, is over `most` [m] from the
    frame's origin.
    """
    if abs(distance) > most:
        large = float(pose[:3, 3].abs().max()) > POSE.millimetres
        fix = "in mm, divide camera_pose[:3, 3] by 1000"
        if not large:
            fix = "in cm, divide camera_pose[:3, 3] by 100"
        allowed = f"a pose in metres; {fix}"
        raise BadArgument("camera_pose", f"{what} {distance:.4g} m from the origin", allowed)


def read_pose(name: str, path: Path | str) -> Transform:
    """Return the rigid transform (4, 4) [m] in a .npy file, or in a .txt file with four lines.

    Each line has four numbers. Raises `BadArgument`, which calls the argument `name`, for a
    malformed file, another format, or a transform that is not rigid.
    """
    data, suffix = read_suffixed(name, path, (".npy", ".txt"))
    try:
        table = parse_npy(data) if suffix == ".npy" else read_lines(data)
        pose = torch.from_numpy(np.array(table, dtype=np.float64))
    except Exception as error:
        allowed = f"a well-formed {suffix} file of 4 x 4 numbers"
        raise BadArgument(name, f"{path}: {explain(error)}", allowed) from error
    return check_rigid(name, pose)


def find_plausible(
    points: Points,
    pose: Transform,
    table: Plane | float | None,
    up: object,
    known_unit: bool,
    target: Target | None = None,
) -> tuple[SupportPlane, ...]:
    """Return the planes on which objects may stand, the most plausible first.

    Args:
        points: the points (n, 3) [m] of the view; all arguments are in their frame.
        pose: pose (4, 4) [m] of the camera in this frame.
        table: the table as a plane, or its height z [m]; None to search for planes in the points.
        up: direction (3,) against gravity. None allows planes that face any way. But if a plane is
            level (its normal is near z), walls are left out. They are kept in the camera's own
            frame, where z need not be up.
        known_unit: whether the user gave the unit of the depth. Then the camera may be up to 10 m
            above the table that is found, else up to 4 m (`POSE.highest`, `POSE.high`).
        target: the object to grasp; None if unknown. Planes under it come first.

    Raises `BadArgument` if the view contradicts the pose, the unit or the given table. Examples
    are a table upside down, a camera too high above it, or a given table far from all points.
    Raises `NoSupport` if there is no plane.
    """
    eye = pose[:3, 3]
    try:
        supports = find_table(points, eye, table, up, target, _image_up(pose, up))
        if table is None and up is None and not _is_own(pose):
            supports = _level(supports, points, eye, target)
    except NoSupport as error:
        if table is not None:
            raise
        middle = float(((points - eye) @ pose[:3, 2]).median())
        if not POSE.shallow < middle < POSE.deep:
            found = f"a median depth of {middle:.3g} m, and no table"
            raise BadArgument("depth", found, UNIT) from None
        # A wrong pose may have turned the table away from `up`.
        if up is not None and not _is_own(pose):
            with contextlib.suppress(NoSupport):
                _check_normals(find_table(points, eye, None, None), pose, up)
        if known_unit or middle < SIZES.higher:
            raise
        allowed = f"{error.allowed}; of a median depth of {middle:.3g} m, look at depth_unit, too"
        raise NoSupport("table", error.found, allowed) from None
    if table is None:
        _check_supports(supports, pose, up, known_unit)
    else:
        _check_given_table(points, supports[0].plane)
    return supports


def _level(
    supports: tuple[SupportPlane, ...], points: Points, eye: Vector, target: Target | None
) -> tuple[SupportPlane, ...]:
    """Return the supports without walls, as z of a given pose says; all of them if none is level.

    If the first one is a wall, level ones are sought alone. The arguments are those of
    `find_table`.
    """
    least = math.cos(math.radians(PLANES.most_tilt))
    if float(supports[0].plane.normal[2]) < least:
        with contextlib.suppress(NoSupport):
            supports = find_table(points, eye, None, [0.0, 0.0, 1.0], target)
    if float(supports[0].plane.normal[2]) < least:
        return supports
    return tuple(support for support in supports if float(support.plane.normal[2]) > POSE.wall)


def check_view(
    points: Points, pose: Transform, up: object, known_unit: bool, target: Target
) -> SupportPlane | None:
    """Return the table that a view's points show, or None if they show none. Raise `BadArgument` if
    the table contradicts the camera's pose or the depth's unit.

    `points` (n, 3) [m] are in the frame to which the camera's `pose` (4, 4) [m] leads. `target`
    holds the points of the object for which the table is sought, in the same frame. `up` is the
    direction (3,) against gravity there; None means z. `known_unit` is whether the user gave the
    unit of the depth. Then the camera may be up to 10 m above the table, else up to 4 m
    (`POSE.highest`, `POSE.high`).
    """
    try:
        supports = find_table(points, pose[:3, 3], None, None, target, _image_up(pose, up))
    except NoSupport:
        return None
    _check_supports(supports, pose, up, known_unit)
    return supports[0]


def _is_own(pose: Transform) -> bool:
    """Return whether a pose is nearly the identity. Then the frame is the camera's, where z need
    not be up.
    """
    turn = float(torch.diagonal(pose[:3, :3]).min())
    return turn > POSE.turn and float(norm(pose[:3, 3])) < POSE.shift


def _image_up(pose: Transform, up: object) -> Vector | None:
    """Return the direction (3,) that is up in the image; None where `up` or a pose tells more."""
    return -pose[:3, 1] if up is None and _is_own(pose) else None


def _degrees(cosine: float) -> float:
    """Return the angle [degrees] of a cosine, which may be rounded out of [-1, 1]."""
    return math.degrees(math.acos(min(1.0, max(-1.0, cosine))))


def _check_supports(
    supports: tuple[SupportPlane, ...], pose: Transform, up: object, known_unit: bool
) -> None:
    """Refuse a pose that contradicts the planes on which objects stand, or a camera too high above
    the first one.
    """
    plane = supports[0].plane
    if not _is_own(pose):
        _check_normals(supports, pose, up)
        _check_distance(pose, plane.offset, POSE.farthest_table, "a table")
    height = float(plane.height(pose[:3, 3]))
    if height > (POSE.highest if known_unit else POSE.high):
        raise BadArgument("depth", f"a camera {height:.3g} m above the table", UNIT)


def _check_normals(supports: tuple[SupportPlane, ...], pose: Transform, up: object) -> None:
    """Refuse a pose with the table upside down, or tilted where another pose convention would make
    it level.
    """
    sky = torch.tensor([0.0, 0.0, 1.0]).double()
    if up is not None:
        sky = unit(torch.as_tensor(up, dtype=torch.float64).cpu())
    normals = torch.stack([support.plane.normal.double() for support in supports])
    tilt = _degrees(float((normals @ sky).max()))
    if tilt < POSE.tilt:
        return

    # The table's normal, as the camera saw it, is turned by each pose that may have been meant.
    turn = pose[:3, :3]
    seen = turn.T @ normals[0]
    mirror = torch.diag(torch.tensor([-1.0, 1.0, 1.0]).double())
    upset = torch.diag(torch.tensor([1.0, -1.0, 1.0]).double())
    meant = {
        "camera_pose @ diag(1, -1, -1, 1), if it is OpenGL's (y up, z backward)": turn @ FLIP,
        "the inverse of camera_pose, if it is camera_from_world": turn.T,
        "inv(camera_pose) @ diag(1, -1, -1, 1), if it is OpenGL's view matrix": turn.T @ FLIP,
        "the pose of the optical frame, if it is of ROS's camera_link (x forward, z up)": (
            turn @ OPTICAL
        ),
        "depth[::-1], if the image is upside down": turn @ upset,
        "depth[:, ::-1], if the image is mirrored": turn @ mirror,
    }
    level = math.cos(math.radians(min(POSE.level, tilt / 3)))
    fixes = [fix for fix, world in meant.items() if float(world @ seen @ sky) > level]
    cosine = float(normals[0] @ sky)
    upright = cosine > -math.cos(math.radians(POSE.sloped))
    if not fixes and (tilt < POSE.sloped or upright):
        return  # a frame that is tilted

    angle = _degrees(cosine)
    normal = ", ".join(f"{x:.2f}" for x in normals[0].tolist())
    found = f"a table whose normal ({normal}) is {angle:.0f} degrees from up"
    other = "`up`, if z is not up" if up is None else "another `up`"
    allowed = f"a pose in which the table's normal points up: {' or '.join([*fixes[:3], other])}"
    raise BadArgument("camera_pose", found, allowed)


def tell_tilt(pose: Transform, plane: Plane) -> tuple[str, ...]:
    """Return one note, a sentence, if a table is tilted by 5 degrees or more from z, else none.

    The bound is `POSE.told`. z is that of the frame to which the camera's `pose` (4, 4) leads.
    `plane` is the table in this frame. With a pose near the identity, z need not be up. There, a
    note is returned if the camera hangs upside down or lies on its side.
    """
    if _is_own(pose):
        right, down, _ = plane.normal.tolist()
        if down > POSE.upturned:
            return (
                "the camera hangs upside down, as the table shows. If it does not, the image is "
                "flipped, and objects are mirrored: give depth[::-1]",
            )
        if abs(right) > POSE.upturned:
            return (
                "the camera lies on its side, as the table shows. If it does not, the image is "
                "transposed, and objects are mirrored: give depth.T, and cx and cy to match",
            )
        return ()
    tilt = _degrees(float(plane.normal[2]))
    if tilt < POSE.told:
        return ()
    wrong = "a wrong camera_pose or focal length, or depth that is no distance, such as a z-buffer"
    fixes = f"if z is up, {wrong}, tilts it; if z is not up, give `up`"
    return (f"the table is tilted by {tilt:.0f} degrees from z of camera_pose: {fixes}",)


def _drawn(points: Points) -> Float[Tensor, "m 3"]:
    """Return some of the points, evenly drawn, in float64 on the CPU."""
    return points[:: 1 + len(points) // POSE.drawn].double().cpu()


def _check_given_table(points: Points, plane: Plane) -> None:
    """Refuse a given table that the camera did not see: it is above most points, or far below all
    points.
    """
    height = plane.height(_drawn(points))
    low = float(torch.quantile(height, POSE.lowest))
    middle = float(height.median())
    on = float((height.abs() < POSE.on_table).double().mean())
    if on < POSE.seen and (middle < 0 or low > POSE.above):
        found = f"one that no point is near: they are {middle:.3g} m above it, in the middle"
        allowed = "the table in the frame of a camera_pose in metres, whose z looks forward"
        raise BadArgument("table", found, allowed)


def tell_layer(points: Points, plane: Plane) -> tuple[str, ...]:
    """Return one note, a sentence, if many points lie in a layer parallel to a given table, else
    none.

    The layer is perhaps the true table. It is 10 mm thick and holds at least 20 % of the points
    (`LAYER.share`). `points` (n, 3) [m] and the `plane` are in one frame.
    """
    height = plane.height(_drawn(points))
    near = height[(height > -LAYER.above) & (height < LAYER.below)]
    if not len(near):
        return ()
    place = ((near + LAYER.above) / LAYER.half).long()
    # two bins at a time, whatever their borders
    count = torch.bincount(place, minlength=2)
    count = count[:-1] + count[1:]
    middle = float(near[(place == count.argmax()) | (place == count.argmax() + 1)].median())
    share = float((height - middle).abs().le(LAYER.half).double().mean())
    on = float(height.abs().le(LAYER.half).double().mean())
    if abs(middle) < LAYER.beside or share < LAYER.share or on > LAYER.own * share:
        return ()
    higher = float((height > middle + LAYER.beside).double().mean())
    if middle > 0 and higher < LAYER.standing:
        return ()
    side = "below" if middle > 0 else "above"
    found = f"the given table is {1e3 * abs(middle):.0f} mm {side} {share:.0%} of the points"
    return (f"{found}, which lie in one layer: is it at {plane.offset + middle:.4g} m?",)


def check_sizes(points: Points, labels: Tensor, pose: Transform, plane: Plane) -> tuple[str, ...]:
    """Raise `BadArgument` if the sizes of objects and the camera's height show a wrong depth unit.

    The height is that above the table `plane`. Most objects are too large if over 0.2 m under a
    camera above 1.5 m. They are so, too, if over 0.5 m under one above 1 m. There 0.12 m is too
    much if a usual wrong unit explains the table's place. All objects are too small if under 0.03 m
    and the camera is below 0.12 m (`SIZES`).

    Otherwise the result is one note, a sentence, or none. The note is for a camera above 1 m, or
    one below 0.2 m if all objects are under 0.05 m. `labels` (n,) holds the object of each of the
    `points` (n, 3) [m], 0 for none. The camera's `pose` (4, 4) [m] leads to their frame.
    """
    parts = [points[labels == k] for k in labels.unique().tolist() if k > 0]
    large_enough = [part for part in parts if len(part) >= SIZES.points]
    sizes = sorted(float((part.amax(0) - part.amin(0)).max()) for part in large_enough)
    height = float(plane.height(pose[:3, 3]))
    high = height > SIZES.high
    found = f"a camera {height:.3g} m above the table"
    if sizes:
        most = sizes[len(sizes) // SIZES.smaller]  # nearly all objects are larger
        large = most > SIZES.large and height > SIZES.higher
        large |= most > SIZES.huge and high
        large |= most > SIZES.large_scaled and high and _is_scaled(pose, plane, height)
        small = sizes[-1] < SIZES.small and height < SIZES.low
        if large or small:
            found = f"{found} and objects of {sizes[0]:.2g} to {sizes[-1]:.2g} m"
            raise BadArgument("depth", found, UNIT)
    metres = "depth_unit (--depth-unit) says the metres of a count"
    if sizes and sizes[-1] < SIZES.tiny and height < SIZES.close:
        found = f"{found}, and objects of {1e3 * sizes[0]:.0f} to {1e3 * sizes[-1]:.0f} mm"
        return (f"{found}: if they are larger, {metres}",)
    return (f"{found}: if it was not so high, {metres}",) * high


def tell_large(points: Points, pose: Transform, plane: Plane | None) -> tuple[str, ...]:
    """Return one note, a sentence, if an object is larger than 0.2 m (`SIZES.large`) and its camera
    is far away, else none.

    Counts of a quarter of a millimetre, read as millimetres, give such a view. `points` (n, 3) [m]
    are those of the object. `plane` is the table in their frame, None if none is found. The `pose`
    (4, 4) [m] leads from the camera's frame to theirs.
    """
    size = float(_extent(points.double().cpu()).max())
    if size <= SIZES.large:
        return ()
    if plane is None:
        middle = float(((points - pose[:3, 3]) @ pose[:3, 2]).median())
        found = f"an object of {size:.2g} m, {middle:.3g} m away"
        far = middle > SIZES.higher
    else:
        height = float(plane.height(pose[:3, 3]))
        found = f"an object of {size:.2g} m, and a camera {height:.3g} m above its table"
        far = height > SIZES.high
    fix = "if both are too large, depth_unit (--depth-unit) says the metres of a count"
    return (f"depth: {found}: {fix}",) * far


def _extent(points: Points) -> Vector:
    """Return the sides (3,) [m] of the box of an object, without flying pixels at its ends."""
    ends = torch.tensor([SIZES.ends, 1 - SIZES.ends], dtype=torch.float64)
    low, high = points.quantile(ends, 0)
    return high - low


def tell_furniture(points: Points, labels: Tensor) -> tuple[str, ...]:
    """Return one note, a sentence, if an object is at least 0.6 m long (`SIZES.furniture`), else
    none.

    Then a wall or the floor may have been taken for the table. `labels` (n,) holds the object of
    each of the `points` (n, 3) [m], 0 for none.
    """
    longest = 0.0
    for k in labels.unique().tolist():
        part = points[labels == k]
        if k > 0 and len(part) >= SIZES.points:
            longest = max(longest, float(_extent(_drawn(part)).norm()))
    if longest < SIZES.furniture:
        return ()
    fix = "if the table is wrong, too, give it, or up"
    return (f"an object is {longest:.1f} m long, as furniture or a wall: {fix}",)


def _is_scaled(pose: Transform, plane: Plane, height: float) -> bool:
    """Return whether a wrong unit explains the table's place. Counts of 0.25 mm read as millimetres
    put a camera four times too high above a table near z = 0.
    """
    if plane.offset >= SIZES.low_table or _is_own(pose):
        return False
    above_origin = float(plane.normal @ pose[:3, 3])
    return any(abs(above_origin - unit * height) < SIZES.near for unit in SIZES.units)
