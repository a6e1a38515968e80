"""Published URDFs: what they hold is repaired, reported, and the clean copy means the same hand."""

import sys

import numpy as np
import pytest
import torch
import trimesh
import yourdfpy

from torchgrasp.app.author.draft import Wish, new_hand
from torchgrasp.app.author.fit_shapes import fit_shapes
from torchgrasp.foundation.errors import BadArgument, HandFileError
from torchgrasp.hand.urdf import read_published, read_urdf
from torchgrasp.testing import check_hand, random_joints

pytestmark = pytest.mark.usefixtures("few_draws")

END = "</robot>"


def change(urdf, *changes):
    """Replace text in a URDF, each old text once or everywhere."""
    text = urdf.read_text()
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    urdf.write_text(text)
    return urdf


def made(urdf, **wish):
    """Draft a hand, write it, check it by the public law; return it with what was told."""
    draft = new_hand(urdf, Wish(**wish))
    folder = urdf.parent / "made"
    folder.mkdir()
    (folder / "hand.toml").write_text(draft.toml)
    (folder / "hand.urdf").write_text(draft.urdf)
    return check_hand(folder), "\n".join(draft.repairs)


def assert_same_links(hand, published, above=""):
    """Compare the poses of all links that both have with yourdfpy's of the published file."""
    robot = yourdfpy.URDF.load(str(published), load_meshes=False)
    joints = random_joints(hand, 20)
    poses = hand.link_poses(joints)
    every = hand.expand(joints)
    shared = [name for name in hand.tree.link_names if name in robot.link_map]
    assert len(shared) > 9
    for row in range(len(joints)):
        robot.update_cfg(
            [float(every[n][row]) if n in every else 0.0 for n in robot.actuated_joint_names]
        )
        for name in shared:
            truth = robot.get_transform(name, above or robot.base_link)
            np.testing.assert_allclose(
                poses[row, hand.tree.link_names.index(name)], truth, atol=1e-9
            )


def mesh_claw(claw, name="package://claw/meshes/{}.stl"):
    """Give the claw meshes for its boxes and balls, as published hands have them."""
    (claw.parent / "meshes").mkdir()
    shapes = {
        '<sphere radius="0.011"/>': ("tip", trimesh.creation.icosphere(4, 11.0)),
        '<box size="0.016 0.02 0.056"/>': ("near", trimesh.creation.box((16.0, 20.0, 56.0))),
    }
    for old, (file, mesh) in shapes.items():
        mesh.export(claw.parent / "meshes" / f"{file}.stl")
        change(claw, (old, f'<mesh filename="{name.format(file)}" scale="0.001 0.001 0.001"/>'))
    return claw


def test_meshes_become_the_shapes_that_they_are(claw):
    hand, told = made(mesh_claw(claw))
    assert "6 collision meshes" in told and "ball" in told
    urdf = read_urdf(hand.urdf_path)
    near = next(x for x in urdf.links if x.name == "left_near").shapes
    assert [s.kind for s in near] == ["box"]
    np.testing.assert_allclose(near[0].size, (0.016, 0.02, 0.056), atol=1e-6)
    np.testing.assert_allclose(near[0].xyz, (0, 0, 0.03), atol=1e-6)
    # the tip is a ball and nothing else: it touches by that ball, tilted towards its end
    assert hand.tips.links == ("left_tip", "right_tip", "thumb_tip")
    assert hand.tips.radius.tolist() == [0.011] * 3
    assert float(hand.tips.center.abs().max()) < 1e-4
    np.testing.assert_allclose(hand.tips.normal[0], [np.cos(np.pi / 6), 0, 0.5], atol=1e-3)


