"""Where the error sits: pictures of the views whose hidden surface is farthest off, for each group of objects."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

from benchmarks.common import Row
from benchmarks.ground_truth import nearest_on_mesh, read_views
from benchmarks.shape.accuracy import RESOLUTION, measure_shape
from torchgrasp.app.report.canvas import INK, PAPER, Canvas, draw_bar, map_colors
from torchgrasp.app.report.stills import rotated, view_of
from torchgrasp.data import read_group
from torchgrasp.files import write_file
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.surface import Surface, extract_surface
from torchgrasp.values import PointCloud

if TYPE_CHECKING:
    import trimesh

WORST, COLUMNS = 10, 5
"""Views on a page, and views in a row."""
TILE = (270, 216)
"""Width and height of one picture [pixels]."""
MOST = 15.0
"""Error and standard deviation [mm] at the bright end of the colours."""
FINE = 4000
"""Faces of the true mesh, at least, whose corners carry the colours."""


def bench_worst(objects: Path, views: Sequence[str], out: Path) -> list[Row]:
    """Draw a page for each group: its views of largest hidden median error, each from behind.

    Above is the true surface, coloured by its distance to the estimated one. Below is the estimated one with its std_m.
    """
    found = []
    for name, view, cloud, mesh in tqdm(
        list(read_views(objects, views=views)), desc="worst", disable=None, leave=False
    ):
        error = measure_shape(fit_shape(cloud, table=0.0), mesh, cloud)["hidden_median_mm"]
        if np.isfinite(error):
            found.append((read_group(objects, name) or "all", error, name, view, cloud, mesh))
    rows = []
    for group in sorted({group for group, *_ in found}):
        worst = sorted((view for view in found if view[0] == group), key=lambda view: -view[1])[:WORST]
        page = out / f"worst_{group}.jpg"
        _draw_page(worst, page)
        named = ", ".join(f"{name} {view} {error:.1f} mm" for _, error, name, view, _, _ in worst)
        rows.append(Row(f"worst views, {group}", "-", f"{named}: {page}", None, {}))
    return rows


def _draw_page(worst: Sequence[tuple[Any, ...]], path: Path) -> None:
    """Draw the views side by side and write the picture."""
    lines, size = -(-len(worst) // COLUMNS), 2 * TILE[1] + 40
    sheet = Image.new("RGB", (COLUMNS * TILE[0], lines * size + 80), PAPER)
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(13)
    for k, (_, error, name, view, cloud, mesh) in enumerate(worst):
        left, top = k % COLUMNS * TILE[0], k // COLUMNS * size
        pen.text((left + 8, top + 2), f"{name}\n{view}: {error:.1f} mm", INK, font)
        surface = extract_surface(fit_shape(cloud, table=0.0), RESOLUTION)
        for row, tile in enumerate(_draw_view(surface, mesh, cloud)):
            sheet.paste(tile, (left, top + 36 + row * TILE[1]))
    draw_bar(sheet, "above: error of the true surface; below: std_m of the estimated one [mm]", MOST, "viridis")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, lambda file: sheet.save(file, format="JPEG", quality=82))


def _draw_view(surface: Surface, mesh: "trimesh.Trimesh", cloud: PointCloud) -> list[Image.Image]:
    """Return the true and the estimated surface, seen from where the camera was not."""
    fine = mesh
    while len(fine.faces) < FINE:
        fine = fine.subdivide()
    vertices = np.asarray(fine.vertices, dtype=np.float64)
    points = torch.from_numpy(vertices)
    error = 1e3 * torch.linalg.vector_norm(nearest_on_mesh(surface.mesh(), points)[0] - points, dim=-1).numpy()
    back = rotated(view_of(cloud), 180.0)
    shown = (
        (vertices, np.asarray(fine.faces), error, None),
        (surface.vertices.numpy(), surface.faces.numpy(), 1e3 * surface.std_m.numpy(), surface.normals.numpy()),
    )
    tiles = []
    for corners, faces, values, normals in shown:
        canvas = Canvas()
        canvas.add_mesh(corners, faces, map_colors(values / MOST, "viridis"), normals)
        tiles.append(Image.open(io.BytesIO(canvas.render_png(vertices, back))).resize(TILE, Image.Resampling.LANCZOS))
    return tiles
