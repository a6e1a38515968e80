"""What a viewer shows, as arrays: of a run, of grasps alone, or read again from a page that `write_viewer` wrote."""

import json
import math
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from torchgrasp.app.report.palette import OBJECT
from torchgrasp.app.report.turning.buffers import KINDS, unpack
from torchgrasp.app.report.turning.contents import COLUMNS, MOST_FACES, MOST_GRASPS, MOST_POINTS, MOST_TICKS, POSTURES
from torchgrasp.errors import BadArgument
from torchgrasp.files import is_file
from torchgrasp.json_fields import Field

MOST_BYTES = 32 * 2**20
"""Largest page [bytes]: four times of what a page may have."""
MOST_LINKS, MOST_PIECES = 512, 1000
"""Most links and shapes of a hand, as of a URDF."""
MOST_VERTICES, MOST_RECORD = 3 * MOST_FACES, 1_000_000
"""Most vertices of a mesh, each face with its own, and ticks of a record."""
MOST_WORDS = 5000
"""Most letters of a verdict or of a path."""
REACH = 1e4
"""Largest number in a buffer [m, s, N], far beyond any scene: pictures of more overflow."""
ALLOWED = "a page that `torchgrasp grasp` wrote"


class ShownMesh(NamedTuple):
    """A mesh [m] with its colour, and the link that it belongs to."""

    points: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    color: str = ""
    link: int = 0


class ShownSurface(NamedTuple):
    """The estimated surface [m], its deviation and its colours; the legend ends at `most_mm`."""

    points: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    std: Float[np.ndarray, " v"]
    colors: UInt8[np.ndarray, "v 3"]
    most_mm: float


class ShownReplay(NamedTuple):
    """The true object, its poses and those of all links at some ticks; time [s] and forces [N] at each of them."""

    mesh: ShownMesh
    object: Float[np.ndarray, "k 4 4"]
    links: Float[np.ndarray, "k l 4 4"]
    time: Float[np.ndarray, " k"]
    forces: Float[np.ndarray, "k f"]


class Shown(NamedTuple):
    """All that a viewer shows.

    `eye` points to the first camera; `links` are the poses of all links in each of the `POSTURES` of each grasp.
    """

    title: str
    verdict: str
    eye: tuple[float, ...]
    table: str | None
    fingers: list[tuple[str, str]]
    cloud: Float[np.ndarray, "n 3"] | None
    others: Float[np.ndarray, "m 3"] | None
    surface: ShownSurface | None
    hand: list[ShownMesh]
    heads: list[str]
    rows: list[list[str]]
    points: Float[np.ndarray, "g f 3"]
    normals: Float[np.ndarray, "g f 3"]
    links: Float[np.ndarray, "g p l 4 4"]
    replay: ShownReplay | None


def read_page(path: Path) -> Shown:
    """Read what a page shows; nothing in it runs.

    Raises:
        BadArgument: a file that is no such page, or one that holds other things than it should.
    """
    try:
        if not is_file(path):
            raise ValueError("no file")
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
        found = re.search(rb'<script type="application/json" id="data">(.*?)</script>', data, re.DOTALL)
        if len(data) > MOST_BYTES or found is None:
            raise ValueError("no data of a viewer")
        value = json.loads(found[1].decode("utf-8"), parse_constant=lambda name: math.nan)
    except (OSError, ValueError, RecursionError) as error:
        raise BadArgument("path", f"{path} ({error})", ALLOWED) from error
    return read_shown(value, path)


def read_shown(contents: Any, path: Path = Path("view.html")) -> Shown:
    """Return contents of a page as arrays, each field with its type and shape.

    Raises:
        BadArgument: a field that is missing, or is not what it should be; the message names it.
    """
    page = Field(path, "", contents, lambda found, allowed: BadArgument("path", found, allowed))
    fingers = [(name.text(), _color(color)) for name, color in (_pair(row) for row in _get(page, "fingers").items(5))]
    hand = [_mesh(piece, _color(_get(piece, "color"))) for piece in _get(page, "hand").items(MOST_PIECES)]
    eye = tuple(part.number(-1.0, 1.0) for part in _get(page, "eye").items(3))
    if len(eye) != 3:
        raise _get(page, "eye").wrong("a direction")
    table, replay, surface = (_get(page, name) for name in ("table", "replay", "surface"))
    clouds = [_get(page, name) for name in ("cloud", "others")]
    cloud, others = (None if x.value is None else _array(x, MOST_POINTS, 3) for x in clouds)
    grasps = _get(page, "grasps")
    rows = [[cell.text() for cell in row.items(len(COLUMNS))] for row in _get(grasps, "rows").items(MOST_GRASPS)]
    links = _array(_get(grasps, "links"), MOST_GRASPS, len(POSTURES), MOST_LINKS, 4, 4)
    points, normals = (_array(_get(grasps, name), MOST_GRASPS, 5, 3) for name in ("points", "normals"))
    contacts = (len(rows), len(fingers), 3)
    if points.shape != contacts or normals.shape != contacts or len(links) != len(rows):
        raise grasps.wrong(f"contacts of {len(fingers)} fingers and postures for each of {len(rows)} rows")
    if any(piece.link >= links.shape[2] for piece in hand):
        raise _get(page, "hand").wrong(f"pieces of {links.shape[2]} links")
    return Shown(
        title=_get(page, "title").text(MOST_WORDS),
        verdict=_get(page, "verdict").text(MOST_WORDS),
        eye=eye,
        table=None if table.value is None else _color(table),
        fingers=fingers,
        cloud=cloud,
        others=others,
        surface=None if surface.value is None else _surface(surface),
        hand=hand,
        heads=[head.text() for head in _get(grasps, "heads").items(len(COLUMNS))],
        rows=rows,
        points=points,
        normals=normals,
        links=links,
        replay=None if replay.value is None else _replay(replay, links.shape[2], len(fingers)),
    )


