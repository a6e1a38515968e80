"""From the arrays of a file to a cloud, and notes on what was left out."""

import dataclasses
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.checks import checked
from torchgrasp.cloud.check import MIN_POINTS
from torchgrasp.cloud.io.text import MAX_POINTS
from torchgrasp.cloud.neighbours import draw_rows, find_inliers, fit_planes
from torchgrasp.cloud.orientation import guess_viewpoint
from torchgrasp.errors import BadArgument, CloudFileError, TooFewPoints
from torchgrasp.values import PointCloud

UNIT_LENGTH, MOST_UNIT = 0.05, 0.9
"""Three further columns are normals if so large a share of them has unit length to within 5 %; else they are not."""
FEW = 2000
"""Points that are asked whether they face a default viewpoint."""


@checked
@dataclasses.dataclass(frozen=True)
class CloudFile(Value):
    """A cloud as it was read, and a sentence for each thing that was left out.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from torchgrasp.cloud import read_cloud_file
    >>> file = Path(tempfile.mkdtemp(), "cloud.npy")
    >>> np.save(file, np.vstack([np.random.default_rng(0).random((50, 3)) * 0.1, np.full((3, 3), np.nan)]))
    >>> read_cloud_file(file).notes
    ('3 of 53 rows with NaN or infinity were left out',)
    """

    cloud: PointCloud
    notes: tuple[str, ...]


def make_cloud(source: str, arrays: dict[str, Any], viewpoint: Tensor | None = None, scale: float = 1.0) -> CloudFile:
    """Return the cloud of arrays without missing rows.

    Rows with NaN or infinity are left out, and so are rows at exactly (0, 0, 0) if there are several: depth cameras
    mark missing pixels by them. Normals of length zero count as missing. The default viewpoint of a PCD file is left
    out unless the points look like those of a camera in the origin.

    Args:
        source: what errors name.
        arrays: "points" (n, 3) or (h, w, 3), or "table" with 3 or 6 columns; optionally "normals", "viewpoint" and
            its "frustum".
        viewpoint: the camera [m], instead of the arrays'.
        scale: metres in a unit of points and of the arrays' viewpoint.

    Raises:
        CloudFileError: arrays of another shape or type; more than 5 million points.
        BadArgument: a viewpoint that is not finite.
        TooFewPoints: fewer than 4 rows are left.
    """
    notes: list[str] = []
    if "table" in arrays:
        arrays = _split_columns(source, arrays, notes)
    points = scale * _as_rows(source, "points", arrays["points"])
    normals = None if arrays.get("normals") is None else _as_rows(source, "normals", arrays["normals"])
    default = bool(arrays.get("default")) and viewpoint is None
    frustum = None if viewpoint is not None else arrays.get("frustum")  # that of another camera says nothing
    if viewpoint is None and arrays.get("viewpoint") is not None:
        viewpoint = scale * _as_rows(source, "viewpoint", arrays["viewpoint"])
        if not bool(torch.isfinite(viewpoint).all()):
            raise BadArgument("path", f"{source}: a viewpoint with NaN or infinity", "finite numbers")
    if normals is not None and len(normals) != len(points):
        raise CloudFileError("path", f"{source}: {len(normals)} normals of {len(points)} points", "one normal a point")
    if viewpoint is not None and viewpoint.ndim == 2 and len(viewpoint) != len(points):
        found = f"{source}: {len(viewpoint)} viewpoints of {len(points)} points"
        raise CloudFileError("path", found, "one viewpoint, or one a point")
    keep, normals = _find_measured(points, normals, notes)
    if int(keep.sum()) < MIN_POINTS:
        found = f"{source} with {int(keep.sum())} points" + "".join(f" ({note})" for note in notes)
        raise TooFewPoints("path", found, f"at least {MIN_POINTS} points")
    if viewpoint is not None and viewpoint.ndim == 2:
        viewpoint = viewpoint[keep]
    if frustum is not None:
        frustum = _as_sides(source, frustum, len(points))
        frustum = frustum if frustum.ndim == 2 else frustum[keep]
    cloud = PointCloud(points[keep], None if normals is None else normals[keep], viewpoint, frustum)
    if default:
        cloud = _judge_default(cloud, notes)
    return CloudFile(cloud, tuple(notes))


