"""The hidden side of the left-out objects, rendered, and of real things that two cameras saw at
once. Also how long plans take.
"""

import dataclasses
import statistics
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.spatial import KDTree

from benchmarks.common import Options, Row, bench, run_all
from benchmarks.ground_truth import read_cameras, sample_hidden
from benchmarks.headline.left_out import LEFT_OUT, PACED
from benchmarks.headline.touched import contact_row
from benchmarks.plan.pace import keep_pace
from torchgrasp.cloud.prepare import estimate_normals
from torchgrasp.data import read_object_mesh, read_view
from torchgrasp.foundation.errors import GraspError
from torchgrasp.geometry.mesh_distance import surface_distance
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import extract_surface
from torchgrasp.values.planning import PointCloud

TABLE = 0.013
"""Height [m] of the table under the real clouds."""

UNSEEN = 0.006
"""Distance [m] from a view's points above which another camera's points are its hidden side."""

NAMES = ("median", "p90", "within_1", "within_2", "within_3")
"""What is told of a view: errors of its hidden side [mm], and shares of it within k std_m."""

RESOLUTION = 56
"""Cells of the grid of the estimated surface along the domain's diameter."""

SAMPLES = 3000
"""Points on the true surface."""

QUERIES = 1500
"""Most points of the hidden side that are compared."""

EDGE = 1 - 1e-9
"""Share of the largest distance from the centre at which a shape is asked."""

LIMIT = 600.0
"""Limit [s] of the CPU time of one view."""


@bench("headline/rendered", objects=True)
def rendered(o: Options) -> list[Row]:
    """Compare the estimated surface of one noisy view of each object with its mesh."""
    tasks = [(o.objects[0], name) for name in o.names or LEFT_OUT]
    found = list(run_all(measure_view, tasks, o.workers, LIMIT))
    return [_hidden(f"rendered views of {len(found)} objects", found, "<= 2.2 mm")]


@bench("headline/real")
def real(o: Options) -> list[Row]:
    """Compare the estimated surface of one camera with what the other measured. Tell where the
    contacts of the best grasp lie.
    """
    if o.clouds is None:
        return [Row("hidden side of real clouds", "<= 3.0 mm", "not measured: no --clouds")]
    clouds = read_cameras(o.clouds)
    found = list[dict[str, float]]()
    floors = list[float]()
    for name, views in clouds.items():
        for camera, points in views.items():
            others = [x for one, x in views.items() if one != camera]
            if not others:
                continue
            measured = torch.cat(others)
            view = judge_hidden(points, measured)
            floor = measure_floor(points, measured)
            found.append(view)
            floors.append(floor)
            print(
                f"{name}_{camera}: median {view['median']:.1f} mm, 90 % {view['p90']:.1f} mm, "
                f"within 2 std_m {view['within_2']:.2f}; the cameras differ by {floor:.1f} mm"
            )
    words = "not measured"
    if floors:
        words = f"{statistics.median(floors):.1f} mm in the median of views"
    floor_row = Row("floor: distance of the cameras where both see", "-", words)
    hidden = _hidden(f"{len(found)} real views", found, "<= 3.0 mm")
    contacts = [contact_row(name, clouds, TABLE, o) for name in o.hands]
    return [hidden, floor_row, *contacts]


@bench("headline/pace", objects=True)
def pace(o: Options) -> list[Row]:
    """Time plans of the Allegro hand on one view of twelve objects."""
    names = o.names or PACED
    return keep_pace(
        dataclasses.replace(o, names=names, views=("view0",), hands=("allegro",), starts=1000)
    )


def measure_view(folder: Path, name: str) -> dict[str, float]:
    """Fit a shape to the first rendered view of an object, and return errors of its hidden side.

    The errors are those of `measure_shape`.
    """
    cloud = read_view(folder, name, "view0")
    return measure_shape(fit_shape(cloud, table=0.0), read_object_mesh(folder, name), cloud)


