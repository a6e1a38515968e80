import pytest
import torch
import trimesh

from torchgrasp.errors import BadArgument
from torchgrasp.evaluation.arrange import scatter
from torchgrasp.geometry.frames import apply


def test_scattered_meshes_stand_on_the_table_and_apart():
    meshes = [trimesh.creation.box([0.05 + 0.01 * i, 0.15, 0.1]) for i in range(5)]
    meshes[0].apply_translation([0.02, 0.0, 0.3])
    poses = scatter(meshes, torch.Generator().manual_seed(3), 0.3, 0.02)
    placed = [mesh.copy().apply_transform(pose.numpy()) for mesh, pose in zip(meshes, poses, strict=True)]
    outlines = []
    for mesh in placed:
        assert abs(mesh.bounds[0, 2]) < 1e-12
        assert torch.from_numpy(mesh.vertices.copy())[:, :2].norm(dim=-1).max() <= 0.3
        corners = torch.from_numpy(mesh.convex_hull.vertices.copy())[:, :2]
        share = torch.linspace(0, 1, 50, dtype=torch.float64)[:, None, None]
        outlines.append((corners[:, None] * share[..., None] + corners[None] * (1 - share[..., None])).reshape(-1, 2))
    for i in range(5):
        for j in range(i):
            assert torch.cdist(outlines[i], outlines[j]).min() >= 0.02 - 1e-9
    again = scatter(meshes, torch.Generator().manual_seed(3), 0.3, 0.02)
    assert torch.equal(poses, again)
    assert not torch.equal(poses, scatter(meshes, torch.Generator().manual_seed(4), 0.3, 0.02))
    assert apply(poses[1], torch.zeros(1, 3, dtype=torch.float64))[0, 2] == pytest.approx(0.05)


def test_too_many_meshes_are_refused():
    with pytest.raises(BadArgument, match="radius"):
        scatter([trimesh.creation.box([0.1, 0.1, 0.1])] * 9, torch.Generator().manual_seed(0), 0.12, 0.01)
