"""How true a shape is: errors of the estimated surface and coverage of its k-sigma band, against the true mesh."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.cloud.io.read import read_cloud
from torchgrasp.errors import BadArgument
from torchgrasp.linalg import unit
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import Surface, extract_surface
from torchgrasp.values import PointCloud

if TYPE_CHECKING:
    import trimesh

HIDDEN = 0.006
"""Distance [m] from the cloud beyond which the true surface counts as never seen."""
SURE_VARIANCE = 0.03
"""The paper's threshold of the variance, normalised, under which a planner takes contacts."""
RESOLUTION = 56
"""Cells of the grid of the estimated surface along the domain's diameter."""
SAMPLES = 3000
"""Points on the true and on the estimated surface."""
NEIGHBOURS = 8
"""Triangles, found by their nearest sample, among which the nearest point of a surface is sought."""
TABLE_FACE = 0.002
"""Height [m] over the lowest point up to which surface that looks down is the face on the table."""

Row = dict[str, Any]
"""Plain numbers by name; lengths in mm, angles in degrees, shares in [0, 1], NaN where nothing was measured."""


def measure_accuracy(
    objects: Path,
    support: Literal["camera", "paper"] = "camera",
    camera: bool = True,
    table: bool = True,
    only: Sequence[str] = (),
) -> list[Row]:
    """Return a row of `measure_shape` for every noisy view of a folder of objects, with "object" and "view" in it.

    Args:
        objects: folder with `manifest.json` ("objects" by name, each with "suggested_scale" and "views" with
            "T_object_camera") and a folder for each object with `mesh.ply` and `<view>_noisy.ply` [m], resting at
            z = 0.
        support: of `fit_shape`.
        camera: whether the camera's position is given.
        table: whether the table is given.
        only: names of objects to keep; all of them if empty.

    Raises:
        BadArgument: no manifest, or one without objects to measure.
    """
    return [
        {"object": name, "view": view}
        | measure_shape(fit_shape(cloud, support=support, table=0.0 if table else None), mesh, cloud)
        for name, view, cloud, mesh in read_views(objects, camera, only)
    ]


def read_views(
    objects: Path, camera: bool = True, only: Sequence[str] = ()
) -> Iterator[tuple[str, str, PointCloud, "trimesh.Trimesh"]]:
    """Yield name, view, noisy cloud and true mesh of every view, at the object's suggested scale; see `measure_accuracy`."""
    import trimesh

    for name, view in list_views(objects, only=only):
        mesh = trimesh.load_mesh(Path(objects) / name / "mesh.ply").apply_scale(object_scale(objects, name))
        yield name, view, read_view(objects, name, view, camera), mesh


def list_views(objects: Path, whole: bool = False, only: Sequence[str] = ()) -> list[tuple[str, str]]:
    """Return the name of each object with that of each of its views, or with "whole"; see `measure_accuracy`."""
    entries = _entries(objects, only)
    return [(name, view) for name in entries for view in (["whole"] if whole else sorted(entries[name]["views"]))]


def read_view(objects: Path, name: str, view: str, camera: bool = True) -> PointCloud:
    """Return the noisy cloud of a view, or as "whole" the whole one with its normals, at the suggested scale."""
    entry, folder, scale = _entries(objects, [name])[name], Path(objects) / name, object_scale(objects, name)
    if view == "whole":
        cloud = read_cloud(folder / "full_normals.ply")
        return PointCloud(cloud.points * scale, cloud.normals)
    cloud = read_cloud(folder / f"{view}_noisy.ply")
    eye = torch.tensor(entry["views"][view]["T_object_camera"], dtype=torch.float64)[:3, 3]
    return PointCloud(cloud.points * scale, None, eye * scale if camera else None)


def object_scale(objects: Path, name: str) -> float:
    """Return what an object's mesh and clouds are to be multiplied by, so that a hand can grasp it."""
    return float(_entries(objects, [name])[name].get("suggested_scale", 1.0))


