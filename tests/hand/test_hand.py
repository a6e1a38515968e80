"""The hand as a value: kinematics against yourdfpy, derivatives against finite differences, facts
of the two hands.
"""

import copy
import dataclasses
import math

import pytest
import torch

from tests.make import near, real
from torchgrasp import Hand, load_hand, sample_configurations
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import rotation_from_rpy
from torchgrasp.hand import hand_abilities
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.testing import largest_fk_error, random_joints

HANDS = [
    ("allegro", "default"),
    ("allegro", "paper_literal"),
    ("allegro", "four"),
    ("barrett", "default"),
]
HANDS += [("leap", "default"), ("shadow", "default")]


@pytest.fixture(params=HANDS, ids=["-".join(h) for h in HANDS])
def hand(request) -> Hand:
    return load_hand(*request.param)


@pytest.mark.promise("N13", "N8")
def test_fk_equals_yourdfpy_coupled_joints_included_and_float32_within_a_micrometre(hand):
    error, link = largest_fk_error(hand, random_joints(hand, 200))
    assert error < 1e-6, link
    joints = random_joints(hand, 500)
    points, normals = hand.fingertips(joints)
    points32, normals32 = hand.fingertips(joints.float())
    assert points32.dtype == torch.float32
    near(points32.double(), points, 1e-6)
    near(normals32.double(), normals, 2e-6)


@pytest.mark.parametrize("given", [False, True], ids=["pads", "given points"])
def test_jacobian_equals_finite_differences_of_points_fixed_to_the_tips(hand, given):
    joints = random_joints(hand, 20).reshape(4, 5, hand.dof)
    steps = 1e-5 * torch.eye(hand.dof, dtype=torch.float64)

    def carried(joints):
        if not given:
            return hand.fingertips(joints)[0]
        poses = hand.link_poses(joints)[..., hand.tips.index, :, :]
        local = hand.tips.center + 0.01
        return (poses[..., :3, :3] @ local[..., None])[..., 0] + poses[..., :3, 3]

    jacobian = hand.jacobian(joints, carried(joints) if given else None)
    for j, step in enumerate(steps):
        difference = (carried(joints + step) - carried(joints - step)) / 2e-5
        torch.testing.assert_close(jacobian[..., j], difference, atol=1e-7, rtol=1e-6)


def test_joint_axes_and_origins_give_the_derivative_of_any_point_of_a_link(hand):
    joints = random_joints(hand, 1)[0]
    spheres = hand.collision_spheres
    axes, origins = hand.tree.joint_axes(hand.link_poses(joints))
    arms = hand.sphere_centres(joints)[:, None] - origins
    velocities = (
        torch.linalg.cross(axes.expand_as(arms), arms)
        * hand.tree.moves[spheres.link_index][..., None]
    )
    derivative = torch.einsum("sjx,jh->sxh", velocities, hand.actuated.coupling)
    truth = torch.autograd.functional.jacobian(hand.sphere_centres, joints)
    torch.testing.assert_close(derivative, truth, atol=2e-8, rtol=1e-6)


@pytest.mark.promise("N9")
def test_batch_equals_singles_and_keeps_its_shape(hand):
    joints = random_joints(hand, 6).reshape(2, 3, hand.dof)
    points, normals = hand.fingertips(joints)
    assert points.shape == normals.shape == (2, 3, len(hand.finger_names), 3)
    assert hand.jacobian(joints).shape == (2, 3, len(hand.finger_names), 3, hand.dof)
    assert hand.self_clearance(joints).shape == (2, 3)
    near(points[1, 2], hand.fingertips(joints[1, 2])[0], 1e-12)
    torch.testing.assert_close(hand.self_clearance(joints)[1, 2], hand.self_clearance(joints[1, 2]))
    empty = joints[:0]
    assert hand.fingertips(empty)[0].shape == (0, 3, len(hand.finger_names), 3)
    assert hand.self_clearance(empty).shape == (0, 3)


