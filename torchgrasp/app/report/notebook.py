"""A table and a picture of the best grasps, as notebooks show them."""

import dataclasses
import html
import io

from torchgrasp.app.report import stills
from torchgrasp.app.report.page import encode_base64
from torchgrasp.app.report.run_data import grasp_columns, grasp_rows
from torchgrasp.cloud.agreement import check_seen
from torchgrasp.data.accept import CloudLike, HandLike, as_cloud
from torchgrasp.files import format_columns
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import GraspError
from torchgrasp.foundation.lazy import Image
from torchgrasp.geometry.frames import inverse
from torchgrasp.geometry.plane import move, upright_frame, upright_table
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import hand_of
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.surface import extract_surface
from torchgrasp.values.planning import Grasps, PointCloud


@dataclasses.dataclass(frozen=True)
class NotebookNumbers:
    """Sizes of what a notebook shows of grasps."""

    rows: int = 5  # number of best grasps in the table: more are seldom read
    # number of colours of the picture: a notebook stays small, and shades stay smooth
    colors: int = 64


NOTEBOOK = NotebookNumbers()


@dataclasses.dataclass(frozen=True)
class GraspSheet:
    """What `Grasps.show` returns: notebooks show it as a table and a picture, `str` as text.

    `title` says how many grasps can be executed. `columns` and `rows` are the table's cells.
    `picture` is a PNG of the first executable grasp; None if there is none, or if its hand is
    unknown.
    """

    title: str
    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]
    picture: bytes | None

    def __repr__(self) -> str:
        return f"{self.title}\n{format_columns([self.columns, *self.rows])}"

    def _repr_html_(self) -> str:
        """Return table and picture as HTML without scripts, and without links to other files."""
        lines = [_row("th", self.columns), *(_row("td", row) for row in self.rows)]
        table = f"<table>\n{''.join(lines)}</table>" if self.rows else ""
        picture = ""
        if self.picture is not None:
            address = f"data:image/png;base64,{encode_base64(self.picture)}"
            picture = f'\n<img alt="the best grasp" src="{address}">'
        return f"<div>\n<p>{html.escape(self.title)}</p>\n{table}{picture}\n</div>"


@checked
def make_sheet(
    grasps: Grasps, cloud: CloudLike | None = None, hand: HandLike | None = None
) -> GraspSheet:
    """Return a table of up to five executable grasps, and a picture of the first, for notebooks.

    Executable grasps passed all checks. `Grasps.show` calls it.

    Args:
        grasps: the grasps of a plan, best first.
        cloud: the cloud that was planned on. The picture then has the surface estimated from it;
            None leaves the surface out.
        hand: the hand of the grasps, its name or its folder; None means the hand that the grasps
            name.

    Raises `BadArgument` for a cloud that the grasps do not touch, or for another hand. Without
    `hand` it is also raised if the grasps name no hand.

    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> print(make_sheet(load_shipped_grasp("jug", "barrett")).title)
    1 of 1 executable, best predicted success 94%, hand barrett
    """
    seen = None if cloud is None else as_cloud(cloud, "cloud")
    if seen is not None:
        check_seen(grasps, seen, "cloud")
    return _make(grasps, seen, hand_of(grasps, hand))


def show_in_notebook(grasps: Grasps) -> str:
    """Return the HTML that a notebook shows of grasps: a table of the best, and a picture.

    The picture is left out if no grasp passed all checks, or if the grasps' hand cannot be loaded.
    """
    try:
        hand = hand_of(grasps)
    except GraspError:  # a hand that is not shipped: `Grasps.show` takes it
        hand = None
    return _make(grasps, None, hand)._repr_html_()


def _make(grasps: Grasps, cloud: PointCloud | None, hand: Hand | None) -> GraspSheet:
    """Return table and picture; without a hand there is no picture."""
    best = grasps.executable
    picture = None
    if hand is not None and len(best):
        picture = _shrink(_draw(best[:1], cloud, hand))
    title = ", ".join(grasps._about())
    return GraspSheet(title, grasp_columns(grasps), grasp_rows(best, NOTEBOOK.rows), picture)


def _draw(grasp: Grasps, cloud: PointCloud | None, hand: Hand) -> bytes:
    """Return a PNG of one grasp, on the surface estimated from its cloud if there is one."""
    table = grasp.table
    surface = None
    points = grasp.contacts.points[0]
    viewpoint = None
    if cloud is not None:
        surface = extract_surface(fit_shape(cloud, table=table))
        points = cloud.points
        viewpoint = cloud.viewpoint
    # Without table and camera nothing tells where up is: the frame of the grasp stays.
    if cloud is not None or table is not None:
        upright_from_obj = inverse(upright_frame(points, viewpoint, table))
        grasp = move(grasp, upright_from_obj)
        surface = None if surface is None else move(surface, upright_from_obj)
        table = upright_table(table, inverse(upright_from_obj))
    return stills.draw_grasp(surface, hand, grasp, stills.facing(grasp), table)


def _shrink(png: bytes) -> bytes:
    """Return a picture with few colours."""
    small = io.BytesIO()
    Image.open(io.BytesIO(png)).convert("RGB").quantize(NOTEBOOK.colors).save(
        small, "PNG", optimize=True
    )
    return small.getvalue()


def _row(cell: str, texts: tuple[str, ...]) -> str:
    """Return a row of an HTML table, with one cell for each of the `texts`, which are escaped.

    `cell` is the tag of a cell: "td", or "th" in a header.
    """
    cells = "".join(f"<{cell}>{html.escape(text)}</{cell}>" for text in texts)
    return f"<tr>{cells}</tr>\n"
