"""Abilities of hands whose spans and forces are known by hand: sliding jaws, and levers."""

import json
import math

import pytest
import torch

from tests.make import load_hand
from torchgrasp.app.cli.hands import describe_abilities
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.hand import hand_abilities
from torchgrasp.hand.load import load_hand as read_hand

EFFORT = 20.0  # of the jaws [N]
RADIUS = 0.005  # of all tips [m]
LEVER = 0.05  # of the third finger [m]
TORQUE = 0.4  # of the third finger [N m]
OPEN = 0.04  # farthest of a jaw from the middle [m]
SHUT = 0.01  # nearest

BODY = (
    '<inertial><mass value="0.1"/><inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" '
    'izz="1e-4"/></inertial>'
)


def shape(geometry, xyz="0 0 0"):
    return f'<collision><origin xyz="{xyz}"/><geometry>{geometry}</geometry></collision>'


@pytest.fixture(scope="module")
def gripper(tmp_path_factory):
    """Two balls slide along x, 50 mm above a plate, 10 to 40 mm either side of the middle; each
    pad faces the other. A third ball swings below, far off, on a lever.
    """
    folder = tmp_path_factory.mktemp("gripper")
    ball = shape(f'<sphere radius="{RADIUS}"/>')
    plate = shape('<box size="0.05 0.05 0.01"/>', "0 0 -0.05")
    links = f'<link name="palm">{BODY}{plate}</link>'
    links += "".join(f'<link name="{name}">{BODY}{ball}</link>' for name in ("left", "right"))
    links += f'<link name="third">{BODY}{shape(f"""<sphere radius="{RADIUS}"/>""", f"{LEVER} 0 0")}</link>'
    rows = [
        ("slide_left", "prismatic", "left", "0 0 0", "-1 0 0", SHUT, OPEN, EFFORT),
        ("slide_right", "prismatic", "right", "0 0 0", "1 0 0", SHUT, OPEN, EFFORT),
        ("swing", "revolute", "third", "0 0.2 0", "0 0 1", -0.5, 0.5, TORQUE),
    ]
    joints = "".join(
        f'<joint name="{name}" type="{kind}"><parent link="palm"/><child link="{child}"/>'
        f'<origin xyz="{xyz}"/><axis xyz="{axis}"/>'
        f'<limit lower="{low}" upper="{high}" effort="{most}" velocity="1"/></joint>'
        for name, kind, child, xyz, axis, low, high, most in rows
    )
    pads = [
        ("left", "slide_left", [RADIUS, 0, 0], [1, 0, 0], [0, 0, 0]),
        ("right", "slide_right", [-RADIUS, 0, 0], [-1, 0, 0], [0, 0, 0]),
        ("third", "swing", [LEVER, -RADIUS, 0], [0, -1, 0], [LEVER, 0, 0]),
    ]
    fingers = "".join(
        f'\n[[finger]]\nname = "{name}"\njoints = ["{joint}"]\ntip_link = "{name}"\n'
        f"contact = {contact}\nnormal = {normal}\n"
        f'tip = "sphere"\ncenter = {center}\nradius = {RADIUS}\n'
        for name, joint, contact, normal, center in pads
    )
    (folder / "hand.urdf").write_text(f'<robot name="gripper">{links}{joints}</robot>')
    (folder / "hand.toml").write_text(
        'name = "gripper"\nurdf = "hand.urdf"\nbase_link = "palm"\napproach = [0, 0, 1]\n'
        "limit_margin = 0.0\n[actuators]\nkp = 1.0\nkd = 0.1\n[options.default]\n"
        'fingers = ["left", "right", "third"]\n'
        + fingers
        + '[self_collision]\npairs = [["left", "right"]]\n'
    )
    return folder


def test_a_gripper_of_balls_has_the_span_width_and_force_of_its_drawing(gripper):
    able = hand_abilities(read_hand(gripper))
    assert able.free == 1.0 and able.joints == 3
    jaws = able.pairs[0]
    assert jaws.fingers == ("left", "right") and jaws.opposed == 1.0
    # contacts look at each other: they are two radii nearer than the balls' centres, as a plate is
    nearest = 2 * (SHUT - RADIUS)
    farthest = 2 * (OPEN - RADIUS)
    for least, greatest in (
        (jaws.least_span, jaws.greatest_span),
        (jaws.least_width, jaws.greatest_width),
        (able.least_width, able.greatest_width),
    ):
        assert nearest <= least < nearest + 0.002
        assert farthest - 0.002 < greatest <= farthest
    left, right, third = able.fingers
    assert [left.force, left.sure_force, right.force] == pytest.approx([EFFORT] * 3)
    # a lever's force is its torque over its arm, in every posture
    assert [third.force, third.sure_force] == pytest.approx([TORQUE / LEVER] * 2)
    assert (left.joints, third.joints) == (1, 1)


