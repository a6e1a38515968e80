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

from torchgrasp.app.author.repair import place
from torchgrasp.app.author.scene_meshes import check_glb, clean_dae
from torchgrasp.files import explain, read_bounded
from torchgrasp.foundation.errors import HandFileError, MissingExtra
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.foundation.limits import HAND_MESH_BYTES, MAX_EXTENT, MESH_BYTES, MESH_FACES
from torchgrasp.geometry.mesh import load_triangles
from torchgrasp.hand.hand_toml import Pad
from torchgrasp.hand.urdf import LinkShape, Urdf, pose_of

MEBIBYTE = 2**20  # [bytes]
MESH_KINDS = (".stl", ".obj", ".ply", ".dae", ".glb")


@dataclasses.dataclass(frozen=True)
class FitNumbers:
    """Numbers of the replacement of meshes by boxes, cylinders and balls."""

    points: int = 4000  # number of points on each shape
    seed: int = 0  # random seed of these points
    # number of subdivisions of an icosahedron, whose corners then sample a sphere
    fineness: int = 3
    sections: int = 48  # number of sides of a sampled cylinder
    # least absolute value of the largest coordinate [m] of a mesh; below it the unit is wrong
    least_reach: float = 5e-4
    # least volume that cutting a link's box in two saves, as a share of the volume of all boxes; a
    # smaller share gives more boxes
    saving: float = 0.12
    saving_tip: float = 0.04  # the same least share for cutting a fingertip's box in two
    short_boxes: int = 3  # greatest number of boxes of a short body
    long_boxes: int = 8  # greatest number of boxes of a long body
    tip_boxes: int = 4  # greatest number of boxes of a long tip, behind its ball
    long: float = 0.08  # least length of a long body [m]
    long_tip: float = 2.6  # least length of a long tip, in radii of its ball
    # number of positions along an axis of a box, with both ends; cuts are tried between the ends
    places: int = 12
    thinnest: float = 0.008  # least thickness of a part [m]
    # number of points that each part of a cut must exceed: the size of fewer is chance
    fewest: int = 20
    # greatest volume of a cylinder that replaces boxes, as a share of their volume
    round_share: float = 0.9
    # greatest volume of a box, turned out of the link's axes, that replaces boxes, as a share of
    # their volume
    turned_share: float = 0.85
    flat: float = 1e-7  # root mean square thickness [m] below which a body is flat, and has no hull
    least_size: float = 1e-4  # least side of a shape [m], so that none is empty
    digits: int = 6  # number of decimals to which all numbers are rounded


FIT = FitNumbers()
MOST_NAME = 80  # of a mesh's name in an error [characters]
Points = Float[np.ndarray, "_ 3"]  # points [m], of any count in each use
Corners = tuple[np.ndarray, np.ndarray]  # lower and upper corner (3,) of a box [m]


def mesh_file(urdf: Urdf, name: str, folder: Path) -> Path:
    """Return the path of the file of a mesh that a URDF names, also by `package://`.

    `name` is the path as the URDF has it. The file must lie inside `folder`. Raises `HandFileError`
    for a file that is missing, outside, larger than 50 MiB (`MESH_BYTES`) or in another format.
    """
    base = folder.resolve()
    here = urdf.path.resolve().parent
    called = f"mesh {name[:MOST_NAME]!r}"
    path = PurePosixPath(name.removeprefix("package://"))
    if ":" in str(path) or "\\" in name or path.is_absolute():
        raise urdf.wrong(
            f"{called}, an absolute path or an address",
            f"a path inside {folder} with slashes, as a/b.stl",
        )
    if path.suffix.lower() not in MESH_KINDS:
        raise urdf.wrong(f"{called} of another format", f"a mesh ({', '.join(MESH_KINDS)})")
    # The files of a package may lie anywhere in the folder. So the first parts of the path may be
    # left out, and folders above the URDF count.
    package = name.startswith("package://")
    above = [x for x in here.parents if package and x.is_relative_to(base)]
    roots = (here, *above, base)
    left_out = range(len(path.parts) if package else 1)
    places = [x.joinpath(*path.parts[k:]) for k in left_out for x in roots]
    why = ""
    for spot in places:
        try:
            file = spot.resolve()
            if not file.is_relative_to(base):
                why = why or "outside, perhaps by a symbolic link"
            elif file.is_file() and file.stat().st_size > MESH_BYTES:
                why = (
                    why or f"of {file.stat().st_size} bytes, more than {MESH_BYTES // MEBIBYTE} MiB"
                )
            elif file.is_file():
                return file
            else:
                beside = [x.name for x in file.parent.iterdir()]
                alike = [x for x in beside if x.lower() == file.name.lower()]
                if alike and alike[0] != file.name:
                    why = why or f"called {alike[0]} there"
        # no such folder, a loop of links, or a name that no system takes
        except (OSError, RuntimeError, ValueError):
            continue
    raise urdf.wrong(
        f"{called}, {why or 'missing'}", f"a file inside {folder} (--meshes names another folder)"
    )