def test_contact_lies_on_the_tips_sphere_along_the_normal_and_touching_spheres_are_tips(hand):
    joints = random_joints(hand, 50)
    points, normals = hand.fingertips(joints)
    radius = hand.tips.radius[:, None]
    torch.testing.assert_close(
        torch.linalg.vector_norm(normals, dim=-1),
        torch.ones(50, len(hand.finger_names), dtype=torch.float64),
    )
    near(hand.tip_centres(joints) + radius * normals, points, 1e-8)
    cover = hand.collision_spheres
    assert sorted(set(cover.link_index[cover.touching].tolist())) == sorted(
        hand.tips.index.tolist()
    )
    parked = (
        {-2} if bool((hand.actuated.coupling == 0).all(1).any()) else set()
    )  # a joint that nothing moves
    assert set(cover.finger.tolist()) == {-1, *range(len(hand.finger_names))} | parked


def test_expand_names_every_joint_and_couples_exactly():
    hand = load_hand("barrett")
    joints = real([1.0, 0.3, 0.6, 0.9])
    q = hand.expand(joints)
    assert set(q) == set(hand.tree.joint_names)
    assert len(q) == 8
    assert q["spread_mimic"] == q["spread"] == 1.0
    for k, value in enumerate((0.1, 0.2, 0.3), start=1):
        assert float(q[f"f{k}_distal"]) == pytest.approx(value, abs=1e-15)
    allegro = load_hand("allegro").expand(torch.zeros(12))
    assert float(allegro["joint_9"]) == pytest.approx(-0.196)  # the ring finger is parked


def test_barrett_is_the_published_hand_and_symmetric_left_to_right():
    hand = load_hand("barrett")
    poses = dict(
        zip(hand.tree.link_names, hand.link_poses(torch.zeros(4, dtype=torch.float64)), strict=True)
    )
    expected = {
        "f1_dist": (-25.0, -119.94, 78.4),
        "f2_dist": (25.0, -119.94, 78.4),
        "f3_dist": (0.0, 119.94, 78.4),
    }
    for link, mm in expected.items():
        near(poses[link][:3, 3] * 1e3, torch.tensor(mm).double(), 1e-3)
    # spread by half a turn brings fingers 1 and 2 to the side of finger 3
    joints = real([math.pi, 0.5, 0.5, 0.5])
    points, _ = hand.fingertips(joints)
    assert bool((points[:, 1] > 0.05).all())
    near(points[0, 1:], points[2, 1:], 1e-6)
    joints = random_joints(hand, 20)
    mirrored = joints[:, [0, 2, 1, 3]]
    flip = real([-1.0, 1, 1])
    middle = real([0.0, 0, 0.0006])  # the fingers' middle plane is 0.6 mm off their axis
    points, others = (hand.fingertips(q)[0] for q in (joints, mirrored))
    near(points[:, 2], others[:, 2] * flip, 2 * middle.norm().item() + 1e-6)
    near(points[:, 0], others[:, 1] * flip, 2 * middle.norm().item() + 1e-6)


def test_allegro_thumb_opposes_the_fingers():
    hand = load_hand("allegro")
    joints = random_joints(hand, 500)
    joints = joints[hand.self_clearance(joints) > 0]
    _, normals = hand.fingertips(joints)
    cosines = (normals[:, :2] * normals[:, 2:]).sum(-1)
    assert float((cosines < -0.5).any(1).double().mean()) > 0.5
    extended, _ = hand.fingertips(torch.zeros(12, dtype=torch.float64))
    near(extended[0, 1] - extended[1, 1], torch.tensor(0.0435 + 0.0126).double(), 2e-3)