def test_tips_that_never_face_each_other_hold_nothing(gripper):
    far = hand_abilities(read_hand(gripper)).pairs[1]
    assert far.fingers == ("left", "third") and far.opposed == 0.0
    assert math.isnan(far.least_width) and math.isnan(far.greatest_width)
    # the distance of two points that move on a line and on an arc, in the grid of all postures
    place = torch.linspace(SHUT, OPEN, 200)
    angle = torch.linspace(-0.5, 0.5, 200)
    x = LEVER * angle.cos() + RADIUS * angle.sin()
    y = 0.2 + LEVER * angle.sin() - RADIUS * angle.cos()
    grid = torch.hypot(x[None] + place[:, None] - RADIUS, y[None])
    assert far.least_span == pytest.approx(float(grid.min()), abs=0.002)
    assert far.greatest_span == pytest.approx(float(grid.max()), abs=0.002)


def test_jaws_that_overlap_are_not_free(gripper, tmp_path):
    """Balls overlap where the sum of their distances from the middle is below one diameter."""
    text = (gripper / "hand.urdf").read_text().replace(f'lower="{SHUT}"', 'lower="0.0"')
    (tmp_path / "hand.urdf").write_text(text)
    (tmp_path / "hand.toml").write_text((gripper / "hand.toml").read_text())
    able = hand_abilities(read_hand(tmp_path))
    # the sum of two uniform places is below 2 r in a triangle of the square
    share = (2 * RADIUS) ** 2 / 2 / OPEN**2
    assert able.free == pytest.approx(1 - share, abs=0.01)
    # nothing thinner than a gap of the free postures is held
    assert 0.0 < able.pairs[0].least_width < 0.002


def test_a_joint_of_unknown_effort_leaves_the_forces_of_other_fingers(gripper, tmp_path):
    """A URDF without an effort has the effort 0: no force is known, which differs from no force."""
    text = (gripper / "hand.urdf").read_text().replace(f'effort="{TORQUE}"', 'effort="0"')
    (tmp_path / "hand.urdf").write_text(text)
    (tmp_path / "hand.toml").write_text((gripper / "hand.toml").read_text())
    able = hand_abilities(read_hand(tmp_path))
    for forces in ([x.force for x in able.fingers], [x.sure_force for x in able.fingers]):
        assert forces == pytest.approx([EFFORT, EFFORT, math.nan], nan_ok=True)
    assert able.content()["fingers"][2]["force_n"] is None
    table = describe_abilities(able).splitlines()
    assert table[4].split()[2:] == ["-", "-"]


def test_forces_are_those_of_the_principle_of_virtual_work():
    """Each joint of the Allegro at its own effort moves the contact: the weakest one bounds it."""
    hand = load_hand("allegro")
    able = hand_abilities(hand, postures=300, seed=3)
    share = torch.rand(
        300, hand.dof, generator=torch.Generator().manual_seed(3), dtype=torch.float64
    )
    joints = hand.lower + (hand.upper - hand.lower) * share
    joints = joints[hand.self_clearance(joints) > 0]
    _, normals = hand.fingertips(joints)
    step = 1e-6
    forces = []
    for k, name in enumerate(hand.joint_names):
        moved = joints.clone()
        moved[:, k] += step
        before = joints.clone()
        before[:, k] -= step
        way = (hand.fingertips(moved)[0] - hand.fingertips(before)[0]) / (2 * step)
        forces.append(hand.actuators[name].effort / (way * normals).sum(-1).abs())
    force = torch.stack(forces).amin(0)  # (n, f)
    for k, finger in enumerate(able.fingers):
        assert finger.force == pytest.approx(float(force[:, k].median()), rel=0.02)
        assert float((force[:, k] >= finger.sure_force - 1e-6).double().mean()) >= 0.89
    assert able.free == pytest.approx(len(joints) / 300)


def test_the_same_seed_gives_the_same_abilities_and_json_has_units(gripper):
    first = hand_abilities(read_hand(gripper), 200, 1)
    assert first == hand_abilities(read_hand(gripper), 200, 1)
    assert first != hand_abilities(read_hand(gripper), 200, 2)
    content = json.loads(json.dumps(first.content()))
    assert content["pairs"][1]["width_m"] == [None, None]
    assert content["fingers"][0]["force_n"] == EFFORT and content["free_share"] == 1.0


def test_a_hand_without_a_free_posture_is_refused(gripper, tmp_path):
    text = (gripper / "hand.urdf").read_text()
    text = text.replace(f'lower="{SHUT}"', 'lower="0.0"').replace(
        f'upper="{OPEN}"', 'upper="0.001"'
    )
    (tmp_path / "hand.urdf").write_text(text)
    (tmp_path / "hand.toml").write_text((gripper / "hand.toml").read_text())
    with pytest.raises(BadArgument, match="meet in all of 100 random postures"):
        hand_abilities(read_hand(tmp_path), 100)
