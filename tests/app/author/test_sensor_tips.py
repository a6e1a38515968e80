"""Sensor tips: fingertips move by exactly the offset, and their shapes grow with them."""

import numpy as np
import pytest
import torch
import trimesh

from torchgrasp.app.author import Wish, new_hand
from torchgrasp.app.author.pads import Guess
from torchgrasp.app.author.sensor_tips import add_seen_sensors, extend_pads, find_sensors
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply
from torchgrasp.hand.hand_toml import Pad
from torchgrasp.hand.load import hands_folder
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.testing import check_hand, random_joints

pytestmark = pytest.mark.usefixtures("few_draws")

TIPS = ("left_tip", "right_tip", "thumb_tip")


def drafted(urdf, folder, **wish):
    """Write the draft of a hand with sensor tips to a folder, and return the hand, checked."""
    folder.mkdir()
    draft = new_hand(urdf, Wish(**wish), file="hand.urdf")
    (folder / "hand.toml").write_text(draft.toml)
    if not draft.urdf:
        (folder / urdf.name).write_bytes(urdf.read_bytes())
    else:
        (folder / "hand.urdf").write_text(draft.urdf)
    return check_hand(folder), draft


def test_fingertips_move_by_exactly_the_offset_along_the_finger(claw, tmp_path):
    """The claw's fingers end straight up, along z of their tips, across the axis y of the joint."""
    offsets = (0.02, 0.0, 0.035)
    before, plain = drafted(claw, tmp_path / "before", tips=TIPS)
    after, draft = drafted(claw, tmp_path / "after", tips=TIPS, tip_offset=offsets)
    joints = random_joints(before, 50)
    points, normals = before.fingertips(joints)
    moved, same = after.fingertips(joints)
    torch.testing.assert_close(same, normals, rtol=0, atol=1e-12)
    poses = before.link_poses(joints)[:, before.tips.index]  # (n, f, 4, 4)
    ahead = torch.tensor(offsets, dtype=torch.float64)[:, None] * poses[..., :3, 2]
    torch.testing.assert_close(moved, points + ahead, rtol=0, atol=1e-9)
    assert not plain.repairs and "left_tip 20 mm along (0, 0, 1)" in draft.repairs[0]
    assert "right_tip" not in draft.repairs[0]
    assert after.tip_radius.tolist() == [0.011] * 3


def test_the_shape_of_the_tip_grows_with_the_sensor(claw, tmp_path):
    """A ball of the given radius touches the pad from inside, and a cylinder leads to it."""
    hand, _ = drafted(claw, tmp_path / "mine", tip_offset=(0.02,), tip_radius=(0.006,))
    assert hand.tip_radius.tolist() == [0.006] * 3
    shapes = {link.name: link.shapes for link in read_urdf(hand.urdf_path).links}
    for k, link in enumerate(hand.tips.links):
        own, neck, ball = shapes[link]
        assert own.kind == "sphere" and own.size == (0.011,)
        centre = hand.tips.center[k].numpy()
        assert ball.kind == "sphere" and ball.size == (0.006,)
        np.testing.assert_allclose(ball.xyz, centre, atol=1e-6)
        assert neck.kind == "cylinder" and neck.size == (0.006, 0.02)
        np.testing.assert_allclose(neck.xyz, centre - [0.0, 0.0, 0.01], atol=1e-6)
        contact = centre + 0.006 * hand.tips.normal[k].numpy()
        np.testing.assert_allclose(hand.tips.contact[k].numpy(), contact, atol=1e-9)
    # what tells of collisions covers the ball, too
    cover = hand.collision_spheres
    mine = cover.link_index == hand.tips.index[0]
    reach = (cover.center[mine, 2] + cover.radius[mine]).max()
    assert float(reach) >= float(hand.tips.center[0, 2]) + 0.006 - 1e-3


