"""Errors of a shape against the true mesh, and coverage of its std_m."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from benchmarks.common import mean_over
from benchmarks.ground_truth import nearest_on_mesh, sample_mesh
from torchgrasp.files import format_columns
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import extract_surface
from torchgrasp.values.planning import PointCloud

if TYPE_CHECKING:
    import trimesh

HIDDEN = 0.006
"""Distance [m] from the cloud beyond which the true surface counts as hidden."""
SURE_VARIANCE = 0.03
"""Variance, normalised, below which a planner takes contacts (the paper's threshold)."""
RESOLUTION = 56
"""Cells of the grid of the estimated surface along the domain's diameter."""
SAMPLES = 3000
"""Points on the true and on the estimated surface."""
EDGE_RADIUS = 0.008
EDGE_ANGLES = (25.0, 120.0)
"""At an edge normals within 8 mm differ by 25 to 120 degrees; by more they are of two sides of a
wall.
"""
TABLE_FACE = 0.002
"""Height [m] over the lowest point within which downward surface is the face on the table."""

Row = dict[str, Any]
"""Numbers by name: lengths in mm, angles in degrees, shares in [0, 1], NaN where nothing was
measured.
"""


def measure_shape(shape: ShapeGP, mesh: "trimesh.Trimesh", cloud: PointCloud, seed: int = 0) -> Row:
    """Return errors of a shape and the coverage of its std_m.

    Names begin with the part of the surface:

    * "seen_": true surface within 6 mm of the cloud.
    * "hidden_": the other true surface, without the face on the table.
    * "sure_": estimated surface of variance below 0.03.

    Names end with the measure:

    * "median_mm", "p90_mm": distance between true and estimated surface.
    * "normal_deg": median angle between their normals.
    * "flat_deg", "edge_deg": the same off and at edges, where true normals within 8 mm differ by
      over 25 degrees.
    * "within_1", "_2", "_3": share of the true surface within k std_m. Surface outside the domain
      is missed.
    * "raw_1", "_2", "_3": the same with the paper's own deviation, sqrt(variance).
    * "share": share of the estimated surface that is sure.

    "chamfer_mm" is the mean distance from each whole surface to the other, averaged over the two
    (L1).

    Args:
        shape: the posterior [m].
        mesh: the true surface in the frame of the cloud [m].
        cloud: what the camera saw, before cleaning.
        seed: of the samples.
    """
    generator = np.random.default_rng(seed)
    surface = extract_surface(shape, RESOLUTION).mesh()
    points, normals = sample_mesh(mesh, SAMPLES, generator)
    ours, _ = sample_mesh(surface, SAMPLES, generator)
    ways = ((surface, points), (mesh, ours))
    chamfer = sum(float((nearest_on_mesh(m, p)[0] - p).norm(dim=-1).mean()) for m, p in ways) / 2
    face_on_table = (points[:, 2] < float(mesh.bounds[0, 2]) + TABLE_FACE) & (normals[:, 2] < -0.7)
    row = _measure_true_surface(
        shape, surface, points[~face_on_table], normals[~face_on_table], cloud
    )
    return (
        row
        | {"chamfer_mm": 1e3 * chamfer}
        | _measure_sure_surface(shape, ours[shape.contains(ours)], mesh)
    )


def _measure_true_surface(
    shape: ShapeGP,
    surface: "trimesh.Trimesh",
    points: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    cloud: PointCloud,
) -> Row:
    """Return the numbers of the seen and of the hidden part of the true surface, given by points
    and normals.
    """
    from scipy.spatial import KDTree

    far = torch.from_numpy(KDTree(cloud.points.numpy()).query(points.numpy())[0]) > HIDDEN
    edge = find_edges(points, normals)
    (feet, _) = nearest_on_mesh(surface, points)
    error = torch.linalg.vector_norm(feet - points, dim=-1)
    # The surface may reach a little over the domain, where `predict` knows the prior alone.
    angle = _angle(unit(shape.jet(shape.normalise(feet)).gradient), normals)
    inside = shape.contains(points)
    estimate = shape.predict(points[inside])
    ratio = torch.full_like(error, torch.inf)
    # Distance and std_m in metres are both divided by the slope there, which cancels.
    ratio[inside] = estimate.distance.abs() / (shape.std_factor * estimate.variance.sqrt())
    row: Row = {}
    for name, where in (("seen", ~far), ("hidden", far)):
        row |= {
            f"{name}_{key}": 1e3 * _quantile(error[where], q)
            for key, q in (("median_mm", 0.5), ("p90_mm", 0.9))
        }
        parts = {"normal_deg": where, "flat_deg": where & ~edge, "edge_deg": where & edge}
        row |= {f"{name}_{key}": _quantile(angle[part], 0.5) for key, part in parts.items()}
        row |= {f"{name}_within_{k}": _share(ratio[where] <= k) for k in (1, 2, 3)}
        row |= {f"{name}_raw_{k}": _share(shape.std_factor * ratio[where] <= k) for k in (1, 2, 3)}
    return row


def _measure_sure_surface(
    shape: ShapeGP, points: Float[Tensor, "n 3"], mesh: "trimesh.Trimesh"
) -> Row:
    """Return the numbers of the part of the estimated surface that is sure, given points of all of
    it.
    """
    estimate = shape.predict(points)
    sure = estimate.variance < SURE_VARIANCE
    feet, true_normal = nearest_on_mesh(mesh, points[sure])
    error = torch.linalg.vector_norm(feet - points[sure], dim=-1)
    angle = _angle(estimate.normal[sure], true_normal)
    numbers = 1e3 * _quantile(error, 0.5), _quantile(angle, 0.5), _share(sure)
    return dict(zip(("sure_median_mm", "sure_normal_deg", "sure_share"), numbers, strict=True))


def format_table(rows: Sequence[Row]) -> str:
    """Return rows of numbers as a table with means."""
    within = ("hidden 1 2 3 sd", "seen 1 2 3 sd", "paper's 1 2 3 sd")
    table: list[tuple[str, ...]] = [
        ("object", "view", "seen mm", "hidden mm  deg", *within, "sure mm  deg")
    ]

    def line(name: str, view: str, r: Row) -> tuple[str, ...]:
        return (
            name,
            view,
            f"{r['seen_median_mm']:.1f}/{r['seen_p90_mm']:.1f}",
            f"{r['hidden_median_mm']:.1f}/{r['hidden_p90_mm']:.1f}  {r['hidden_normal_deg']:.0f}",
            *(
                " ".join(f"{r[f'{kind}_{k}']:.2f}" for k in (1, 2, 3))
                for kind in ("hidden_within", "seen_within")
            ),
            " ".join(f"{r[f'hidden_raw_{k}']:.2f}" for k in (1, 2, 3)),
            f"{r['sure_median_mm']:.1f}  {r['sure_normal_deg']:.0f}",
        )

    names = sorted({r["object"] for r in rows})
    for name in names:
        mine = [r for r in rows if r["object"] == name]
        table += [line(name, r["view"], r) for r in mine] + [line(name, "mean", mean_row(mine))]
    table.append(line("all", "mean", mean_row(rows)))
    least = min(r["hidden_within_2"] for r in rows)
    text = format_columns(table, left=range(len(table[0])))
    return f"{text}\nleast share of a view's hidden surface within 2 std_m: {least:.2f}"


def format_groups(rows: Sequence[Row]) -> str:
    """Return the mean of each group of objects, with its interval over families, as a table."""
    columns = {
        "seen median mm": ("seen_median_mm", 2),
        "flat deg": ("seen_flat_deg", 1),
        "edge deg": ("seen_edge_deg", 1),
        "hidden median mm": ("hidden_median_mm", 1),
        "90 % mm": ("hidden_p90_mm", 1),
        "normals deg": ("hidden_normal_deg", 0),
        "within 1 sd %": ("hidden_within_1", 0),
        "2 sd %": ("hidden_within_2", 0),
        "chamfer mm": ("chamfer_mm", 1),
    }
    groups = sorted({str(row["group"]) for row in rows})
    table: list[tuple[str, ...]] = [("group", "views", *columns)]
    for group in (*groups, *(["all"] if len(groups) > 1 else [])):
        mine = [row for row in rows if group in (row["group"], "all")]
        cells = []
        for key, digits in columns.values():
            scale = 100 if "within" in key else 1
            found = mean_over((str(row["family"]), scale * row[key]) for row in mine)
            cells.append(
                f"{found.value:.{digits}f} [{found.low:.{digits}f}, {found.high:.{digits}f}]"
            )
        table.append((group or "-", str(len(mine)), *cells))
    return format_columns(table, left=(0,))


def mean_row(rows: Sequence[Row]) -> Row:
    """Return the mean of every number of the first row over the rows that measured it."""
    numbers = [key for key, value in rows[0].items() if isinstance(value, float)]
    table = {key: np.array([row.get(key, np.nan) for row in rows]) for key in numbers}
    return {
        key: float(v[np.isfinite(v)].mean()) if np.isfinite(v).any() else float("nan")
        for key, v in table.items()
    }


def find_edges(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
    """Tell at which samples of a surface others nearby are turned away, but not to the other side
    of a wall.
    """
    close = torch.cdist(points, points) < EDGE_RADIUS
    angle = normals @ normals.T
    low, high = (math.cos(math.radians(degrees)) for degrees in EDGE_ANGLES)
    return (close & (angle < low) & (angle > high)).any(-1)


def _angle(a: Float[Tensor, "n 3"], b: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Return the angle [deg] between unit vectors."""
    return torch.rad2deg(torch.arccos((a * b).sum(-1).clamp(-1.0, 1.0)))


def _quantile(values: Float[Tensor, "n"], q: float) -> float:
    """Return a quantile, NaN of nothing."""
    return float(values.quantile(q)) if len(values) else float("nan")


def _share(mask: Bool[Tensor, "n"]) -> float:
    """Return the share that is true, NaN of nothing."""
    return float(mask.double().mean()) if len(mask) else float("nan")
