"""Folders of objects: what the manifest says is what is read."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from torchgrasp import PointCloud
from torchgrasp.cloud.read import save_cloud
from torchgrasp.data import (
    list_views,
    read_entries,
    read_entry,
    read_object_mesh,
    read_view,
    write_objects,
)
from torchgrasp.foundation.errors import (
    BadArgument,
    CloudWarning,
    DatasetError,
    MeshError,
    NoEffect,
    TwoBodies,
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A box of 0.2 m, to be halved, with two views and a whole cloud, and a torn mesh without
    views.
    """
    box = trimesh.creation.box((0.2, 0.2, 0.2))
    for name in ("box", "torn"):
        (tmp_path / name).mkdir()
    box.export(tmp_path / "box" / "mesh.ply")
    trimesh.Trimesh(box.vertices, box.faces[:-1]).export(tmp_path / "torn" / "mesh.ply")
    corners = torch.from_numpy(np.array(box.vertices))
    for view in ("view0", "view1"):
        save_cloud(PointCloud(corners), tmp_path / "box" / f"{view}_noisy.ply")
    save_cloud(PointCloud(corners, corners / 0.1), tmp_path / "box" / "full_normals.ply")
    pose = np.eye(4)
    pose[:3, 3] = [0.0, 0.0, 2.0]
    views = {view: {"T_object_camera": pose.tolist()} for view in ("view1", "view0")}
    entries = {
        "torn": {"views": {}},
        "box": {"suggested_scale": 0.5, "family": "cuboid", "group": "solid", "views": views},
    }
    (tmp_path / "manifest.json").write_text(json.dumps({"objects": entries}))
    return tmp_path


def test_views_are_listed_in_order(folder: Path):
    assert list_views(folder) == [("box", "view0"), ("box", "view1")]
    assert list_views(folder, most=1) == [("box", "view0")]
    assert list_views(folder, whole=True) == [("box", "whole"), ("torn", "whole")]
    assert list_views(folder, only=["torn"]) == []


def test_an_object_without_family_is_one_of_its_own(folder: Path):
    found = [
        (entry.family, entry.group)
        for entry in (read_entry(folder, name) for name in ("box", "torn"))
    ]
    assert found == [("cuboid", "solid"), ("torn", "")]


def test_views_and_meshes_come_at_the_suggested_scale(folder: Path):
    cloud = read_view(folder, "box", "view0")
    mesh = read_object_mesh(folder, "box")
    assert cloud.normals is None
    assert cloud.points.abs().max().item() == pytest.approx(0.05) and mesh.volume == pytest.approx(
        1e-3
    )
    assert cloud.viewpoint is not None and cloud.viewpoint.tolist() == pytest.approx(
        [0.0, 0.0, 1.0]
    )
    assert read_view(folder, "box", "view0", camera=False).viewpoint is None


def test_a_whole_cloud_has_normals_and_no_camera(folder: Path):
    cloud = read_view(folder, "box", "whole")
    assert cloud.normals is not None and cloud.viewpoint is None
    assert cloud.points.abs().max().item() == pytest.approx(0.05)


def test_a_torn_mesh_is_refused(folder: Path):
    with pytest.raises(MeshError, match="open surface"):
        read_object_mesh(folder, "torn")


def test_a_folder_without_a_manifest_or_the_object_is_refused(folder: Path, tmp_path: Path):
    with pytest.raises(BadArgument, match="manifest"):
        list_views(tmp_path / "empty")
    with pytest.raises(BadArgument, match="asked for"):
        list_views(folder, only=["jug"])
    with pytest.raises(BadArgument, match="jug"):  # none of several names is skipped
        list_views(folder, only=["box", "jug"])


