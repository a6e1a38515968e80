"""Reading and writing of point clouds. Errors name the malformed file, and no file can run code."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.check import MIN_POINTS, check_cloud
from torchgrasp.cloud.neighbours import draw_rows, find_inliers, fit_local_planes
from torchgrasp.cloud.pcd import parse_pcd
from torchgrasp.cloud.pixels import is_lattice
from torchgrasp.cloud.ply import format_ply, parse_ply
from torchgrasp.cloud.prepare import lie_across
from torchgrasp.cloud.safe_files import parse_npy, parse_npz, unread_arrays
from torchgrasp.cloud.viewpoint import GUESS, can_see, is_along_z, is_before_origin
from torchgrasp.files import explain, read_bounded, write_file
from torchgrasp.files.columns import find_columns, parse_text
from torchgrasp.foundation.base import Value, flatnonzero, named_tensors
from torchgrasp.foundation.checks import check_tensor, checked
from torchgrasp.foundation.errors import (
    BadArgument,
    CloudFileError,
    CloudWarning,
    TooFewPoints,
)
from torchgrasp.foundation.lazy import spatial
from torchgrasp.foundation.limits import CLOUD_BYTES, CLOUD_POINTS
from torchgrasp.foundation.rules import check_suffix, check_unmasked
from torchgrasp.foundation.told import warn_user
from torchgrasp.geometry.linalg import norm, unit_of_any
from torchgrasp.geometry.plane import Plane
from torchgrasp.values.planning import PointCloud

TEXTS = (".xyz", ".txt", ".csv", ".asc", ".pts", ".xyzi", ".xyzn", ".xyzrgb")  # tables of numbers
SUFFIXES = (".ply", ".pcd", ".npz", ".npy", *TEXTS)
ARRAYS = ("points", "normals", "viewpoint", "frustum", "pose_error", "table")
"""Arrays of a .npz file that are read."""
IMAGES = (".png", ".tif", ".tiff", ".exr")
OF_IMAGE = "; of a depth image `torchgrasp cloud scene` makes a scene"
"""Suffixes of depth images, and what to do with one."""
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Length [m] of each unit of files."""


@dataclasses.dataclass(frozen=True)
class ReadNumbers:
    """Bounds by which the arrays of a file are understood."""

    shown: int = 200
    """Greatest number of letters of the names of columns in a note."""
    lines: int = 3
    """Greatest number of lines of a header in notes."""
    unit: float = 1e-4
    """Greatest error of the length of a table's unit normal."""
    near_unit: float = 0.05
    """Greatest error of the length of a normal in columns 4 to 6."""
    normals: float = 0.9
    """Least share of rows with nearly unit length (`near_unit`) in columns 4 to 6, if these are
    normals.
    """
    drawn: int = 2000
    """Greatest number of points by which a camera in the origin is judged."""
    searched: int = 1000
    """Number of rows, about, among which a point that stands for missing pixels is sought."""
    fewest: int = 100
    """Least number of rows among which a point that stands for missing pixels is found."""
    repeated: float = 0.05
    """Least share of the searched rows that hold a point that stands for missing pixels."""
    usual: float = 0.9
    """Quantile of the numbers of equal rows that counts as the usual number, as clouds may hold
    copies of points.
    """
    more: float = 5.0
    """Least number of rows with a point that stands for missing pixels. It is a multiple of the
    usual number of equal rows.
    """


READ = ReadNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class CloudFile(Value):
    """The content of a cloud's file; `read_cloud_file` returns it.

    Attributes:
        cloud: the points [m], in float64.
        notes: a sentence for each kind of data in the file that was left out.
        table: plane of the table in the frame of the cloud, as `save_cloud` writes it. None if the
            file holds none.
        doubts: those of the notes that say that the points may mean something else. `read_cloud`
            warns of them.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp(), "cloud.npy")
    >>> points = np.random.default_rng(0).random((50, 3)) * 0.1
    >>> np.save(file, np.vstack([points, np.full((3, 3), np.nan)]))
    >>> read_cloud_file(file).notes
    ('3 of 53 rows with NaN or infinity were left out',)
    """

    cloud: PointCloud
    notes: tuple[str, ...]
    table: Plane | None = None
    doubts: tuple[str, ...] = ()

    @checked
    def tell(self, name: str) -> PointCloud:
        """Return the cloud. Warn (`CloudWarning`) of the doubts; `name` is that of the file."""
        for doubt in self.doubts:
            warn_user(CloudWarning, f"{name}: {doubt}")
        return self.cloud


