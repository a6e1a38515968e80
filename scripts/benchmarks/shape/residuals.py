"""How bad clouds are: what views show by themselves, of real cameras beside rendered ones.

No statistic needs a mesh or the hidden side. `realsense_cloud` was fitted to them, on ten scans of
other things than those in the real clouds. Here bodies by `household.py` are rendered.
"""

import itertools
import math
import statistics
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import binary_closing, binary_fill_holes
from scipy.spatial import KDTree
from torch import Tensor
from train.household import CALIBRATING, GOLDEN_ANGLE, author_household, family_of

from benchmarks.common import Options, Row, bench
from benchmarks.ground_truth import read_cameras
from torchgrasp.cloud import look_at
from torchgrasp.cloud.camera import partial_view
from torchgrasp.cloud.neighbours import draw_rows, find_inliers, nearest
from torchgrasp.cloud.prepare import prepare_cloud
from torchgrasp.cloud.sensor import SensorName
from torchgrasp.foundation.errors import GraspError
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.completion.silhouette import silhouettes
from torchgrasp.values.planning import PointCloud

RADII = (0.003, 0.006, 0.012)
"""Radii [m] of the patches to which a quadric is fitted."""

EDGE = RADII[1]
"""Radius [m] of the patches that show edges and normals."""

APART = ((0.0005, 0.0015), (0.0015, 0.0025), (0.0025, 0.004), (0.004, 0.006))
"""Distances [m] of the points whose residuals are compared: the noise's correlation length."""

ANGLES = (60.0, 70.0)
"""Angles [deg] of incidence beyond which little is measured."""

BEYOND = (0.002, 0.005)
"""Distances [m] beyond a view's outline at which the other camera's points are counted."""

PROBES = 400
"""Most points of a cloud at which patches are fitted."""

LEAST = 10
"""Fewest points of a patch: a quadric has six unknowns."""

SHARP = 0.95
"""Quantile of the curvature that stands for edges."""

CLOSED = 3
"""Rounds of closing, in cells of two pixels: wider gaps at the rim belong to the outline."""

SAME = 0.006
"""Distance [m] within which two cameras measured the same surface."""

ALIKE = 0.7
"""Least cosine between the normals of the same surface."""

ROUNDS = 15
"""Rounds of the alignment of two views by a shift."""

HALF = 0.001
"""Distance [m] at which a pair of points has half the weight in the alignment."""

WEIGHT = 1e-3
"""Weight of no shift, for each pair: it decides along directions that no surface holds."""

BODIES = 12
SIZES = (0.04, 0.2)
"""Number of bodies, and the bounds of their longest side [m]: those of the real things."""

SECOND = 114.0
ELEVATIONS = (35.0, 38.0)
DISTANCES = (0.5, 0.7)
"""Angle [deg] between two cameras from above, their elevations [deg], and their distances [m]: as
the pixels of the real clouds show them.
"""

SENSORS: tuple[SensorName, ...] = ("realsense", "realsense_cloud")
Stats = dict[str, float]


@bench("shape/residuals")
def residuals(o: Options) -> list[Row]:
    """Compare what clouds show by themselves, real and rendered."""
    columns = dict[str, list[Stats]]()
    if o.clouds is not None:
        columns["real"] = list(measure_pairs(real_pairs(o.clouds)))
    for name in SENSORS:
        columns[name] = list(measure_pairs(rendered_pairs(name, o.times(BODIES))))
    keys = list(dict.fromkeys(key for rows in columns.values() for row in rows for key in row))
    found = list[Row]()
    for key in keys:
        middle = {
            name: statistics.median(
                [row[key] for row in rows if not math.isnan(row.get(key, math.nan))] or [math.nan]
            )
            for name, rows in columns.items()
        }
        words = "; ".join(f"{name} {value:.2f}" for name, value in middle.items())
        found.append(Row(key, "-", words, None, dict(middle)))
    return found


def real_pairs(folder: Path) -> Iterator[list[PointCloud]]:
    """Return the views of each thing in a folder of files NAME_CAMERA.ply, where there are two."""
    things = read_cameras(folder).values()
    return (list(map(PointCloud, views.values())) for views in things if len(views) == 2)