def _get(within: Field, name: str) -> Field:
    """Return a field of an object; one that is missing is None."""
    return within.entries().get(name, Field(within.path, f"{within.place}.{name}", None, within.refuse))


def _pair(row: Field) -> list[Field]:
    """Return the two fields of a list."""
    both = row.items(2)
    if len(both) != 2:
        raise row.wrong("a name and a colour")
    return both


def _color(field: Field) -> str:
    """Return a colour."""
    if not re.fullmatch("#[0-9a-f]{6}", field.text()):
        raise field.wrong("a colour such as #1f4fd8")
    return field.text()


def _array(field: Field, *most: int, kind: str = "f4") -> np.ndarray:
    """Return an array of numbers with as many axes as there are bounds; an axis of at most 5 has its whole length."""
    shape = [part.whole(0, bound) for part, bound in zip(_get(field, "shape").items(len(most)), most, strict=False)]
    short = any(x != bound for x, bound in zip(shape, most, strict=False) if bound in (3, 4))
    if len(shape) != len(most) or short or _get(field, "kind").value != kind:
        raise field.wrong(f"a buffer {kind} of at most {most}")
    data = _get(field, "data").text(2 * math.prod(shape) * np.dtype(KINDS[kind]).itemsize + 8)
    try:
        array = unpack({"kind": kind, "shape": shape, "data": data})
    except ValueError as error:
        raise field.wrong(f"{math.prod(shape)} numbers as text") from error
    if kind == "f4" and not (np.abs(array) <= REACH).all():
        raise field.wrong(f"numbers up to {REACH:g}")
    return array


def _faces(field: Field, points: np.ndarray) -> np.ndarray:
    """Return faces between points."""
    faces = _array(field, MOST_FACES, 3, kind="u4")
    if faces.size and int(faces.max()) >= len(points):
        raise field.wrong(f"faces of {len(points)} points")
    return faces


def _mesh(field: Field, color: str) -> ShownMesh:
    """Return a mesh; one without a link has the first."""
    points, link = _array(_get(field, "points"), MOST_VERTICES, 3), _get(field, "link")
    at = 0 if link.value is None else link.whole(0, MOST_LINKS - 1)
    return ShownMesh(points, _faces(_get(field, "faces"), points), color, at)


def _surface(field: Field) -> ShownSurface:
    """Return the estimated surface."""
    points, normals = (_array(_get(field, name), MOST_VERTICES, 3) for name in ("points", "normals"))
    std, colors = _array(_get(field, "std"), MOST_VERTICES), _array(_get(field, "colors"), MOST_VERTICES, 3, kind="u1")
    if not len(points) == len(normals) == len(std) == len(colors):
        raise field.wrong("a normal, a deviation and a colour for each point")
    faces, most_mm = _faces(_get(field, "faces"), points), _get(field, "most_mm").number(0.0, 1e3 * REACH)
    return ShownSurface(points, normals, faces, std, colors, most_mm)


def _replay(field: Field, links: int, fingers: int) -> ShownReplay:
    """Return a closing, with time and forces at the ticks that are replayed."""
    time, forces = _array(_get(field, "time"), MOST_RECORD), _array(_get(field, "forces"), MOST_RECORD, 5)
    ticks = _array(_get(field, "ticks"), MOST_TICKS, kind="u4")
    poses, frames = (
        _array(_get(field, "object"), MOST_TICKS, 4, 4),
        _array(_get(field, "links"), MOST_TICKS, links, 4, 4),
    )
    whole = len(time) == len(forces) and len(ticks) == len(poses) == len(frames) > 0
    if not whole or int(ticks.max()) >= len(time) or frames.shape[1] != links or forces.shape[1] != fingers:
        raise field.wrong("poses of the object and of all links at some ticks of the record")
    return ShownReplay(_mesh(field, OBJECT), poses, frames, time[ticks], forces[ticks])
