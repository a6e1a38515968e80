"""The way of the arm through a grasp: straight, steady, within limits, clear of table, objects and
itself.
"""

import dataclasses

import pytest
import torch
import yaml

from tests.arm.ur5e import ur5e, ur5e_urdf
from tests.make import distance_field, random_motion, real
from torchgrasp import ContactSpec, Plane, Status, load_object, plan_grasps
from torchgrasp.arm.reach import follow_grasps, way_of
from torchgrasp.export import format_motion, plan_motion
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.plane import move
from torchgrasp.ik import CollisionWorld

TABLE = CollisionWorld(table=Plane.horizontal(0.0))


@pytest.fixture(scope="module")
def good(grasps):
    return grasps.executable


def test_the_planner_returns_grasps_that_the_arm_reaches(arm, grasps, good):
    assert len(good) > 10 and torch.equal(good.status, grasps.status[: len(good)])
    assert torch.allclose(arm.hand_poses(good.arm), good.obj_from_hand, atol=2e-4)
    assert bool((good.ease > 0).all()) and bool((grasps.arm[len(good) :] == 0).all())
    percents = (100 * good.success).round().tolist()
    keys = list(zip(percents, good.ease.prod(1).tolist(), strict=True))
    assert keys == sorted(keys, reverse=True) and len(set(percents)) < len(percents)


def test_a_way_is_straight_steady_and_within_limits(arm, hand, good):
    way, found, ease = follow_grasps(arm, hand, good, TABLE)
    assert bool(found.all())
    wanted = way_of(hand, good, TABLE)
    assert torch.allclose(arm.hand_poses(way.flatten(0, 1)).view_as(wanted), wanted, atol=2e-4)
    begins = good.obj_from_hand[:, :3, 3] - 0.1 * good.approach
    assert torch.allclose(wanted[:, 0, :2, 3], begins[:, :2]) and torch.allclose(
        wanted[:, -1, :3, 3], good.obj_from_hand[:, :3, 3] + real([0, 0, 0.1])
    )
    assert bool(((way >= arm.lower) & (way <= arm.upper)).all())
    assert (way[:, 1:] - way[:, :-1]).abs().max() <= torch.pi * 0.0125 / 0.1
    room = torch.minimum(way - arm.lower, arm.upper - way) / ((arm.upper - arm.lower) / 2)
    assert torch.allclose(room.flatten(1).amin(1), ease[:, 0])


def test_links_keep_clear_of_table_objects_and_each_other(arm, hand, good):
    """No sphere is below the table; a table at the wrists, or a ball around the forearms, leaves no
    way.
    """
    way, _, _ = follow_grasps(arm, hand, good, TABLE)
    centres = arm.sphere_centres(way.flatten(0, 1).T)
    assert (centres[2, arm.moving] - arm.radius[arm.moving, None]).min() >= 0
    high = CollisionWorld(table=Plane.horizontal(0.75))
    assert not follow_grasps(arm, hand, good, high)[1].any()
    inside = distance_field(
        lambda x: (x - real([-0.3, 0, 0.3])).norm(dim=-1) - 0.4, real([-0.3, 0, 0.3]), 0.6, 0.05
    )
    assert not follow_grasps(arm, hand, good, CollisionWorld(inside))[1].any()
    folded = torch.zeros(6, 1, dtype=torch.float64)
    folded[2] = 3.1  # the forearm beside the upper arm, the wrist at the shoulder
    assert not arm.overlaps(arm.sphere_centres(0 * folded)).any()
    assert arm.overlaps(arm.sphere_centres(folded)).any()


def test_a_base_on_a_rail_stands_on_the_table_and_keeps_clear_of_objects(arm, hand, good):
    rail = """<link name="rail"/><joint name="slide" type="prismatic"><parent link="rail"/><child link="base_link"/>
        <axis xyz="0 1 0"/><limit lower="-0.4" upper="0.4" effort="100" velocity="0.5"/></joint>"""
    sliding = ur5e(
        hand, urdf=ur5e_urdf().replace('<robot name="ur5e">', f'<robot name="ur5e">{rail}')
    )
    way, found, _ = follow_grasps(sliding, hand, good, TABLE)
    assert found.double().mean() > 0.5 and way[found][..., 0].std() > 0.05
    wanted = way_of(hand, good, TABLE)[found]
    assert torch.allclose(
        sliding.hand_poses(way[found].flatten(0, 1)).view_as(wanted), wanted, atol=2e-4
    )
    turned = sliding.link[sliding.moving] > 1
    base = sliding.link[sliding.moving] == 1
    centres = sliding.sphere_centres(way[found].flatten(0, 1).T)
    lowest = centres[2, sliding.moving].amin(1) - sliding.radius[sliding.moving]
    assert lowest[turned].min() >= 0 > lowest[base].min()
    place = real([-0.55, 0, 0])
    beam = distance_field(lambda x: (x - place)[..., ::2].norm(dim=-1) - 0.05, place, 0.7, 0.02)
    world = dataclasses.replace(TABLE, field=beam)  # along the rail, lower than the shoulder
    assert (
        not follow_grasps(sliding, hand, good, world)[1].any()
        and follow_grasps(arm, hand, good, world)[1].all()
    )