def rendered_pairs(sensor: SensorName, count: int) -> Iterator[list[PointCloud]]:
    """Return two views of each of some bodies on z = 0, without the cameras' places."""
    numbers = (k for k in itertools.count() if family_of(k) in CALIBRATING)
    bodies = ((k, author_household(k).mesh) for k in numbers)
    low, high = SIZES
    sized = ((k, mesh) for k, mesh in bodies if low < max(mesh.extents) < high)
    for k, mesh in itertools.islice(sized, count):
        azimuth = GOLDEN_ANGLE * k % 360
        pair = list[PointCloud]()
        for side, (elevation, distance) in enumerate(zip(ELEVATIONS, DISTANCES, strict=True)):
            pose = look_at(azimuth + SECOND * side, elevation, distance, target=mesh)
            seen = partial_view(mesh, pose, n=1000000, noise=sensor, seed=2 * k + side)
            pair.append(PointCloud(seen.points.double()))
        yield pair


def measure_pairs(pairs: Iterable[list[PointCloud]]) -> Iterator[Stats]:
    """Return the statistics of each view of each pair; a view that is refused has none."""
    for pair in pairs:
        for view, other in (pair, pair[::-1]):
            try:
                yield measure_alone(view.points) | compare_two(view, other)
            except GraspError as error:
                print(f"refused: {type(error).__name__}")


def measure_alone(points: Tensor) -> Stats:
    """Return what one view's points (n, 3) [m] on a table show by themselves."""
    rows = draw_rows(len(points), PROBES)
    near = nearest(points, 2)[0][:, 1]
    seen = prepare_cloud(PointCloud(points), torch.Generator().manual_seed(0), up=_up())
    eye = seen.viewpoint
    assert eye is not None
    found: Stats = {
        "points": float(len(points)),
        "spacing of neighbours [mm]": 1e3 * float(near.median()),
        "outliers [%]": 100 * float((~find_inliers(points)).double().mean()),
    }
    patches = {radius: fit_patches(points, rows, radius) for radius in RADII}
    for radius, fits in patches.items():
        name = f"residual, patches of {1e3 * radius:.0f} mm [mm]"
        found[name] = 1e3 * _median(fits.rms[np.isfinite(fits.rms)])
    fits = patches[EDGE]
    good = np.isfinite(fits.rms)
    sharp = float(np.quantile(fits.curvature[good], SHARP)) if good.any() else math.nan
    found["radius of edges [mm]"] = 1e3 / sharp
    ray = unit(points[rows] - eye.double()).numpy()
    steep = np.rad2deg(np.arccos(np.abs((ray * fits.normal).sum(1))[good].clip(0.0, 1.0)))
    for angle in ANGLES:
        found[f"seen at more than {angle:.0f} degrees [%]"] = 100 * float(np.mean(steep > angle))
    fits = patches[RADII[-1]]
    good = np.isfinite(fits.own)
    found |= correlate(points[rows].numpy()[good], fits.own[good])
    found["holes [%]"] = 100 * share_of_holes(points, eye)
    return found


class Patches:
    """Quadrics fitted round m points; NaN where a patch has too few points."""

    def __init__(self, m: int):
        """Make room for m points."""
        self.own = np.full(m, np.nan)  # height [m] of the point over its quadric
        self.rms = np.full(m, np.nan)  # rms residual [m] of the patch
        self.curvature = np.full(m, np.nan)  # greatest curvature [1/m] of the quadric
        self.normal = np.zeros((m, 3))


def fit_patches(points: Tensor, rows: Tensor, radius: float) -> Patches:
    """Return the quadrics fitted to the points (n, 3) [m] within a radius [m] of some of them."""
    array = points.numpy()
    found = Patches(len(rows))
    around = KDTree(array).query_ball_point(array[rows.numpy()], radius)
    for k, (row, some) in enumerate(zip(rows.tolist(), around, strict=True)):
        if len(some) < LEAST:
            continue
        patch = array[some] - array[row]
        axes = np.linalg.svd(patch - patch.mean(0), full_matrices=False)[2]
        u, v, height = (patch @ axes.T).T
        u, v = u / radius, v / radius
        terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], 1)
        quadric = np.linalg.lstsq(terms, height, rcond=None)[0]
        residual = height - terms @ quadric
        _, _, _, a, b, c = quadric / radius**2
        found.own[k] = residual[some.index(row)]
        found.rms[k] = math.sqrt((residual**2).sum() / (len(some) - len(quadric)))
        found.curvature[k] = np.abs(np.linalg.eigvalsh([[2 * a, b], [b, 2 * c]])).max()
        found.normal[k] = axes[2]
    return found