@checked
def read_cloud(
    path: Path | str,
    viewpoint: Sequence[float | int] | Tensor | None = None,
    unit: Literal["m", "cm", "mm"] = "m",
) -> PointCloud:
    """Read the point cloud [m] of one object, in float64.

    `read_cloud_file` also returns the table in the file, and says what was left out. The suffix
    tells the format:

    * `.ply`, ascii or binary: x y z, optionally nx ny nz. Header lines `comment viewpoint x y z`
      and `comment frustum` give the camera. The 12 numbers of a frustum are the inward unit normals
      of the view's four sides, as in `PointCloud`. `comment table` gives the table, by the 3
      numbers of its unit normal and its offset. A mesh gives 2000 surface points, with normals if
      it is closed.
    * `.pcd`, ascii, binary or compressed: x y z, optionally normal_x normal_y normal_z. VIEWPOINT
      gives the camera. Its default `0 0 0 1 0 0 0` counts only if a camera there can have seen the
      points. If this place is below all points, it does not count: it may be a robot's base.
    * `.npz`: arrays `points` (n, 3), optionally `normals` (n, 3), `viewpoint` (3,), `table` (4,),
      `frustum` (4, 3), `pose_error` (n,). For several views: `viewpoint` (n, 3) and `frustum` (n,
      4, 3). Other arrays are not read; a note names them.
    * `.npy`: an array (n, 3), or (n, 6) with normals or colours. Columns 4 to 6 without names are
      normals if they have length 1 and fit the surface of the points. Otherwise they are left out.
    * `.xyz`, `.txt`, `.csv`, `.asc`, `.pts`, `.xyzi`, `.xyzn`, `.xyzrgb`: the columns of `.npy` as
      text. A first line may name the columns (x y z nx ny nz), or hold the number of points.

    Arrays may also be images (h, w, 3) of points. Points with NaN or infinity are left out. Several
    points at (0, 0, 0) are left out, and so are many points at any other single place. Points whose
    normal is NaN or zero are left out. If most normals are NaN or zero, all normals are left out
    instead.

    A `CloudWarning` is given for a header with a unit or a scale, which is not applied. It is also
    given for an estimated surface, and for points of a `.pcd` that are perhaps in the camera's
    frame.

    Args:
        path: the file.
        viewpoint: the camera's position (3,) [m] in the cloud's frame. It replaces the file's
            viewpoint and frustum. None keeps those of the file.
        unit: unit of all lengths in the file, "m", "cm" or "mm". The argument `viewpoint` is always
            in metres.

    Raises:
        CloudFileError: no such file; an unknown suffix; malformed content; more than 512 MB or 5
            million points.
        BadArgument: a viewpoint other than three numbers; points on one line.
        TooFewPoints: fewer than 4 distinct points.
        SuspiciousScale: an extent outside [5 mm, 2 m].

    >>> read_cloud("scan.docx")
    Traceback (most recent call last):
    torchgrasp.foundation.errors.CloudFileError: path: expected a file ending in
    .ply, ..., got scan.docx
    """
    return check_cloud(read_cloud_file(path, viewpoint, unit).tell(str(path)))


@checked
def read_cloud_file(
    path: Path | str,
    viewpoint: Sequence[float | int] | Tensor | None = None,
    unit: Literal["m", "cm", "mm"] = "m",
) -> CloudFile:
    """Read a cloud of any extent, such as a whole scene. Return it with the file's table, and notes
    on what was left out.

    `read_cloud` lists the formats, and which points are left out. The table is the plane that the
    file holds, as `save_cloud` writes it. It is not searched for among the points.

    Args:
        path: the file.
        viewpoint: the camera's position (3,) [m] in the cloud's frame. It replaces the file's
            viewpoint and frustum. None keeps those of the file.
        unit: unit of all lengths in the file, "m", "cm" or "mm". The result is in metres, and so is
            the argument `viewpoint`.

    Raises:
        CloudFileError: no such file; an unknown suffix; malformed content; more than 512 MB or 5
            million points.
        BadArgument: a viewpoint other than three finite numbers.
        TooFewPoints: fewer than 4 measured points.

    >>> read_cloud_file("none.ply")
    Traceback (most recent call last):
    torchgrasp.foundation.errors.CloudFileError: path: expected a .ply file, got
    none.ply, which is no file
    """
    try:
        position = None
        if viewpoint is not None:
            position = torch.as_tensor(viewpoint, dtype=torch.float64).clone()
    except (TypeError, ValueError, RuntimeError) as error:
        raise BadArgument("viewpoint", repr(viewpoint), "three numbers [m]") from error
    if position is not None:
        check_tensor("viewpoint", position, (3,))
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        hint = OF_IMAGE if suffix in IMAGES else ""
        allowed = f"a file ending in {', '.join(SUFFIXES)}{hint}"
        raise CloudFileError("path", path, allowed)
    refuse = functools.partial(CloudFileError, "path")
    data = read_bounded(path, CLOUD_BYTES, f"a {suffix} file", refuse)
    try:
        arrays = _parse(data, suffix)
    except Exception as error:  # zlib, zipfile, numpy and trimesh each raise their own
        allowed = f"a well-formed {suffix} file"
        raise CloudFileError("path", f"{path}: {explain(error)}", allowed) from error
    return make_cloud(str(path), arrays, position, METRES[unit])


