"""Random scenes: objects of a folder that stand apart on a table, and one camera."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.cloud.camera import look_at
from torchgrasp.cloud.render import render_depth
from torchgrasp.data import read_object_mesh
from torchgrasp.errors import BadArgument
from torchgrasp.evaluation.arrange import scatter

SIZES = {
    "apart": (3, 8, 0.25),
    "crowded": (12, 18, 0.28),
    "boxes": (2, 5, 0.30),
    "close": (2, 4, 0.16),
    "lone": (1, 1, 0.20),
}
"""Least and greatest number of objects of each kind of scene, and the radius [m] of the circle they stand in. "boxes"
has two big boxes more; "close" is seen from nearby."""


@dataclasses.dataclass(frozen=True)
class Picture:
    """One depth image [m] of a scene in the world frame, where the table is z = 0, and its true labels."""

    depth: Float[Tensor, "h w"]
    labels: Int[Tensor, "h w"]
    camera_pose: Float[Tensor, "4 4"]


def read_meshes(objects: Path) -> list[trimesh.Trimesh]:
    """Return the meshes of a folder, in the order of their names."""
    return [read_object_mesh(objects, path.parent.name) for path in sorted(objects.glob("*/mesh.ply"))]


def take_picture(
    meshes: Sequence[trimesh.Trimesh], seed: int, kind: str = "apart", table: bool = True, gap: float = 0.01
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
        chosen = [meshes[i] for i in torch.randperm(len(meshes), generator=generator)[:count].tolist()]
        if kind == "boxes":
            sizes = [[uniform(0.1, 0.3), uniform(0.1, 0.2), uniform(0.02, 0.2)] for _ in range(2)]
            chosen = [trimesh.creation.box(size) for size in sizes] + chosen
        try:
            poses = scatter(chosen, generator, radius, gap)
        except BadArgument:
            continue
        break
    placed = [mesh.copy().apply_transform(pose.numpy()) for mesh, pose in zip(chosen, poses, strict=True)]
    distance = uniform(0.35, 0.45) if kind == "close" else uniform(0.45, 0.8)
    middle = torch.tensor([uniform(-0.05, 0.05), uniform(-0.05, 0.05), 0.03], dtype=torch.float64)
    pose = look_at(uniform(0, 360), uniform(30, 60), distance, middle)
    depth, labels = render_depth(placed, pose, table=0.0 if table else None, seed=seed)
    return Picture(depth, labels, pose)
