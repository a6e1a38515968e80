"""Scenes for benchmarks: arranged objects."""

import numpy as np
import torch
import trimesh
from benchmarks.scene.scenes import scatter


def test_scatter_places_meshes_upright_and_apart():
    meshes = [trimesh.creation.box([0.05 + 0.01 * i, 0.15, 0.1]) for i in range(5)]
    poses = scatter(meshes, torch.Generator().manual_seed(3), 0.3, 0.02)
    placed = [
        mesh.copy().apply_transform(pose.numpy()) for mesh, pose in zip(meshes, poses, strict=True)
    ]
    assert all(
        abs(x.bounds[0, 2]) < 1e-12 and np.hypot(*x.vertices[:, :2].T).max() <= 0.3 for x in placed
    )
    corners = [torch.from_numpy(mesh.sample(2000, seed=0)[:, :2]) for mesh in placed]
    assert (
        min(float(torch.cdist(corners[i], corners[j]).min()) for i in range(5) for j in range(i))
        >= 0.02 - 1e-9
    )