def test_a_folder_of_meshes_becomes_objects_with_views_that_see_them(tmp_path: Path):
    (tmp_path / "meshes").mkdir()
    box = trimesh.creation.box((0.06, 0.08, 0.1))
    box.apply_translation([0.4, 0.1, 0.3])
    box.export(tmp_path / "meshes" / "carton.stl")
    trimesh.creation.icosphere(subdivisions=2, radius=0.04).export(tmp_path / "meshes" / "ball.obj")
    assert write_objects(tmp_path / "meshes", tmp_path / "out", views=2) == ["ball", "carton"]
    assert list_views(tmp_path / "out") == [
        (name, f"view{k}") for name in ("ball", "carton") for k in (0, 1)
    ]
    mesh = read_object_mesh(tmp_path / "out", "carton")
    np.testing.assert_allclose(mesh.bounds, [[-0.03, -0.04, 0.0], [0.03, 0.04, 0.1]], atol=1e-6)
    cloud = read_view(tmp_path / "out", "carton", "view1")
    gap = np.abs(trimesh.proximity.signed_distance(mesh, cloud.points.numpy()))
    assert np.median(gap) < 0.002 and len(cloud) == 1000
    assert (
        cloud.viewpoint is not None
        and float((cloud.viewpoint - torch.tensor([0, 0, 0.05])).norm()) > 0.4
    )
    again = tmp_path / "again"
    write_objects(tmp_path / "meshes", again, views=2)
    for file in sorted(path.relative_to(again) for path in again.rglob("*") if path.is_file()):
        assert (again / file).read_bytes() == (tmp_path / "out" / file).read_bytes()


def test_meshes_of_other_formats_and_in_folders_are_told_and_own_folders_are_not(tmp_path):
    box = trimesh.creation.box((0.05, 0.06, 0.12))
    meshes = tmp_path / "meshes"
    (meshes / "more").mkdir(parents=True)
    for name in ("carton.stl", "tin.GLB", "more/mug.obj"):
        box.export(meshes / name, file_type=name[-3:].lower())
    (meshes / "carton.mtl").write_text("a material is no mesh")
    with pytest.warns(NoEffect, match=r"2 .*not read, more, tin\.GLB: ") as told:
        assert write_objects(meshes, tmp_path / "objects", views=1) == ["carton"]
    assert len(told) == 1
    (meshes / "tin.GLB").unlink()
    shutil.rmtree(meshes / "more")
    for out in (meshes / "objects", meshes):
        for _ in range(2):
            assert write_objects(meshes, out, views=1) == ["carton"]  # and warns of nothing


def test_other_objects_and_entries_of_a_manifest_are_not_lost(tmp_path):
    box = trimesh.creation.box((0.05, 0.06, 0.12))
    for name in ("carton", "tin"):
        (tmp_path / name).mkdir()
        box.export(tmp_path / name / f"{name}.stl")
    objects = tmp_path / "objects"
    write_objects(tmp_path / "carton", objects, views=1)
    manifest = objects / "manifest.json"
    before = manifest.read_text()
    with pytest.raises(DatasetError, match=r"out: .*would be lost, carton$"):
        write_objects(tmp_path / "tin", objects, views=1)
    assert manifest.read_text() == before and not (objects / "tin").exists()
    edited = before.replace('"views"', '"mass_kg": 0.3, "views"')
    manifest.write_text(edited)
    with pytest.raises(DatasetError, match=r"out: .*would be lost, carton$"):
        write_objects(tmp_path / "carton", objects, views=1)
    assert manifest.read_text() == edited


def test_a_mass_and_a_scale_of_other_names_are_told_once(tmp_path):
    entries = {name: {"views": {}, "mass": 0.3, "scale": 0.5} for name in ("mug", "tin")}
    entries["jug"] = {"views": {}, "mass": 0.3, "mass_kg": 0.4, "suggested_scale": 2.0}
    (tmp_path / "manifest.json").write_text(json.dumps({"objects": entries}))
    with pytest.warns(NoEffect) as told:
        found = read_entries(tmp_path)
    assert [str(one.message).partition(": ")[2] for one in told] == [
        "'mass' of 2 objects is not read: call it 'mass_kg'",
        "'scale' of 2 objects is not read: call it 'suggested_scale'",
    ]
    assert (found["mug"].mass, found["mug"].scale, found["jug"].mass) == (None, 1.0, 0.4)
    assert read_entries(tmp_path, ["jug"])["jug"].scale == 2.0