def _as_sides(source: str, array: Any, n: int) -> Tensor:
    """Return a frustum's normals, or refuse its file."""
    array = np.asarray(array)
    if array.dtype.kind not in "fiu" or array.shape not in ((4, 3), (n, 4, 3)) or not np.isfinite(array).all():
        raise CloudFileError("path", f"{source}: a frustum of shape {array.shape}", "finite numbers of shape (4, 3)")
    return torch.from_numpy(array.astype(np.float64))


def _as_rows(source: str, name: str, array: Any) -> Tensor:
    """Return an array as float64 rows, or refuse its file."""
    array = np.asarray(array)
    if array.dtype.kind not in "fiu":
        raise CloudFileError("path", f"{source}: {name} of type {array.dtype}", "real numbers")
    if array.ndim not in ((1, 2, 3) if name == "viewpoint" else (2, 3)) or array.shape[-1] != 3:
        raise CloudFileError("path", f"{source}: {name} of shape {array.shape}", "(n, 3), or (h, w, 3) of an image")
    if array.size > 3 * MAX_POINTS:
        raise CloudFileError("path", f"{source} with {array.size // 3} points", f"at most {MAX_POINTS} points")
    # A copy: owned, writable, native bytes. What double precision cannot hold becomes infinite, as of no point.
    with np.errstate(invalid="ignore", over="ignore"):
        rows = np.array(array, dtype=np.float64, order="C")
    return torch.from_numpy(rows if array.ndim < 3 else rows.reshape(-1, 3))


def _split_columns(source: str, arrays: dict[str, Any], notes: list[str]) -> dict[str, Any]:
    """Split a table of 3 or 6 columns into points and normals; colours are no normals."""
    table = np.asarray(arrays["table"])
    if table.ndim not in (2, 3) or table.shape[-1] not in (3, 6) or table.dtype.kind not in "fiu":
        found = f"{source}: an array of shape {table.shape} and type {table.dtype}"
        raise CloudFileError("path", found, "(n, 3) or (n, 6) real numbers, or (h, w, 3) or (h, w, 6) of an image")
    split = {**arrays, "points": table[..., :3]}
    if table.shape[-1] == 6:
        more = table[..., 3:].reshape(-1, 3).astype(np.float64)
        more = more[np.isfinite(more).all(1) & more.any(1)]
        length = np.linalg.norm(more.clip(-2, 2), axis=1)  # no unit vector has more, and squares would overflow
        if len(more) and np.mean(np.abs(length - 1) < UNIT_LENGTH) >= MOST_UNIT:
            split["normals"] = table[..., 3:]
        else:
            notes.append("columns 4 to 6 are no unit vectors (colours?) and were left out")
    return split


def _find_measured(points: Tensor, normals: Tensor | None, notes: list[str]) -> tuple[Tensor, Tensor | None]:
    """Tell which rows were measured, and return the normals, or None where most are missing."""
    finite = torch.isfinite(points).all(1)
    if not bool(finite.all()):
        notes.append(f"{int((~finite).sum())} of {len(points)} rows with NaN or infinity were left out")
    origin = (points == 0).all(1)
    if int(origin.sum()) > 1:
        notes.append(f"{int(origin.sum())} of {len(points)} rows at exactly (0, 0, 0), missing pixels, were left out")
        finite &= ~origin
    if normals is None:
        return finite, None
    bad = finite & ~(torch.isfinite(normals).all(1) & normals.ne(0).any(1))
    if not bool(bad.any()):
        return finite, normals
    if 2 * int(bad.sum()) > int(finite.sum()):
        notes.append(f"{int(bad.sum())} normals are missing (NaN or zero): all were left out")
        return finite, None
    notes.append(f"{int(bad.sum())} of {len(points)} rows without a normal (NaN or zero) were left out")
    return finite & ~bad, normals


def _judge_default(cloud: PointCloud, notes: list[str]) -> PointCloud:
    """Keep the viewpoint (0, 0, 0) only if the points look like seen from there."""
    points = cloud.points[draw_rows(len(cloud), FEW)]
    if bool(points.ne(points[0]).any()):  # else all coincide, which is refused later
        points = points[find_inliers(points)]
        if not bool(guess_viewpoint(points, fit_planes(points)[0]).any()):
            return cloud
    notes.append("the default viewpoint (0, 0, 0), which the points do not face, was left out (--viewpoint gives one)")
    return PointCloud(cloud.points, cloud.normals)