def correlate(points: np.ndarray, residual: np.ndarray) -> Stats:
    """Return the correlation of the residuals (n,) of points (n, 3) [m], by their distance."""
    apart = np.linalg.norm(points[:, None] - points, axis=-1)
    product = residual[:, None] * residual / np.mean(residual**2)
    found: Stats = {}
    for low, high in APART:
        pairs = (apart > low) & (apart < high)
        value = float(product[pairs].mean()) if pairs.sum() > LEAST else math.nan
        found[f"correlation of residuals, {1e3 * low:g} to {1e3 * high:g} mm apart"] = value
    return found


def share_of_holes(points: Tensor, eye: Tensor) -> float:
    """Return the share of the area within a view's outline in which nothing was measured."""
    forward = unit(points.mean(0) - eye.double())
    right = unit(torch.linalg.cross(forward, _up().to(points)))
    local = points - eye.double()
    depth = local @ forward
    down = torch.linalg.cross(forward, right)
    pixels = torch.stack([local @ right / depth, local @ down / depth], 1)
    pitch = np.median(KDTree(pixels.numpy()).query(pixels.numpy(), k=2)[0][:, 1])
    cell = 2 * float(pitch)
    column, row = (torch.round((pixels - pixels.amin(0)) / cell).long() + CLOSED).T
    seen = np.zeros((int(row.max()) + CLOSED + 1, int(column.max()) + CLOSED + 1), dtype=bool)
    seen[row.numpy(), column.numpy()] = True
    whole = np.asarray(binary_fill_holes(binary_closing(seen, iterations=CLOSED)))
    return float((whole & ~seen).sum() / whole.sum())


def compare_two(view: PointCloud, other: PointCloud) -> Stats:
    """Return how a second camera's points lie at those of a first: their distance where both see,
    before and after a shift, and how many are beyond the first's outline then.
    """
    first, second = (
        prepare_cloud(x, torch.Generator().manual_seed(0), up=_up()) for x in (view, other)
    )
    tree = KDTree(first.points.numpy())

    def pairs(shift: Tensor) -> tuple[Tensor, Tensor]:
        """Return normals and signed distances [m] of the pairs of points of one surface."""
        away, index = map(torch.from_numpy, tree.query((second.points + shift).numpy()))
        normals = first.normals[index]
        same = (away < SAME) & ((normals * second.normals).sum(1) > ALIKE)
        offset = second.points + shift - first.points[index]
        return normals[same], (offset * normals).sum(1)[same]

    shift = torch.zeros(3, dtype=torch.float64)
    normals, height = pairs(shift)
    if len(height) < LEAST:
        return {}
    found = _distances("where both cameras see", height)
    for _ in range(ROUNDS):
        weight = 1 / (1 + (height / HALF) ** 2)
        held = WEIGHT * len(height) * torch.eye(3, dtype=torch.float64)
        system = (weight[:, None] * normals).T @ normals + held
        shift = shift - torch.linalg.solve(system, ((weight * height)[:, None] * normals).sum(0))
        normals, height = pairs(shift)
        if len(height) < LEAST:
            return found
    found |= _distances("the same, after a shift", height)
    outline = silhouettes(PointCloud(first.points, first.normals, first.viewpoint))
    beyond = outline.hull_distance(other.points + shift)
    for limit in BEYOND:
        share = 100 * float((beyond > limit).double().mean())
        found[f"beyond the outline by {1e3 * limit:.0f} mm, after a shift [%]"] = share
    return found


def _distances(what: str, height: Tensor) -> Stats:
    """Return the median and the 90 % quantile of distances [m]."""
    off = 1e3 * height.abs()
    return {
        f"{what}, median [mm]": float(off.median()),
        f"{what}, 90 % [mm]": float(off.quantile(0.9)),
    }


def _median(values: np.ndarray) -> float:
    """Return the median, NaN of nothing."""
    return float(np.median(values)) if len(values) else math.nan


def _up() -> Tensor:
    """Return the upward direction of the clouds."""
    return torch.tensor([0.0, 0.0, 1.0])
