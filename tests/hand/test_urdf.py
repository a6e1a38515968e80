"""Hostile and broken URDFs: each is refused with a named error, and nothing else is opened."""

import re
from pathlib import Path

import pytest

from torchgrasp.errors import HandFileError
from torchgrasp.hand.hand import load_hand
from torchgrasp.hand.urdf import MAX_BYTES, read_urdf

LINKS = '<link name="a"/><link name="b"/>'
JOINT = (
    '<joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>'
    '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
)
GOOD = f'<robot name="r">{LINKS}{JOINT}</robot>'


def write(tmp_path: Path, text: str | bytes) -> Path:
    path = tmp_path / "hand.urdf"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_a_small_tree_is_read(tmp_path):
    urdf = read_urdf(write(tmp_path, GOOD))
    assert (urdf.root, [j.name for j in urdf.joints], [x.name for x in urdf.links]) == ("a", ["j"], ["a", "b"])


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>'
HOSTILE = {
    "doctype": (f"<!DOCTYPE robot>{GOOD}", "declaration"),
    "entity bomb": (BOMB + GOOD, "declaration"),
    "external entity": ('<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/passwd">]>' + GOOD, "declaration"),
    "doctype after a comment": (f"<!-- x --><!DOCTYPE robot>{GOOD}", "declaration"),
    "doctype between instructions": ("<?x <!-- ?><!DOCTYPE r [<!ENTITY e 'x'>]><?y --> ?>" + GOOD, "declaration"),
    "doctype between comments": (f"<!--><!DOCTYPE robot>-->{GOOD}", "XML|declaration"),
    "utf-16": (GOOD.encode("utf-16"), "UTF-8|encoding|XML"),
    "declared encoding": ('<?xml version="1.0" encoding="utf-7"?>' + GOOD, "encoding"),
    "latin bytes": (GOOD.replace("name=\"r\"", "name=\"\xe9\"").encode("latin-1"), "UTF-8"),
    "empty": ("", "XML"),
    "not xml": ("hello", "XML"),
    "cut short": (GOOD[:-9], "XML"),
    "deep": ("<robot name='r'>" + "<link name='x'>" * 5000 + "</link>" * 5000 + "</robot>", "depth"),
    "not a robot": ("<sdf/>", "<robot>"),
    "unknown tag": (GOOD.replace("</robot>", "<plugin/></robot>"), "plugin"),
    "no links": ("<robot name='r'/>", "links"),
    "513 links": ("<robot name='r'>" + "".join(f"<link name='l{i}'/>" for i in range(513)) + "</robot>", "512"),
    "link twice": (GOOD.replace(LINKS, LINKS + '<link name="a"/>'), "twice"),
    "two parents": (GOOD.replace("</robot>", JOINT.replace('"j"', '"k"') + "</robot>"), "twice"),
    "two roots": (GOOD.replace(LINKS, LINKS + '<link name="c"/>'), "root"),
    "missing link": (GOOD.replace('<child link="b"/>', '<child link="z"/>'), "'z'"),
    "no parent": (GOOD.replace('<parent link="a"/>', ""), "parent"),
    "self loop": (GOOD.replace('<parent link="a"/>', '<parent link="b"/>'), "root|cycle"),
    "cycle": (
        GOOD.replace("</robot>", JOINT.replace('"j"', '"k"').replace('"a"', '"t"').replace('"b"', '"a"') + "</robot>")
        .replace('link="t"', 'link="b"'),
        "cycle",
    ),
    "cycle beside the tree": (
        "<robot name='r'>" + LINKS + '<link name="c"/><link name="d"/>' + JOINT
        + JOINT.replace('"j"', '"k"').replace('"a"', '"c"').replace('"b"', '"d"')
        + JOINT.replace('"j"', '"m"').replace('"a"', '"d"').replace('"b"', '"c"') + "</robot>",
        "cycle",
    ),
    "unknown joint type": (GOOD.replace("revolute", "floating"), "floating"),
    "zero axis": (GOOD.replace('"0 0 1"', '"0 0 0"'), "axis"),
    "axis that hides a ratio": (GOOD.replace('"0 0 1"', '"0 0 0.333"'), "axis"),
    "nan limit": (GOOD.replace('lower="-1"', 'lower="nan"'), "lower"),
    "infinite limit": (GOOD.replace('upper="1"', 'upper="inf"'), "upper"),
    "inverted limits": (GOOD.replace('lower="-1"', 'lower="2"'), "lower < upper"),
    "no limits": (re.sub("<limit[^>]*>", "", GOOD), "limit"),
    "nan origin": (GOOD.replace("<axis", '<origin xyz="nan 0 0"/><axis'), "origin"),
    "two numbers": (GOOD.replace("<axis", '<origin xyz="0 0"/><axis'), "3 finite"),
    "mimics nothing": (GOOD.replace("<axis", '<mimic joint="z"/><axis'), "'z'"),
    "mimics itself": (GOOD.replace("<axis", '<mimic joint="j"/><axis'), "coupled"),
    "capsule": (GOOD.replace('<link name="a"/>', '<link name="a"><collision><geometry><capsule/></geometry>'
                             "</collision></link>"), "capsule"),
    "negative box": (GOOD.replace('<link name="a"/>', '<link name="a"><collision><geometry><box size="1 -1 1"/>'
                                  "</geometry></collision></link>"), "positive"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_urdf_is_refused(tmp_path, name):
    text, match = HOSTILE[name]
    with pytest.raises(HandFileError, match=match):
        read_urdf(write(tmp_path, text))


MESHES = ["../../x.stl", "/etc/x.stl", "file:///x.stl", "http://x/x.stl", "package://a/../../x.stl"]
MESHES += ["a.dae", "", "x" * 5000]


@pytest.mark.parametrize("mesh", MESHES)
def test_mesh_outside_the_folder_is_refused(tmp_path, mesh):
    link = f'<link name="a"><visual><geometry><mesh filename="{mesh}"/></geometry></visual></link>'
    with pytest.raises(HandFileError, match="mesh"):
        read_urdf(write(tmp_path, GOOD.replace('<link name="a"/>', link)))


def test_symbolic_link_out_of_the_folder_is_refused(tmp_path):
    (tmp_path / "hand").mkdir()
    (tmp_path / "hand" / "x.stl").symlink_to(tmp_path / "secret.stl")
    link = '<link name="a"><visual><geometry><mesh filename="x.stl"/></geometry></visual></link>'
    with pytest.raises(HandFileError, match="mesh"):
        read_urdf(write(tmp_path / "hand", GOOD.replace('<link name="a"/>', link)))


def test_too_large_and_missing_files_are_refused(tmp_path):
    with pytest.raises(HandFileError, match="bytes"):
        read_urdf(write(tmp_path, GOOD + " " * MAX_BYTES))
    with pytest.raises(HandFileError, match="no file"):
        read_urdf(tmp_path / "none.urdf")
    with pytest.raises(HandFileError, match="no file"):
        read_urdf(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('name = "toy"', 'name = 3', "name"),
        ('name = "toy"', 'name = "toy', "TOML"),
        ("kp = 1.0", "kp = nan", "kp"),
        ("kp = 1.0", 'kp = "much"', "kp"),
        ("normal = [0, 0, 1]", "normal = [0, 0, 2]", "unit"),
        ("contact = [0, 0, 0.1]", "contact = [0, 0.1]", "three"),
        ('urdf = "hand.urdf"', 'urdf = "../hand.urdf"', "beside"),
        ('fingers = ["f1", "f2", "f3"]', 'fingers = ["f1", "f2"]', "three different"),
        ('fingers = ["f1", "f2", "f3"]', 'fingers = ["f1", "f2", "f9"]', "three different"),
        ('tip_link = "t1"', 'tip_link = "t9"', "'t9'"),
        ('base_link = "palm"', 'base_link = "t1"', "root"),
        ("kd = 0.1", "kd = 0.1\nki = 0.1", "ki"),
    ],
)  # fmt: skip
def test_broken_hand_toml_is_refused(toy_hand, old, new, match):
    text = (toy_hand / "hand.toml").read_text()
    assert old in text
    load_hand(toy_hand)
    (toy_hand / "hand.toml").write_text(text.replace(old, new))
    with pytest.raises(HandFileError, match=match):
        load_hand(toy_hand)