def _entries(objects: Path, only: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return what the manifest says of the objects asked for, by their names in order."""
    manifest = Path(objects) / "manifest.json"
    if not manifest.is_file():
        raise BadArgument("objects", str(objects), "a folder with a manifest.json")
    entries = json.loads(manifest.read_text()).get("objects", {})
    found = {name: entries[name] for name in sorted(entries) if not only or name in only}
    if not found:
        raise BadArgument("objects", f"{manifest} with {sorted(entries)}", "a manifest with the objects asked for")
    return found


def measure_shape(shape: ShapeGP, mesh: "trimesh.Trimesh", cloud: PointCloud, seed: int = 0) -> Row:
    """Return how far the shape is from the true mesh, where it was seen and where not, and how true its std_m is.

    Names begin with "seen_" (true surface within 6 mm of the cloud), "hidden_" (the rest, without the face on the
    table) or "sure_" (estimated surface of variance < 0.03). For seen and hidden: "median_mm" and "p90_mm" from the
    true surface to the estimated one, "normal_deg" (median) between their normals, "within_1", "_2", "_3": the share
    whose signed distance is within 1, 2, 3 std_m of zero; "raw_1", "_2", "_3" the same with the paper's own standard
    deviation, sqrt(variance), in place of std_m. For sure: median_mm, normal_deg, and "share" of the surface. True
    surface outside the shape's domain counts as missed by every band.

    Args:
        shape: the posterior [m].
        mesh: the true surface in the frame of the cloud [m].
        cloud: what was seen, before cleaning.
        seed: of the samples.
    """
    from scipy.spatial import KDTree

    generator = np.random.default_rng(seed)
    points, normals = sample_mesh(mesh, SAMPLES, generator)
    face_on_table = (points[:, 2] < float(mesh.bounds[0, 2]) + TABLE_FACE) & (normals[:, 2] < -0.7)
    points, normals = points[~face_on_table], normals[~face_on_table]
    far = torch.from_numpy(KDTree(cloud.points.numpy()).query(points.numpy())[0]) > HIDDEN

    surface = mesh_from_surface(extract_surface(shape, RESOLUTION))
    at, _ = nearest_on_mesh(surface, points)
    error = torch.linalg.vector_norm(at - points, dim=-1)
    # The surface may reach a little over the domain, where `predict` refuses.
    angle = _angle(unit(shape.jet(shape.normalise(at)).gradient), normals)
    inside = shape.contains(points)
    found = shape.predict(points[inside])
    ratio = torch.full_like(error, torch.inf)
    ratio[inside] = found.distance.abs() * shape.scale / found.std_m
    row: Row = {}
    for name, where in (("seen", ~far), ("hidden", far)):
        row |= {
            f"{name}_median_mm": 1e3 * _quantile(error[where], 0.5),
            f"{name}_p90_mm": 1e3 * _quantile(error[where], 0.9),
            f"{name}_normal_deg": _quantile(angle[where], 0.5),
        }
        row |= {f"{name}_within_{k}": _share(ratio[where] <= k) for k in (1, 2, 3)}
        row |= {f"{name}_raw_{k}": _share(shape.std_factor * ratio[where] <= k) for k in (1, 2, 3)}

    ours, _ = sample_mesh(surface, SAMPLES, generator)
    ours = ours[shape.contains(ours)]
    found = shape.predict(ours)
    sure = found.variance < SURE_VARIANCE
    at, true_normal = nearest_on_mesh(mesh, ours[sure])
    row["sure_median_mm"] = 1e3 * _quantile(torch.linalg.vector_norm(at - ours[sure], dim=-1), 0.5)
    row["sure_normal_deg"] = _quantile(_angle(found.normal[sure], true_normal), 0.5)
    row["sure_share"] = _share(sure)
    return row


def format_table(rows: Sequence[Row]) -> str:
    """Return rows of `measure_accuracy` as a table, one line a view, then the mean of each object and of all views."""
    titles = (
        "object",
        "view",
        "seen mm",
        "hidden mm  deg",
        "hidden 1 2 3 sd",
        "seen 1 2 3 sd",
        "paper's 1 2 3 sd",
        "sure mm  deg",
    )
    widths = (12, 7, 12, 20, 18, 18, 18, 12)
    lines = ["".join(t.ljust(w) for t, w in zip(titles, widths, strict=True)).rstrip()]

    def line(name: str, view: str, r: Row) -> str:
        cells = (
            name,
            view,
            f"{r['seen_median_mm']:.1f}/{r['seen_p90_mm']:.1f}",
            f"{r['hidden_median_mm']:.1f}/{r['hidden_p90_mm']:.1f}  {r['hidden_normal_deg']:.0f}",
            *(" ".join(f"{r[f'{kind}_{k}']:.2f}" for k in (1, 2, 3)) for kind in ("hidden_within", "seen_within")),
            " ".join(f"{r[f'hidden_raw_{k}']:.2f}" for k in (1, 2, 3)),
            f"{r['sure_median_mm']:.1f}  {r['sure_normal_deg']:.0f}",
        )
        return "".join(c.ljust(w) for c, w in zip(cells, widths, strict=True)).rstrip()

    names = sorted({r["object"] for r in rows})
    for name in names:
        mine = [r for r in rows if r["object"] == name]
        lines += [line(name, r["view"], r) for r in mine]
        lines.append(line(name, "mean", mean_row(mine)))
    lines.append(line("all", "mean", mean_row(rows)))
    lines.append(
        f"least share of a view's hidden surface within 2 std_m: {min(r['hidden_within_2'] for r in rows):.2f}"
    )
    return "\n".join(lines)


def mean_row(rows: Sequence[Row]) -> Row:
    """Return the mean of every number over rows, those left out where nothing was measured."""
    numbers = [key for key, value in rows[0].items() if isinstance(value, float)]
    table = {key: np.array([row[key] for row in rows]) for key in numbers}
    return {key: float(v[np.isfinite(v)].mean()) if np.isfinite(v).any() else float("nan") for key, v in table.items()}


def mesh_from_surface(surface: Surface) -> "trimesh.Trimesh":
    """Return an estimated surface as a mesh."""
    import trimesh

    return trimesh.Trimesh(surface.vertices.cpu().numpy(), surface.faces.cpu().numpy(), process=False)


def sample_mesh(
    mesh: "trimesh.Trimesh", n: int, generator: np.random.Generator
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Return n points of a mesh, evenly by area, and their face normals."""
    points, _, normals = _sample(mesh, n, generator)
    return torch.from_numpy(points), torch.from_numpy(normals)


def nearest_on_mesh(
    mesh: "trimesh.Trimesh", points: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Return the nearest point of a mesh to each point, and its face normal.

    The faces of the eight nearest of 20000 samples are tried, exactly: much faster than
    a search over all faces.
    """
    from scipy.spatial import KDTree
    from trimesh.triangles import closest_point

    if not len(points):
        return points, points
    samples, faces, _ = _sample(mesh, 20000, np.random.default_rng(0))
    place = points.numpy()
    _, index = KDTree(samples).query(place, k=NEIGHBOURS)
    candidates = faces[index]  # (n, k)
    repeated = np.repeat(place, NEIGHBOURS, 0)
    at = closest_point(mesh.triangles[candidates.reshape(-1)], repeated).reshape(len(place), NEIGHBOURS, 3)
    best = np.linalg.norm(at - place[:, None], axis=-1).argmin(1)
    rows = np.arange(len(place))
    normals = _face_normals(mesh, candidates[rows, best])
    return torch.from_numpy(at[rows, best]), torch.from_numpy(normals)


def _sample(
    mesh: "trimesh.Trimesh", n: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, faces and face normals, evenly by area."""
    corners = np.asarray(mesh.triangles)
    area = np.cumsum(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1))
    face = np.minimum(np.searchsorted(area, generator.random(n) * area[-1]), len(area) - 1)
    u, v = generator.random((2, n))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = corners[face].transpose(1, 0, 2)
    return a + u[:, None] * (b - a) + v[:, None] * (c - a), face, _face_normals(mesh, face)


def _face_normals(mesh: "trimesh.Trimesh", faces: np.ndarray) -> np.ndarray:
    """Return unit normals of faces by their winding, for thin ones too."""
    a, b, c = np.asarray(mesh.triangles)[faces].transpose(1, 0, 2)
    across = np.cross(b - a, c - a)
    return across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-300)


def _angle(a: Float[Tensor, "n 3"], b: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Return the angle [deg] between unit vectors."""
    return torch.rad2deg(torch.arccos((a * b).sum(-1).clamp(-1.0, 1.0)))


def _quantile(values: Float[Tensor, "n"], q: float) -> float:
    """Return a quantile, NaN of nothing."""
    return float(values.quantile(q)) if len(values) else float("nan")


def _share(mask: Bool[Tensor, "n"]) -> float:
    """Return the share that is true, NaN of nothing."""
    return float(mask.double().mean()) if len(mask) else float("nan")