def _parse(data: bytes, suffix: str) -> dict[str, Any]:
    """Return the arrays in a file of a known suffix, by name."""
    if suffix == ".ply":
        return parse_ply(data)
    if suffix == ".pcd":
        return parse_pcd(data)
    if suffix == ".npz":
        return {**parse_npz(data, ARRAYS, "points"), "unread": unread_arrays(data, ARRAYS)}
    return {"columns": parse_npy(data)} if suffix == ".npy" else parse_text(data, suffix)


@checked
def cloud_from_array(
    points: np.ndarray,
    normals: np.ndarray | None = None,
    viewpoint: np.ndarray | Sequence[float | int] | None = None,
) -> PointCloud:
    """Return a cloud made of NumPy arrays [m], in float64, without the points that were not
    measured.

    Not measured are points with NaN or infinity, and points at (0, 0, 0) if there are several.
    Points whose normal is NaN or zero are also left out. If most normals are NaN or zero, all
    normals are left out instead.

    Args:
        points: (n, 3), or (h, w, 3) for an image of points. Without `normals` there may be six
            columns. The last three are normals if they have length 1 and fit the surface. Otherwise
            they are taken for colours and left out.
        normals: outward normals in the shape of `points`; None without normals.
        viewpoint: position (3,) [m] of the camera, in the frame of the points. For several cameras,
            one position for each point: an array (n, 3), or (h, w, 3) for an image. None if it is
            unknown.

    Raises `TooFewPoints` for fewer than 4 distinct points, and `SuspiciousScale` for an extent
    outside [5 mm, 2 m]. Raises `BadArgument` for points on one line, a normal of length zero, or a
    camera over 50 m away. Raises `CloudFileError` for arrays of another shape or type.

    >>> len(cloud_from_array(np.random.default_rng(0).random((6, 8, 3))))
    48
    """
    arrays = {
        "columns" if normals is None else "points": points,
        "normals": normals,
        "viewpoint": viewpoint,
    }
    return check_cloud(make_cloud("an array", arrays).cloud)


@checked
def save_cloud(cloud: PointCloud, path: Path | str, table: Plane | None = None) -> Path:
    """Write a cloud as `.npz` (exact) or binary `.ply`, atomically; return the path.

    A `.ply` has numbers in float32, or in float64 where float32 is rounded by over 0.01 mm.

    Args:
        cloud: the points [m]. Their normals, cameras and errors are also written.
        path: a file ending in `.npz` or `.ply`.
        table: plane of the table in the frame of the cloud, which is also written. None without a
            table.

    Raises `OutputError` if the file cannot be written. Raises `BadArgument` for another suffix, or
    for a table with an edge, which neither file can hold. `BadArgument` is also raised for a `.ply`
    of several views, or of a cloud with `pose_error`.

    >>> save_cloud(PointCloud(torch.rand(9, 3)), "cloud.txt")
    Traceback (most recent call last):
    torchgrasp.foundation.errors.BadArgument: path: expected a file ending in .npz or
    .ply, got cloud.txt
    """
    path = Path(path)
    if table is not None and table.edge is not None:
        raise BadArgument("table", "a table with an edge", "one without an edge, for a file")
    arrays = {name: tensor.detach().cpu().numpy() for name, tensor in named_tensors(cloud).items()}
    arrays |= {} if table is None else {"table": np.array([*table.normal.tolist(), table.offset])}
    check_suffix("path", path, ".npz", ".ply")
    if path.suffix.lower() == ".npz":
        return write_file(path, lambda file: np.savez_compressed(file, **arrays))  # pyright: ignore[reportArgumentType]
    several = cloud.viewpoint is not None and cloud.viewpoint.ndim == 2
    if several or cloud.pose_error is not None:
        raise BadArgument("path", path, "a file ending in .npz, for a cloud of several views")
    return write_file(path, format_ply(**arrays))