def test_a_name_that_occurs_twice_in_a_manifest_is_refused(tmp_path):
    twice = {
        "mug": '{"objects": {"mug": {"views": {}}, "tin": {}, "mug": {"views": {}}}}',
        "suggested_scale": '{"objects": {"mug": {"suggested_scale": 1, "suggested_scale": 2}}}',
    }
    for name, text in twice.items():
        (tmp_path / "manifest.json").write_text(text)
        with pytest.raises(DatasetError, match=f"'{name}' twice in one object"):
            read_entries(tmp_path)


def test_a_normalised_mesh_and_bodies_that_lie_apart_are_told(tmp_path):
    def make(name, *parts):
        (tmp_path / name).mkdir()
        trimesh.util.concatenate(parts).export(tmp_path / name / "thing.ply")
        return tmp_path / name

    unit = make("unit", trimesh.creation.box((1.0, 0.6, 0.5)))
    box = trimesh.creation.box((0.05, 0.06, 0.12))
    apart = make("apart", box, box.copy().apply_translation((0.2, 0, 0)))
    joined = make("joined", *(box.copy().apply_translation((0.04 * k, 0, 0)) for k in (0, 2, 1)))
    with pytest.warns(CloudWarning, match=r"1\.00 m long.*suggested_scale"):
        write_objects(unit, tmp_path / "a", views=1)
    with pytest.warns(TwoBodies, match="lie apart"):
        write_objects(apart, tmp_path / "b", views=1)
    write_objects(joined, tmp_path / "c", views=1)  # without a word


def test_a_mesh_that_falls_over_is_told(tmp_path):
    """A hammer with y up lies on its head; lying cylinders and balls stay where they are."""
    head = trimesh.creation.box((0.03, 0.03, 0.08))
    shaft = trimesh.creation.box((0.2, 0.02, 0.02)).apply_translation((0.11, 0, 0.02))
    rolling = trimesh.creation.cylinder(0.03, 0.1).apply_transform(
        trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
    )
    things = {
        "hammer": trimesh.util.concatenate([head, shaft]),
        "can": rolling,
        "ball": trimesh.creation.icosphere(2, 0.03),
    }
    for name, thing in things.items():
        (tmp_path / name).mkdir()
        thing.export(tmp_path / name / "thing.ply")
    with pytest.warns(CloudWarning, match=r"falls over as it lies: .* mm beside its foot"):
        write_objects(tmp_path / "hammer", tmp_path / "a", views=1)
    for name in ("can", "ball"):  # without a word
        write_objects(tmp_path / name, tmp_path / f"{name} out", views=1)


@pytest.mark.parametrize("name", ["mug ", ".mug", "mug.", "a:b", "a\\b", "m\tug", 101 * "m"])
def test_a_mesh_of_a_name_that_readers_refuse_is_refused_before_work(tmp_path: Path, name: str):
    trimesh.creation.box((0.06, 0.08, 0.1)).export(tmp_path / "mesh.stl")
    (tmp_path / "mesh.stl").rename(tmp_path / f"{name}.stl")
    with pytest.raises(DatasetError, match="meshes: expected a printable name of 1 to 100 bytes"):
        write_objects(tmp_path, tmp_path / "out", views=1)
    assert not (tmp_path / "out").exists()


def test_no_meshes_two_of_a_name_and_an_open_one_are_refused(tmp_path: Path):
    with pytest.raises(BadArgument, match="without meshes"):
        write_objects(tmp_path, tmp_path / "out")
    with pytest.raises(BadArgument, match="none, which is no folder"):
        write_objects(tmp_path / "none", tmp_path / "out")
    box = trimesh.creation.box((0.06, 0.08, 0.1))
    for suffix in ("stl", "ply"):
        box.export(tmp_path / f"box.{suffix}")
    with pytest.raises(BadArgument, match="two meshes"):
        write_objects(tmp_path, tmp_path / "out")
    (tmp_path / "box.ply").unlink()
    trimesh.Trimesh(box.vertices, box.faces[:-1]).export(tmp_path / "torn.ply")
    with pytest.raises(MeshError):
        write_objects(tmp_path, tmp_path / "out")
    assert not (tmp_path / "out" / "manifest.json").exists()
