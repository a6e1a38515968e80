"""Scenes for trials in clutter: objects dropped on a table in SAPIEN, and a camera that sees them."""

import dataclasses
import functools
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.camera import FOCAL, HEIGHT, WIDTH, look_at
from torchgrasp.data import read_object_mesh
from torchgrasp.data.shipped import list_objects, load_object
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply, inverse, rigid, rotation_from_vector
from torchgrasp.geometry.linalg import farthest_points
from torchgrasp.geometry.mesh import read_mesh
from torchgrasp.sim.convex_parts import convex_parts, hull
from torchgrasp.sim.sapien_bodies import import_sapien, open_world, place, rigid_body, table
from torchgrasp.sim.scene_spec import Body
from torchgrasp.values.specs import TrialSpec

MASS = 0.1
"""Mass [kg] of every dropped object, as of `TrialSpec`."""
SPREAD = 0.13
REGION = 0.25
"""Radii [m] within which objects are dropped, and within which their centres must come to rest."""
DROP_TIME = 1.0
REST_TIME = 3.0
"""Longest times [s] until the next object is dropped, and until all objects must be still."""
CORNERS = 120
"""Most corners of a convex part. PhysX keeps 255 faces and changes a part that has more."""


@dataclasses.dataclass(frozen=True)
class PlacedScene:
    """Objects at rest on the table z = 0, their convex parts, and a camera, all in the world frame."""

    names: tuple[str, ...]
    meshes: tuple[trimesh.Trimesh, ...]
    parts: tuple[tuple[trimesh.Trimesh, ...], ...]
    camera_pose: Float[Tensor, "4 4"]

    def __len__(self) -> int:
        return len(self.names)

    def centres(self) -> np.ndarray:
        """Return the mass centres (n, 3) [m]."""
        return np.array([mesh.center_mass for mesh in self.meshes]).reshape(-1, 3)


class SettlingTable:
    """A table z = 0 and bodies that fall on it. Damping of rotation [1/s] stands for rolling
    resistance.
    """

    def __init__(self, damping: float = 2.0, timestep: float = 1 / 240) -> None:
        self._sapien, self._physx = import_sapien()
        self._system, self._scene = open_world(
            self._sapien, self._physx, 9.81, timestep, patches=True
        )
        self._material = self._physx.PhysxMaterial(0.8, 0.8, 0.0)
        place(self._sapien, self._scene, "table", table(self._sapien, self._physx, self._material))
        self._damping = damping
        self._timestep = timestep
        self._bodies: list[Any] = []

    def add(self, body: Body, pose: np.ndarray) -> None:
        """Add a body at rest at a pose (4, 4) of its mesh's frame."""
        self._bodies.append(
            rigid_body(
                self._sapien,
                self._physx,
                self._material,
                body,
                [x.vertices for x in body.parts],
                0.005,
            )
        )
        self._bodies[-1].angular_damping = self._damping
        place(self._sapien, self._scene, "neighbour", self._bodies[-1])
        self.move(len(self._bodies) - 1, pose)

    def move(self, index: int, pose: np.ndarray) -> None:
        """Put a body elsewhere, at rest."""
        body = self._bodies[index]
        body.entity.set_pose(self._sapien.Pose(np.asarray(pose, float)))
        body.linear_velocity = body.angular_velocity = np.zeros(3, np.float32)

    def poses(self) -> np.ndarray:
        """Return the poses (m, 4, 4) of the bodies."""
        return np.array(
            [body.entity_pose.to_transformation_matrix() for body in self._bodies], float
        )

    def wait(self, seconds: float) -> None:
        """Simulate some seconds."""
        for _ in range(round(seconds / self._timestep)):
            self._scene.step()

    def settle(self, seconds: float) -> bool:
        """Simulate until all bodies are still, at most some seconds; return whether they are still."""
        before = self.poses()
        for _ in range(round(seconds / 0.1)):
            self.wait(0.1)
            poses = self.poses()
            change = np.abs(poses - before)
            before = poses
            if change[:, :3, 3].max() < 5e-4 and change[:, :3, :3].max() < 0.01:
                return True
        return False


