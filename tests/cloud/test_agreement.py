"""Inputs about one object that contradict each other are told, and right twins pass."""

import dataclasses
import functools

import pytest
import torch
import trimesh

from torchgrasp import fit_shape, load_object
from torchgrasp.cloud.agreement import (
    check_agreement,
    check_contacts,
    check_foot,
    check_mesh,
    check_seen,
    check_stand,
    warn_of_low_table,
)
from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.foundation.errors import BadArgument, CloudWarning, NoEffect
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.values.planning import PointCloud

BOX = trimesh.creation.box((0.08, 0.06, 0.12))
BOX.apply_translation((0.0, 0.0, 0.06))
GROUND = Plane.horizontal(0.0)


@functools.cache
def view(distance=0.6):
    """A noisy view of the box by a camera at a distance [m]."""
    return partial_view(BOX, look_at(30.0, 40.0, distance, BOX), 400)


def moved(mesh, *shift):
    copy = mesh.copy()
    copy.apply_translation(shift)
    return copy


@pytest.mark.parametrize("distance", [0.4, 0.8, 1.5])
def test_a_noisy_view_agrees_with_its_mesh_also_with_points_of_the_table(distance):
    cloud = view(distance)
    square = 0.1 * torch.rand(60, 3, generator=torch.Generator().manual_seed(0)).double()
    square[:, 2] = 0.0
    check_mesh(cloud, BOX)
    check_mesh(PointCloud(torch.cat([cloud.points, square]), None, cloud.viewpoint), BOX)
    check_foot(cloud, GROUND)
    check_stand(BOX, GROUND)


@pytest.mark.parametrize("shift", [(0.13, 0.0, 0.0), (0.0, 0.0, -0.06), (0.0, 0.04, 0.03)])
def test_a_mesh_in_another_frame_is_told(shift):
    with pytest.raises(
        BadArgument,
        match=r"mesh: expected the cloud's points within \d\d mm .* got \d+ of 300 about",
    ):
        check_mesh(view(), moved(BOX, *shift))
    check_mesh(PointCloud(view().points + torch.tensor(shift)), moved(BOX, *shift))


def test_the_distance_is_that_of_the_surface():
    with pytest.raises(BadArgument, match="1 of 1 about 200 mm off"):
        check_agreement("mesh", torch.tensor([[0.0, 0.23, 0.06]]), "points", BOX, 0.1, 0.5)


def test_a_table_above_the_foot_is_told_and_a_hidden_foot_is_none():
    cloud = view()
    with pytest.raises(BadArgument, match="above the object's foot"):
        check_foot(cloud, Plane.horizontal(0.054))
    check_foot(cloud, Plane.horizontal(0.012))
    check_foot(cloud, Plane.horizontal(-0.3))  # the camera may see the top alone
    for height, word in ((0.054, "below"), (-0.054, "above")):
        with pytest.raises(BadArgument, match=f"foot is 54 mm {word} the table"):
            check_stand(BOX, Plane.horizontal(height))


@pytest.mark.parametrize("camera", [True, False])
def test_contacts_on_the_hidden_side_agree_and_contacts_elsewhere_do_not(camera):
    cloud = view() if camera else PointCloud(view().points)
    contacts = torch.tensor([[-0.04, 0.0, 0.06], [0.04, 0.0, 0.06], [0.0, -0.03, 0.05]])
    check_agreement("FILE", contacts, "contacts", cloud, 0.03, 0.5)
    for wrong in (contacts + torch.tensor([0.0, 0.2, 0.0]), 100 * contacts):
        with pytest.raises(BadArgument, match="FILE: expected contacts within 30 mm of the cloud"):
            check_agreement("FILE", wrong, "contacts", cloud, 0.03, 0.5)
    towards_camera = contacts + 0.15 * (view().viewpoint / view().viewpoint.norm()).float()
    if camera:  # in space that the camera saw to be free
        with pytest.raises(BadArgument):
            check_agreement("FILE", towards_camera, "contacts", cloud, 0.03, 0.5)


