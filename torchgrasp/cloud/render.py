"""Depth images of placed meshes on a table, with true labels."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.cloud.camera import HEIGHT, INTRINSICS, WIDTH, add_noise, cast_mesh
from torchgrasp.cloud.depth import check_rigid
from torchgrasp.geometry.frames import rotate

if TYPE_CHECKING:
    import trimesh

TABLE_RADIUS = 0.6
"""Radius [m] of the round table about the origin: about the size of a small real one."""


def render_depth(
    meshes: "Sequence[trimesh.Trimesh]",
    camera_pose: Float[Tensor, "4 4"],
    *,
    table: float | None = 0.0,
    noise: bool = True,
    seed: int = 0,
) -> tuple[Float[Tensor, "h w"], Int[Tensor, "h w"]]:
    """Return what the default camera measures of meshes on a table: depths [m] and true labels.

    Depth is 0 where nothing was measured or nothing is. The noise is that of `partial_view`. Labels have none: 0 is
    the table or nothing, k is mesh k - 1. The table is a disc of radius 0.6 m about the origin, with nothing beyond.

    Args:
        meshes: in the world frame [m], already placed.
        camera_pose: obj_from_camera in the world frame, see `look_at`.
        table: height z of the table [m]; None: no table.
        noise: that of a real camera; False: exact depths.
        seed: of the noise.

    Raises:
        BadArgument: a pose that is not rigid.
        MeshError: a mesh has no faces.

    >>> import trimesh
    >>> from torchgrasp.cloud.camera import look_at
    >>> depth, labels = render_depth([trimesh.creation.box([0.1, 0.1, 0.1])], look_at(30.0, 40.0))
    >>> depth.shape, labels.unique()
    (torch.Size([480, 640]), tensor([0, 1]))
    """
    pose = check_rigid("camera_pose", camera_pose).double()
    depth = torch.full((HEIGHT, WIDTH), torch.inf, dtype=torch.float64)
    cosine, labels = torch.zeros_like(depth), torch.zeros(HEIGHT, WIDTH, dtype=torch.int64)
    layers = [(0, *_cast_table(table, pose))] if table is not None else []
    for label, z, against in layers + [(k + 1, *cast_mesh(mesh, pose)) for k, mesh in enumerate(meshes)]:
        nearer = (z > 0) & (z < depth)
        depth, cosine = torch.where(nearer, z, depth), torch.where(nearer, against, cosine)
        labels[nearer] = label
    depth = torch.where(torch.isfinite(depth), depth, 0.0)
    if noise:
        depth = add_noise(depth, cosine, torch.Generator().manual_seed(seed))
    return depth, labels


def _cast_table(
    height: float, obj_from_camera: Float[Tensor, "4 4"]
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Return depth [m] of the table and |cosine| of ray and normal, both 0 where it is not."""
    row, column = torch.meshgrid(torch.arange(HEIGHT).double(), torch.arange(WIDTH).double(), indexing="ij")
    rays = torch.stack([column, row, torch.ones_like(row)], -1) @ torch.linalg.inv(INTRINSICS).T
    direction, origin = rotate(obj_from_camera, rays), obj_from_camera[:3, 3]
    depth = (height - origin[2]) / direction[..., 2]
    where = origin[:2] + depth[..., None] * direction[..., :2]
    met = (depth > 0) & (torch.linalg.vector_norm(where, dim=-1) < TABLE_RADIUS)
    cosine = direction[..., 2].abs() / torch.linalg.vector_norm(direction, dim=-1)
    return torch.where(met, depth, 0.0), torch.where(met, cosine, 0.0)
