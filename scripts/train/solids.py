"""Solids of household bodies: each is one body, and the convex pieces that it consists of, known by
construction.

A thing is a list of solids [mm] that overlap or share a plane, its mesh is their union. A piece has
at most 48 corners: a physics engine takes 64. The module needs manifold3d, a dependency of
development only.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import manifold3d as m3
import numpy as np
import trimesh
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

Draw = Callable[[float, float], float]
"""Draws a number uniformly between two limits."""
Profile = Sequence[tuple[float, float]]
"""Radii and heights [mm] of a solid of revolution, from below."""

SIDES = 24
"""Of a solid of revolution: a frustum then has 48 corners."""
SECTORS = 16
"""Of a wall. Each has two facets outside and one inside, so that it is convex and few make a smooth
vessel.
"""
ROUND = 12
"""Sides of a rod or a handle."""

MERGED = 1e-3
"""Corners of a union this near to each other [mm] become one, as a file in single precision needs.
"""
ROCKING = 1.0
"""Between two faces on which a body lies alike [deg]: it rocks, but does not tip over."""
STEADY = 4.0
"""A body tips over when it is tilted by more than this [deg]. A lying rod of 24 sides rolls at 7.5.
"""


class Solid(NamedTuple):
    """A solid body [mm], and the corners (n, 3) [mm] of each of its convex pieces."""

    body: m3.Manifold
    pieces: list[np.ndarray]


Thing = list[Solid]

Families = dict[str, Callable[[Draw], Thing]]
"""Makers of bodies by the name of their family."""


def family(families: Families, **sizes: tuple[float, float]) -> Callable[[Callable], Callable]:
    """Return a decorator that enters a maker of bodies into the table `families` under its name.

    `sizes` are the limits of its arguments; each is drawn between its limits, one after another.
    """

    def enter(make: Callable[..., Thing]) -> Callable[..., Thing]:
        def maker(draw: Draw) -> Thing:
            drawn = {name: draw(*limits) for name, limits in sizes.items()}
            return make(draw, **drawn)

        families[make.__name__] = maker
        return make

    return enter


def stack(profile: Profile, oval: float = 1.0, sides: int = SIDES) -> Thing:
    """Return a solid of revolution about z, with one frustum between two points of a profile.

    `profile` are pairs of radius and height [mm], from below. `oval` scales the solid along y.
    """
    rings = [disc(r, r * oval, z, sides) for r, z in profile]
    pairs = itertools.pairwise(rings)
    pieces = [np.concatenate((low, high)) for low, high in pairs if low[0, 2] < high[0, 2]]
    return [Solid(_sew(np.stack(rings)), pieces)]


def disc(a: float, b: float, z: float, sides: int = SIDES) -> np.ndarray:
    """Return the corners (sides, 3) [mm] of an ellipse at height z.

    Its half axes are a along x and b along y.
    """
    # a side, not a corner, is lowest in a lying solid
    angle = 2 * math.pi * (np.arange(sides) + 0.5) / sides
    return np.stack([a * np.cos(angle), b * np.sin(angle), np.full(sides, z)], -1)


def shell(levels: Sequence[tuple[float, float, float]], oval: float = 1.0) -> Thing:
    """Return a wall about the z axis, whose convex pieces are sectors.

    `levels` are (outer radius, inner radius, height) [mm], from below. `oval` scales the wall along
    y.
    """
    outer = np.stack([disc(r, r * oval, z, 2 * SECTORS) for r, _, z in levels])
    inner = np.stack([disc(r, r * oval, z, 2 * SECTORS) for _, r, z in levels])
    pieces = []
    for level, k in itertools.product(range(len(levels) - 1), range(0, 2 * SECTORS, 2)):
        seen = np.arange(k, k + 3) % (2 * SECTORS)
        both = slice(level, level + 2)
        pieces.append(np.concatenate([*outer[both, seen], *inner[both, seen[::2]]]))
    # the hole opens both ends
    hole = inner[:, ::2]
    beyond = [hole[:1] - np.array([0, 0, 1]), hole, hole[-1:] + np.array([0, 0, 1])]
    return [Solid(_sew(outer) - _sew(np.concatenate(beyond)), pieces)]


def vessel(outline: Profile, wall: float, floor: float, oval: float = 1.0) -> Thing:
    """Return an open vessel about the z axis, with a wall and a floor of these thicknesses [mm].

    `outline` are pairs of outer radius and height [mm], from below. `oval` scales it along y.
    The wall is wider in a level where it leans, so that it is as thick across.
    """
    radius, height = np.array(outline).T
    levels = np.array([floor, *height[height > floor + 1.0]])  # no level is lower than a millimetre
    outer = np.interp(levels, height, radius)
    inner = outer - wall * np.hypot(1.0, np.gradient(outer, levels))
    inner = np.maximum(inner, 0.1 * outer)  # a thick wall leaves a narrow hole
    (around,) = shell(list(zip(outer, inner, levels, strict=True)), oval)
    ends = ((radius[0], 0.0), (outer[0], floor))
    base = np.stack([disc(r, r * oval, z, 2 * SECTORS) for r, z in ends])
    halves = [np.arange(first, first + SECTORS + 1) % (2 * SECTORS) for first in (0, SECTORS)]
    pieces = [base[:, half].reshape(-1, 3) for half in halves]
    return [Solid(_sew(base) + around.body, pieces + around.pieces)]


def box(x: float, y: float, z: float, at: Sequence[float] = (0.0, 0.0, 0.0)) -> Thing:
    """Return a box with edges [mm] along x, y and z; `at` [mm] is the middle of its lowest face."""
    corners = np.array(list(itertools.product((-0.5, 0.5), (-0.5, 0.5), (0.0, 1.0))))
    return lump(corners * (x, y, z) + at)


def crate(x: float, y: float, z: float, wall: float, floor: float) -> Thing:
    """Return a box that is open above, with these edges and thicknesses along x, y and z [mm]."""
    sides = [
        box(x, wall, z, (0, s * (y - wall) / 2, 0)) + box(wall, y, z, (s * (x - wall) / 2, 0, 0))
        for s in (-1, 1)
    ]
    hole = box(x - 2 * wall, y - 2 * wall, z, (0, 0, floor))[0].body
    pieces = [solid.pieces[0] for solid in [*box(x, y, floor), *sides[0], *sides[1]]]
    return [Solid(box(x, y, z)[0].body - hole, pieces)]


def prism(
    outline: Sequence[tuple[float, float]] | np.ndarray, height: float, top: float = 1.0
) -> Thing:
    """Return a prism: a convex outline of points (x, y) [mm], extruded along z to a `height` [mm].

    The factor `top` scales the outline of its upper face.
    """
    flat = np.array(outline)
    below = np.c_[flat, np.zeros(len(flat))]
    above = np.c_[top * flat, np.full(len(flat), height)]
    return lump(np.concatenate([below, above]))


def slab(x: float, y: float, z: float, corner: float, edge: float) -> Thing:
    """Return a lying plate of the size x, y, z, with rounded corners and cut edges, all in mm.

    `corner` is the radius of its corners seen from above; `edge` is the width of the cut.
    """
    quarter = np.repeat([0, 90, 180, 270], 3)
    rounded = np.radians(quarter + np.tile([0, 45, 90], 4))
    middle = np.radians(quarter + 45)
    sign = np.sign(np.stack([np.cos(middle), np.sin(middle)], -1))
    arcs = corner * np.stack([np.cos(rounded), np.sin(rounded)], -1)
    flat = sign * (x / 2 - corner, y / 2 - corner) + arcs
    inset = flat * (1 - 2 * edge / x, 1 - 2 * edge / y)
    levels = ((inset, 0.0), (flat, edge), (flat, z - edge), (inset, z))
    return lump(np.concatenate([np.c_[ring, np.full(12, height)] for ring, height in levels]))


def lump(corners: np.ndarray) -> Thing:
    """Return the convex hull of corners (n, 3) [mm] as a thing of one piece."""
    return [Solid(m3.Manifold.hull_points(corners), [corners])]


def ball(a: float, b: float, c: float, slices: int = 8) -> Thing:
    """Return an ellipsoid about the origin with half axes a, b and c [mm] along x, y and z.

    Its poles are cut flat, so that it rests. `slices` is the number of its convex pieces.
    """
    cap = 0.18  # angle of the cut [rad]
    angle = np.linspace(math.pi - cap, cap, slices + 1)
    return stack(list(zip(a * np.sin(angle), c * np.cos(angle), strict=True)), b / a)


def pebble(a: float, b: float, c: float, at: Sequence[float] = (0.0, 0.0, 0.0)) -> Thing:
    """Return a coarse ellipsoid about the point `at` in one convex piece, for a detail; lengths in
    mm.
    """
    angle = np.linspace(0.35, math.pi - 0.35, 4)
    rings = [disc(a * math.sin(t), b * math.sin(t), c * math.cos(t), ROUND) for t in angle]
    return lump(np.concatenate(rings) + at)


def rod(
    start: Sequence[float], end: Sequence[float], r: float, r_end: float | None = None
) -> Thing:
    """Return a round bar of radius r between two points, all in mm.

    If `r_end` is given, the bar is a frustum with this radius at its end.
    """
    along = np.subtract(end, start)
    side = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    return path(np.array([start, end], float), [r, r if r_end is None else r_end], normal=side)


def path(
    points: np.ndarray,
    thick: float | Sequence[float] | np.ndarray,
    wide: float | Sequence[float] | np.ndarray | None = None,
    normal: Sequence[float] | np.ndarray = (0.0, 1.0, 0.0),
    closed: bool = False,
    sides: int = ROUND,
) -> Thing:
    """Return a bent bar through points (n, 3) [mm] of a plane, with one convex piece between two of
    them.

    Args:
        points: points of the middle line.
        thick: half the thickness [mm] in the plane, of the whole bar or at each point.
        wide: half the width [mm] along the normal; by default the thickness.
        normal: of the plane.
        closed: the last point is joined to the first.
        sides: of the elliptic section; 4 gives a rectangle.
    """
    around = np.concatenate([points[-1:], points, points[:1]]) if closed else points
    along = np.gradient(around, axis=0)[1:-1] if closed else np.gradient(around, axis=0)
    up = np.asarray(normal, float) / np.linalg.norm(normal)
    out = np.cross(along / np.linalg.norm(along, axis=1, keepdims=True), up)
    section = disc(1.0, 1.0, 0.0, sides) * (math.sqrt(2) if sides == 4 else 1.0)
    halves = (thick, thick if wide is None else wide)
    # (n, 1, 1)
    in_plane, beside = (np.broadcast_to(half, len(points))[:, None, None] for half in halves)
    outward = in_plane * section[:, :1] * out[:, None]
    rings = points[:, None] + outward - beside * section[:, 1:2] * up
    pairs = itertools.pairwise([*rings, rings[0]] if closed else rings)
    return [Solid(_sew(rings, closed), [np.concatenate(pair) for pair in pairs])]


def arc(
    radius: float | tuple[float, float], start: float, end: float, count: int, at: Sequence[float]
) -> np.ndarray:
    """Return points (count, 3) [mm] on an arc of a circle or ellipse in the plane of x and z.

    `radius` is that of the circle, or the half axes of the ellipse. The arc is between two angles
    [deg], counted from x to z, about the point `at`.
    """
    x, z = radius if isinstance(radius, tuple) else (radius, radius)
    angle = np.radians(np.linspace(start, end, count))
    return np.stack([x * np.cos(angle), np.zeros(count), z * np.sin(angle)], -1) + at


def move(thing: Thing, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Thing:
    """Return a copy of the thing, moved by x, y and z [mm]."""
    by = np.array([x, y, z])
    return [
        Solid(body.translate((x, y, z)), [piece + by for piece in pieces]) for body, pieces in thing
    ]


def turn(thing: Thing, axis: str, degrees: float) -> Thing:
    """Return a copy of the thing, turned about an `axis` ("x", "y" or "z") through the origin.

    Turns by 90 degrees are exact, so that planes stay planes.
    """
    matrix = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    matrix = np.round(matrix) if degrees % 90 == 0 else matrix
    pose = np.c_[matrix, np.zeros(3)]
    return [
        Solid(body.transform(pose), [piece @ matrix.T for piece in pieces])
        for body, pieces in thing
    ]


def lie(thing: Thing) -> Thing:
    """Return a copy of the thing on its side: turned by 90 degrees about x."""
    return turn(thing, "x", 90)


def tip(draw: Draw, thing: Thing, share: float, degrees: float = 90.0) -> Thing:
    """Return the thing, which is turned by `degrees` about x in a random `share` of all cases."""
    return turn(thing, "x", degrees if draw(0, 1) < share else 0)


def around(thing: Thing, count: int, whole: float = 360.0) -> Thing:
    """Return `count` copies of the thing as one, spread evenly about z over an angle [deg]."""
    return join(turn(thing, "z", whole * k / count) for k in range(count))


def join(things: Iterable[Thing]) -> Thing:
    """Return several things as one, with the solids of all."""
    return list(itertools.chain.from_iterable(things))


def unite(thing: Thing) -> tuple[trimesh.Trimesh, list[trimesh.Trimesh]]:
    """Return (mesh, parts): the union of a thing's solids, and the hull of each convex piece, in
    metres.

    >>> mesh, parts = unite(box(20, 30, 40) + box(10, 10, 10, at=(0, 0, 40)))
    >>> round(mesh.volume * 1e9), mesh.is_volume, len(parts)
    (25000, True, 2)
    """
    union = m3.Manifold.batch_boolean([solid.body for solid in thing], m3.OpType.Add)
    hulls = [m3.Manifold.hull_points(piece) for solid in thing for piece in solid.pieces]
    return _in_metres(union.simplify(MERGED)), list(map(_in_metres, hulls))


def find_rest(mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the least rotation, as a pose (4, 4), that lays a body steadily on a face of its hull.

    If no face is steady, it is the rotation to the steadiest one.

    >>> find_rest(trimesh.creation.box((1, 1, 1))).tolist() == np.eye(4).tolist()
    True
    """
    planes = np.unique(ConvexHull(mesh.vertices).equations.round(12), axis=0)
    normals = planes[:, :3]
    height = -planes[:, 3] - normals @ mesh.center_mass  # of the mass centre above each face
    cosine = normals @ normals.T
    sine = np.sqrt(np.maximum(1 - cosine**2, 0))
    # from below the mass centre to each edge
    reach = (height - height[:, None] * cosine) / np.maximum(sine, 1e-9)
    within = np.where(sine > 1e-6, reach, np.inf).min(1) >= 0  # a face has no edge with itself
    apart = sine > math.sin(math.radians(ROCKING))
    steady = np.where(apart, reach, np.inf).min(1) / height * within
    good = steady >= min(math.tan(math.radians(STEADY)), steady.max())
    down = normals[np.argmax(np.where(good, -normals[:, 2], -np.inf))]
    pose = np.eye(4)
    sine = math.hypot(down[0], down[1])
    if sine > 1e-6:  # else it rests already
        axis = np.array([-down[1], down[0], 0.0]) / sine
        pose[:3, :3] = Rotation.from_rotvec(math.atan2(sine, -down[2]) * axis).as_matrix()
    return pose


