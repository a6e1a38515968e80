"""An interactive 3D page of one run in one HTML file: shape, contacts, postures, and the replayed
closing.
"""

import dataclasses
import functools
import hashlib
import json
import re
import tempfile
import webbrowser
import zipfile
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.app.report.canvas import FINGERS, OBJECT, TABLE, color_std, map_colors
from torchgrasp.app.report.closing_moments import mass_centre, moments_of
from torchgrasp.app.report.film import describe_film
from torchgrasp.app.report.page import TEMPLATES, encode_base64, render
from torchgrasp.app.report.raster import FULL
from torchgrasp.app.report.run_data import Run, grasp_columns, grasp_rows, verdict
from torchgrasp.app.report.solids import link_poses, solids_of_links
from torchgrasp.app.report.stills import facing, mesh_arrays, view_of
from torchgrasp.cloud.agreement import check_seen
from torchgrasp.control.finger_forces import squeeze
from torchgrasp.data.accept import CloudLike, HandLike, as_cloud
from torchgrasp.files import write_file
from torchgrasp.foundation.checks import checked
from torchgrasp.geometry.frames import apply, inverse, rotate, to_array
from torchgrasp.geometry.plane import Plane
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import hand_of
from torchgrasp.ik.motion import APPROACH_DISTANCE, opened_pose
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.surface import extract_surface
from torchgrasp.values.closing import ClosureResult
from torchgrasp.values.planning import Grasps
from torchgrasp.values.specs import ContactSpec


@dataclasses.dataclass(frozen=True)
class ViewerNumbers:
    """Limits of what a 3D page holds, and numbers of its first view.

    With these limits a page has a few megabytes.
    """

    grasps: int = 20  # number of the best grasps that are shown
    points: int = 10_000  # greatest number of points of a cloud
    faces: int = 40_000  # greatest number of faces of a mesh
    ticks: int = 120  # greatest number of moments of a replay
    # number of grid cells along the diagonal of a mesh in the first round of its thinning
    cells: int = 256
    coarser: float = 1.2  # ratio of the cells' sides in successive rounds of thinning
    rise: float = 0.35  # least rise of the first view for each metre along the ground
    ramp: int = 17  # number of colours of the bar of standard deviations


VIEWER = ViewerNumbers()
STARTING = 100  # last letters of the library in which it would start its own viewer
COLUMNS = (0, 1, 5, 3)  # of `grasp_columns`: rank, success, margin, clearance
MORE_COLUMNS = 6  # the first of the others that a page shows: standard deviation, task margin
POSTURES = ("approach", "pre-grasp", "grasp", "squeeze")
"""Postures of the hand in the order of its motion; the last is the target of its drives."""


@checked
def write_viewer(path: Path | str, run: Run) -> Path:
    """Write a run as an interactive 3D page in one HTML file, atomically; return the path.

    The page needs WebGL, but no network. It shows:

    * the cloud, and the surface coloured by its standard deviation;
    * the surface moved by a chosen number of standard deviations;
    * the best 20 grasps with their contacts, each in four postures. They are approach, pre-grasp,
      grasp and squeeze, the targets with which the fingers press;
    * a replay of the run's closing with its forces.

    The address may name a state: `view.html#grasp=3&posture=squeeze&sigma=2` or
    `view.html#tick=50`.

    Args:
        path: the file to write.
        run: the inputs and results that the page shows.

    Raises `OutputError` if the file cannot be written, and `BadArgument` if the executable grasps
    do not touch the run's mesh. These are the grasps that passed all checks.

    >>> import tempfile
    >>> from torchgrasp import ContactSpec, fit_shape, load_hand, load_object
    >>> from torchgrasp.shape import extract_surface
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> jug, hand = load_object("jug"), load_hand("barrett")
    >>> surface = extract_surface(fit_shape(jug.view), 24)
    >>> grasps = load_shipped_grasp("jug", "barrett")
    >>> run = Run("jug", Path("jug.ply"), jug.view, hand, ContactSpec(), surface, grasps)
    >>> write_viewer(Path(tempfile.mkdtemp(), "view.html"), run).stat().st_size < 8 * 2**20
    True
    """
    return write_file(path, format_viewer(run))


@checked
def show_grasps(
    cloud: CloudLike, grasps: Grasps, hand: HandLike | None = None, browser: bool = True
) -> Path:
    """Write the 3D page of grasps to a temporary file, and open it in the browser; return its path.

    Args:
        cloud: the cloud that was planned on, in any form that `plan_grasps` takes. The surface on
            the page is estimated again from this cloud.
        grasps: grasps that were planned on the cloud.
        hand: the hand of the grasps, its name or its folder; None means the hand that `grasps.meta`
            names.
        browser: whether the page is opened; False only writes it.

    Raises `BadArgument` for a cloud that the grasps do not touch, or for another hand than that of
    the grasps. Without `hand` it is also raised if the grasps name no hand.

    >>> from torchgrasp import load_object
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> show_grasps(load_object("jug"), load_shipped_grasp("jug", "barrett"), browser=False).name
    'view.html'
    """
    cloud = as_cloud(cloud, "cloud")
    check_seen(grasps, cloud, "cloud")
    table = grasps.table
    surface = extract_surface(fit_shape(cloud, table=table))
    spec = ContactSpec(table=table)
    path = Path(tempfile.mkdtemp(), "view.html")
    write_viewer(path, Run("object", path, cloud, hand_of(grasps, hand), spec, surface, grasps))
    if browser:
        webbrowser.open(path.as_uri())
    return path


