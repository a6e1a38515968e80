import math

import numpy as np
import pytest
import torch
import trimesh
from train.object_shapes import author

from torchgrasp.data.shipped import DATA, list_objects, load_object
from torchgrasp.foundation.errors import BadArgument


@pytest.fixture(scope="module", params=list_objects())
def thing(request):
    return load_object(request.param)


def test_the_mesh_is_one_closed_body_at_rest_in_metres(thing):
    mesh = thing.mesh
    assert mesh.is_volume and mesh.body_count == 1 and len(mesh.faces) <= 20_000
    assert abs(mesh.bounds[0, 2]) < 1e-6
    assert 0.05 < mesh.extents.min() <= 0.08  # a hand spans it
    assert 0.1 < mesh.extents[2] < 0.25
    # it stands: its centre of mass is above the hull of what touches the table
    feet = mesh.vertices[mesh.vertices[:, 2] < 1e-4][:, :2]
    hull = trimesh.convex.convex_hull(
        np.concatenate([np.c_[feet, 0 * feet[:, :1]], np.c_[feet, 0 * feet[:, :1] + 1]])
    )
    assert hull.contains([[*mesh.center_mass[:2], 0.5]]).all()
    assert 0.05 < thing.mass < 0.5


def test_the_cylinder_has_the_volume_of_a_cylinder():
    assert abs(load_object("cylinder").mesh.volume / (math.pi * 0.033**2 * 0.11) - 1) < 1e-3


def test_the_parts_are_convex_small_and_make_up_the_mesh(thing):
    union = trimesh.boolean.union(thing.parts, engine="manifold")
    both = trimesh.boolean.intersection([union, thing.mesh], engine="manifold")
    assert abs(union.volume / thing.mesh.volume - 1) < 0.01
    assert both.volume > 0.985 * thing.mesh.volume
    for part in thing.parts:
        assert part.is_convex and len(part.vertices) <= 255
        assert len(part.facets) + len(part.faces) - sum(map(len, part.facets)) <= 255


def test_the_view_is_the_noisy_side_that_the_camera_sees(thing):
    view = thing.view
    assert len(view) == 1000 and view.normals is None
    assert abs(np.linalg.norm(view.viewpoint.numpy() - thing.mesh.bounds.mean(0)) - 0.5) < 1e-6
    _, distance, face = trimesh.proximity.closest_point(thing.mesh, view.points.numpy())
    assert (
        np.median(distance) < 0.001
        and np.percentile(distance, 90) < 0.002
        and distance.max() < 0.05
    )
    toward = ((view.viewpoint - view.points).numpy() * thing.mesh.face_normals[face]).sum(-1)
    assert (toward > 0).mean() > 0.95
    # a side is hidden: the mesh has surface that no point is near
    nearest = (
        torch.cdist(torch.from_numpy(np.array(thing.mesh.triangles_center)), view.points)
        .amin(-1)
        .numpy()
    )
    hidden = thing.mesh.area_faces[nearest > 0.015].sum() / thing.mesh.area
    assert 0.2 < hidden < 0.7


def test_the_files_are_those_that_the_author_writes(thing):
    solid, parts = author(thing.name)
    assert abs(solid.volume() / thing.mesh.volume - 1) < 1e-5
    assert len(parts) == len(thing.parts)
    for corners, part in zip(parts, thing.parts, strict=True):
        assert abs(trimesh.convex.convex_hull(corners).volume / part.volume - 1) < 1e-4


def test_the_files_are_small_and_unknown_names_are_refused():
    assert sum(path.stat().st_size for path in DATA.rglob("*") if path.is_file()) < 1_500_000
    with pytest.raises(BadArgument, match="cylinder, jug, rabbit, spray"):
        load_object("teapot")