def shape_points(urdf: Urdf, folder: Path) -> dict[str, tuple[Points, ...]]:
    """Return points (n, 3) [m] on each collision shape of every link, by the name of the link.

    They are in the link's frame, one array for each shape. The mesh files lie inside `folder`.
    Raises `HandFileError` for mesh files that are missing, malformed, or larger than 200 MiB in all
    (`HAND_MESH_BYTES`). Raises it also for a mesh in a wrong unit: one with a coordinate beyond 2 m
    (`MAX_EXTENT`), or none of 0.5 mm.
    """
    names = {shape.file for link in urdf.links for shape in link.shapes if shape.kind == "mesh"}
    size = sum(mesh_file(urdf, name, folder).stat().st_size for name in names)
    if size > HAND_MESH_BYTES:
        raise urdf.wrong(
            f"meshes of {size} bytes", f"meshes of at most {HAND_MESH_BYTES // MEBIBYTE} MiB in all"
        )
    meshes = {name: _sample(read_mesh_file(urdf, name, folder)) for name in sorted(names)}
    found = {}
    for link in urdf.links:
        parts = []
        for shape in link.shapes:
            is_mesh = shape.kind == "mesh"
            local = meshes[shape.file] * shape.size if is_mesh else _sample(primitive_mesh(shape))
            reach = float(np.abs(local).max())
            called = f"mesh {shape.file!r} that reaches"
            if not reach <= MAX_EXTENT:
                most = f"shapes that reach at most {MAX_EXTENT:g} m"
                wanted = f"{most}; a mesh in millimetres needs a scale of 0.001"
                raise urdf.wrong(f"{called} {reach:.3g} m", wanted)
            if is_mesh and 0 in shape.size:
                scale = " ".join(f"{x:g}" for x in shape.size)
                found = f"mesh {shape.file!r} with the scale {scale}"
                raise urdf.wrong(found, "a scale that is not 0 on any axis")
            if is_mesh and reach < FIT.least_reach:
                wanted = "metres: scaled twice, or by 0?"
                raise urdf.wrong(f"{called} {1e3 * reach:.3g} mm", wanted)
            pose = pose_of(shape)
            parts.append(local @ pose[:3, :3].T + pose[:3, 3])
        found[link.name] = tuple(parts)
    return found


def replace_meshes(urdf: Urdf, points: Mapping[str, tuple[Points, ...]]) -> tuple[Urdf, list[str]]:
    """Return the URDF with a few boxes or a cylinder instead of every collision mesh, and a
    sentence on it.

    `points`, from `shape_points`, holds by link an array (n, 3) [m] of points on each shape. They
    are in the link's frame. The sentence says how many shapes replace how many meshes. It is the
    only one in a list, which is empty without meshes.
    """
    links = []
    count = 0
    made = 0
    for link in urdf.links:
        shapes: list[LinkShape] = []
        for shape, on_it in zip(link.shapes, points[link.name], strict=True):
            if shape.kind != "mesh":
                shapes.append(shape)
                continue
            fitted = fit_shapes(on_it)
            count += 1
            made += len(fitted)
            shapes += fitted
        links.append(dataclasses.replace(link, shapes=tuple(shapes)))
    replaced = dataclasses.replace(urdf, links=tuple(links))
    done = f"{count} collision meshes became {made} boxes or cylinders around them"
    return replaced, [done] if count else []


def ball_tip(urdf: Urdf, tip: str, ball: Pad, outward: np.ndarray, points: Points) -> Urdf:
    """Return the URDF with a ball at the end of the link `tip` instead of its shapes.

    A tip longer than 2.6 radii of the ball (`FIT.long_tip`) also gets boxes up to the ball. `ball`
    is the tip's pad, the sphere that touches objects; its radius is not 0. The unit vector
    `outward` (3,) points to the end of the finger. `points` (n, 3) [m] lie on the surface of the
    tip. All are in the frame of the link.
    """
    link = next(x for x in urdf.links if x.name == tip)
    reach = (points - np.array(ball.center)) @ outward
    shapes = [LinkShape("sphere", (ball.radius,), ball.center, (0.0, 0.0, 0.0))]
    if np.ptp(reach) > FIT.long_tip * ball.radius:
        motion = np.array(ball.normal) - ball.normal @ outward * outward
        motion /= np.linalg.norm(motion)
        axes = np.stack([motion, outward, np.cross(motion, outward)], 1)
        behind = points[reach < 0] @ axes
        shapes += _boxes(_cut(behind, FIT.tip_boxes, FIT.saving_tip), axes)
    ended = dataclasses.replace(link, shapes=tuple(shapes))
    return dataclasses.replace(urdf, links=tuple(ended if x is link else x for x in urdf.links))