def make_cloud(
    source: str, arrays: dict[str, Any], viewpoint: Tensor | None = None, scale: float = 1.0
) -> CloudFile:
    """Return a `CloudFile` made of arrays by name, without points that were not measured.

    The arrays are in units of `scale` metres. Their names are "points", "normals", "viewpoint" and
    so on, as in a .npz file of `read_cloud`. `viewpoint` [m] replaces that of the arrays. `source`
    is the file in errors. Raises `CloudFileError`, `BadArgument` or `TooFewPoints` for arrays that
    are no cloud.
    """
    notes: list[str] = []
    if "columns" in arrays:
        arrays = _split_columns(source, arrays, notes)
        if arrays.get("normals") is not None and not _fit_surface(arrays):
            del arrays["normals"]
            notes.append("columns 4 to 6 are across the surface (colours?) and were left out")
    if arrays.get("other"):
        notes.append(f"columns {', '.join(arrays['other'])[: READ.shown]} were left out")
    if arrays.get("unread"):
        notes.append(f"arrays {', '.join(arrays['unread'])[: READ.shown]} were not read")
    doubts = list[str]()
    for line in arrays.get("said", ())[: READ.lines]:
        told = f"the header's line {line[: READ.shown]!r} is not applied"
        doubts.append(f"{told}: --unit says the unit, and options are in metres")
    if arrays.get("estimated"):
        told = "an estimated surface, whose std_m are not read"
        doubts.append(f"{told}: all of it counts as measured; plan on the cloud that it came from")
    points = scale * _as_rows(source, "points", arrays["points"])
    normals = arrays.get("normals")
    normals = None if normals is None else _as_rows(source, "normals", normals)
    # Frustum and default are those of the arrays' own camera.
    of_file = viewpoint is None
    default = bool(arrays.get("default")) and of_file
    frustum = arrays.get("frustum") if of_file else None
    error = arrays.get("pose_error")
    if of_file and arrays.get("viewpoint") is not None:
        viewpoint = scale * _as_rows(source, "viewpoint", arrays["viewpoint"])
        if not torch.isfinite(viewpoint).all():
            found = f"{source}: a viewpoint with NaN or infinity"
            raise BadArgument("path", found, "a viewpoint of finite numbers")
    if normals is not None and len(normals) != len(points):
        found = f"{source}: {len(normals)} normals of {len(points)} points"
        raise CloudFileError("path", found, "one normal for each point")
    if viewpoint is not None and viewpoint.ndim == 2 and len(viewpoint) != len(points):
        found = f"{source}: {len(viewpoint)} viewpoints of {len(points)} points"
        raise CloudFileError("path", found, "one viewpoint, or one for each point")
    keep, normals = _find_measured(points, normals, notes)
    if int(keep.sum()) < MIN_POINTS:
        left_out = "".join(f" ({note})" for note in notes)
        found = f"{source} with {int(keep.sum())} points{left_out}"
        raise TooFewPoints("path", found, f"at least {MIN_POINTS} points")
    if viewpoint is not None and viewpoint.ndim == 2:
        viewpoint = viewpoint[keep]
    if frustum is not None:
        frustum = _as_numbers(source, "frustum", frustum, (4, 3), (len(points), 4, 3))
        frustum = frustum if frustum.ndim == 2 else frustum[keep]
    if error is not None:
        error = scale * _as_numbers(source, "pose_error", error, (len(points),))[keep]
    normals = None if normals is None else normals[keep]
    cloud = PointCloud(points[keep], normals, viewpoint, frustum, error)
    if default:
        cloud = _judge_default(cloud, notes)
    elif arrays.get("turn") is not None and of_file:
        doubts += _tell_own_frame(cloud, torch.from_numpy(arrays["turn"]))
    table = arrays.get("table")
    if table is not None:
        *normal, offset = _as_numbers(source, "table", table, (4,)).tolist()
        if not abs(math.hypot(*normal) - 1) < READ.unit:
            found = f"{source}: a table with the normal {normal}"
            raise CloudFileError("path", found, "a unit vector")
        table = Plane(torch.tensor(normal, dtype=torch.float64), scale * offset)
    return CloudFile(cloud, (*notes, *doubts), table, tuple(doubts))