def test_a_mesh_that_ends_a_finger_gets_a_ball_on_its_surface(claw):
    """The tip is a bar of 16 x 14 x 40 mm with a round end, in the frame of its last joint."""
    bar = trimesh.util.concatenate(
        [
            trimesh.creation.box(
                (0.014, 0.016, 0.033), trimesh.transformations.translation_matrix((0, 0, 0.0165))
            ),
            trimesh.creation.icosphere(4, 0.007).apply_translation((0, 0, 0.033)),
        ]
    )
    bar.export(claw.parent / "far.obj")
    change(
        claw,
        ('<box size="0.014 0.018 0.04"/>', '<mesh filename="far.obj"/>'),
        ('xyz="0 0 0.022"', 'xyz="0 0 0"'),
    )
    text = claw.read_text()
    for name in ("left", "right", "thumb"):  # no link of its own for the tip
        start = text.index(f'<joint name="{name}_end"')
        text = text[:start] + text[text.index("</joint>", start) + 8 :]
        start = text.index(f'<link name="{name}_tip"')
        text = text[:start] + text[text.index("</link>", start) + 7 :]
    claw.write_text(text)
    hand, _ = made(claw)
    assert hand.tips.links[0] == "left_far" and 0.006 < float(hand.tips.radius[0]) < 0.009
    contact = hand.tips.contact[0].numpy()
    distance = trimesh.proximity.closest_point(bar, contact[None])[1][0]
    assert distance < 5e-4  # the samples of the surface lie this far apart
    assert contact[2] > 0.03 and contact[0] > 0.003
    ball, *boxes = next(x.shapes for x in read_urdf(hand.urdf_path).links if x.name == "left_far")
    assert ball.kind == "sphere" and boxes
    for box in boxes:  # none passes the bar's sides or the ball's centre
        assert abs(box.xyz[0]) < 1e-3 and box.size[0] < 0.0161 and box.xyz[2] < ball.xyz[2]


def within(points, boxes):
    """Mark the points in some of the boxes."""
    inside = np.zeros(len(points), dtype=bool)
    for shape in boxes:
        pose = trimesh.transformations.compose_matrix(angles=shape.rpy, translate=shape.xyz)
        inside |= (
            np.abs((points - pose[:3, 3]) @ pose[:3, :3]) <= np.array(shape.size) / 2 + 1e-5
        ).all(1)
    return inside


def test_fitted_boxes_hold_all_points_and_little_else():
    """An L of two bars, 20 x 20 x 100 mm: one box would have twice its volume."""
    bars = [
        trimesh.creation.box(
            (0.02, 0.02, 0.1), trimesh.transformations.translation_matrix((0, 0, 0.05))
        ),
        trimesh.creation.box(
            (0.1, 0.02, 0.02), trimesh.transformations.translation_matrix((0.06, 0, 0.01))
        ),
    ]
    points = np.concatenate([trimesh.sample.sample_surface(bar, 4000, seed=0)[0] for bar in bars])
    shapes = fit_shapes(points)
    assert within(points, shapes).all() and len(shapes) <= 3
    assert sum(np.prod(s.size) for s in shapes) < 1.1 * (0.02 * 0.02 * 0.2)
    tube = trimesh.creation.cylinder(0.03, 0.02)
    tube.apply_transform(trimesh.transformations.rotation_matrix(0.5, (1, 0, 0)))
    found = fit_shapes(trimesh.sample.sample_surface(tube, 4000, seed=0)[0])
    assert [s.kind for s in found] == ["cylinder"]
    np.testing.assert_allclose(found[0].size, (0.03, 0.02), rtol=0.02)


@pytest.mark.parametrize("thickness", [0.0, 1e-8, 1e-6, 1e-4])
def test_flat_bodies_in_any_pose_are_covered(thickness):
    turn = trimesh.transformations.random_rotation_matrix(np.random.default_rng(1).random(3))[
        :3, :3
    ]
    points = np.random.default_rng(0).uniform(-1, 1, (2000, 3)) * [0.02, 0.03, thickness] @ turn.T
    assert within(points, fit_shapes(points)).all()