def drop(objects: Path | None, count: tuple[int, int], seed: int) -> PlacedScene:
    """Drop objects on a table, one after another, and wait until they rest; equal seeds give equal
    bits.

    An object falls upright, turned at random and slightly tilted, from just above what lies below
    it. An object that rolls away is dropped again.

    Args:
        objects: folder of NAME/mesh.ply [m], with or without manifest.json; None: the library's own
            objects.
        count: least and largest number of objects; some are dropped twice where there are too few.
        seed: of every random number.

    Raises:
        BadArgument: no objects, or no scene comes to rest in view.
    """
    low, high = count
    generator = torch.Generator().manual_seed(seed)
    known = object_names(objects)
    for _ in range(50):
        n = int(torch.randint(low, high + 1, (1,), generator=generator))
        order = torch.cat(
            [torch.randperm(len(known), generator=generator) for _ in range(-(-n // len(known)))]
        )
        names = tuple(known[i] for i in order[:n])
        bodies = [_read_body(objects, name) for name in names]
        poses = _fall(bodies, generator)
        if poses is None:
            continue
        scene = aim(_moved(names, bodies, poses, torch.eye(4, dtype=torch.float64)), generator)
        if scene is not None and _is_steady(scene):
            return scene
    raise BadArgument(
        "objects", f"{objects}, of which no scene comes to rest in view", "smaller objects"
    )


def object_names(objects: Path | None) -> list[str]:
    """Return the sorted names of a folder's objects; None: the library's own."""
    if objects is None:
        return list(list_objects())
    names = sorted(file.parent.name for file in Path(objects).glob("*/mesh.ply"))
    if not names:
        raise BadArgument("objects", str(objects), "a folder with NAME/mesh.ply in it")
    return names


def aim(placed: PlacedScene, generator: torch.Generator) -> PlacedScene | None:
    """Return the scene with a random camera whose image has all objects; None: no such camera was
    found.
    """
    vertices = torch.from_numpy(np.concatenate([mesh.vertices for mesh in placed.meshes]))
    middle = (vertices.amin(0) + vertices.amax(0)) / 2
    for _ in range(20):
        turn, rise, away = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
        pose = look_at(360 * turn, 40.0 + rise * (60.0 - 40.0), 0.6 + away * (0.75 - 0.6), middle)
        x, y, z = apply(inverse(pose), vertices).unbind(-1)
        wide = float((x / z).abs().max()) * FOCAL < WIDTH / 2 - 8
        if wide and float((y / z).abs().max()) * FOCAL < HEIGHT / 2 - 8:
            return dataclasses.replace(placed, camera_pose=pose)
    return None


def _is_steady(placed: PlacedScene) -> bool:
    """Return whether the objects also stay in a trial: in another frame, with its timestep, without
    damping.
    """
    turn = rigid(
        rotation_from_vector(torch.tensor([0.0, 0.0, 1.0])).double(), torch.zeros(3).double()
    ).numpy()
    bodies = [
        Body(mesh, parts, MASS) for mesh, parts in zip(placed.meshes, placed.parts, strict=True)
    ]
    turned = _moved(placed.names, bodies, np.repeat(turn[None], len(bodies), 0), placed.camera_pose)
    table = SettlingTable(damping=0.0, timestep=TrialSpec().timestep)
    for mesh, parts in zip(turned.meshes, turned.parts, strict=True):
        table.add(Body(mesh, parts, MASS), np.eye(4))
    table.wait(2.0)
    for mesh, pose in zip(turned.meshes, table.poses(), strict=True):
        moved = np.asarray(mesh.vertices) @ (pose[:3, :3] - np.eye(3)).T + pose[:3, 3]
        if np.abs(moved).max() > 0.004:
            return False
    return True


def _moved(
    names: tuple[str, ...], bodies: list[Body], poses: np.ndarray, camera_pose: Float[Tensor, "4 4"]
) -> PlacedScene:
    """Return bodies at their poses."""
    pairs = list(zip(bodies, poses, strict=True))
    meshes = tuple(body.mesh.copy().apply_transform(pose) for body, pose in pairs)
    parts = tuple(
        tuple(part.copy().apply_transform(pose) for part in body.parts) for body, pose in pairs
    )
    return PlacedScene(names, meshes, parts, camera_pose)


def _fall(bodies: list[Body], generator: torch.Generator) -> np.ndarray | None:
    """Drop bodies one after another; return their poses at rest, or None."""
    table = SettlingTable()
    waiting = list(range(len(bodies)))
    placed = 0
    for _ in range(3 * len(bodies)):
        k = waiting.pop(0)
        pose = _above(bodies, table, k, generator)
        if k == placed:
            table.add(bodies[k], pose)
            placed += 1
        else:
            table.move(k, pose)
        still = table.settle(DROP_TIME if waiting else REST_TIME)
        poses = table.poses()
        pairs = zip(bodies[:placed], poses, strict=True)
        centres = [pose[:3, :3] @ body.mesh.center_mass + pose[:3, 3] for body, pose in pairs]
        waiting += [
            i
            for i, c in enumerate(centres)
            if not math.hypot(c[0], c[1]) < REGION and i not in waiting
        ]
        if not waiting:
            return poses if still else None
    return None


def _above(
    bodies: list[Body], table: SettlingTable, k: int, generator: torch.Generator
) -> np.ndarray:
    """Return a random pose of a body 5 mm above the bodies below it, tilted by at most 10 degrees."""
    draws = torch.rand(5, generator=generator, dtype=torch.float64).tolist()
    tilt, lean, turn, share, angle = (
        2 * math.pi * x if i in (1, 2, 4) else x for i, x in enumerate(draws)
    )
    leaning = torch.tensor([math.cos(lean), math.sin(lean), 0.0], dtype=torch.float64) * (
        math.radians(10) * tilt
    )
    turning = torch.tensor([0.0, 0.0, turn], dtype=torch.float64)
    rotation = rotation_from_vector(leaning) @ rotation_from_vector(turning)
    corners = np.asarray(bodies[k].mesh.vertices) @ rotation.numpy().T
    middle = (corners.min(0) + corners.max(0)) / 2
    distance = SPREAD * math.sqrt(share)
    x = distance * math.cos(angle) - middle[0]
    y = distance * math.sin(angle) - middle[1]
    low = corners.min(0)[:2] + np.array([x, y])
    high = corners.max(0)[:2] + np.array([x, y])
    top = 0.0
    for i, pose in enumerate(table.poses()):
        lying = np.asarray(bodies[i].mesh.vertices) @ pose[:3, :3].T + pose[:3, 3]
        if i != k and bool((lying.min(0)[:2] < high).all() and (lying.max(0)[:2] > low).all()):
            top = max(top, float(lying[:, 2].max()))
    place = torch.tensor([x, y, top + 0.005 - corners[:, 2].min()], dtype=torch.float64)
    return rigid(rotation, place).numpy()


@functools.lru_cache(maxsize=128)
def _read_body(objects: Path | None, name: str) -> Body:
    """Return an object with its convex parts."""
    if objects is None:
        known = load_object(name)
        return Body(known.mesh, [_coarse(part) for part in known.parts], MASS)
    scaled = (Path(objects) / "manifest.json").is_file()
    mesh = (
        read_object_mesh(objects, name) if scaled else read_mesh(Path(objects) / name / "mesh.ply")
    )
    return Body(mesh, [_coarse(part) for part in convex_parts(mesh)], MASS)


def _coarse(part: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a convex part with at most `CORNERS` corners, the farthest from each other."""
    if len(part.vertices) <= CORNERS:
        return part
    corners = torch.from_numpy(np.array(part.vertices, dtype=np.float64))
    return hull(corners[farthest_points(corners, CORNERS)].numpy())
