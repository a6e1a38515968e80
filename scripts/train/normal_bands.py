"""Fit the deviation of normals to true surfaces, and try it on families of objects left out.

Errors have heavier tails than a normal distribution. So the parts' factors are those of a t distribution, and all are
then scaled until 1, 2 and 3 deviations hold what they say.
"""

import hashlib
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from benchmarks.ground_truth import nearest_on_mesh, sample_mesh
from jaxtyping import Float
from torch import Tensor

from torchgrasp.columns import format_columns
from torchgrasp.evaluation.intervals import mean_over
from torchgrasp.geometry.linalg import unit
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.normal_band import normal_parts
from torchgrasp.shape.surface import extract_surface
from torchgrasp.values import PointCloud

if TYPE_CHECKING:
    import trimesh

SAMPLES = 300
"""Points of the estimated surface of a view."""
LOW, SHARE_OF_HEIGHT = 0.010, 0.3
"""Least height [m] of these points; of low things this share of their height. No finger comes lower."""
FREEDOM = 5.0
"""Degrees of freedom of the errors: with 4 to 8 the factors differ by less than a tenth."""
HIDDEN = 0.006
"""Distance [m] of hidden surface from the cloud."""
EDGE_BEND = 40.0
"""Bend [1/m] of an edge: 18 degrees on 8 mm."""
ROUNDS = 60
"""Iterations of the fit, which takes 20."""
FORMER = (1.0, 0.0, 0.0, 0.0)
"""The posterior's own deviation alone, to compare with."""

Row = dict[str, Any]
"""A view: "family", and by point "error" (n, 2) [rad], "parts" (n, 2, 4) [rad^2], and "hidden" and "edge" (n,)."""
Fitted = tuple[float, float, float, float]
"""`OWN`, `BEND`, `EDGE` and `LEAST` of torchgrasp/shape/normal_band.py."""


def measure_normals(shape: ShapeGP, mesh: "trimesh.Trimesh", cloud: PointCloud) -> Row:
    """Return errors of normals on the estimated surface of a view, and the parts of their variance."""
    from scipy.spatial import KDTree

    points, _ = sample_mesh(extract_surface(shape).mesh(), SAMPLES, np.random.default_rng(0))
    low, high = mesh.bounds[:, 2]
    points = points[shape.contains(points) & (points[:, 2] > low + min(LOW, SHARE_OF_HEIGHT * (high - low)))]
    x = shape.normalise(points)
    normals, axes = unit(shape.mean_and_gradient(x)[1]), x.new_zeros(len(x), 2, 3)
    parts = x.new_ones(len(x), 2, 4)
    for wall, own in zip(shape.walls, shape.wall_at(x).T, strict=True):
        found = normal_parts(wall, x[own], shape.scale, shape.std_factor)
        axes[own] = found.axes
        parts[own, :, :3] = torch.stack([found.own, found.bend, found.edge], -1)
    _, true = nearest_on_mesh(mesh, points, normals)
    known = ~true.isnan().any(-1)
    error, parts = (true[:, None] * axes).sum(-1)[known], parts[known]
    far = torch.from_numpy(KDTree(cloud.points.numpy()).query(points[known].numpy())[0]) > HIDDEN
    bend = shape.jet(x[known]).normal_jacobian / shape.scale
    edge = torch.linalg.matrix_norm(bend, ord=2) > EDGE_BEND
    return {"error": error, "parts": parts, "hidden": far, "edge": edge}