def test_frames_wrist_and_masses(claw):
    """A frame above, one below, one in between, an inertia of no body, no mass: the same hand, in
    the root's frame.
    """
    limit = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'
    text = (
        claw.read_text()
        .replace('<mass value="0.04"/>', '<mass value="0"/>')
        .replace('ixx="0.0003"', 'ixx="9"')
    )
    frames = (
        '<link name="world"/><link name="flange"/><link name="eye"/>'
        '<joint name="w" type="fixed"><parent link="world"/><child link="flange"/>'
        '<origin xyz="0 0 0.1" rpy="0.3 0 1"/></joint>'
        '<joint name="turn" type="revolute"><parent link="flange"/><child link="base"/><axis xyz="0 0 1"/>'
        f"{limit}</joint>"
        '<joint name="e" type="fixed"><parent link="left_near"/><child link="eye"/></joint>'
    )
    claw.write_text(text.replace(END, frames + END))
    hand, told = made(claw)
    for words in ("flange", "eye", "turn at 0", "without mass", "inertia"):
        assert words in told, words
    assert hand.tree.link_names[0] != "flange" and "turn" not in hand.tree.joint_names
    assert_same_links(hand, claw)


@pytest.mark.parametrize("reverse", [False, True])
def test_a_wrist_of_followers_is_fixed_in_any_order_of_the_file(claw, reverse):
    """The third joint follows the second, which follows the first, and a finger follows the third."""
    joints = []
    last = "base"
    for k, mimic in ((3, ("w2", 2, 0.1)), (2, ("w1", -1, 0.3)), (1, None)):
        follow = '<mimic joint="{}" multiplier="{}" offset="{}"/>'.format(*mimic) if mimic else ""
        joints.append(
            f'<link name="w{k}"/><joint name="w{k}" type="revolute"><parent link="w{k}"/>'
            f'<child link="{last}"/><origin xyz="0 0 0.05"/><axis xyz="{k == 3:d} {k == 2:d} {k == 1:d}"/>'
            f'<limit lower="{0.2 if k == 1 else -2}" upper="2" effort="1" velocity="1"/>{follow}</joint>'
        )
        last = f"w{k}"
    joints = joints[::-1] if reverse else joints
    swivel = '<joint name="left_swivel" type="revolute">'
    change(claw, (END, "".join(joints) + END))
    change(claw, (swivel, swivel + '<mimic joint="w3" multiplier="0.5"/>'))
    hand, told = made(claw)
    # w1 stands at its lower limit
    w1 = 0.2
    w2 = -w1 + 0.3
    w3 = 2 * w2 + 0.1
    for words in (
        "w1 at 0.2",
        f"w2 at {w2:.4g}",
        f"w3 at {w3:.4g}",
        f"left_swivel at {w3 / 2:.4g}",
    ):
        assert words in told, told
    assert "left_swivel" not in hand.tree.joint_names


def test_an_arm_above_the_hand_is_left_out(claw):
    """By itself from four common joints on, or by the root that is named."""
    links = "".join(f'<link name="arm{k}"/>' for k in range(5))
    joints = "".join(
        f'<joint name="a{k}" type="revolute"><parent link="arm{k}"/>'
        f'<child link="{"base" if k == 4 else f"arm{k + 1}"}"/><origin xyz="0 0 0.1"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        for k in range(5)
    )
    change(claw, (END, links + joints + END))
    hand, told = made(claw)
    assert "an arm" in told and hand.tree.link_names[0] == "base"
    assert_same_links(hand, claw, above="base")
    assert new_hand(claw, Wish(root="base")).urdf == hand.urdf_path.read_text()
    with pytest.raises(BadArgument, match="nowhere"):
        new_hand(claw, Wish(root="nowhere"))


def test_followers_limits_and_drives(claw):
    """A chain of followers, a limit passed by rounding, joints without limits or drives."""
    change(
        claw,
        (
            '<mimic joint="right_bend" multiplier="-0.7" offset="0.1"/>',
            '<mimic joint="left_follow" multiplier="2"/>',
        ),
        ('lower="-0.9" upper="0.5"', 'lower="-0.80997" upper="2.5"'),
        ('name="thumb_swivel" type="revolute"', 'name="thumb_swivel" type="continuous"'),
        ('effort="1.5"', 'effort="0"'),
    )
    text = claw.read_text()
    start = text.index('name="right_follow"')
    claw.write_text(text[:start] + text[start:].replace('lower="-0.80997"', 'lower="-2"', 1))
    hand, told = made(claw)
    for words in (
        "follows a follower",
        "left_bend is limited to [-0.5, 1.29996",
        "thumb_swivel",
        "without effort",
    ):
        assert words in told, words
    joints = random_joints(hand, 5)
    every = hand.expand(joints)
    torch.testing.assert_close(every["right_follow"], 2 * (-0.7 * every["left_bend"] + 0.1))
    assert all(drive.effort > 0 and drive.velocity > 0 for drive in hand.actuators.values())


