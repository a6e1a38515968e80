"""Fig. 4 of the paper with the objects of torchgrasp: clouds, whole and partial, and the shapes
that follow.
"""

from pathlib import Path

import numpy as np
from PIL import Image

from paper.sheet import render_tile, save_sheet
from paper.table3 import sample_whole
from torchgrasp import PointCloud, ShapeGP, fit_shape, list_objects, load_object
from torchgrasp.app.report.canvas import INK, Canvas, map_colors
from torchgrasp.app.report.stills import rotated, view_of
from torchgrasp.shape.surface import Surface, extract_surface

TILE = (340, 360)
"""Width and height of one picture of a figure [pixels]."""
BUDGET = 200
"""Observations of a whole cloud; a partial one has some 160, with those that complete it."""
ROWS = (
    "whole cloud",
    "shape from the whole cloud",
    "partial cloud",
    "the paper's shape from it",
    "the default shape",
)
ARROW = 0.07
"""Length of the observed normals over the object's diagonal."""
TURN = 70.0
"""Angle [deg] from the camera of the partial cloud to the eye of the figure: both sides show."""


def fig4(out: Path, seed: int = 0) -> None:
    """Draw Fig. 4: four objects as whole and partial clouds, and their shapes coloured by standard
    deviation.

    Two shapes are of the partial cloud: with the paper's observations, and with torchgrasp's own.
    Arrows are the points that a shape observes on the surface, with its normals. They are of the
    cloud and of its completion.

    Args:
        out: folder of fig4.png; it is made where it does not exist.
        seed: of the draw of points.
    """
    scenes = []
    for name in list_objects():
        thing = load_object(name)
        clouds = (sample_whole(thing.mesh, seed), thing.view)
        # Exact normals are observed as they are. New ones would mix the two sides of thin walls, 6
        # mm between points.
        whole = fit_shape(clouds[0], budget=BUDGET, support="paper", seed=seed)
        paper = fit_shape(clouds[1], support="paper", seed=seed)
        default = fit_shape(clouds[1], seed=seed, table=0.0)
        shapes = (whole, paper, default)
        surfaces = [extract_surface(shape, 64) for shape in shapes]
        arrows = [observed_normals(shape) for shape in shapes]
        for kind, surface in zip(("whole", "paper", "default"), surfaces, strict=True):
            std = 1e3 * surface.std_m
            told = f"median {std.median():.1f}, 99 % {std.quantile(0.99):.1f}"
            print(f"{name:10}{kind:9} std [mm]: {told}")
        scenes.append((thing, clouds, surfaces, arrows))
    # One scale for all, the most certain 80 % of each. The least certain bulges would leave all
    # else in one colour.
    every = [surface for _, _, surfaces, _ in scenes for surface in surfaces]
    most = 1e3 * max(float(surface.std_m.quantile(0.8)) for surface in every)
    columns = []
    for thing, clouds, surfaces, arrows in scenes:
        eye = rotated(view_of(thing.view), TURN)
        corners = np.asarray(thing.mesh.vertices)
        of_whole, *of_views = zip(surfaces, arrows, strict=True)
        column = ((clouds[0], None), of_whole, (clouds[1], None), *of_views)
        columns.append([draw(what, normals, most, corners, eye) for what, normals in column])
    titles = {(row, 0): title for row, title in enumerate(ROWS)}
    save_sheet(out / "fig4.png", list(zip(*columns, strict=True)), titles, most)


def observed_normals(shape: ShapeGP) -> tuple[np.ndarray, np.ndarray]:
    """Return (points, normals): the points (n, 3) [m] that a shape observes on the surface, and its
    unit normals there.
    """
    points = shape.metres(shape.x[shape.has_normal])
    return points.numpy(), shape.predict(points).normal.numpy()


def draw(
    what: PointCloud | Surface,
    arrows: tuple[np.ndarray, np.ndarray] | None,
    most: float,
    corners: np.ndarray,
    eye: tuple[float, float, float],
) -> Image.Image:
    """Return a picture of a cloud coloured by height, or of a surface coloured by its deviation.

    The colours of the standard deviation end at `most` [mm]. `arrows` are points [m] and directions
    to draw, or None. `corners` (n, 3) [m] must be in the picture, and `eye` is the direction to the
    viewer.
    """
    canvas = Canvas()
    if isinstance(what, PointCloud):
        points = what.points.numpy()
        height = points[:, 2] - points[:, 2].min()
        canvas.add_points(points, map_colors(height / max(float(height.max()), 1e-12), "cividis"))
    else:
        vertices = what.vertices.numpy()
        faces = what.faces.numpy()
        normals = what.normals.numpy()
        colors = map_colors(1e3 * what.std_m.numpy() / most, "viridis")
        canvas.add_mesh(vertices, faces, colors, normals)
        corners = np.concatenate([corners, vertices])
    if arrows:
        length = ARROW * float(np.linalg.norm(np.ptp(corners, axis=0)))
        canvas.add_arrows(*arrows, length, (INK,) * len(arrows[0]))
    return render_tile(canvas, corners, eye, TILE)