def _as_numbers(source: str, name: str, array: Any, *shapes: tuple[int, ...]) -> Tensor:
    """Return an array as a tensor if it has finite numbers and an allowed shape; else refuse the
    file `source`.
    """
    array = np.asarray(array)
    if array.dtype.kind not in "fiu" or array.shape not in shapes or not np.isfinite(array).all():
        allowed = f"finite numbers of shape {' or '.join(map(str, shapes))}"
        raise CloudFileError("path", f"{source}: a {name} of shape {array.shape}", allowed)
    return torch.from_numpy(array.astype(np.float64))


def _as_rows(source: str, name: str, array: Any) -> Tensor:
    """Return an array of points as float64 rows (n, 3), or refuse the file `source`; a viewpoint
    may be (3,).
    """
    check_unmasked(name, array)
    array = np.asarray(array)
    if array.dtype.kind not in "fiu":
        raise CloudFileError("path", f"{source}: {name} of type {array.dtype}", "real numbers")
    if array.ndim not in ((1, 2, 3) if name == "viewpoint" else (2, 3)) or array.shape[-1] != 3:
        allowed = "an array of shape (n, 3), or (h, w, 3) of an image, or (3,) of one viewpoint"
        raise CloudFileError("path", f"{source}: {name} of shape {array.shape}", allowed)
    if array.size > 3 * CLOUD_POINTS:
        found = f"{source} with {array.size // 3} points"
        raise CloudFileError("path", found, f"at most {CLOUD_POINTS} points")
    # A copy is owned, writable and of native bytes. Numbers beyond double precision become
    # infinite, as if missing.
    with np.errstate(invalid="ignore", over="ignore"):
        rows = np.array(array, dtype=np.float64, order="C")
    return torch.from_numpy(rows if array.ndim < 3 else rows.reshape(-1, 3))


def _split_columns(source: str, arrays: dict[str, Any], notes: list[str]) -> dict[str, Any]:
    """Return arrays in which the table of 3 or 6 columns is split into points and normals. Colours
    are left out.
    """
    check_unmasked("points", arrays["columns"])
    table = np.asarray(arrays["columns"])
    if names := table.dtype.names:
        pixels = table.reshape(-1)  # an organised cloud (h, w) as well
        return find_columns(names, [pixels[name] for name in names])
    if table.ndim not in (2, 3) or table.shape[-1] not in (3, 6) or table.dtype.kind not in "fiu":
        found = f"{source}: an array of shape {table.shape} and type {table.dtype}"
        allowed = "real numbers of shape (n, 3) or (n, 6), or (h, w, 3) or (h, w, 6) of an image"
        allowed += OF_IMAGE if table.ndim == 2 else ""
        raise CloudFileError("path", found, allowed)
    split = {**arrays, "points": table[..., :3]}
    if table.shape[-1] == 6:
        more = table[..., 3:].reshape(-1, 3).astype(np.float64)
        more = more[np.isfinite(more).all(1) & more.any(1)]
        # Squares of larger numbers would overflow.
        length = np.linalg.norm(more.clip(-2, 2), axis=1)
        near_unit = np.abs(length - 1) < READ.near_unit
        if len(more) and np.mean(near_unit) >= READ.normals:
            split["normals"] = table[..., 3:]
        else:
            notes.append("columns 4 to 6 are no unit vectors (colours?) and were left out")
    return split


def _fit_surface(arrays: dict[str, Any]) -> bool:
    """Return whether unnamed unit vectors are normals: colours such as red have length 1, too."""
    rows = np.concatenate([arrays[name].reshape(-1, 3) for name in ("points", "normals")], -1)
    rows = torch.from_numpy(rows.astype(np.float64))
    rows = rows[torch.isfinite(rows).all(1) & rows[:, 3:].any(1)].unique(dim=0)
    return not lie_across(rows[:, :3], rows[:, 3:])