def read_mesh_file(urdf: Urdf, name: str, folder: Path) -> "trimesh.Trimesh":
    """Return the mesh [m] of a file that a URDF names, before the scale that the URDF gives it.

    `name` is the path as the URDF has it. Other files that the mesh file refers to are not read.
    Raises `HandFileError` for a file that is missing, outside `folder`, malformed or without faces.
    Raises it also for more than 50 MiB (`MESH_BYTES`) or 500,000 faces (`MESH_FACES`). Raises
    `MissingExtra` for a .dae if pycollada is not installed.
    """
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
        found = f"mesh {name!r} without faces, or with vertices that are not finite"
        raise urdf.wrong(found, allowed)
    if scale != 1.0:
        mesh.apply_scale(scale)
    return mesh


def primitive_mesh(shape: LinkShape) -> "trimesh.Trimesh":
    """Return the mesh [m] of a box, sphere or cylinder, centred at the origin."""
    if shape.kind == "box":
        return trimesh.creation.box(shape.size)
    if shape.kind == "sphere":
        return trimesh.creation.icosphere(FIT.fineness, shape.size[0])
    radius, length = shape.size
    return trimesh.creation.cylinder(radius, length, sections=FIT.sections)


def _sample(mesh: "trimesh.Trimesh") -> Points:
    """Return points on a mesh: random points of its surface, then some of its vertices."""
    points = np.asarray(trimesh.sample.sample_surface(mesh, FIT.points, seed=FIT.seed)[0])
    vertices = np.asarray(mesh.vertices)
    return np.concatenate([points, vertices[:: len(vertices) // FIT.points + 1]])


def fit_shapes(points: Points) -> list[LinkShape]:
    """Return collision shapes that cover the points (n, 3) [m] on a body: up to eight boxes, or one
    cylinder.

    The cylinder is taken if it has less than 0.9 of the boxes' volume (`FIT.round_share`). The
    shapes are in the frame of the points.
    """
    turn = _axes(points)
    local = points @ turn
    short = float(np.ptp(local, axis=0).max()) < FIT.long
    boxes = _cut(local, FIT.short_boxes if short else FIT.long_boxes, FIT.saving)
    volume = sum(float(np.prod(high - low)) for low, high in boxes)
    low = local.min(0)
    high = local.max(0)
    middle = (low + high) / 2
    sides = high - low
    for axis in range(3):
        across = np.delete(local - middle, axis, 1)
        radius = float(np.linalg.norm(across, axis=1).max())
        if math.pi * radius**2 * sides[axis] < FIT.round_share * volume:
            along = np.roll(np.eye(3), -axis - 1, 0).T  # its third column is the axis
            return [turned_shape("cylinder", (radius, sides[axis]), turn @ along, turn @ middle)]
    return _boxes(boxes, turn)


def _axes(points: Points) -> Float[np.ndarray, "3 3"]:
    """Return the axes of the fitted boxes as columns: the axes of the link, unless rotated axes fit
    much better.
    """
    tolerance = FIT.flat * math.sqrt(len(points))
    if np.linalg.matrix_rank(points - points.mean(0), tol=tolerance) < 3:
        return np.eye(3)
    turned, sizes = trimesh.bounds.oriented_bounds(points)
    straight = np.prod(np.ptp(points, axis=0))
    return turned[:3, :3].T if np.prod(sizes) < FIT.turned_share * straight else np.eye(3)


def _boxes(corners: list[Corners], axes: np.ndarray) -> list[LinkShape]:
    """Return collision boxes, given their lower and upper corners along the columns of `axes`."""
    return [
        turned_shape("box", tuple(high - low), axes, axes @ (low + high) / 2)
        for low, high in corners
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
    """Return each way to cut a box in two across an axis: the saved volume and both parts."""
    found = []
    for axis in range(3):
        for at in np.linspace(low[axis], high[axis], FIT.places)[1:-1]:
            if min(at - low[axis], high[axis] - at) < FIT.thinnest:
                continue
            below = points[:, axis] < at
            if not FIT.fewest < int(below.sum()) < len(points) - FIT.fewest:
                continue
            two = []
            for part, face, side in ((points[below], 1, at), (points[~below], 0, at)):
                corners = [part.min(0), part.max(0)]
                corners[face][axis] = side  # no gap between the two
                two.append((corners[0], corners[1], part))
            saved = np.prod(high - low) - sum(np.prod(h - b) for b, h, _ in two)
            found.append((float(saved), two))
    return found


def turned_shape(
    kind: str, size: tuple[float, ...], turn: np.ndarray, center: np.ndarray
) -> LinkShape:
    """Return a collision shape of a link from its axes and its middle, with rounded numbers.

    `kind` is "box", "cylinder" or "sphere". `size` [m] is the three sides, (radius, length), or
    (radius,). `turn` (3, 3) holds the axes of the shape as columns; a cylinder lies along the
    third. `center` (3,) [m] is the middle of the shape. Both are in the link's frame.
    """
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose[:3, 3] = center
    xyz, rpy = place(pose)
    x, y, z = (round(v, FIT.digits) for v in xyz)
    roll, pitch, yaw = (round(v, FIT.digits) for v in rpy)
    sides = tuple(max(round(float(v), FIT.digits), FIT.least_size) for v in size)
    return LinkShape(kind, sides, (x, y, z), (roll, pitch, yaw))