def test_an_arm_far_away_reaches_nothing_and_the_planner_says_so(hand):
    plan = {"spec": ContactSpec(table=0.0), "starts": 8, "time_budget": 0.001}
    found = plan_grasps(
        load_object("cylinder").view, hand, arm=ur5e(hand, (-2.0, 0.0, 0.0)), **plan
    )
    assert Status.OK not in found.status
    with pytest.raises(BadArgument, match=r"arm: .*many clouds"):
        plan_grasps([load_object("cylinder").view], hand, arm=ur5e(hand), **plan)


def test_same_seed_same_grasps_in_any_frame(arm, hand, grasps):
    motion = random_motion(7)
    table = Plane.horizontal(0.0)
    again = plan_grasps(
        load_object("cylinder").view, hand, ContactSpec(table=0.0), starts=24, arm=arm
    )
    assert torch.equal(again.arm, grasps.arm) and torch.equal(
        again.obj_from_hand, grasps.obj_from_hand
    )
    view = move(load_object("cylinder").view.to(torch.float64), motion)
    spec = ContactSpec(table=table.moved(motion))
    moved = plan_grasps(view, hand, spec, starts=24, arm=arm.moved(motion))
    assert torch.equal(moved.status, grasps.status) and torch.allclose(
        moved.arm, grasps.arm, atol=1e-6
    )


def test_reachable_counts_beside_the_arm(arm, hand):
    plan = {"spec": ContactSpec(table=0.0), "starts": 8, "time_budget": 0.001, "arm": arm}
    found = plan_grasps(
        load_object("cylinder").view, hand, reachable=lambda x: x[:, 0, 3] > 9.0, **plan
    )
    assert Status.OK not in found.status


def test_saved_grasps_keep_the_arm(good, tmp_path):
    from torchgrasp import load_grasps

    good.save(tmp_path / "grasps.safetensors")
    found = load_grasps(tmp_path / "grasps.safetensors")
    assert torch.equal(found.arm, good.arm) and torch.equal(found.ease, good.ease)
    assert dataclasses.replace(good, arm=None, ease=None)[0].arm is None


def test_a_motion_has_all_joints_and_goes_through_the_grasp(arm, hand, good):
    motion = plan_motion(arm, hand, good[:3])
    assert (
        motion.joint_names == (*arm.joint_names, *hand.tree.joint_names)
        and (motion.times.diff() > 0).all()
    )
    at = motion.phases
    fingers = motion.positions[..., 6:]
    assert (
        list(at) == ["above", "pregrasp", "grasp", "squeeze", "lift"]
        and at["lift"] == len(motion.times) - 1
    )
    assert torch.equal(motion.positions[:, at["grasp"], :6], good.arm[:3])
    for phase, joints in (
        ("above", good.pregrasp),
        ("pregrasp", good.pregrasp),
        ("grasp", good.joints),
    ):
        assert torch.allclose(fingers[:, at[phase]], hand.expand_joints(joints[:3]))
    risen = arm.hand_poses(motion.positions[:, -1, :6])[:, :3, 3] - good.obj_from_hand[:3, :3, 3]
    assert torch.allclose(risen, real([0, 0, 0.1]).expand(3, 3), atol=1e-4)
    most = motion.positions[..., :6].diff(dim=1).abs() / motion.times.diff()[:, None]
    assert (most <= arm.speed).all()
    documents = list(yaml.safe_load_all(format_motion(hand, motion)))
    assert len(documents) == 3 and documents[0]["joint_names"] == list(motion.joint_names)
    points = documents[2]["points"]
    assert torch.allclose(
        real([point["positions"] for point in points]), motion.positions[2], atol=1e-8
    )
    seconds = [
        point["time_from_start"]["sec"] + 1e-9 * point["time_from_start"]["nanosec"]
        for point in points
    ]
    assert torch.allclose(real(seconds), motion.times)
    with pytest.raises(BadArgument, match=r"grasps: .*posture of this arm"):
        plan_motion(arm, hand, dataclasses.replace(good[:1], arm=None))
    failed = dataclasses.replace(good[:1], status=torch.tensor([int(Status.NO_PROMISE)]))
    with pytest.raises(BadArgument, match=r"grasps: .*failed .*NO_PROMISE"):
        plan_motion(arm, hand, failed)
    for other in (
        ur5e(hand, (-0.45, 0.0, 0.0)),
        arm.moved(random_motion(2)),
    ):  # it stands elsewhere
        with pytest.raises(BadArgument, match=r"grasps: .*posture of this arm"):
            plan_motion(other, hand, good[:1])
    far = dataclasses.replace(good[:1], approach=20.0 * good.approach[:1])  # from 2 m away
    with pytest.raises(BadArgument, match=r"grasps: .*cannot follow"):
        plan_motion(arm, hand, far)
    again = plan_motion(arm.to(torch.float32), hand, good[:3].to(torch.float32))
    assert torch.allclose(again.positions, motion.positions, atol=1e-3)


def test_without_a_table_the_way_that_the_planner_judges_is_that_of_the_motion(hand):
    """The least room of a joint in `ease` is that of the motion, which lifts along z and not
    towards the camera.
    """
    arm = ur5e(hand, (-0.95, 0.0, 0.2))  # almost stretched
    found = plan_grasps(load_object("cylinder").view, hand, starts=8, arm=arm)
    found = found.executable
    joints = plan_motion(arm, hand, found).positions[..., : len(arm.lower)]
    room = torch.minimum(joints - arm.lower, arm.upper - joints) / ((arm.upper - arm.lower) / 2)
    assert len(found) > 3 and torch.allclose(room.flatten(1).amin(1), found.ease[:, 0], atol=1e-4)