def test_spheres_cover_the_collision_shapes(hand):
    cover = hand.collision_spheres
    generator = torch.Generator().manual_seed(0)
    for index, link in enumerate(read_urdf(hand.urdf_path).links):
        for shape in link.shapes:
            if shape.kind != "box":
                continue
            half = real(shape.size) / 2
            points = (2 * torch.rand(500, 3, generator=generator, dtype=torch.float64) - 1) * half
            side = torch.randint(3, (500,), generator=generator)
            points[torch.arange(500), side] = half[side]  # on the faces
            points = points @ rotation_from_rpy(shape.rpy).T + real(shape.xyz)
            mine = cover.link_index == index
            gap = (torch.cdist(points, cover.center[mine]) - cover.radius[mine]).amin(1)
            of_palm = bool((cover.finger[mine] == -1).all())
            assert float(gap.max()) < (0.009 if of_palm else 0.004), link.name


@pytest.mark.promise("I13")
def test_joints_outside_the_limits_are_named():
    hand = load_hand("allegro")
    joints = torch.zeros(2, 12)
    joints[:, 8:] = 0.3
    assert hand.check_joints(joints) is joints
    joints[1, 9] = 2.0
    with pytest.raises(BadArgument, match=r"1\.163.*joint_13"):
        hand.check_joints(joints)
    joints[1, 9] = torch.nan
    with pytest.raises(BadArgument, match=r"joints: expected .*got nan at index \[1, 9\]"):
        hand.check_joints(joints)
    with pytest.raises(BadArgument, match="12 joints"):
        hand.fingertips(torch.zeros(2, 16))
    for method in (hand.fingertips, hand.jacobian, hand.self_clearance, hand.expand):
        with pytest.raises(BadArgument, match=r"joints: expected .*got nan at index \[1, 9\]"):
            method(joints)


def test_tactile_fingertips_reach_23_mm_farther_and_change_nothing_else():
    """Reach from the last joint with NVIDIA's model of the sensors: 61.8 mm, thumb 77.4 mm; stock
    38.7 and 54.3 mm.
    """
    stock = load_hand("allegro")
    tactile = load_hand("allegro_biotac")
    reach = []
    for hand in (stock, tactile):
        poses = hand.link_poses(torch.zeros(hand.dof, dtype=torch.float64))
        tips = torch.linalg.inv(
            poses[[hand.tree.link_names.index(f"{f}_distal") for f in hand.tips.names]]
        )
        centres = (tips @ poses[hand.tips.index])[:, :3, 3]
        reach.append(centres[:, 2] + hand.tips.radius)
    near(reach[0], torch.tensor([0.0387, 0.0387, 0.0543]).double(), 1e-6)
    near(reach[1], torch.tensor([0.0618, 0.0618, 0.0774]).double(), 2e-4)
    same = [name for name in stock.tree.link_names if not name.endswith("tip")]
    joints = 0.5 * (stock.lower + stock.upper)
    for name in same:
        found = [
            hand.link_poses(joints)[hand.tree.link_names.index(name)] for hand in (stock, tactile)
        ]
        torch.testing.assert_close(*found, rtol=0, atol=1e-12)


def test_a_hand_that_was_changed_in_place_is_refused_and_a_replaced_one_is_taken():
    """A limit that was narrowed in place would reach some functions, and not what they cached."""
    hand = load_hand("barrett")
    middle = (hand.lower + hand.upper) / 2
    opened = hand.lower  # no copy, although it looks like one
    opened[0] += 0.1
    calls = [hand.fingertips, hand.jacobian, hand.self_clearance, hand.check_joints, hand.expand]
    for call in calls:
        with pytest.raises(BadArgument, match="changed in place"):
            call(middle)
    with pytest.raises(BadArgument, match="make another"):
        hand_abilities(hand, postures=100)
    other = load_hand("barrett")
    upper = other.upper.clone()
    upper[0] = 0.5
    narrow = dataclasses.replace(other, actuated=dataclasses.replace(other.actuated, upper=upper))
    near(narrow.fingertips(middle)[0], other.fingertips(middle)[0], 0)
    assert float(sample_configurations(narrow, 50).joints[:, 0].max()) <= 0.5
    for copied in (copy.copy(narrow), copy.deepcopy(narrow), narrow.to("cpu")):
        assert copied == narrow
        near(copied.fingertips(middle)[0], other.fingertips(middle)[0], 0)