def test_a_joint_may_follow_one_of_another_finger(claw):
    """A fourth finger's swivel turns the left finger, too: it moves, though its own finger is
    parked.
    """
    start = claw.read_text().index('<link name="left_root">')
    text = claw.read_text()
    left = text[start : text.index('<link name="right_root">')]
    ring = left.replace("left_", "ring_").replace(
        'xyz="-0.045 -0.03 0.015"', 'xyz="-0.045 -0.09 0.015"'
    )
    text = text.replace(END, ring + END)
    old = '<joint name="left_swivel" type="revolute">'
    claw.write_text(
        text.replace(old, old + '<mimic joint="ring_swivel" multiplier="-1" offset="0"/>')
    )
    (claw.parent / "hand.toml").write_text(
        new_hand(
            claw, Wish(tips=("left_tip", "right_tip", "thumb_tip", "ring_tip")), file="claw.urdf"
        ).toml
    )
    hand = check_hand(claw.parent)
    assert "ring_swivel" in hand.joint_names and "ring_bend" not in hand.joint_names
    joints = random_joints(hand, 3)
    for row in joints:
        numeric = torch.autograd.functional.jacobian(lambda q: hand.fingertips(q)[0], row)
        torch.testing.assert_close(hand.jacobian(row), numeric)
    assert hand.jacobian(joints)[:, 0, :, hand.joint_names.index("ring_swivel")].abs().max() > 0.01


def test_fingers_may_slide(claw):
    """A gripper whose fingers slide towards each other."""
    change(claw, ('type="revolute"><parent link="base"', 'type="prismatic"><parent link="base"'))
    change(
        claw,
        ('lower="-0.5" upper="0.5"', 'lower="-0.01" upper="0.02"'),
        ('<axis xyz="0 0 1"/>', '<axis xyz="1 0 0"/>'),
    )
    draft = new_hand(claw)
    (claw.parent / "hand.toml").write_text(draft.toml)
    assert draft.urdf == "" and check_hand(claw.parent).tree.slides


ELSEWHERE = [
    "../secret.stl",
    "/etc/secret.stl",
    "file:///etc/secret.stl",
    "http://localhost/x.stl",
    "package://../secret.stl",
    "package://claw/../../secret.stl",
    "a\\..\\x.stl",
    "x.dae",
    "none.stl",
    "package://",
    "link.stl",
    "folder.stl",
]
WHY = {
    "none.stl": "missing",
    "package://claw/none.stl": "missing",
    "Box.STL": "called box.stl there",
    "x.fbx": "format",
    "package://claw/Box.stl": "called box.stl there",
    "/etc/box.stl": "absolute",
    "file:///box.stl": "address",
    "a\\box.stl": "slashes",
    "../secret.stl": "outside",
    "link.stl": "symbolic link",
    "large.stl": "more than 50 MiB",
}
BROKEN = {
    "empty": (b"", "stl"),
    "words": (b"solid x\nhello\n", "stl"),
    "a lying header": (bytes(80) + (2**31).to_bytes(4, "little") + bytes(100), "stl"),
    "many faces": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + b"f 1 2 3\n" * 500_001, "obj"),
    "not a number": (b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "obj"),
    "a missing corner": (b"v 0 0 0\nf 1 2 3\n", "obj"),
    "many declared": (
        b"ply\nformat ascii 1.0\nelement vertex 3\nelement face 99999999999\nend_header\n",
        "ply",
    ),
    "scaled twice": (trimesh.creation.box((1e-4, 1e-4, 1e-4)).export(file_type="stl"), "stl"),
    "in millimetres": (trimesh.creation.box((9000, 9000, 9000)).export(file_type="stl"), "stl"),
}