def _in_metres(solid: m3.Manifold) -> trimesh.Trimesh:
    """Return a solid as a mesh in metres."""
    arrays = solid.to_mesh64()
    return trimesh.Trimesh(
        np.asarray(arrays.vert_properties)[:, :3] / 1000.0, np.asarray(arrays.tri_verts)
    )


def _sew(rings: np.ndarray, closed: bool = False) -> m3.Manifold:
    """Return the solid between rings (n, k, 3) of corners, counterclockwise as seen from the last
    one.

    A facet of four corners that are not in a plane is bent outwards, as in the hull.
    """
    n, k, _ = rings.shape
    corners = rings.reshape(-1, 3)
    row, column = np.meshgrid(np.arange(n if closed else n - 1), np.arange(k), indexing="ij")
    right = (column + 1) % k
    up = (row + 1) % n
    quads = (row * k + column, row * k + right, up * k + right, up * k + column)
    a, b, c, d = (x.ravel() for x in quads)
    p, q, r, s = (corners[x] for x in (a, b, c, d))
    bulge = (np.cross(q - p, r - p) * (s - p)).sum(-1)[:, None] <= 0
    faces = [
        np.where(bulge, np.c_[a, b, c], np.c_[a, b, d]),
        np.where(bulge, np.c_[a, c, d], np.c_[b, c, d]),
    ]
    if not closed:
        fan = np.c_[np.zeros(k - 2, int), np.arange(1, k - 1), np.arange(2, k)]
        faces += [fan[:, ::-1], fan + (n - 1) * k]
    return m3.Manifold(m3.Mesh64(corners, np.concatenate(faces).astype(np.uint64)))
