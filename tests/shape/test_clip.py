"""Meshes cut along a field, against areas in closed form."""

import numpy as np
import pytest
import trimesh

from torchgrasp.shape.clip import clip_mesh


@pytest.mark.parametrize("height", [-0.3, 0.0, 0.61])
def test_a_ball_cut_by_a_plane_keeps_the_area_of_the_cap_and_its_winding(height: float):
    ball = trimesh.creation.icosphere(subdivisions=4)
    vertices, faces, cut = clip_mesh(ball.vertices, ball.faces, ball.vertices[:, 2] - height)
    kept = trimesh.Trimesh(vertices, faces, process=False)
    assert kept.area == pytest.approx(2 * np.pi * (1 + height), rel=0.01)  # Archimedes
    wide = kept.area_faces > 1e-9
    assert (kept.face_normals * kept.triangles_center).sum(1)[wide].min() > 0.9
    assert vertices[:, 2].max() < height + 1e-12
    np.testing.assert_allclose(vertices[cut, 2], height, atol=1e-12)


def test_nothing_and_all_of_a_mesh():
    box = trimesh.creation.box()
    vertices, faces, cut = clip_mesh(box.vertices, box.faces, -np.ones(8))
    assert len(faces) == 12 and len(vertices) == 8 and not cut.any()
    assert len(clip_mesh(box.vertices, box.faces, np.ones(8))[1]) == 0
