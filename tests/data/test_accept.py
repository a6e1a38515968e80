"""What public functions take in place of clouds, scenes and hands: each gives the value that a
careful caller makes.
"""

import types
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

import torchgrasp
from tests.hostile.arguments import HOSTILE, NO_PATHS
from tests.make import see
from torchgrasp import cloud_from_array, load_hand, load_object, save_scene
from torchgrasp.cloud import save_cloud
from torchgrasp.cloud.neighbours import fit_local_planes
from torchgrasp.data import load_shipped_grasp
from torchgrasp.data.accept import CloudLike, as_cloud, as_hand, as_seen
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, NoEffect
from torchgrasp.geometry.plane import Plane
from torchgrasp.values.planning import PointCloud
from torchgrasp.values.specs import ContactSpec

VIEW = load_object("cylinder").view
ARRAY = VIEW.points.numpy()
GRASP = load_shipped_grasp("jug", "barrett")


def open3d(points, normals=()):
    """A cloud with the attributes that Open3D's legacy cloud has; an array stands for its vectors."""
    return types.SimpleNamespace(points=np.asarray(points), normals=np.asarray(normals))


ALIKE = {
    "array": ARRAY,
    "float32": ARRAY.astype(np.float32),
    "image": ARRAY.reshape(10, -1, 3),
    "tensor": VIEW.points,
    "open3d": open3d(ARRAY),
    "trimesh": trimesh.PointCloud(ARRAY),
}


@pytest.mark.parametrize("given", ALIKE.values(), ids=ALIKE)
def test_what_holds_points_is_a_cloud_of_these_points_in_metres_without_a_camera(given):
    cloud = as_cloud(given, "cloud")
    assert torch.allclose(cloud.points.double(), VIEW.points.double(), atol=1e-7)
    assert cloud.normals is None and cloud.viewpoint is None


def test_the_table_of_a_file_is_told_where_it_is_not_read(tmp_path):
    path = save_cloud(VIEW, tmp_path / "a.npz", Plane.horizontal(0.02))
    with pytest.warns(NoEffect, match="its table, normal 0 0 1, offset 0.02.* give it"):
        assert torch.equal(as_cloud(path, "cloud").points, VIEW.points)
    with pytest.warns(NoEffect, match="its table"):
        assert read_beside(path).points.shape == VIEW.points.shape


def test_the_table_of_a_file_is_not_told_to_who_gives_a_table(tmp_path):
    path = save_cloud(VIEW, tmp_path / "a.npz", Plane.horizontal(0.02))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_beside(path, table=0.02)
        read_beside(path, spec=ContactSpec(table=0.02))
    with pytest.warns(NoEffect, match="its table"):
        read_beside(path, spec=ContactSpec())
    # an earlier call says nothing about this one
    with pytest.warns(NoEffect, match="its table"):
        as_cloud(path, "cloud")


@checked
def read_beside(
    cloud: CloudLike, table: float | None = None, spec: ContactSpec | None = None
) -> PointCloud:
    """Return the cloud that a function would get, beside its table and its spec."""
    return as_cloud(cloud, "cloud")


def test_normals_of_open3d_and_of_six_columns_are_kept():
    normals = fit_local_planes(VIEW.points)[0]
    for given in (open3d(ARRAY, normals), np.hstack([ARRAY, normals])):
        assert torch.equal(as_cloud(given, "cloud").normals, normals.double())


def test_files_and_objects_are_read_with_their_camera(tmp_path):
    path = save_cloud(VIEW, tmp_path / "view.npz")
    for given in (path, str(path), load_object("cylinder"), VIEW):
        cloud = as_cloud(given, "cloud")
        assert torch.equal(cloud.points, VIEW.points) and torch.equal(
            cloud.viewpoint, VIEW.viewpoint
        )
    scene = save_scene(see((0.0, 0.0, 0.06, 0.1)).select(1), tmp_path / "scene.npz")
    assert as_seen(scene, "cloud").target == 1


