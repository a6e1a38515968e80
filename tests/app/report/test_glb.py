"""GLB files: trimesh reads back where the hand and the object are, what they are called, and their
colours.
"""

import dataclasses
import json
import struct

import numpy as np
import pytest
import trimesh

from torchgrasp import load_hand, load_object
from torchgrasp.app import cli
from torchgrasp.app.report import write_glb
from torchgrasp.app.report.canvas import FINGERS, rgb
from torchgrasp.app.report.solids import solids_from_hand
from torchgrasp.data.shipped import DATA, load_shipped_grasp
from torchgrasp.foundation.errors import BadArgument

Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""z, which is up in the run, becomes y; x stays."""


def tree_of(path):
    """The JSON of a GLB file, read from its first chunk as the specification says."""
    data = path.read_bytes()
    magic, version, length = struct.unpack("<4sII", data[:12])
    size, kind = struct.unpack("<I4s", data[12:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    return json.loads(data[20 : 20 + size])


def test_the_hand_and_the_object_stand_as_in_the_run_with_y_up(run, tmp_path):
    grasp = run.executable[:1]
    path = write_glb(tmp_path / "a.glb", run.hand, grasp, run.mesh)
    scene = trimesh.load_scene(path)
    joints = run.hand.expand_joints(grasp.joints[0].double())
    solids = solids_from_hand(run.hand, joints, run.hand.tree.joint_names, grasp.obj_from_hand[0])
    links = {run.hand.tree.link_names[s.link] for s in solids}
    assert set(scene.geometry) == links | {"object"}
    for name in links:
        expected = (
            np.concatenate([s.vertices for s in solids if run.hand.tree.link_names[s.link] == name])
            @ Y_UP.T
        )
        pose, shape = scene.graph[name]
        seen = scene.geometry[shape].vertices @ pose[:3, :3].T + pose[:3, 3]
        np.testing.assert_allclose(seen.min(0), expected.min(0), atol=1e-6)
        np.testing.assert_allclose(seen.max(0), expected.max(0), atol=1e-6)
    body = scene.geometry["object"].copy().apply_transform(scene.graph["object"][0])
    assert body.volume == pytest.approx(run.mesh.volume, rel=1e-5) and body.extents.max() < 0.061
    assert (
        write_glb(tmp_path / "b.glb", run.hand, grasp, run.mesh).read_bytes() == path.read_bytes()
    )


def test_fingers_have_their_colours_in_linear_light_and_the_surface_its_standard_deviation(
    run, tmp_path
):
    path = write_glb(tmp_path / "a.glb", run.hand, run.executable[:1], run.surface)
    tree = tree_of(path)
    scene = trimesh.load_scene(path)
    parts = {mesh["name"]: mesh["primitives"][0] for mesh in tree["meshes"]}
    for finger, tip in enumerate(run.hand.tips.links):
        look = tree["materials"][parts[tip]["material"]]["pbrMetallicRoughness"]
        light = np.array(look["baseColorFactor"][:3])
        shown = np.where(
            light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055
        )  # sRGB's definition
        np.testing.assert_allclose(shown, rgb(FINGERS[finger]), atol=0.01)
        assert look["metallicFactor"] == 0.0
    assert "COLOR_0" in parts["object"]["attributes"] and "material" in parts["object"]
    assert len(scene.geometry["object"].vertices) == len(run.surface.vertices)


def test_a_tilted_table_is_level_in_the_file_and_several_grasps_are_refused(run, tmp_path):
    grasp = run.executable[:1]
    tilted = dataclasses.replace(
        grasp, meta={**grasp.meta, "table": "normal 0.6 0 0.8, offset -0.03"}
    )
    scene = trimesh.load_scene(write_glb(tmp_path / "a.glb", run.hand, tilted, run.mesh))
    np.testing.assert_allclose(
        scene.graph["object"][0][:3, :3] @ [0.6, 0.0, 0.8], [0.0, 1.0, 0.0], atol=1e-6
    )
    with pytest.raises(BadArgument):
        write_glb(tmp_path / "b.glb", run.hand, run.grasps, run.mesh)


def test_export_writes_the_mesh_and_refuses_a_cloud(tmp_path, capsys):
    grasps = tmp_path / "grasps.safetensors"
    load_shipped_grasp("jug", "barrett").save(grasps)
    command = [
        "export",
        str(grasps),
        "--format",
        "glb",
        "--out",
        str(tmp_path / "a.glb"),
        "--object",
    ]
    jug = load_object("jug")
    hand = load_hand("barrett")
    assert cli.main([*command, str(DATA / "jug" / "mesh.ply")]) == 0
    first = write_glb(tmp_path / "b.glb", hand, load_shipped_grasp("jug", "barrett"), jug.mesh)
    assert (tmp_path / "a.glb").read_bytes() == first.read_bytes()
    assert cli.main([*command, str(DATA / "jug" / "view.ply")]) == 2
    assert "--object: expected a closed triangle mesh" in capsys.readouterr().err
    assert cli.main(command[:-1]) == 2
