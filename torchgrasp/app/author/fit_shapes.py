"""Replacement of the meshes in a published hand by boxes, cylinders and balls.

A mesh is sampled by points, which get a bounding box. A box is cut in two where this saves most
volume.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float

from torchgrasp.app.author.repair import place, pose_of
from torchgrasp.app.author.scene_meshes import check_glb, clean_dae
from torchgrasp.files import explain, read_bounded
from torchgrasp.foundation.errors import HandFileError, MissingExtra
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.foundation.limits import HAND_MESH_BYTES, MAX_EXTENT, MESH_BYTES, MESH_FACES
from torchgrasp.geometry.mesh import load_triangles
from torchgrasp.hand.hand_toml import Pad
from torchgrasp.hand.urdf import LinkShape, Urdf

MESH_KINDS = (".stl", ".obj", ".ply", ".dae", ".glb")
SAVING = 0.12
SAVING_TIP = 0.04
"""A box of a link or of a fingertip is cut in two if the cut saves this share of the volume of all
boxes.
"""
Points = Float[np.ndarray, "_ 3"]  # points, of any count in each use
Corners = tuple[np.ndarray, np.ndarray]


def mesh_file(urdf: Urdf, name: str, folder: Path) -> Path:
    """Return the path of a mesh that a URDF names, also by `package://`; raise `HandFileError`,
    which says why not.
    """
    base = folder.resolve()
    here = urdf.path.resolve().parent
    called = f"mesh {name[:80]!r}"
    path = PurePosixPath(name.removeprefix("package://"))
    if ":" in str(path) or "\\" in name or path.is_absolute():
        raise urdf.wrong(
            f"{called}, an absolute path or an address",
            f"a path inside {folder} with slashes, as a/b.stl",
        )
    if path.suffix.lower() not in MESH_KINDS:
        raise urdf.wrong(f"{called} of another format", f"a mesh ({', '.join(MESH_KINDS)})")
    # the files of a package may lie anywhere in the folder: the first parts of the path may be left
    # out
    package = name.startswith("package://")
    roots = (here, *(x for x in here.parents if package and x.is_relative_to(base)), base)
    places = [
        x.joinpath(*path.parts[k:]) for k in range(len(path.parts) if package else 1) for x in roots
    ]
    why = ""
    for spot in places:
        try:
            file = spot.resolve()
            if not file.is_relative_to(base):
                why = why or "outside, perhaps by a symbolic link"
            elif file.is_file() and file.stat().st_size > MESH_BYTES:
                why = why or f"of {file.stat().st_size} bytes, more than {MESH_BYTES >> 20} MiB"
            elif file.is_file():
                return file
            else:
                alike = [
                    x.name for x in file.parent.iterdir() if x.name.lower() == file.name.lower()
                ]
                why = why or (f"called {alike[0]} there" if alike and alike[0] != file.name else "")
        except (
            OSError,
            RuntimeError,
            ValueError,
        ):  # no such folder, a loop of links, or a name that no system takes
            continue
    raise urdf.wrong(
        f"{called}, {why or 'missing'}", f"a file inside {folder} (--meshes names another folder)"
    )


def shape_points(urdf: Urdf, folder: Path) -> dict[str, tuple[Points, ...]]:
    """Return points [m] on each shape of every link, in the link's frame; raise `HandFileError` for
    unusable meshes.
    """
    names = {shape.file for link in urdf.links for shape in link.shapes if shape.kind == "mesh"}
    size = sum(mesh_file(urdf, name, folder).stat().st_size for name in names)
    if size > HAND_MESH_BYTES:
        raise urdf.wrong(
            f"meshes of {size} bytes", f"meshes of at most {HAND_MESH_BYTES >> 20} MiB in all"
        )
    meshes = {name: _read_points(urdf, name, folder) for name in sorted(names)}
    found = {}
    for link in urdf.links:
        parts = []
        for shape in link.shapes:
            local = (
                meshes[shape.file] * shape.size
                if shape.kind == "mesh"
                else _primitive_points(shape)
            )
            reach = float(np.abs(local).max())
            if not reach <= MAX_EXTENT:
                wanted = f"shapes that reach at most {MAX_EXTENT:g} m; a mesh in millimetres needs a scale of 0.001"
                raise urdf.wrong(f"mesh {shape.file!r} that reaches {reach:.3g} m", wanted)
            if shape.kind == "mesh" and reach < 5e-4:  # thinner than a fingernail
                raise urdf.wrong(
                    f"mesh {shape.file!r} that reaches {1e3 * reach:.3g} mm",
                    "metres: scaled twice, or by 0?",
                )
            pose = pose_of(shape)
            parts.append(local @ pose[:3, :3].T + pose[:3, 3])
        found[link.name] = tuple(parts)
    return found


def replace_meshes(urdf: Urdf, points: Mapping[str, tuple[Points, ...]]) -> tuple[Urdf, list[str]]:
    """Replace every mesh by a few boxes or a cylinder around its points; also return a sentence
    with the counts.
    """
    links = []
    count = 0
    made = 0
    for link in urdf.links:
        shapes: list[LinkShape] = []
        for shape, on_it in zip(link.shapes, points[link.name], strict=True):
            fitted = fit_shapes(on_it) if shape.kind == "mesh" else [shape]
            count = count + (shape.kind == "mesh")
            made = made + (len(fitted) if shape.kind == "mesh" else 0)
            shapes += fitted
        links.append(dataclasses.replace(link, shapes=tuple(shapes)))
    done = (
        [f"{count} collision meshes became {made} boxes or cylinders around them"] if count else []
    )
    return dataclasses.replace(urdf, links=tuple(links)), done


def ball_tip(urdf: Urdf, tip: str, ball: Pad, outward: np.ndarray, points: Points) -> Urdf:
    """Replace the shapes of a tip by a ball at its end, towards `outward`, and on a long tip boxes
    up to the ball.
    """
    link = next(x for x in urdf.links if x.name == tip)
    reach = (points - np.array(ball.center)) @ outward
    shapes = [LinkShape("sphere", (ball.radius,), ball.center, (0.0, 0.0, 0.0))]
    if np.ptp(reach) > 2.6 * ball.radius:
        motion = np.array(ball.normal) - ball.normal @ outward * outward
        motion /= np.linalg.norm(motion)
        axes = np.stack([motion, outward, np.cross(motion, outward)], 1)
        shapes += _boxes(_cut(points[reach < 0] @ axes, 4, SAVING_TIP), axes)
    ended = dataclasses.replace(link, shapes=tuple(shapes))
    return dataclasses.replace(urdf, links=tuple(ended if x is link else x for x in urdf.links))


def _read_points(urdf: Urdf, name: str, folder: Path) -> Points:
    """Read a mesh file, but no file that it refers to; return points on the mesh."""
    path = mesh_file(urdf, name, folder)
    data = read_bounded(path, MESH_BYTES, "a mesh", functools.partial(HandFileError, "urdf"))
    allowed = f"a triangle mesh of at most {MESH_FACES} faces"
    suffix = path.suffix.lower()
    scale = 1.0
    try:
        if suffix == ".dae":
            data, scale = clean_dae(data)
        elif suffix == ".glb":
            check_glb(data)
        mesh = load_triangles(data, suffix, process=False, ignore_broken=False)
    except MissingExtra:
        raise
    except Exception as error:  # the readers of trimesh raise errors of many kinds
        raise urdf.wrong(f"mesh {name!r}: {explain(error)}", allowed) from error
    sound = isinstance(mesh, trimesh.Trimesh) and 0 < len(mesh.faces) <= MESH_FACES
    if not sound or not np.isfinite(mesh.vertices).all():
        raise urdf.wrong(
            f"mesh {name!r} without faces, or with vertices that are not finite", allowed
        )
    return scale * _sample(mesh)


def _primitive_points(shape: LinkShape) -> Points:
    if shape.kind == "box":
        return _sample(trimesh.creation.box(shape.size))
    if shape.kind == "sphere":
        return _sample(trimesh.creation.icosphere(3, shape.size[0]))
    return _sample(trimesh.creation.cylinder(shape.size[0], shape.size[1], sections=48))


def _sample(mesh: "trimesh.Trimesh") -> Points:
    """Return points on a mesh: random points of its surface, then some of its vertices."""
    count = 4000  # points on each shape
    points = np.asarray(trimesh.sample.sample_surface(mesh, count, seed=0)[0])
    vertices = np.asarray(mesh.vertices)
    return np.concatenate([points, vertices[:: len(vertices) // count + 1]])


def fit_shapes(points: Points) -> list[LinkShape]:
    """Return a few boxes, or a cylinder, that cover the points on a body."""
    round_share = (
        0.9  # a cylinder replaces boxes if its volume is less than this share of their volume
    )
    turn = _axes(points)
    local = points @ turn
    boxes = _cut(local, 3 if float(np.ptp(local, axis=0).max()) < 0.08 else 8, SAVING)
    volume = sum(float(np.prod(high - low)) for low, high in boxes)
    low = local.min(0)
    high = local.max(0)
    middle = (low + high) / 2
    sides = high - low
    for axis in range(3):
        radius = float(np.linalg.norm(np.delete(local - middle, axis, 1), axis=1).max())
        if math.pi * radius**2 * sides[axis] < round_share * volume:
            along = np.roll(np.eye(3), -axis - 1, 0).T  # its third column is the axis
            return [_shape("cylinder", (radius, sides[axis]), turn @ along, turn @ middle)]
    return _boxes(boxes, turn)


def _axes(points: Points) -> Float[np.ndarray, "3 3"]:
    """Return the axes of the fitted boxes as columns: the axes of the link, unless rotated axes fit
    much better.
    """
    turned_share = (
        0.85  # a box is turned out of the link's axes if its volume falls below this share
    )
    if (
        np.linalg.matrix_rank(points - points.mean(0), tol=1e-7 * math.sqrt(len(points))) < 3
    ):  # a flat body has no hull
        return np.eye(3)
    turned, sizes = trimesh.bounds.oriented_bounds(points)
    straight = np.prod(np.ptp(points, axis=0))
    return turned[:3, :3].T if np.prod(sizes) < turned_share * straight else np.eye(3)


def _boxes(corners: list[Corners], axes: np.ndarray) -> list[LinkShape]:
    """Return collision boxes, given their lower and upper corners along the columns of `axes`."""
    return [
        _shape("box", tuple(high - low), axes, axes @ (low + high) / 2) for low, high in corners
    ]


def _cut(points: Points, most: int, saving: float) -> list[Corners]:
    """Return corners of at most `most` boxes that cover the points; each cut saves the share
    `saving` of the volume.
    """
    cells = [(points.min(0), points.max(0), points)]
    while len(cells) < most:
        total = sum(float(np.prod(high - low)) for low, high, _ in cells)
        cuts = [(gain, k, two) for k, cell in enumerate(cells) for gain, two in _halves(*cell)]
        gain, k, two = max(cuts, key=lambda cut: cut[0], default=(0.0, 0, ()))
        if gain <= saving * total:
            break
        cells[k : k + 1] = two
    return [(low, high) for low, high, _ in cells]


def _halves(low: np.ndarray, high: np.ndarray, points: Points) -> list[tuple[float, list]]:
    """Return each way to cut a box in two across an axis: the saved volume and both parts, each
    over 8 mm thick.
    """
    found = []
    for axis in range(3):
        for at in np.linspace(low[axis], high[axis], 12)[1:-1]:
            if min(at - low[axis], high[axis] - at) < 0.008:
                continue
            below = points[:, axis] < at
            if not 20 < int(below.sum()) < len(points) - 20:
                continue
            two = []
            for part, face, side in ((points[below], 1, at), (points[~below], 0, at)):
                corners = [part.min(0), part.max(0)]
                corners[face][axis] = side  # no gap between the two
                two.append((corners[0], corners[1], part))
            saved = np.prod(high - low) - sum(np.prod(h - b) for b, h, _ in two)
            found.append((float(saved), two))
    return found


def _shape(kind: str, size: tuple[float, ...], turn: np.ndarray, center: np.ndarray) -> LinkShape:
    """Return a collision shape of a kind, size, rotation and centre; all numbers are rounded to
    1e-6.
    """
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose[:3, 3] = center
    xyz, rpy = place(pose)
    x, y, z = (round(v, 6) for v in xyz)
    roll, pitch, yaw = (round(v, 6) for v in rpy)
    return LinkShape(
        kind, tuple(max(round(float(v), 6), 1e-4) for v in size), (x, y, z), (roll, pitch, yaw)
    )