def measure_shape(shape: ShapeGP, mesh: trimesh.Trimesh, cloud: PointCloud) -> dict[str, float]:
    """Return errors of an estimated shape, by name, on the true surface that its cloud does not
    show. The face on the table is left out.

    * "median", "p90": distance [mm] of the true surface from the estimated one.
    * "within_1", "within_2", "within_3": share of the true surface within k std_m. Surface outside
      the domain is missed.

    All is NaN where nothing is hidden.
    """
    points = sample_hidden(mesh, cloud, SAMPLES)
    if not len(points):
        return dict.fromkeys(NAMES, float("nan"))
    surface = extract_surface(shape, RESOLUTION)
    away = surface_distance(surface.vertices, surface.faces)(points.numpy())
    inside = shape.contains(points)
    estimate = shape.predict(points[inside])
    ratio = torch.full((len(points),), torch.inf, dtype=torch.float64)
    # Distance and std_m in metres are both divided by the slope there, which cancels.
    ratio[inside] = estimate.distance.abs() / (shape.std_factor * estimate.variance.sqrt())
    return _tell(torch.from_numpy(away).abs(), ratio)


def judge_hidden(
    seen: torch.Tensor, measured: torch.Tensor, table: float = TABLE
) -> dict[str, float]:
    """Return errors of the shape of one camera's points on the surface that another one measured.

    `seen` (n, 3) and `measured` (m, 3) are points [m] in one frame; `table` is the table's height
    [m]. The errors are those of `measure_shape`, at measured points far from those seen.
    All is NaN if no shape can be fitted.
    """
    far = torch.from_numpy(KDTree(seen.numpy()).query(measured.numpy())[0]) > UNSEEN
    hidden = measured[far]
    hidden = hidden[:: max(1, len(hidden) // QUERIES)]
    try:
        shape = fit_shape(PointCloud(seen), table=table)
    except GraspError:
        return dict.fromkeys(NAMES, float("nan"))
    # the estimate ends at twice the domain's radius: points beyond are within no deviation of it
    outward = hidden - shape.center
    away = outward.norm(dim=1, keepdim=True)
    most = EDGE * 2 * shape.domain_radius * shape.scale
    beyond = (away - most).clamp_min(0.0)
    guess = shape.predict(shape.center + outward * (most / away).clamp_max(1.0))
    off = (guess.distance * shape.scale).abs() + beyond[:, 0]
    return _tell(off, torch.where(beyond[:, 0] > 0, torch.inf, off / guess.std_m))


def _tell(error: torch.Tensor, ratio: torch.Tensor) -> dict[str, float]:
    """Return the numbers `NAMES` of errors (n,) [m] and their ratios (n,) to std_m."""
    shares = [float((ratio <= k).double().mean()) for k in (1, 2, 3)]
    values = [1e3 * float(error.median()), 1e3 * float(error.quantile(0.9)), *shares]
    return dict(zip(NAMES, values, strict=True))


def measure_floor(seen: torch.Tensor, measured: torch.Tensor) -> float:
    """Return the median distance [mm] of another camera's points from a view's tangent planes.

    Both are (n, 3) [m]; only points that the view saw, too, count. The cameras' calibration and
    noise cause the distance. `judge_hidden` cannot tell a smaller error of the hidden side. It is
    NaN where the view saw none of them.
    """
    view = estimate_normals(PointCloud(seen))
    assert view.normals is not None
    away, rows = KDTree(view.points.numpy()).query(measured.numpy())
    both = away < UNSEEN
    rows = np.asarray(rows)[both]
    offset = measured[both] - view.points[rows]
    height = (offset * view.normals[rows]).sum(1).abs()
    return 1e3 * float(height.median()) if len(height) else float("nan")


def _hidden(what: str, found: list[dict[str, float]], bar: str) -> Row:
    """Return the row of the hidden side: medians over views, and mean shares within k std_m."""
    good = [x for x in found if x["median"] == x["median"]]
    if not good:
        words = f"not measured: {len(found)} refused"
        return Row(f"hidden side, {what}", bar, words, False, {"views": found})
    middle = {key: statistics.median(x[key] for x in good) for key in ("median", "p90")}
    share = {k: statistics.mean(x[f"within_{k}"] for x in good) for k in (1, 2, 3)}
    words = f"median {middle['median']:.1f} mm, 90 % below {middle['p90']:.1f} mm; within 1, 2, 3 std_m "
    words += ", ".join(f"{share[k]:.2f}" for k in (1, 2, 3))
    words += f"; worst view at two {min(x['within_2'] for x in good):.2f}"
    words += f"; {len(found) - len(good)} refused"
    met = middle["median"] <= float(bar.split()[1])
    return Row(f"hidden side, {what}", bar, words, met, {"views": found})
