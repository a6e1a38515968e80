"""Rooms: things on tables with edges, holes, floors and walls, in bins, on shelves and on tilted
boards.
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from benchmarks.scene.scenes import scatter
from torchgrasp.cloud.camera import INTRINSICS, look_at, render_depth
from torchgrasp.cloud.sensor import SensorName
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import rigid, rotation_from_vector
from torchgrasp.geometry.plane import Plane

CAMERAS: tuple[SensorName, ...] = ("realsense", "kinect_v1", "azure", "zivid")
"""Cameras that take the pictures, in turn."""
CLEARANCE = 3
LEAST = 400
"""Pixels between a lone thing and every other thing in the picture; least measured pixels of it."""


@dataclasses.dataclass(frozen=True)
class Room:
    """One depth image [m] of a room, and what is true about it, in a world with z up.

    In `labels`, 0 is furniture or nothing, and k is the thing `names[k - 1]`. In `furniture`, 0 is
    a thing or nothing, and k is the part `parts[k - 1]` of the furniture. `table` is the support's
    plane and `meshes` [m] are the things, both in the world's frame.
    """

    kind: str
    sensor: SensorName
    depth: Float[Tensor, "h w"]
    intrinsics: Float[Tensor, "3 3"]
    camera_pose: Float[Tensor, "4 4"]
    table: Plane
    labels: Int[Tensor, "h w"]
    furniture: Int[Tensor, "h w"]
    names: tuple[str, ...]
    parts: tuple[str, ...]
    meshes: tuple[trimesh.Trimesh, ...]

    @property
    def table_in_camera(self) -> Plane:
        """The table's plane in the camera's frame."""
        return self.table.moved(torch.linalg.inv(self.camera_pose))

    def lone(self) -> tuple[int, ...]:
        """Return the labels of things that stand alone in the picture.

        Such a thing does not reach the picture's rim, and has no other thing beside it. It has
        enough measured pixels.
        """
        from scipy.ndimage import binary_dilation

        found = []
        for k in range(1, len(self.names) + 1):
            mine = self.labels == k
            about = torch.from_numpy(binary_dilation(mine.numpy(), iterations=CLEARANCE))
            cut = mine[:2].any() | mine[-2:].any() | mine[:, :2].any() | mine[:, -2:].any()
            others = about & (self.labels > 0) & ~mine
            measured = int((mine & (self.depth > 0)).sum())
            if measured >= LEAST and not bool(cut) and not bool(others.any()):
                found.append(k)
        return tuple(found)


def rooms(seed: int, kind: str | None = None, sensor: SensorName | None = None) -> Room:
    """Return a random room.

    Args:
        seed: of furniture, things, camera and noise.
        kind: one of `KINDS`; None: in turn.
        sensor: the camera; None: in turn.
    """
    kind = kind or list(KINDS)[seed % len(KINDS)]
    sensor = sensor or CAMERAS[(seed // len(KINDS)) % len(CAMERAS)]
    rng = np.random.default_rng((seed, 43))
    generator = torch.Generator().manual_seed(seed)
    furniture, radius, view, tilt = KINDS[kind](rng)
    names, placed = _things(rng, generator, radius)
    turn = np.eye(4)
    turn[:3, :3] = rotation_from_vector(torch.tensor(tilt, dtype=torch.float64)).numpy()
    placed = [mesh.apply_transform(turn) for mesh in placed]
    level = {"floor", "wall"}  # parts that a tilted board does not take along
    parts = [
        (name, mesh if name in level else mesh.apply_transform(turn)) for name, mesh in furniture
    ]
    pose = _camera(rng, *view)
    depth, labels = render_depth(
        [*placed, *(mesh for _, mesh in parts)], pose, table=None, noise=sensor, seed=seed
    )
    count = len(placed)
    normal = torch.from_numpy(turn[:3, 2].copy())
    return Room(
        kind=kind,
        sensor=sensor,
        depth=depth,
        intrinsics=INTRINSICS,
        camera_pose=pose,
        table=Plane(normal, 0.0),
        labels=torch.where(labels <= count, labels, 0),
        furniture=torch.where(labels > count, labels - count, 0),
        names=tuple(names),
        parts=tuple(name for name, _ in parts),
        meshes=tuple(placed),
    )


class Furniture(NamedTuple):
    """The furniture of a room: its named parts, with the support's top in the plane z = 0.

    `radius` [m] is that of the circle about the origin in which things stand. `view` has the limits
    of the camera's azimuth [deg], elevation [deg] and distance [m]. `tilt` turns the support about
    the origin; it is a rotation vector [rad].
    """

    parts: list[tuple[str, trimesh.Trimesh]]
    radius: float
    view: tuple[tuple[float, float], ...]
    tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)


def _round(rng: np.random.Generator) -> Furniture:
    radius = rng.uniform(0.25, 0.45)
    high = rng.uniform(0.4, 0.75)
    top = trimesh.creation.cylinder(radius, 0.02, sections=64).apply_translation([0, 0, -0.01])
    leg = _box([0.06, 0.06, high - 0.02], [0, 0, -high / 2 - 0.01])
    chair = _box([0.4, 0.4, 0.05], [-0.9, rng.uniform(-0.5, 0.5), -0.3])
    parts = [("table", top), ("leg", leg), ("floor", _floor(-high)), ("chair", chair)]
    return Furniture(parts, radius - 0.06, ((0, 360), (28, 50), (0.7, 1.1)))


def _rectangular(rng: np.random.Generator) -> Furniture:
    long = rng.uniform(0.6, 1.2)
    wide = rng.uniform(0.4, 0.6)
    high = rng.uniform(0.4, 0.75)
    top = _box([wide, long, 0.03], [0, 0, -0.015])
    parts = [("table", top), ("floor", _floor(-high)), ("wall", _panel(-rng.uniform(0.8, 1.4)))]
    return Furniture(parts, wide / 2 - 0.03, ((-45, 45), (25, 50), (0.7, 1.1)))


def _holes(rng: np.random.Generator) -> Furniture:
    step = 0.1
    hole = 0.03
    cells = np.arange(-4, 5) * step
    strips = [_box([step - hole, 0.9, 0.01], [x + step / 2, 0, -0.005]) for x in cells[:-1]]
    places = [[x, y + step / 2, -0.005] for x in cells for y in cells[:-1]]
    bars = [_box([hole, step - hole, 0.01], place) for place in places]
    parts = [("table", _join(*strips, *bars)), ("floor", _floor(-0.5))]
    return Furniture(parts, 0.25, ((0, 360), (35, 55), (0.6, 0.9)))


def _wall(rng: np.random.Generator) -> Furniture:
    top = _box([0.7, 1.4, 0.03], [0, 0, -0.015])
    parts = [("table", top), ("wall", _panel(-rng.uniform(0.25, 0.34)))]
    return Furniture(parts, 0.22, ((-35, 35), (25, 45), (0.6, 0.9)))


def _bin(rng: np.random.Generator) -> Furniture:
    long = rng.uniform(0.45, 0.6)
    wide = rng.uniform(0.35, 0.45)
    high = rng.uniform(0.08, 0.16)
    sides = [_box([0.01, long, high], [x * wide / 2, 0, high / 2]) for x in (-1, 1)]
    sides += [_box([wide, 0.01, high], [0, y * long / 2, high / 2]) for y in (-1, 1)]
    parts = [("table", _box([wide, long, 0.01], [0, 0, -0.005])), ("bin", _join(*sides))]
    parts.append(("floor", _floor(-rng.choice([0.02, 0.5]))))
    return Furniture(parts, wide / 2 - 0.04, ((0, 360), (50, 70), (0.6, 0.9)))


def _shelf(rng: np.random.Generator) -> Furniture:
    gap = rng.uniform(0.35, 0.45)
    top = _box([0.35, 0.9, 0.02], [0, 0, -0.01])
    board = _box([0.35, 0.9, 0.02], [0, 0, gap + 0.01])
    side = _box([0.35, 0.02, gap], [0, 0.44, gap / 2])
    parts = [("table", top), ("board", board), ("wall", _panel(-0.18)), ("side", side)]
    parts.append(("floor", _floor(-0.6)))
    return Furniture(parts, 0.15, ((-30, 30), (15, 25), (0.6, 0.9)))


def _board(rng: np.random.Generator) -> Furniture:
    angle = math.radians(rng.uniform(8, 20))
    way = rng.uniform(0, 2 * math.pi)
    tilt = (angle * math.cos(way), angle * math.sin(way), 0.0)
    top = _box([0.55, 0.75, 0.015], [0, 0, -0.0075])
    parts = [("table", top), ("floor", _floor(-rng.uniform(0.2, 0.6)))]
    return Furniture(parts, 0.24, ((0, 360), (35, 55), (0.6, 0.9)), tilt)


def _ground(rng: np.random.Generator) -> Furniture:
    parts = [
        ("table", _box([3, 3, 0.01], [0, 0, -0.005])),
        ("wall", _panel(-rng.uniform(0.6, 1.2))),
    ]
    return Furniture(parts, 0.25, ((-45, 45), (30, 55), (0.7, 1.0)))


def _above(rng: np.random.Generator) -> Furniture:
    top = _box([0.9, 0.9, 0.03], [0, 0, -0.015])
    parts = [("table", top), ("floor", _floor(-rng.uniform(0.4, 0.75)))]
    return Furniture(parts, 0.22, ((0, 360), (78, 89), (0.6, 0.9)))


MAKERS = (_round, _rectangular, _holes, _wall, _bin, _shelf, _board, _ground, _above)
KINDS = {make.__name__.removeprefix("_"): make for make in MAKERS}
"""Kinds of rooms: a round or rectangular table over a floor, a plate with holes, a table at a wall.
Also a bin, a shelf, a tilted board, the ground itself, and a table from above.
"""


def _box(size: list[float], centre: list[float]) -> trimesh.Trimesh:
    return trimesh.creation.box(size).apply_translation(centre)


def _join(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    joined = trimesh.util.concatenate(list(meshes))
    assert isinstance(joined, trimesh.Trimesh)
    return joined


def _floor(height: float) -> trimesh.Trimesh:
    return _box([4, 4, 0.01], [0, 0, height - 0.005])


def _panel(x: float) -> trimesh.Trimesh:
    return _box([0.02, 4, 3], [x - 0.01, 0, 0.5])


def _camera(
    rng: np.random.Generator, azimuths: tuple, elevations: tuple, distances: tuple
) -> Float[Tensor, "4 4"]:
    middle = torch.tensor([*rng.uniform(-0.04, 0.04, 2), 0.03], dtype=torch.float64)
    return look_at(
        rng.uniform(*azimuths), rng.uniform(*elevations), rng.uniform(*distances), middle
    )


def _things(
    rng: np.random.Generator, generator: torch.Generator, radius: float
) -> tuple[list[str], list[trimesh.Trimesh]]:
    """Return the names and the meshes of one to five random things that stand apart on z = 0."""
    count = int(rng.integers(1, 6))
    while True:
        makers = [THINGS[k] for k in rng.choice(len(THINGS), count)]
        names = [make.__name__.removeprefix("_") for make in makers]
        meshes = [make(rng) for make in makers]
        try:
            poses = scatter(meshes, generator, radius, 0.02)
        except BadArgument:
            count = max(1, count - 1)
            continue
        return names, [
            mesh.apply_transform(pose.numpy()) for mesh, pose in zip(meshes, poses, strict=True)
        ]


def _brick(rng: np.random.Generator) -> trimesh.Trimesh:
    size = rng.uniform([0.04, 0.03, 0.03], [0.09, 0.07, 0.16])
    return _box(list(size), [0, 0, size[2] / 2])


def _tin(rng: np.random.Generator) -> trimesh.Trimesh:
    radius = rng.uniform(0.025, 0.045)
    high = rng.uniform(0.05, 0.14)
    return trimesh.creation.cylinder(radius, high, sections=48).apply_translation([0, 0, high / 2])


def _ball(rng: np.random.Generator) -> trimesh.Trimesh:
    radius = rng.uniform(0.025, 0.05)
    return trimesh.creation.icosphere(3, radius).apply_translation([0, 0, radius])


def _vessel(bottom: float, top: float, high: float, wall: float = 0.004) -> trimesh.Trimesh:
    """Return an open vessel with straight sides; its inside is seen from above."""
    outside = [[0, 0], [bottom, 0], [top, high]]
    inside = [[top - wall, high], [bottom - wall, wall], [0, wall]]
    return trimesh.creation.revolve(np.array(outside + inside), sections=64)


def _mug(rng: np.random.Generator) -> trimesh.Trimesh:
    radius = rng.uniform(0.035, 0.045)
    high = rng.uniform(0.08, 0.11)
    quarter = rotation_from_vector(torch.tensor([math.pi / 2, 0.0, 0.0]).double())
    ring = trimesh.creation.torus(0.5 * high - 0.01, 0.006)
    ring.apply_transform(rigid(quarter, torch.zeros(3).double()).numpy())
    handle = ring.slice_plane([0, 0, 0], [1, 0, 0])
    handle.apply_translation([radius - 0.003, 0, high / 2])
    mug = _join(_vessel(radius, radius, high), handle)
    return mug.apply_transform(
        trimesh.transformations.rotation_matrix(rng.uniform(0, 2 * math.pi), [0, 0, 1])
    )


def _bowl(rng: np.random.Generator) -> trimesh.Trimesh:
    top = rng.uniform(0.06, 0.085)
    return _vessel(0.5 * top, top, rng.uniform(0.045, 0.065))


def _glass(rng: np.random.Generator) -> trimesh.Trimesh:
    top = rng.uniform(0.03, 0.04)
    return _vessel(0.8 * top, top, rng.uniform(0.09, 0.14))


def _bottle(rng: np.random.Generator) -> trimesh.Trimesh:
    radius = rng.uniform(0.03, 0.042)
    high = rng.uniform(0.16, 0.24)
    body = [[0, 0], [radius, 0], [radius, 0.6 * high]]
    neck = [[0.013, 0.8 * high], [0.013, high], [0, high]]
    return trimesh.creation.revolve(np.array(body + neck), sections=48)


def _ring(rng: np.random.Generator) -> trimesh.Trimesh:
    minor = rng.uniform(0.012, 0.018)
    return trimesh.creation.torus(rng.uniform(0.04, 0.055), minor).apply_translation([0, 0, minor])


def _bridge(rng: np.random.Generator) -> trimesh.Trimesh:
    span = rng.uniform(0.07, 0.1)
    high = rng.uniform(0.06, 0.09)
    legs = [_box([0.02, 0.04, high], [x * span / 2, 0, high / 2]) for x in (-1, 1)]
    return _join(*legs, _box([span + 0.02, 0.04, 0.02], [0, 0, high - 0.01]))


THINGS = (_brick, _tin, _ball, _mug, _bowl, _glass, _bottle, _ring, _bridge)
"""Things of random sizes, which stand at z = 0."""
