"""The shipped hands: tips where public descriptions place them, left hands as mirror images, all
colliding pairs.
"""

import re

import pytest
import torch

from tests.make import near, real
from tests.pinch import QUICK
from torchgrasp import ContactSpec, close_hand, load_object, plan_grasps
from torchgrasp.hand.collision_shapes import collision_pairs
from torchgrasp.hand.hand_toml import read_hand_toml
from torchgrasp.hand.load import hands_folder, load_hand
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.testing import check_hand, random_joints

README = (hands_folder() / "README.md").read_text("utf-8")
SHIPPED = sorted(path.parent.name for path in hands_folder().glob("*/hand.toml"))
FINGERS = ("index", "middle", "ring", "little", "thumb")
PLACES = re.findall(r"^\| (\w+) \| (0\.\d) ((?:\| [-0-9. ]+ ){5})\|$", README, re.MULTILINE)
"""Hand, share of every joint's range, and where its fingertips' balls are [mm] by the public
descriptions.
"""


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_hands_obey_the_law(name):
    assert check_hand(name).name == name
    assert f"`{name}`" in README  # where its numbers come from, and how to drive it


@pytest.mark.promise("H6")
@pytest.mark.parametrize(
    ("name", "share", "cells"), PLACES, ids=[f"{name}-{share}" for name, share, _ in PLACES]
)
def test_tips_lie_where_public_descriptions_place_them(name, share, cells):
    import yourdfpy

    folder = hands_folder() / name
    robot = yourdfpy.URDF.load(
        str(folder / "hand.urdf"), load_meshes=False, load_collision_meshes=False
    )
    limits = [joint.limit for joint in robot.actuated_joints]
    robot.update_cfg([limit.lower + float(share) * (limit.upper - limit.lower) for limit in limits])
    links = {
        finger.name: finger.tip_link for finger in read_hand_toml(folder / "hand.toml").all_fingers
    }
    found = dict(zip(FINGERS, [cell.split() for cell in cells.split("|")[1:]], strict=True))
    assert {finger for finger, words in found.items() if len(words) == 3} == set(links)
    for finger, link in links.items():
        there = [float(word) for word in found[finger]]
        assert robot.get_transform(link)[:3, 3] * 1e3 == pytest.approx(there, abs=1e-3)


def test_public_descriptions_have_places_and_the_shadow_hands_tendons_move_distal_joints():
    assert {name for name, _, _ in PLACES} >= {
        "leap",
        "leap_left",
        "shadow",
        "shadow_left",
        "allegro_left",
    }
    hand = load_hand("shadow")
    joints = hand.expand(random_joints(hand, 20))
    for finger in ("FF", "MF"):
        torch.testing.assert_close(joints[f"{finger}J1"], joints[f"{finger}J2"])
    assert hand.dof == 11


@pytest.mark.parametrize(
    ("names", "axis", "kept"),
    [
        (("shadow", "shadow_left"), 0, ()),
        (("allegro", "allegro_left"), 1, ("joint_0", "joint_4", "joint_8")),
    ],
)
def test_a_left_hand_is_the_mirror_image(names, axis, kept):
    """The `kept` joints turn about the same axis on both sides."""
    right, left = (load_hand(name) for name in names)
    joints = random_joints(right, 50)
    flip = torch.ones(3, dtype=torch.float64)
    flip[axis] = -1
    turned = real([-1.0 if name in kept else 1.0 for name in right.joint_names])
    for mine, other in zip(left.fingertips(joints * turned), right.fingertips(joints), strict=True):
        near(mine, other * flip, 1e-9)
    near(left.self_clearance(joints * turned), right.self_clearance(joints), 1e-8)
    torch.testing.assert_close(left.approach, right.approach * flip)
    masses = [
        [(x.mass, *x.inertia[::3]) for x in read_urdf(hand.urdf_path).links]
        for hand in (left, right)
    ]
    assert masses[0] == masses[1]
    assert left.check_joints(joints * turned) is not None


@pytest.mark.promise("H6")
@pytest.mark.parametrize("name", ["leap", "shadow"])
def test_the_pairs_of_links_that_can_meet_are_in_the_file(name):
    folder = hands_folder() / name
    pairs = read_hand_toml(folder / "hand.toml").pairs
    urdf = read_urdf(folder / "hand.urdf")
    coupling = {j.name: j.mimic for j in urdf.movable if j.mimic is not None}
    assert set(collision_pairs(urdf, coupling, n=200, seed=1)) <= {
        *pairs,
        *(pair[::-1] for pair in pairs),
    }


@pytest.mark.sim
@pytest.mark.parametrize("name", ["shadow", "allegro_left"])
def test_a_planned_grasp_holds_the_cylinder(name, few_postures):
    pytest.importorskip("sapien")
    hand = load_hand(name)
    thing = load_object("cylinder")
    best = plan_grasps(thing.view, hand, ContactSpec(table=0.0), starts=8)[0]
    assert close_hand(best, hand, thing.mesh, QUICK, parts=thing.parts).status == 0
