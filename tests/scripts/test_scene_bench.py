"""Scenes for benchmarks: arranged and dropped objects."""

import numpy as np
import pytest
import torch
import trimesh
from benchmarks.scene.drop import drop
from benchmarks.scene.scenes import scatter

pytestmark = pytest.mark.filterwarnings("ignore")


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


@pytest.mark.sim
def test_dropped_scenes_are_repeatable_at_rest_and_within_reach():
    scene = drop(None, (2, 2), 4)
    again = drop(None, (2, 2), 4)
    assert all(
        np.array_equal(a.vertices, b.vertices)
        for a, b in zip(scene.meshes, again.meshes, strict=True)
    )
    assert -2e-3 < min(mesh.bounds[0, 2] for mesh in scene.meshes) < 1e-3
    assert np.linalg.norm(scene.centres()[:, :2], axis=1).max() < 0.25