@pytest.mark.promise("H2")
@pytest.mark.parametrize("name", [*ELSEWHERE, *BROKEN])
def test_a_mesh_that_is_broken_or_elsewhere_is_refused_by_name(claw, name):
    (claw.parent.parent / "secret.stl").write_bytes(trimesh.creation.box().export(file_type="stl"))
    (claw.parent / "link.stl").symlink_to(claw.parent.parent / "secret.stl")
    (claw.parent / "folder.stl").mkdir()
    data, kind = BROKEN.get(name, (b"", ""))
    (claw.parent / f"tip.{kind}").write_bytes(data)
    change(
        claw, ('<sphere radius="0.011"/>', f'<mesh filename="{f"tip.{kind}" if kind else name}"/>')
    )
    with pytest.raises(HandFileError, match="mesh"):
        new_hand(claw)


def test_a_mesh_that_is_scaled_flat_is_refused(claw):
    trimesh.creation.box((0.02, 0.02, 0.02)).export(claw.parent / "tip.stl")
    change(claw, ('<sphere radius="0.011"/>', '<mesh filename="tip.stl" scale="1 1 0"/>'))
    with pytest.raises(HandFileError, match=r"not 0 on any axis, got .* the scale 1 1 0"):
        new_hand(claw)


@pytest.mark.parametrize("name", WHY)
def test_a_refused_mesh_says_why(claw, name):
    box = trimesh.creation.box().export(file_type="stl")
    for file in (claw.parent / "box.stl", claw.parent.parent / "secret.stl"):
        file.write_bytes(box)
    (claw.parent / "link.stl").symlink_to(claw.parent.parent / "secret.stl")
    with (claw.parent / "large.stl").open("wb") as file:
        file.truncate(51 * 2**20)
    change(claw, ('<sphere radius="0.011"/>', f'<mesh filename="{name}"/>'))
    with pytest.raises(HandFileError, match=f"mesh .*{WHY[name]}|{WHY[name]}.*mesh"):
        new_hand(claw)


def test_too_many_bytes_of_meshes_are_refused(claw, monkeypatch):
    monkeypatch.setattr(sys.modules["torchgrasp.app.author.fit_shapes"], "HAND_MESH_BYTES", 1000)
    with pytest.raises(HandFileError, match="in all"):
        new_hand(mesh_claw(claw))


def test_what_a_mesh_names_is_not_opened(claw, tmp_path):
    """Materials and textures of an .obj are files of anybody's choice."""
    tip = "mtllib ../../secret.mtl\nusemtl x\n" + trimesh.creation.icosphere(3, 0.011).export(
        file_type="obj"
    )
    (claw.parent / "tip.obj").write_text(tip)
    (tmp_path / "secret.mtl").write_text("newmtl x\nmap_Kd /etc/passwd\n")
    change(claw, ('<sphere radius="0.011"/>', '<mesh filename="tip.obj"/>'))
    opened = []
    sys.addaudithook(
        lambda event, arguments: opened.append(str(arguments[0])) if event == "open" else None
    )
    new_hand(claw)
    assert not [path for path in opened if "secret" in path or "passwd" in path]


def test_a_mimic_in_a_circle_and_too_many_shapes_are_refused(claw):
    good = claw.read_text()
    claw.write_text(
        good.replace('joint="left_bend"', 'joint="right_follow"').replace(
            'joint="right_bend"', 'joint="left_follow"'
        )
    )
    with pytest.raises(HandFileError, match="circle"):
        new_hand(claw)
    ball = '<collision><geometry><sphere radius="0.01"/></geometry></collision>'
    claw.write_text(good.replace('<link name="base">', '<link name="base">' + ball * 1001))
    with pytest.raises(HandFileError, match="1000"):
        new_hand(claw)


def test_the_clean_copy_reads_as_the_same_values(claw):
    (claw.parent / "far.stl").write_bytes(
        trimesh.creation.box((0.014, 0.018, 0.04)).export(file_type="stl")
    )
    change(claw, ('<box size="0.014 0.018 0.04"/>', '<mesh filename="far.stl"/>'))
    first = new_hand(claw)
    (claw.parent / "hand.urdf").write_text(first.urdf)
    again = new_hand(claw.parent / "hand.urdf")
    assert again.urdf == "" and again.repairs == () and again.toml == first.toml
    assert read_published(claw).joints == read_urdf(claw.parent / "hand.urdf").joints