def format_viewer(run: Run) -> str:
    """Return the interactive 3D page of a run, which `write_viewer` writes, as HTML text."""
    contents = describe(run)
    # The files are one function, so that no name of theirs meets a name of the library.
    names = "scene.js", "cloud.js", "panel.js"
    parts = "".join((TEMPLATES / name).read_text(encoding="utf-8") for name in names)
    # "<" would end the block of data early; within JSON it is only in texts.
    data = json.dumps(contents, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    scripts = (three(), f'(() => {{\n"use strict";\n{parts}}})();\n')
    digests = [encode_base64(hashlib.sha256(x.encode("utf-8")).digest()) for x in scripts]
    return render("view.html", title=contents["title"], data=data, scripts=scripts, digests=digests)


@functools.cache
def three() -> str:
    """Return the JavaScript of the library three.js with its mouse controls, as text.

    It is part of the package trimesh. Raises `RuntimeError` for a version of trimesh with another
    viewer.
    """
    archive = resources.files("trimesh") / "resources" / "templates" / "viewer.zip"
    with archive.open("rb") as file, zipfile.ZipFile(file) as opened:
        template = opened.read("viewer.html.template").decode("utf-8")
    scripts = "\n".join(re.findall(r"<script[^>]*>(.*?)</script>", template, re.DOTALL))
    # Browsers read line ends as \n before they compare a script with its digest.
    library = re.sub(r"init\(\);\s*$", "", re.sub(r"\r\n?", "\n", scripts))
    if "TrackballControls" not in library or "init();" in library[-STARTING:]:
        raise RuntimeError("the installed trimesh has another viewer than trimesh 4.5 to 5.2")
    return library


def describe(run: Run) -> dict[str, Any]:
    """Return the contents of a run's 3D page as a dictionary for JSON: meshes, poses and texts.

    All are in a frame where z is up, in metres (`Run.upright`).
    """
    frame = inverse(run.obj_from_upright)
    sentence = verdict(run)
    run = run.upright()
    best = run.executable[: VIEWER.grasps]
    scene = run.scene
    others = None
    if scene is not None:
        others = _points(scene.points[(scene.labels > 0) & ~scene.rows_of()])
    viewpoints = [view.viewpoint for view in run.cloud.split_views()]
    x, y, z = facing(best[0]) if len(best) else view_of(run.cloud)
    # raised to look from above
    eye = np.array([x, y, max(z, VIEWER.rise * float(np.hypot(x, y)))])
    hand = []
    for solid in solids_of_links(run.hand):
        mesh = _mesh(solid.vertices, solid.faces, solid.normals)
        hand.append({"link": solid.link, "color": solid.color, **mesh})
    return {
        "title": run.title,
        "source": str(run.source),
        "verdict": sentence,
        "good": run.good,
        "eye": (eye / np.linalg.norm(eye)).tolist(),
        "frame": frame.tolist(),
        "sensors": [place.tolist() for place in viewpoints if place is not None],
        "table": None if run.spec.table is None else TABLE,
        "edge": _edge(run.spec.plane),
        "object": OBJECT,
        "fingers": [list(pair) for pair in zip(run.hand.tips.names, FINGERS, strict=False)],
        "cloud": _points(run.cloud.points),
        "others": others,
        "surface": _surface(run),
        "hand": hand,
        "postures": POSTURES,
        "grasps": _grasps(run.hand, best),
        "replay": None if run.closure is None or run.mesh is None else _replay(run, run.closure),
    }


def _points(points: Float[Tensor, "n 3"]) -> dict[str, object]:
    """Return a cloud as a JSON object made by `pack`, thinned if it has many points."""
    return pack(to_array(points)[thin_rows(len(points), VIEWER.points)])


def _mesh(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> dict[str, object]:
    """Return a mesh with vertex normals as a dict of arrays made by `pack`."""
    return {"points": pack(vertices), "normals": pack(normals), "faces": pack(faces, "u4")}


def _surface(run: Run) -> dict[str, object]:
    """Return the estimated surface with standard deviations and colours, as a dict of arrays made
    by `pack`.
    """
    vertices, faces, normals = mesh_arrays(run.surface)
    kept, faces = thin_mesh(vertices, faces)
    colors, most = color_std(run.surface)
    ramp = map_colors(np.linspace(0.0, 1.0, VIEWER.ramp), "viridis")
    return {
        **_mesh(vertices[kept], faces, normals[kept]),
        "std": pack(to_array(run.surface.std_m)[kept]),
        "colors": pack(np.round(FULL * colors[kept]), "u1"),
        "most_mm": 1e3 * most,
        "ramp": np.round(FULL * ramp).astype(int).tolist(),
    }


def _grasps(hand: Hand, grasps: Grasps) -> dict[str, object]:
    """Return the table rows of grasps, their contacts, and all link poses in each of the
    `POSTURES`.
    """
    heads = grasp_columns(grasps)
    columns = *COLUMNS, *range(MORE_COLUMNS, len(heads))
    return {
        "heads": [heads[k] for k in columns],
        "rows": [[row[k] for k in columns] for row in grasp_rows(grasps, VIEWER.grasps)],
        "points": pack(to_array(grasps.contacts.points)),
        "normals": pack(to_array(grasps.contacts.normals)),
        "links": pack(to_array(pose_postures(hand, grasps))),
    }


def pose_postures(hand: Hand, grasps: Grasps) -> Float[Tensor, "g p l 4 4"]:
    """Return the poses obj_from_link [m] of all l links, in each of the p postures of g grasps.

    The four postures are, in order, "approach", "pre-grasp", "grasp" and "squeeze". The last is the
    target with which the fingers press. The poses are in the frame of the grasps, and the links in
    the order of `hand.tree.link_names`.
    """
    pose = grasps.obj_from_hand.double()
    opened = grasps.pregrasp.double()
    raised = opened_pose(hand, opened, pose, grasps.table)
    away = raised.clone()
    away[:, :3, 3] -= APPROACH_DISTANCE * grasps.approach.double()
    squeezed = squeeze(hand, grasps).joints if len(grasps) else opened
    motion = [(opened, away), (opened, raised), (grasps.joints.double(), pose), (squeezed, pose)]
    poses = [link_poses(hand, hand.expand_joints(q), hand.tree.joint_names, p) for q, p in motion]
    return torch.stack(poses, 1)


def _edge(table: Plane | None) -> list[float] | None:
    """Return normal and offset [m] of a table's edge; None without one."""
    edge = None if table is None else table.edge
    return None if edge is None else [*edge.normal.tolist(), edge.offset]


def _replay(run: Run, closure: ClosureResult) -> dict[str, object]:
    """Return the data of the replayed closing: mesh, poses of object and links at some ticks,
    forces at all ticks.
    """
    assert run.mesh is not None
    ticks = thin_rows(len(closure.time), VIEWER.ticks)
    vertices = np.asarray(run.mesh.vertices)
    kept, faces = thin_mesh(vertices, np.asarray(run.mesh.faces))
    links = link_poses(
        run.hand, closure.joints[ticks], closure.joint_names, closure.hand_pose[ticks]
    )
    hand_pose = closure.hand_pose[ticks].double()
    trace = closure.trace
    moments = []
    for moment in moments_of(closure, mass_centre(run.mesh), run.hand.tips.names):
        nearest = int(np.abs(ticks - moment.tick).argmin())
        moments.append((nearest, moment.name))
    return {
        "grasp": 1,  # the first is the one that was closed
        "story": describe_film(run.mesh, run.hand, closure),
        "moments": moments,
        "touches": pack(to_array(apply(hand_pose, trace.points[ticks].double()))),
        "pushes": pack(to_array(rotate(hand_pose, trace.forces[ticks].double()))),
        "points": pack(vertices[kept]),
        "faces": pack(faces, "u4"),
        "ticks": pack(ticks, "u4"),
        "object": pack(to_array(closure.object_pose[ticks])),
        "links": pack(to_array(links)),
        "time": pack(to_array(closure.time)),
        "forces": pack(to_array(closure.forces)),
    }


def pack(values: np.ndarray, kind: str = "f4") -> dict[str, object]:
    """Return an array as a dictionary for JSON: "kind", "shape", and "data", its bytes in base64.

    `kind` is the number format to which the values are converted, little-endian. It is "f4" for
    float32, "u4" for uint32, or "u1" for uint8.
    """
    data = np.ascontiguousarray(values).astype(f"<{kind}").tobytes()
    return {"kind": kind, "shape": list(values.shape), "data": encode_base64(data)}


def thin_mesh(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    most: int = VIEWER.faces,
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, "g 3"]]:
    """Return a mesh with at most `most` faces: the indices (k,) of the vertices that it keeps, and
    its faces (g, 3).

    The faces hold indices of the k kept vertices. A mesh of more than `most` faces keeps one vertex
    in each cell of a grid. The cells grow until the faces are few enough. Any other mesh is
    unchanged. `vertices` are in metres.
    """
    kept = np.arange(len(vertices))
    thinned = faces
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0))) if len(vertices) else 0.0
    cell = diagonal / VIEWER.cells
    while len(thinned) > most:
        _, kept, group = np.unique(
            np.round(vertices / cell), axis=0, return_index=True, return_inverse=True
        )
        thinned = group.reshape(-1)[faces]
        # a face with two corners in one cell is gone
        a, b, c = thinned.T
        thinned = thinned[(a != b) & (b != c) & (c != a)]
        cell *= VIEWER.coarser
    return kept, thinned


def thin_rows(count: int, most: int) -> Int[np.ndarray, " k"]:
    """Return at most `most` of the indices 0 to `count` - 1, evenly spread from first to last."""
    if count <= most:
        return np.arange(count)
    return np.round(np.linspace(0, count - 1, most)).astype(np.int64)
