"""Hostile and broken URDFs: each is refused with a named error, and nothing else is opened."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torchgrasp.foundation.errors import HandFileError
from torchgrasp.foundation.limits import URDF_BYTES
from torchgrasp.hand.urdf import read_published, read_urdf

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


def test_a_tree_is_read_and_too_large_and_missing_files_are_refused(tmp_path):
    urdf = read_urdf(write(tmp_path, GOOD))
    assert (urdf.root, [j.name for j in urdf.joints], [x.name for x in urdf.links]) == (
        "a",
        ["j"],
        ["a", "b"],
    )
    chain = JOINT + JOINT.replace('"j"', '"k"').replace('"b"', '"c"').replace('"a"', '"b"')
    urdf = read_urdf(
        write(tmp_path, GOOD.replace(LINKS + JOINT, LINKS + '<link name="c"/>' + chain))
    )
    assert [[j.name for j in urdf.joints_above(x)] for x in "abc"] == [[], ["j"], ["k", "j"]]
    with pytest.raises(HandFileError, match="bytes"):
        read_urdf(write(tmp_path, GOOD + " " * URDF_BYTES))
    with pytest.raises(HandFileError, match="no file"):
        read_urdf(tmp_path / "none.urdf")
    with pytest.raises(HandFileError, match="no file"):
        read_urdf(tmp_path)


def test_the_same_bytes_are_parsed_once_and_a_changed_file_anew(tmp_path, monkeypatch):
    path = write(tmp_path, GOOD)
    first = read_urdf(path)
    monkeypatch.setattr("torchgrasp.hand.urdf.parse_urdf", None)  # nothing reads again
    assert read_urdf(path) is first
    monkeypatch.undo()
    write(tmp_path, GOOD.replace('upper="1"', 'upper="2"'))
    assert (first.joints[0].upper, read_urdf(path).joints[0].upper) == (1.0, 2.0)


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>'
HOSTILE = {
    "doctype": (f"<!DOCTYPE robot>{GOOD}", "declaration"),
    "entity bomb": (BOMB + GOOD, "declaration"),
    "external entity": (
        '<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/passwd">]>' + GOOD,
        "declaration",
    ),
    "doctype after a comment": (f"<!-- x --><!DOCTYPE robot>{GOOD}", "declaration"),
    "doctype between instructions": (
        "<?x <!-- ?><!DOCTYPE r [<!ENTITY e 'x'>]><?y --> ?>" + GOOD,
        "declaration",
    ),
    "doctype between comments": (f"<!--><!DOCTYPE robot>-->{GOOD}", "XML|declaration"),
    "utf-16": (GOOD.encode("utf-16"), "UTF-8|encoding|XML"),
    "declared encoding": ('<?xml version="1.0" encoding="utf-7"?>' + GOOD, "encoding"),
    "latin bytes": (GOOD.replace('name="r"', 'name="\xe9"').encode("latin-1"), "UTF-8"),
    "empty": ("", "XML"),
    "not xml": ("hello", "XML"),
    "cut short": (GOOD[:-9], "XML"),
    "deep": ("<robot name='r'>" + "<link name='x'>" * 5000 + "</link>" * 5000 + "</robot>", "deep"),
    "not a robot": ("<sdf/>", "<robot>"),
    "unknown tag": (GOOD.replace("</robot>", "<plugin/></robot>"), "plugin"),
    "no links": ("<robot name='r'/>", "links"),
    "513 links": (
        "<robot name='r'>" + "".join(f"<link name='l{i}'/>" for i in range(513)) + "</robot>",
        "512",
    ),
    "link twice": (GOOD.replace(LINKS, LINKS + '<link name="a"/>'), "twice"),
    "two parents": (GOOD.replace("</robot>", JOINT.replace('"j"', '"k"') + "</robot>"), "twice"),
    "two roots": (GOOD.replace(LINKS, LINKS + '<link name="c"/>'), "root"),
    "missing link": (GOOD.replace('<child link="b"/>', '<child link="z"/>'), "'z'"),
    "no parent": (GOOD.replace('<parent link="a"/>', ""), "parent"),
    "self loop": (GOOD.replace('<parent link="a"/>', '<parent link="b"/>'), "root|cycle"),
    "cycle": (
        GOOD.replace(
            "</robot>",
            JOINT.replace('"j"', '"k"').replace('"a"', '"t"').replace('"b"', '"a"') + "</robot>",
        ).replace('link="t"', 'link="b"'),
        "cycle",
    ),
    "cycle beside the tree": (
        "<robot name='r'>"
        + LINKS
        + '<link name="c"/><link name="d"/>'
        + JOINT
        + JOINT.replace('"j"', '"k"').replace('"a"', '"c"').replace('"b"', '"d"')
        + JOINT.replace('"j"', '"m"').replace('"a"', '"d"').replace('"b"', '"c"')
        + "</robot>",
        "cycle",
    ),
    "line of 101": (
        '<robot name="r"><link name="l0"/>'
        + "".join(
            f'<link name="l{k}"/><joint name="j{k}" type="fixed"><parent link="l{k - 1}"/><child link="l{k}"/></joint>'
            for k in range(1, 101)
        )
        + "</robot>",
        "100 links",
    ),
    "tab in a name": (GOOD.replace('link name="a"', 'link name="a&#9;"'), "printable"),
    "unknown joint type": (GOOD.replace("revolute", "floating"), "floating"),
    "zero axis": (GOOD.replace('"0 0 1"', '"0 0 0"'), "axis"),
    "axis that hides a ratio": (GOOD.replace('"0 0 1"', '"0 0 0.333"'), "axis"),
    "nan limit": (GOOD.replace('lower="-1"', 'lower="nan"'), "lower"),
    "infinite limit": (GOOD.replace('upper="1"', 'upper="inf"'), "upper"),
    "swapped limits": (GOOD.replace('lower="-1"', 'lower="2"'), "lower < upper: are they swapped"),
    "limits in degrees": (
        GOOD.replace('lower="-1" upper="1"', 'lower="-29" upper="108"'),
        "in degrees",
    ),
    "limits in millimetres": (
        GOOD.replace("revolute", "prismatic").replace('upper="1"', 'upper="40"'),
        "in millimetres",
    ),
    "a lower limit alone": (GOOD.replace('upper="1" ', ""), "both limits, or none"),
    "an upper limit alone": (GOOD.replace('lower="-1" ', ""), "both limits, or none"),
    "angles in degrees": (
        GOOD.replace("<axis", '<origin rpy="0 90 0"/><axis'),
        "radians .in degrees. 90 is 1.57 rad",
    ),
    "xacro variable": (GOOD.replace('upper="1"', 'upper="${pi/2}"'), "without xacro .*pi/2"),
    "xacro argument": (
        GOOD.replace('name="j"', 'name="$(arg prefix)j"'),
        "without xacro .*arg prefix",
    ),
    "xacro tag": (
        GOOD.replace("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"').replace(
            "</robot>", '<xacro:finger side="left"/></robot>'
        ),
        "without xacro .*xacro:finger",
    ),
    "xacro tag in a link": (
        GOOD.replace("<robot", '<robot xmlns:xacro="http://ros.org/wiki/xacro"').replace(
            '<link name="a"/>', '<link name="a"><xacro:inertia/></link>'
        ),
        "link a 'xacro:inertia",
    ),
    "xacro tag without its name": (
        GOOD.replace("</robot>", "<xacro:finger/></robot>"),
        "without xacro",
    ),
    "xacro find": (
        GOOD.replace(
            '<link name="a"/>',
            '<link name="a"><collision><geometry>'
            '<mesh filename="$(find h)/x.stl"/></geometry></collision></link>',
        ),
        "xacro .*find h",
    ),
    "two scales": (
        GOOD.replace(
            '<link name="a"/>',
            '<link name="a"><collision><geometry>'
            '<mesh filename="x.stl" scale="1 1"/></geometry></collision></link>',
        ),
        "3 finite",
    ),
    "no limits": (re.sub("<limit[^>]*>", "", GOOD), "limit"),
    "nan origin": (GOOD.replace("<axis", '<origin xyz="nan 0 0"/><axis'), "origin"),
    "two numbers": (GOOD.replace("<axis", '<origin xyz="0 0"/><axis'), "3 finite"),
    "mimics nothing": (GOOD.replace("<axis", '<mimic joint="z"/><axis'), "'z'"),
    "huge box": (
        GOOD.replace(
            '<link name="a"/>',
            '<link name="a"><collision><geometry><box size="1 10 1"/>'
            "</geometry></collision></link>",
        ),
        "2 m",
    ),
    "1001 shapes": (
        GOOD.replace(
            '<link name="a"/>',
            '<link name="a">' + '<collision><geometry><sphere radius="1"/>'
            "</geometry></collision>" * 1001 + "</link>",
        ),
        "1001",
    ),
    "follows a follower": (
        GOOD.replace(
            "</robot>",
            '<link name="c"/>'
            + JOINT.replace('"j"', '"k"')
            .replace('"b"', '"c"')
            .replace("<axis", '<mimic joint="j"/><axis')
            + "</robot>",
        ).replace(
            "</robot>",
            '<link name="d"/>'
            + JOINT.replace('"j"', '"m"')
            .replace('"b"', '"d"')
            .replace("<axis", '<mimic joint="k"/><axis')
            + "</robot>",
        ),
        "coupled",
    ),
    "continuous": (GOOD.replace("revolute", "continuous"), "limit"),
    "mimics itself": (GOOD.replace("<axis", '<mimic joint="j"/><axis'), "coupled"),
    "capsule": (
        GOOD.replace(
            '<link name="a"/>',
            '<link name="a"><collision><geometry><capsule/></geometry></collision></link>',
        ),
        "capsule",
    ),
    "collision mesh": (
        GOOD.replace(
            '<link name="a"/>',
            '<link name="a"><collision><geometry><mesh filename="x.stl"/>'
            "</geometry></collision></link>",
        ),
        "box, cylinder or sphere",
    ),
    "many joints of one name": (
        "<robot name='r'>" + LINKS + JOINT * 20_000 + "</robot>",
        "elements|twice",
    ),
    "negative box": (
        GOOD.replace(
            '<link name="a"/>',
            '<link name="a"><collision><geometry><box size="1 -1 1"/>'
            "</geometry></collision></link>",
        ),
        "positive",
    ),
}


@pytest.mark.promise("H1")
@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_urdf_is_refused(tmp_path, name):
    text, match = HOSTILE[name]
    with pytest.raises(HandFileError, match=match):
        read_urdf(write(tmp_path, text))


VISUALS = [
    "../../x.stl",
    "/etc/x.stl",
    "file:///x.stl",
    "http://x/x.stl",
    "package://a/../../x.stl",
    "a.dae",
    "",
    ".",
]


@pytest.mark.parametrize("mesh", VISUALS)
def test_what_is_only_seen_is_not_read(tmp_path, mesh):
    """A visual mesh that is missing, or lies anywhere, says nothing about the hand; no reader gets
    its name.
    """
    link = f'<link name="a"><visual><geometry><mesh filename="{mesh}"/></geometry></visual></link>'
    urdf = read_urdf(write(tmp_path, GOOD.replace('<link name="a"/>', link)))
    assert urdf.links == read_urdf(write(tmp_path, GOOD)).links
    assert b"mesh" in urdf.data and b"mesh" not in urdf.xml


def test_the_inertia_of_a_turned_frame_is_turned(tmp_path):
    """R diag(1, 2, 3) R', here by SciPy's rotation."""
    inertia = '<inertia ixx="1" ixy="0" ixz="0" iyy="2" iyz="0" izz="3"/>'
    body = (
        f'<inertial><origin xyz="0 0 1" rpy="0.3 -0.4 0.5"/><mass value="1"/>{inertia}</inertial>'
    )
    link = read_urdf(
        write(tmp_path, GOOD.replace('<link name="a"/>', f'<link name="a">{body}</link>'))
    ).links[0]
    turn = Rotation.from_euler("xyz", [0.3, -0.4, 0.5]).as_matrix()
    assert link.com == (0, 0, 1)
    np.testing.assert_allclose(
        link.inertia, (turn @ np.diag([1, 2, 3]) @ turn.T)[np.triu_indices(3)], atol=1e-12
    )


@pytest.mark.parametrize(
    "rpy", ["0.1 -0.2 0.3", "0 -1.65806279 -1.5707963", "3 1.2 -2", "0 -1.57079 0", "1 2 3"]
)
def test_angles_come_back_as_they_stand_in_the_file(tmp_path, rpy):
    text = GOOD.replace("<axis", f'<origin xyz="0 0 0" rpy="{rpy}"/><axis')
    found = Rotation.from_euler("xyz", read_urdf(write(tmp_path, text)).joints[0].rpy)
    truth = Rotation.from_euler("xyz", [float(x) for x in rpy.split()])
    assert (found.inv() * truth).magnitude() < 1e-14


def test_a_scale_of_one_number_counts_for_all_axes(tmp_path):
    mesh = '<collision><geometry><mesh filename="x.stl" scale="0.001"/></geometry></collision>'
    urdf = read_published(
        write(tmp_path, GOOD.replace('<link name="a"/>', f'<link name="a">{mesh}</link>'))
    )
    assert urdf.links[0].shapes[0].size == (0.001,) * 3


def test_a_full_turn_either_way_is_read(tmp_path):
    """As the joints of many arms have it."""
    urdf = read_urdf(write(tmp_path, GOOD.replace('"-1" upper="1"', '"-6.28319" upper="6.28319"')))
    assert urdf.joints[0].upper == 6.28319