def test_a_turned_cylinder_leads_from_the_old_ball_to_the_new_one(tmp_path):
    """The allegro's tips are balls on links that joints turn: the neck is along the offset."""
    urdf = hands_folder() / "allegro" / "hand.urdf"
    tips = ("index_tip", "middle_tip", "thumb_tip")
    before, _ = drafted(urdf, tmp_path / "before", tips=tips)
    after, _ = drafted(urdf, tmp_path / "after", tips=tips, tip_offset=(0.015,))
    shapes = {link.name: link.shapes for link in read_urdf(after.urdf_path).links}
    for k, link in enumerate(after.tips.links):
        way = (after.tips.contact[k] - before.tips.contact[k]).numpy()
        assert np.linalg.norm(way) == pytest.approx(0.015, abs=1e-12)
        neck, ball = shapes[link][-2:]
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = _turn(neck.rpy)
        pose[:3, 3] = torch.tensor(neck.xyz, dtype=torch.float64)
        ends = apply(pose, torch.tensor([[0, 0, -0.0075], [0, 0, 0.0075]], dtype=torch.float64))
        np.testing.assert_allclose(ends[1].numpy(), ball.xyz, atol=3e-6)
        np.testing.assert_allclose((ends[1] - ends[0]).numpy(), way, atol=3e-6)


def _turn(rpy):
    """Rotation about the fixed axes x, y, z, from its definition."""
    turn = np.eye(3)
    for angle, (one, two) in zip(rpy, ((1, 2), (2, 0), (0, 1)), strict=True):
        step = np.eye(3)
        step[one, one] = step[two, two] = np.cos(angle)
        step[two, one] = np.sin(angle)
        step[one, two] = -np.sin(angle)
        turn = step @ turn
    return torch.from_numpy(turn)


def test_the_drawn_sensor_is_closed_however_thin_it_is():
    """A capsule of 1 to 40 mm across lies between the old contact and the new one, with no hole."""
    before = Pad((0.0, 0.0, 0.03), (0.0, 0.0, 1.0), (0.0, 0.0, 0.02), 0.01)
    guess = Guess((before,), (np.array([0.0, 0.0, 1.0]),), (0.0, 0.0, 1.0))
    empty = np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    for radius in (0.0005, 0.001, 0.02):
        (pad,) = extend_pads(["tip"], guess, (0.01,), (radius,), named=True)
        sensors = find_sensors(["tip"], guess, [pad])
        vertices, faces = add_seen_sensors({"tip": empty}, sensors)["tip"]
        drawn = trimesh.Trimesh(vertices, faces, process=False)
        assert drawn.is_volume
        bounds = [-radius, -radius, 0.03 - 2 * radius], [radius, radius, 0.04]
        np.testing.assert_allclose(drawn.bounds, bounds, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("wish", "words"),
    [
        ({"tip_offset": (0.02, 0.03)}, "tip_offset: .*one number, or with --tips"),
        ({"tip_offset": (0.01, 0.02), "tips": TIPS}, "2 numbers for 3 tips"),
        ({"tip_offset": (-0.01,)}, "tip_offset: .*0 to 0.1 m"),
        ({"tip_offset": (float("nan"),)}, "tip_offset"),
        ({"tip_offset": (0.02,), "tip_radius": (0.5,)}, "tip_radius: .*0.0001 to 0.1 m"),
        ({"tip_radius": (0.01,)}, "--tip-offset beside it"),
    ],
)
def test_a_wrong_sensor_tip_is_refused(claw, wish, words):
    with pytest.raises(BadArgument, match=words):
        new_hand(claw, Wish(**wish))


def test_a_flat_tip_needs_a_radius(claw, tmp_path):
    text = claw.read_text().replace('<sphere radius="0.011"/>', '<box size="0.02 0.018 0.03"/>')
    claw.write_text(text)
    with pytest.raises(BadArgument, match=r"tip_radius: .*left_tip, which is flat"):
        new_hand(claw, Wish(tip_offset=(0.02,)))
    hand, _ = drafted(claw, tmp_path / "mine", tip_offset=(0.02,), tip_radius=(0.008,))
    # the pad's side of the box, 10 mm from its middle, and 20 mm farther out
    assert float(hand.tips.contact[0, 0]) == pytest.approx(0.01)
    assert hand.tip_radius.tolist() == [0.008] * 3
