"""Random scenes: objects of a folder that stand apart on a table, and one camera."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.cloud.camera import look_at, render_depth
from torchgrasp.data import read_object_mesh
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import rigid, rotation_from_vector

SIZES = {
    "apart": (3, 8, 0.25),
    "crowded": (12, 18, 0.28),
    "boxes": (2, 5, 0.30),
    "close": (2, 4, 0.16),
    "lone": (1, 1, 0.20),
}
"""Least and greatest number of objects of each kind of scene, and the radius [m] of the circle they
stand in. "boxes" has two big boxes more; "close" is seen from nearby.
"""


@dataclasses.dataclass(frozen=True)
class Picture:
    """One depth image [m] of a scene in the world frame, where the table is z = 0, and its true
    labels.
    """

    depth: Float[Tensor, "h w"]
    labels: Int[Tensor, "h w"]
    camera_pose: Float[Tensor, "4 4"]


def read_meshes(objects: Path) -> list[trimesh.Trimesh]:
    """Return the meshes of a folder, in the order of their names."""
    return [
        read_object_mesh(objects, path.parent.name) for path in sorted(objects.glob("*/mesh.ply"))
    ]


def take_picture(
    meshes: Sequence[trimesh.Trimesh],
    seed: int,
    kind: str = "apart",
    table: bool = True,
    gap: float = 0.01,
) -> Picture:
    """Return the picture of a random scene.

    Args:
        meshes: to choose from.
        seed: of the choice, the places, the camera and its noise.
        kind: one of `SIZES`.
        table: False: the same without its table.
        gap: least distance of two objects [m].
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand(1, generator=generator))

    few, many, radius = SIZES[kind]
    while True:
        count = int(torch.randint(few, many + 1, (1,), generator=generator))
        chosen = [
            meshes[i] for i in torch.randperm(len(meshes), generator=generator)[:count].tolist()
        ]
        if kind == "boxes":
            sizes = [[uniform(0.1, 0.3), uniform(0.1, 0.2), uniform(0.02, 0.2)] for _ in range(2)]
            chosen = [trimesh.creation.box(size) for size in sizes] + chosen
        try:
            poses = scatter(chosen, generator, radius, gap)
        except BadArgument:
            continue
        break
    placed = [
        mesh.copy().apply_transform(pose.numpy()) for mesh, pose in zip(chosen, poses, strict=True)
    ]
    distance = uniform(0.35, 0.45) if kind == "close" else uniform(0.45, 0.8)
    middle = torch.tensor([uniform(-0.05, 0.05), uniform(-0.05, 0.05), 0.03], dtype=torch.float64)
    pose = look_at(uniform(0, 360), uniform(30, 60), distance, middle)
    depth, labels = render_depth(placed, pose, table=0.0 if table else None, seed=seed)
    return Picture(depth, labels, pose)


def scatter(
    meshes: Sequence[trimesh.Trimesh], generator: torch.Generator, radius: float, gap: float
) -> Float[Tensor, "n 4 4"]:
    """Return random poses of meshes that stand upright on the table z = 0.

    The footprints, convex hulls seen from above, lie within `radius` [m] of the origin and at least
    `gap` [m] apart. Meshes that do not fit raise `BadArgument`.
    """
    outlines = [_footprint(mesh) for mesh in meshes]
    largest_first = sorted(
        range(len(meshes)),
        key=lambda i: -float(torch.linalg.vector_norm(outlines[i], dim=-1).max()),
    )
    for _ in range(50):
        placed: dict[int, tuple[Float[Tensor, "4 4"], Float[Tensor, "k 2"]]] = {}
        for i in largest_first:
            taken = [outline for _, outline in placed.values()]
            for _ in range(200):
                pose = _random_pose(-float(meshes[i].bounds[0, 2]), generator, radius)
                outline = outlines[i] @ pose[:2, :2].T + pose[:2, 3]
                inside = float(torch.linalg.vector_norm(outline, dim=-1).max()) <= radius
                if inside and all(_separation(outline, other) >= gap for other in taken):
                    placed[i] = pose, outline
                    break
            else:
                break
        if len(placed) == len(meshes):
            return torch.stack([placed[i][0] for i in range(len(meshes))])
    raise BadArgument(
        "radius",
        f"{radius:g} m for {len(meshes)} meshes",
        "a circle that holds them, with their gaps",
    )


def _random_pose(height: float, generator: torch.Generator, radius: float) -> Float[Tensor, "4 4"]:
    """Return an upright pose at a random place in the circle, at a height [m]."""
    turn, share, angle = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
    distance = radius * math.sqrt(share)
    angle = 2 * math.pi * angle
    position = [distance * math.cos(angle), distance * math.sin(angle), height]
    rotation = rotation_from_vector(
        torch.tensor([0.0, 0.0, 2 * math.pi * turn], dtype=torch.float64)
    )
    return rigid(rotation, torch.tensor(position, dtype=torch.float64))


def _footprint(mesh: trimesh.Trimesh) -> Float[Tensor, "n 2"]:
    """Return the corners of the convex hull of a mesh, seen from above, in order."""
    from scipy.spatial import ConvexHull

    flat = np.array(mesh.vertices, dtype=np.float64)[:, :2]
    return torch.from_numpy(flat[ConvexHull(flat).vertices])


def _separation(a: Float[Tensor, "n 2"], b: Float[Tensor, "m 2"]) -> float:
    """Return a lower bound of the distance of two convex polygons: the widest strip along an edge
    between them.
    """
    return max(_widest_strip(a, b), _widest_strip(b, a))


def _widest_strip(a: Float[Tensor, "n 2"], b: Float[Tensor, "m 2"]) -> float:
    """Return the greatest distance of b from an edge of a, outward; a's corners run counter-
    clockwise.
    """
    edge = a.roll(-1, 0) - a
    outward = torch.stack([edge[:, 1], -edge[:, 0]], -1) / torch.linalg.vector_norm(
        edge, dim=-1, keepdim=True
    )
    return float(((b @ outward.T).amin(0) - (a * outward).sum(-1)).max())