def _find_measured(
    points: Tensor, normals: Tensor | None, notes: list[str]
) -> tuple[Tensor, Tensor | None]:
    """Return a mask of the measured rows, and the normals (None if most are missing). Add notes on
    the other rows.
    """
    total = len(points)
    finite = torch.isfinite(points).all(1)
    if not finite.all():
        notes.append(f"{int((~finite).sum())} of {total} rows with NaN or infinity were left out")
    origin = (points == 0).all(1)
    if int(origin.sum()) > 1:
        missing = "rows at exactly (0, 0, 0), missing pixels, were left out"
        notes.append(f"{int(origin.sum())} of {total} {missing}")
        finite &= ~origin
    finite &= ~_find_repeated(points, finite, notes)
    if normals is None:
        return finite, None
    bad = finite & ~(torch.isfinite(normals).all(1) & normals.ne(0).any(1))
    count = int(bad.sum())
    if 2 * count > int(finite.sum()):
        notes.append(f"{count} normals are missing (NaN or zero): all were left out")
        return finite, None
    if count:
        notes.append(f"{count} of {total} rows without a normal (NaN or zero) were left out")
    return finite & ~bad, normals


def _find_repeated(points: Tensor, keep: Tensor, notes: list[str]) -> Tensor:
    """Return a mask of the rows at one place, if it holds far more rows than other places do. Add a
    note on them.

    Only the rows of the mask `keep` count. Rows at one place are missing pixels: (0, 0, 0), moved
    with the other points, or (-1, -1, -1).
    """
    none = torch.zeros_like(keep)
    rows = flatnonzero(keep)
    some = points[rows[:: 1 + len(rows) // READ.searched]]
    if len(some) < READ.fewest:
        return none
    places, count = some.unique(dim=0, return_counts=True)
    most = int(count.max())
    # a cloud may have several copies of each point
    usual = float(count.double().quantile(READ.usual))
    if most < READ.repeated * len(some) or most < READ.more * usual:
        return none
    place = places[count.argmax()]
    found = keep & (points == place).all(1)
    where = ", ".join(f"{x:.6g}" for x in place.tolist())
    missing = f"rows at exactly ({where}), missing pixels, were left out"
    notes.append(f"{int(found.sum())} of {len(points)} {missing}")
    return found


def _tell_own_frame(cloud: PointCloud, turn: Float[Tensor, "4"]) -> list[str]:
    """Return a list with one sentence if points of a PCD file are perhaps in their camera's frame;
    else an empty one.

    `turn` is the quaternion wxyz of the camera in the frame of VIEWPOINT. Seen from the camera, the
    points are ahead, along z as in images, or along x as on robots. If they are not, but lie before
    the origin, the origin may be the camera. So it may if its pixels alone are a regular lattice.
    PCL writes such files.
    """
    points = cloud.points
    eye = cloud.viewpoint
    if eye is None or not is_before_origin(points):
        return []
    past = False
    # a camera that is not turned has no direction that anybody gave
    if float(norm(turn[1:])) > 0:
        rotation = spatial.transform.Rotation.from_quat(turn[[1, 2, 3, 0]].numpy())
        axes = torch.from_numpy(rotation.as_matrix()).to(points)
        ahead = unit_of_any(points.mean(0) - eye) @ axes
        past = max(float(ahead[0]), float(ahead[2])) < GUESS.ahead
    own = is_lattice(points, torch.zeros_like(eye)) and not is_lattice(points, eye)
    if not past and not own:
        return []
    found = "the points lie before the origin, as in a camera's frame, and VIEWPOINT is elsewhere"
    return [f"{found}: if VIEWPOINT is the camera's pose, give it as --camera-pose"]


def _judge_default(cloud: PointCloud, notes: list[str]) -> PointCloud:
    """Return the cloud, without its viewpoint (0, 0, 0) if no camera can have been there; a note
    then says so.

    In a robot's frame, z is up and the origin is often below all points. In a camera's frame, the
    points are ahead of the origin along z.
    """
    points = cloud.points[draw_rows(len(cloud), READ.drawn)]
    if points.ne(points[0]).any():  # else all coincide, which is refused later
        points = points[find_inliers(points)]
        below = bool((points[:, 2] > 0).all()) and not is_along_z(points)
        origin = torch.zeros(3, dtype=points.dtype)
        if not below and can_see(points, fit_local_planes(points)[0], origin):
            return cloud
    default = "the default viewpoint (0, 0, 0) of PCD"
    unseen = "from which a camera cannot have seen these points, was left out"
    notes.append(f"{default}, {unseen} (--viewpoint gives one)")
    return PointCloud(cloud.points, cloud.normals)
