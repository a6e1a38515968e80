"""The shapes of torchgrasp's own objects from exact geometry; `author_objects.py` writes them.

Every object is a union of convex solids, so its convex parts need no decomposition. A physics
engine takes at most 255 corners and 255 faces. So curved parts are coarser than the mesh; they have
the same volume. The module needs manifold3d, a dependency of development only. Metres, z up,
resting at z = 0.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import manifold3d as m3
import numpy as np

SEGMENTS = 96
"""Sides of a solid of revolution: at a radius of 33 mm the facets lie 0.02 mm inside the circle."""
FINE_SIDES = 48
COARSE_SIDES = 20
"""Sides of the equator of an ellipsoid in the mesh and in the parts (102 corners, 200 faces)."""

Vector = Sequence[float | int] | np.ndarray


class Solid(NamedTuple):
    """A convex solid twice: `fine` for the mesh, and coarse, as a `part` for a physics engine."""

    fine: m3.Manifold
    part: m3.Manifold


def author(name: str) -> tuple[m3.Manifold, list[np.ndarray]]:
    """Return the solid of an object and the corners (k, 3) [m] of each of its convex parts.

    Raises:
        KeyError: no such object.

    >>> solid, parts = author("cylinder")
    >>> len(parts), round(solid.volume() * 1e6)
    (1, 376)
    """
    solid, parts = {"cylinder": _cylinder, "rabbit": _rabbit, "spray": _spray, "jug": _jug}[name]()
    # Parts that share a face leave slivers without volume: the object is the largest piece.
    solid = max(solid.simplify(1e-6).decompose(), key=lambda piece: piece.volume())
    return solid, [np.asarray(p.hull().to_mesh64().vert_properties)[:, :3] for p in parts]


def _cylinder() -> tuple[m3.Manifold, list[m3.Manifold]]:
    """A tin: radius 33 mm, height 110 mm."""
    tin = m3.Manifold.cylinder(0.110, 0.033, 0.033, SEGMENTS)
    return tin, [tin]


def _rabbit() -> tuple[m3.Manifold, list[m3.Manifold]]:
    """A sitting rabbit that looks along x, 155 mm high and 72 mm wide, flat underneath."""
    solids = [
        _ellipsoid((-0.004, 0, 0.040), (0.048, 0.034, 0.042), pitch=-22.0),  # body
        _ellipsoid((0.020, 0, 0.052), (0.026, 0.026, 0.036), pitch=12.0),  # chest
        _ellipsoid((0.034, 0, 0.088), (0.028, 0.023, 0.023), pitch=10.0),  # head
        _ellipsoid((0.055, 0, 0.081), (0.012, 0.013, 0.011)),  # muzzle
        _ellipsoid((-0.050, 0, 0.022), (0.013, 0.013, 0.013)),  # tail
    ]
    for side in (-1, 1):
        solids += [
            _ellipsoid(
                (0.020, 0.012 * side, 0.125), (0.008, 0.011, 0.032), pitch=-18.0, roll=-12.0 * side
            ),  # ear
            _ellipsoid((-0.018, 0.024 * side, 0.024), (0.028, 0.012, 0.026)),  # haunch
            _ellipsoid((0.008, 0.026 * side, 0.006), (0.028, 0.010, 0.010)),  # hind foot
            _ellipsoid((0.036, 0.013 * side, 0.022), (0.010, 0.009, 0.030), pitch=-14.0),  # foreleg
            _ellipsoid((0.046, 0.013 * side, 0.006), (0.013, 0.009, 0.009)),  # fore paw
        ]
    above = m3.Manifold.cube((1.0, 1.0, 1.0), True).translate((0, 0, 0.5))
    return _unite([Solid(s.fine ^ above, s.part ^ above) for s in solids])


def _spray() -> tuple[m3.Manifold, list[m3.Manifold]]:
    """A spray bottle, 232 mm high: an oval body of 70 x 54 mm, a neck, and a trigger head. It
    sprays along x.
    """
    profile = [(0.029, 0), (0.033, 0.004), (0.035, 0.020)]
    profile += [(0.035, 0.090), (0.0335, 0.110), (0.029, 0.130)]
    profile += [(0.0225, 0.146), (0.0165, 0.158), (0.0145, 0.166)]
    body = [_frusta(profile[i : i + 3], flatten=0.77) for i in range(0, len(profile) - 2, 2)]
    neck = [
        _frusta([(0.0110, 0.160), (0.0110, 0.178)]),
        _frusta([(0.0165, 0.172), (0.0165, 0.186), (0.0145, 0.190)]),  # the screw cap
    ]
    heads = (
        [(-0.026, 0.206), (-0.022, 0.189), (0.016, 0.189), (0.016, 0.214), (-0.018, 0.214)],
        [(-0.026, 0.205), (0.036, 0.205), (0.036, 0.224), (-0.004, 0.232), (-0.024, 0.226)],
    )
    triggers = (
        [(0.018, 0.208), (0.030, 0.208), (0.036, 0.186), (0.029, 0.184)],
        [(0.036, 0.187), (0.029, 0.186), (0.033, 0.164), (0.040, 0.163)],
        [(0.040, 0.165), (0.033, 0.166), (0.041, 0.150), (0.047, 0.153)],
    )
    # the union depends on which solid was made first
    head = [_prism(outline, 0.022) for outline in heads]
    head.append(_tube((0.030, 0, 0.215), (0.052, 0, 0.215), 0.0075))  # the nozzle
    head += [_prism(outline, 0.012) for outline in triggers]
    return _unite([*body, *neck, *head])


def _jug() -> tuple[m3.Manifold, list[m3.Manifold]]:
    """A full jug: 152 mm high, 78 mm wide, filled to 14 mm below the rim. A spout is along x, a
    handle behind.
    """
    outline = [(0.030, 0), (0.034, 0.004), (0.037, 0.025)]
    outline += [(0.039, 0.050), (0.0385, 0.070), (0.036, 0.090)]
    outline += [(0.0325, 0.108), (0.0305, 0.120), (0.0305, 0.126), (0.0315, 0.138)]
    body = [_frusta(outline[i : i + 3]) for i in (0, 2, 4)]
    # the outline is hollow at the neck: one frustum each
    body += [_frusta(outline[i : i + 2]) for i in (6, 7, 8)]
    outside = [(0.0315, 0.138), (0.0340, 0.152)]
    inside = [(0.0275, 0.138), (0.0305, 0.152)]
    rim, staves = _ring(outside, inside, pieces=24)
    root = [(0.029, s * 0.013, z) for s in (-1, 1) for z in (0.135, 0.152)]
    lip = [(0.030, 0, 0.122), (0.047, 0.004, 0.153), (0.047, -0.004, 0.153), (0.045, 0, 0.149)]
    spout = m3.Manifold.hull_points(np.array(root + lip))
    angle = np.linspace(math.radians(62), math.radians(-68), 11)
    path = [(-0.030 - 0.038 * math.cos(a), 0.0, 0.082 + 0.046 * math.sin(a)) for a in angle]
    path = [(-0.0285, 0.0, 0.1255), *path, (-0.034, 0.0, 0.033)]
    slope = np.gradient(np.array(path), axis=0)
    slope /= np.linalg.norm(slope, axis=1, keepdims=True)
    ends = list(zip(path, slope, strict=True))
    handle = [_bar(ends[i : i + 2], 0.0050, 0.0075) for i in range(len(ends) - 1)]
    solid, parts = _unite([*body, Solid(spout, spout), *handle])
    return solid + rim, parts + staves


def _ellipsoid(centre: Vector, axes: Vector, pitch: float = 0.0, roll: float = 0.0) -> Solid:
    """An ellipsoid with semi-axes `axes` [m], its top tipped forward by `pitch` and sideways by
    `roll` [deg].
    """

    def place(ball: m3.Manifold) -> m3.Manifold:
        return (
            ball.scale((axes[0], axes[1], axes[2]))
            .rotate((roll, pitch, 0.0))
            .translate((centre[0], centre[1], centre[2]))
        )

    fine = m3.Manifold.sphere(1.0, FINE_SIDES)
    coarse = m3.Manifold.sphere(1.0, COARSE_SIDES)
    grow = (4 / 3 * math.pi / coarse.volume()) ** (1 / 3)
    return Solid(place(fine), place(coarse.scale((grow, grow, grow))))


def _frusta(profile: Sequence[Vector], flatten: float = 1.0) -> Solid:
    """A solid of revolution of (radius, height) [m], convex as a whole; `flatten` scales it along
    y.
    """

    def revolve(segments: int, grow: float) -> m3.Manifold:
        angle = np.arange(segments) * 2 * np.pi / segments
        x = np.cos(angle)
        y = np.sin(angle)
        rings = [
            np.stack([r * grow * x, r * grow * flatten * y, np.full(segments, z)], -1)
            for r, z in profile
        ]
        return m3.Manifold.hull_points(np.concatenate(rings))

    sides = 240 // len(profile) // 4 * 4
    area = math.sin(2 * math.pi / SEGMENTS) * SEGMENTS / (math.sin(2 * math.pi / sides) * sides)
    return Solid(revolve(SEGMENTS, 1.0), revolve(sides, math.sqrt(area)))


def _ring(
    outer: Sequence[Vector], inner: Sequence[Vector], pieces: int
) -> tuple[m3.Manifold, list[m3.Manifold]]:
    """A ring between two convex profiles of (radius, height) [m], and the nearly convex pieces it
    is cut into.
    """
    parts = []
    for i in range(pieces):
        angle = (np.arange(SEGMENTS // pieces + 1) + i * SEGMENTS // pieces) * 2 * np.pi / SEGMENTS
        corners = [
            (r * math.cos(a), r * math.sin(a), z) for r, z in [*outer, *inner] for a in angle
        ]
        parts.append(m3.Manifold.hull_points(np.array(corners)))
    return _frusta(outer).fine - _frusta(inner).fine, parts


def _prism(outline: Sequence[Vector], width: float) -> Solid:
    """A convex outline of (x, z) [m], `width` [m] thick along y."""
    corners = [(x, y, z) for x, z in outline for y in (-width / 2, width / 2)]
    solid = m3.Manifold.hull_points(np.array(corners))
    return Solid(solid, solid)


def _tube(start: Vector, end: Vector, radius: float) -> Solid:
    """A round bar between two points of the plane y = 0."""
    along = np.subtract(end, start) / np.linalg.norm(np.subtract(end, start))
    return _bar([(start, along), (end, along)], radius, radius)


def _bar(ends: Sequence[tuple[Vector, Vector]], thick: float, wide: float) -> Solid:
    """The hull of two elliptic discs in the plane y = 0: (centre, direction), semi-axes in the
    plane and along y.
    """

    def hull(sides: int) -> m3.Manifold:
        angle = np.arange(sides) * 2 * np.pi / sides
        rings = [
            np.asarray(centre)
            + thick * np.cos(angle)[:, None] * np.array([-direction[2], 0, direction[0]])
            + wide * np.sin(angle)[:, None] * np.array([0, 1, 0])
            for centre, direction in ends
        ]
        return m3.Manifold.hull_points(np.concatenate(rings))

    return Solid(hull(32), hull(32))


def _unite(solids: Sequence[Solid]) -> tuple[m3.Manifold, list[m3.Manifold]]:
    """Return the union of the solids, and their convex parts."""
    return m3.Manifold.batch_boolean([s.fine for s in solids], m3.OpType.Add), [
        s.part for s in solids
    ]