@pytest.mark.parametrize(
    ("away", "count", "told"),
    [(0.015, 3, False), (0.06, 3, True), (0.06, 1, False), (0.06, 2, True)],
)
def test_grasps_are_refused_half_of_whose_contacts_are_before_all_that_the_camera_saw(
    away, count, told
):
    """One contact of three may lie on a side that nobody saw."""
    cloud = view()
    distance = (cloud.points - cloud.viewpoint).norm(dim=-1)
    points = cloud.points[distance.argsort()[:3]]
    points[:count] -= away * unit(points[:count] - cloud.viewpoint)
    grasp = load_shipped_grasp("jug", "barrett")
    contacts = dataclasses.replace(grasp.contacts, points=points[None].to(grasp.contacts.points))
    grasp = dataclasses.replace(grasp, contacts=contacts)
    if not told:
        return check_seen(grasp, cloud, "FILE")
    with pytest.raises(BadArgument, match=r"FILE: expected the contacts within 30 mm of the cloud"):
        check_seen(grasp, cloud, "FILE")


def misplaced(way):
    """The jug in the frame of its grasps, or as strangers give it."""
    jug = load_object("jug").mesh
    turn = trimesh.transformations.rotation_matrix
    return {
        "right": jug,
        "a little off": moved(jug, 0.004, 0.004, 0.0),
        "beside": moved(jug, 0.1, 0.0, 0.0),
        "a bit beside": moved(jug, 0.0, 0.05, 0.0),
        "floating": moved(jug, 0.0, 0.0, 0.02),
        "y up": jug.copy().apply_transform(turn(-torch.pi / 2, [1, 0, 0])),
        "upside down": jug.copy().apply_transform(turn(torch.pi, [1, 0, 0])),
        "centred": moved(jug, *-jug.centroid),
        "in decimetres": jug.copy().apply_scale(10),
        "another object": load_object("spray").mesh.copy().apply_translation([0.1, 0.0, 0.0]),
    }[way]


WAYS = ("right", "a little off", "beside", "a bit beside", "floating", "y up", "upside down")


@pytest.mark.parametrize("hand", ["allegro", "barrett"])
@pytest.mark.parametrize("way", [*WAYS, "centred", "in decimetres", "another object"])
def test_a_mesh_that_is_not_where_the_grasp_is_is_told(way, hand):
    grasp = load_shipped_grasp("jug", hand)
    assert grasp.table is not None
    if way in ("right", "a little off"):
        return check_contacts(grasp, misplaced(way))
    with pytest.raises(BadArgument, match=r"mesh: .*(within 10 mm of the mesh|foot is \d+ mm)"):
        check_contacts(grasp, misplaced(way))


def test_a_table_is_told_that_is_farther_below_the_points_than_they_extend():
    """A ball seen from straight above shows no foot, and its table is right."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.05).apply_translation((0, 0, 0.05))
    for cloud in (view(), partial_view(ball, look_at(0.0, 89.0, 0.6, ball), 400)):
        foot = float(cloud.points[:, 2].quantile(0.02))
        extent = float((cloud.points.amax(0) - cloud.points.amin(0)).norm())
        for height in (0.0, foot - 0.99 * extent):
            warn_of_low_table(cloud, Plane.horizontal(height))
        with pytest.warns(
            NoEffect, match=r"table changes nothing: it is \d+ mm below .*--no-table"
        ):
            warn_of_low_table(cloud, Plane.horizontal(foot - 1.01 * extent))


def test_such_a_table_is_told_once_and_the_shape_is_that_of_any_table_as_low():
    """Which is what the warning says: the table changes nothing."""
    shapes = []
    for height in (-0.6, -0.9):
        with pytest.warns(NoEffect, match="table changes nothing") as told:
            shapes.append(fit_shape(view(), table=height))
        assert len(told) == 1
    at = view().points
    first, second = (shape.predict(at) for shape in shapes)
    torch.testing.assert_close(first.distance, second.distance, rtol=0.0, atol=1e-4)
    torch.testing.assert_close(first.std_m, second.std_m, rtol=0.0, atol=1e-5)  # [m]


def test_a_similar_mesh_is_told():
    check_mesh(view(), BOX)
    similar = trimesh.creation.box((0.071, 0.069, 0.126)).apply_translation((0.0, 0.0, 0.063))
    with pytest.warns(CloudWarning, match=r"--mesh: half of the cloud's points are over \d mm off"):
        check_mesh(view(), similar, "--mesh")


def test_a_known_error_of_the_cameras_pose_is_no_other_mesh():
    shifted = moved(BOX, 0.004, 0.004, 0.004)
    with pytest.warns(CloudWarning, match="mesh of this object"):
        check_mesh(view(), shifted)
    error = torch.full_like(view().points[:, 0], 0.005)
    check_mesh(dataclasses.replace(view(), pose_error=error), shifted)
