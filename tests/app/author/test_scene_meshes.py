"""Meshes of hands in .dae and .glb files: their geometry is read as placed and scaled, and nothing
else is.
"""

import importlib.util
import json
import re
import struct
import sys

import numpy as np
import pytest
import trimesh

from tests.app.author.test_published import change, made, mesh_claw
from torchgrasp.app.author.draft import new_hand
from torchgrasp.app.author.scene_meshes import check_glb, clean_dae
from torchgrasp.files import Malformed
from torchgrasp.foundation.errors import HandFileError, MissingExtra
from torchgrasp.foundation.limits import MESH_FACES
from torchgrasp.hand.urdf import read_urdf

pytestmark = pytest.mark.usefixtures("few_draws")


def scene(kind, size=(16.0, 20.0, 56.0)):
    """A box beside the origin, moved there by a node of the scene."""
    parts = trimesh.Scene()
    parts.add_geometry(
        trimesh.creation.box(size),
        transform=trimesh.transformations.translation_matrix((1.0, 2.0, 3.0)),
    )
    return parts.export(file_type=kind)


def dae(size=(16.0, 20.0, 56.0)):
    """The same as COLLADA, whose writer in trimesh drops the nodes' places."""
    text = trimesh.creation.box(size).export(file_type="dae").decode()
    return re.sub(r"(<node [^>]*>)", r"\1<translate>1 2 3</translate>", text)


@pytest.mark.parametrize("kind", ["dae", "glb"])
def test_a_scene_becomes_the_shape_that_it_shows(claw, kind):
    mesh_claw(claw)
    data = dae().encode() if kind == "dae" else scene("glb")
    (claw.parent / "meshes" / f"near.{kind}").write_bytes(data)
    change(claw, ("near.stl", f"near.{kind}"))
    hand, _ = made(claw)
    near = next(x for x in read_urdf(hand.urdf_path).links if x.name == "left_near").shapes
    assert [s.kind for s in near] == ["box"]
    np.testing.assert_allclose(near[0].size, (0.016, 0.02, 0.056), atol=1e-6)
    np.testing.assert_allclose(near[0].xyz, (0.001, 0.002, 0.033), atol=1e-6)


@pytest.mark.parametrize(
    ("unit", "scale"), [("0.001", "1 1 1"), ("1", "0.001"), ("0.01", "0.1 0.1 0.1")]
)
def test_the_unit_of_a_dae_and_one_scale_for_all_axes_count(claw, unit, scale):
    text = re.sub(r'meter="[^"]*"', f'meter="{unit}"', dae())
    text = (
        text
        if "<unit" in text
        else text.replace("</asset>", f'<unit name="u" meter="{unit}"/></asset>')
    )
    (claw.parent / "near.dae").write_text(text)
    mesh = f'<mesh filename="near.dae" scale="{scale}"/>'
    change(claw, ('<box size="0.016 0.02 0.056"/>', mesh))
    near = next(x for x in read_urdf(made(claw)[0].urdf_path).links if x.name == "left_near").shapes
    np.testing.assert_allclose(near[0].size, (0.016, 0.02, 0.056), atol=1e-6)


def test_what_a_dae_holds_beside_its_geometry_is_not_read(claw):
    image = "<library_images><image id='i'><init_from>file:///etc/passwd</init_from></image></library_images>"
    (claw.parent / "near.dae").write_text(
        dae().replace("<library_geometries>", image + "<library_geometries>")
    )
    change(claw, ('<box size="0.016 0.02 0.056"/>', '<mesh filename="near.dae" scale="0.001"/>'))
    opened = []
    sys.addaudithook(
        lambda event, arguments: opened.append(str(arguments[0])) if event == "open" else None
    )
    new_hand(claw)
    assert not [path for path in opened if "passwd" in path]


def glb(**changed):
    """A .glb file of a box with another header."""
    data = scene("glb")
    length = int.from_bytes(data[12:16], "little")
    header = json.loads(data[20 : 20 + length])
    text = json.dumps(header | {key: make(header) for key, make in changed.items()}).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return (
        struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
        + text
        + rest
    )


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"solid", "no header of a .glb"),
        (glb(extensionsRequired=lambda h: ["KHR_draco_mesh_compression"]), "compressed.*draco"),
        (glb(skins=lambda h: [{"joints": [0]}]), "skins"),
        (
            glb(accessors=lambda h: [{"count": 9, "type": "VEC3", "componentType": 5126}]),
            "compressed",
        ),
        (
            glb(bufferViews=lambda h: 60 * h["bufferViews"]),
            "corners",
        ),  # the same bytes again and again
        (
            glb(nodes=lambda h: [{"children": [1] * 500_001}, {"mesh": 0}]),
            "corners",
        ),  # one mesh in many places
    ],
)
def test_a_glb_that_needs_more_than_its_bytes_is_told(data, words):
    with pytest.raises(Malformed, match=words):
        check_glb(data)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("<library_geometries>", "<!DOCTYPE x><library_geometries>", "DOCTYPE"),
        ("<instance_geometry", "<instance_controller/><instance_geometry", "<instance_controller>"),
        ("<instance_geometry", "<instance_node url='#a'/><instance_geometry", "<instance_node>"),
        (
            "</library_geometries>",
            "<geometry/>" * 50_001 + "</library_geometries>",
            "a larger XML tree",
        ),
    ],
)
def test_a_dae_of_more_than_plain_geometry_is_told(old, new, words):
    clean_dae(dae().encode())
    with pytest.raises(Malformed, match=words):
        clean_dae(dae().replace(old, new).encode())


def test_one_geometry_in_too_many_places_is_told():
    text = dae()
    placed = re.search(
        r"<instance_geometry.*?</instance_geometry>|<instance_geometry[^>]*/>", text, re.DOTALL
    )
    assert placed is not None
    indices = len(re.search(r"<p>(.*?)</p>", text).group(1).split())  # pyright: ignore[reportOptionalMemberAccess]
    one = re.sub(r"<bind_material>.*</bind_material>", "", placed.group(), flags=re.DOTALL)
    with pytest.raises(Malformed, match="indices"):
        clean_dae(
            text.replace(placed.group(), one * (12 * MESH_FACES // (40 * indices)))
            .replace("<p>", "<p>" + "0 " * 41 * indices)
            .encode()
        )


def test_a_dae_without_pycollada_names_the_extra(claw, monkeypatch):
    (claw.parent / "near.dae").write_text(dae())
    change(claw, ('<box size="0.016 0.02 0.056"/>', '<mesh filename="near.dae"/>'))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtra, match=r"torchgrasp\[meshes\]"):
        new_hand(claw)


def test_a_broken_scene_is_told_in_our_words(claw):
    (claw.parent / "near.glb").write_bytes(scene("glb")[:-40])
    change(claw, ('<box size="0.016 0.02 0.056"/>', '<mesh filename="near.glb"/>'))
    with pytest.raises(HandFileError, match=r"near\.glb.*broken or cut off|near\.glb.*bytes"):
        new_hand(claw)