def fit_normals(rows: Sequence[Row], fit_scale: Callable[[list[np.ndarray]], float]) -> Fitted:
    """Return the factors of the parts for views that count alike; `fit_scale` is that of ratios of views."""
    rows = [row for row in rows if len(row["error"])]
    error, parts = torch.cat([row["error"] for row in rows]), torch.cat([row["parts"] for row in rows])
    weight = torch.cat([torch.full((len(row["error"]), 1), 1 / len(row["error"])) for row in rows]).double()
    size = parts.mean((0, 1)).clamp(min=1e-12)
    logs = torch.full((4,), -1.5, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([logs], max_iter=ROUNDS, line_search_fn="strong_wolfe")
    start = error.square().mean() / size

    def loss() -> Tensor:
        optimiser.zero_grad()
        variance = parts @ (start * logs.exp())
        tail = (FREEDOM + 1) * torch.log1p(error.square() / (FREEDOM * variance))
        value = (weight * (variance.log() + tail)).sum() / weight.sum()
        value.backward()
        return value

    optimiser.step(loss)  # pyright: ignore[reportArgumentType]
    squares = (start * logs.detach().exp()).tolist()
    fitted = tuple(s**0.5 for s in squares)
    scale = fit_scale([ratios(row, fitted).numpy() for row in rows])
    return tuple(round(scale * f, 4) for f in fitted)  # pyright: ignore[reportReturnType]


def ratios(row: Row, fitted: Sequence[float]) -> Float[Tensor, "n 2"]:
    """Return errors over their deviations with these factors."""
    squares = torch.tensor(fitted, dtype=torch.float64).square()
    return row["error"].abs() / (row["parts"] @ squares).sqrt()


def report_normals(rows: Sequence[Row], fit_scale: Callable[[list[np.ndarray]], float]) -> str:
    """Return the factors fitted to all, and what bands hold on the half of families that did not choose them."""
    halves = [[row for row in rows if is_tuning(row["family"]) == half] for half in (True, False)]
    chosen = [fit_normals(half, fit_scale) for half in halves]
    heads = ("normals", "points", "off by deg", "std deg", "1 std %", "2 %", "3 %", "own 1 2 3 %")
    table: list[tuple[str, ...]] = [heads]
    for hidden in (False, True):
        for edge in (False, True, None):
            table.append(_line(halves, chosen, hidden, edge))
    told = (
        f"OWN, BEND, EDGE, LEAST = {fit_normals(rows, fit_scale)}\nhalves of families {chosen}, each tried on the other"
    )
    return f"{told}\n{format_columns(table, left=(0,))}"


def _line(halves: list[list[Row]], chosen: list[Fitted], hidden: bool, edge: bool | None) -> tuple[str, ...]:
    """Return the row of one place: each half of families with the factors of the other."""
    shares: dict[str, list[tuple[str, float]]] = {}
    off, std = [], []
    for half, fitted in zip(halves, reversed(chosen), strict=True):
        for row in half:
            here = (row["hidden"] == hidden) & (torch.ones_like(row["edge"]) if edge is None else row["edge"] == edge)
            if not bool(here.any()):
                continue
            off.append(row["error"][here])
            std.append((row["error"] / ratios(row, fitted)).abs()[here])
            for name, factors in (("new", fitted), ("own", FORMER)):
                for k in (1, 2, 3):
                    share = float((ratios(row, factors)[here] <= k).double().mean())
                    shares.setdefault(f"{name}{k}", []).append((row["family"], 100 * share))
    place = "hidden" if hidden else "seen"
    place += "" if edge is None else ", edge" if edge else ", flat"
    if not off:
        return (place, "0", *[""] * 6)
    middle = float(torch.rad2deg(torch.cat(off).abs().quantile(0.683)))
    cells = []
    for k in (1, 2, 3):
        found = mean_over(shares[f"new{k}"])
        cells.append(f"{found.value:.1f} [{found.low:.1f}, {found.high:.1f}]")
    own = " ".join(f"{mean_over(shares[f'own{k}']).value:.1f}" for k in (1, 2, 3))
    deviation = float(torch.rad2deg(torch.cat(std).nanmedian()))
    return place, str(len(torch.cat(off))), f"{middle:.1f}", f"{deviation:.1f}", *cells, own


def is_tuning(family: str) -> bool:
    """Tell whether a family is in the half that constants are chosen on."""
    return hashlib.sha256(family.encode()).digest()[0] % 2 == 0