def test_planners_get_the_cloud_and_the_hand_of_an_array_and_a_name(monkeypatch):
    asked = []

    def stop(request, **_):
        asked.append(request)
        raise KeyError

    for name in (
        "grasps.plan_request",
        "many.plan_request",
        "grasps.stream_request",
        "explain.try_request",
    ):
        monkeypatch.setattr(f"torchgrasp.planner.{name}", stop)
    for function in (torchgrasp.plan_grasps, torchgrasp.stream_grasps, torchgrasp.explain_empty):
        with pytest.raises(KeyError):
            function(ARRAY, "barrett")
    with pytest.raises(KeyError):
        torchgrasp.plan_grasps([open3d(ARRAY), VIEW], "barrett")
    wanted = cloud_from_array(ARRAY)
    assert len(asked) == 4 and all(one.hand is as_hand("barrett", "hand") for one in asked)
    assert all(
        torch.equal(one.cloud.points, wanted.points) and one.cloud.viewpoint is None
        for one in asked
    )


def test_a_shape_of_an_array_is_that_of_its_cloud():
    assert torch.equal(
        torchgrasp.fit_shape(cloud_from_array(ARRAY)).x, torchgrasp.fit_shape(ARRAY).x
    )


def test_a_shipped_hand_is_loaded_once_and_a_folder_each_time():
    assert as_hand("barrett", "hand") is as_hand("barrett", "hand")
    folder = load_hand("barrett").urdf_path.parent
    assert as_hand("./" + str(folder.relative_to(Path.cwd())), "hand").name == "barrett"


REFUSED = [x for x in HOSTILE if not isinstance(x, Path | str | list | tuple)] + [
    [1],
    ARRAY[:3],
    ARRAY[:, :2],
    ARRAY[:, 0],
    ARRAY > 0,
    trimesh.creation.box(),
    torch.zeros(9, 2),
    load_hand("barrett"),
    open3d(ARRAY[:, :2]),
    open3d(ARRAY, ARRAY[:5]),
    GRASP.contacts,
]


@pytest.mark.parametrize("function", ["plan_grasps", "stream_grasps", "explain_empty", "fit_shape"])
def test_what_is_no_cloud_is_refused_by_name(function):
    call = getattr(torchgrasp, function)
    hand = [] if function == "fit_shape" else ["barrett"]
    for given in [*REFUSED, *NO_PATHS, "", "none.ply", Path("none.docx")]:
        with pytest.raises(BadArgument, match=r"^cloud") as caught:
            call(given, *hand)
        if isinstance(given, int | trimesh.Trimesh | torchgrasp.Contacts):
            assert "cloud_from_array" in str(caught.value)


def test_what_is_no_hand_is_refused_by_name():
    for given in [*REFUSED, *NO_PATHS, "", "octopus", Path("none")]:
        if not isinstance(given, torchgrasp.Hand):
            with pytest.raises(BadArgument, match=r"^hand"):
                torchgrasp.plan_grasps(VIEW, given)


def test_a_bad_item_of_a_list_is_named():
    with pytest.raises(BadArgument, match=r"^cloud\[1\]: .*cloud_from_array"):
        torchgrasp.plan_grasps([VIEW, 5], "barrett")
    with pytest.raises(BadArgument, match=r"^scene: .*got none.npz"):
        torchgrasp.plan_scene("none.npz", "barrett")


@pytest.mark.sim
def test_a_hand_closes_by_name_on_an_object():
    """Its fingers are those of the grasp, and the convex parts those of the object."""
    pytest.importorskip("sapien")
    jug = load_object("jug")
    grasp = load_shipped_grasp("jug", "allegro")
    spec = torchgrasp.TrialSpec(hold_time=0.1)
    careful = torchgrasp.close_hand(grasp, load_hand("allegro"), jug.mesh, spec, parts=jug.parts)
    plain = torchgrasp.close_hand(grasp, "allegro", jug, spec)
    assert careful.held and torch.equal(careful.joints, plain.joints)
