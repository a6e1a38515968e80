"""Things of a scene: which is easy, what its best grasp is, and why another cannot be had."""

import dataclasses

import pytest
import torch

from tests.make import load_hand, near, see
from torchgrasp import ContactSpec, Status, load_scene, plan_grasps, plan_scene
from torchgrasp.contacts.region import Region
from torchgrasp.foundation.errors import BadArgument, MissingExtra, NoEffect, SuspiciousScale
from torchgrasp.geometry.frames import apply, inverse, rigid, rotation_from_vector
from torchgrasp.ik.configuration import Configuration, SpatialJacobian
from torchgrasp.planner.graspable import order_by_ease
from torchgrasp.planner.objects import TARGET_POINTS, take_target
from torchgrasp.success.task import GraspTask

HAND = load_hand("barrett")


def test_room_and_height_are_easy_and_what_something_lies_on_is_not():
    near = (0.0, 0.0, 0.06, 0.1)
    flat = (0.15, 0.0, 0.06, 0.015)
    scene = see(near, (0.0, 0.07, 0.06, 0.1), flat, (-0.15, 0.1, 0.06, 0.1))
    assert order_by_ease(scene)[0] == 4
    covered = see((0.0, 0.0, 0.1, 0.05), (0.0, 0.0, 0.06, 0.06, 0.05), (0.2, 0.0, 0.04, 0.1))
    assert order_by_ease(covered)[-1] == 1


@pytest.fixture(scope="module")
def crowded():
    scene = see((0.0, 0.0, 0.06, 0.12), (0.0, -0.1, 0.06, 0.14), (0.1, 0.02, 0.05, 0.06)).select(1)
    return scene, plan_grasps(scene, HAND, starts=24)


def test_no_link_comes_into_a_neighbour_whose_presence_lowers_success_unless_pushed(crowded):
    _, grasps = crowded
    good = grasps.executable
    assert len(good) > 0
    spheres = HAND.collision_spheres
    at = SpatialJacobian.at(HAND, Configuration(good.joints, good.obj_from_hand))
    centres = at.points(spheres.link_index, spheres.center)
    for x, y, width, height in ((0.0, -0.1, 0.06, 0.14), (0.1, 0.02, 0.05, 0.06)):
        half = torch.tensor([width / 2, width / 2, height / 2]).double()
        beyond = (centres - torch.tensor([x, y, height / 2]).double()).abs() - half
        distance = beyond.clamp_min(0).norm(dim=-1) + beyond.amax(-1).clamp_max(0)
        assert float((distance - spheres.radius.to(distance)).min()) > -0.004  # noise of the camera
    scene, grasps = crowded
    lone = plan_grasps(take_target(scene, 0), HAND, ContactSpec(table=scene.table), starts=24)
    pushing = plan_grasps(scene, HAND, ContactSpec(contact_allowed=True), starts=24)
    count = [int((some.status == Status.OK).sum()) for some in (grasps, pushing, lone)]
    assert count[0] <= count[1] <= count[2]
    assert float(grasps.success.max()) <= float(lone.success.max()) + 1e-9
    assert not bool((pushing.status == Status.NEIGHBOUR_COLLISION).any())


def test_a_scene_in_another_frame_gives_the_same_grasps():
    boxes = (0.0, 0.0, 0.06, 0.12), (0.0, -0.1, 0.06, 0.14)
    pose = rigid(
        rotation_from_vector(torch.tensor([0.3, 1.0, -2.0]).double()),
        torch.tensor([0.5, -1.0, 2.0]).double(),
    )
    here = see(*boxes).select(1)
    there = see(*boxes, pose=pose).select(1)
    there = dataclasses.replace(there, table=here.table.moved(pose))  # a fit differs by rounding
    first, second = (plan_grasps(scene, HAND, starts=10) for scene in (here, there))
    assert torch.equal(first.status, second.status)
    near(inverse(pose) @ second.obj_from_hand, first.obj_from_hand, 1e-6)
    near(first.joints, second.joints, 1e-6)


def test_reachable_is_asked_in_the_given_frame_and_its_word_counts():
    scene = see((0.0, 0.0, 0.06, 0.12)).select(1)
    asked = []

    def reachable(obj_from_hand):
        asked.append(obj_from_hand)
        return obj_from_hand[:, 0, 3] > 0.0

    grasps = plan_grasps(scene, HAND, starts=16, reachable=reachable)
    good = grasps.executable
    assert len(good) and float(good.obj_from_hand[:, 0, 3].min()) > 0.0
    places = torch.cat(asked)[:, :3, 3]
    assert (
        float(apply(torch.eye(4).double(), places)[:, 2].max()) < 0.6
    )  # palms near the box, in the scene's frame


def test_things_are_ranked_with_reasons():
    plan = plan_scene(load_scene(), HAND, starts=16, enough=0.5)
    successes = [thing.success for thing in plan.things]
    assert successes == sorted(successes, reverse=True)
    assert plan.best is plan.things[0] and plan.best.success >= 0.5
    assert all((thing.grasps is None) == bool(thing.reason) for thing in plan.things)
    assert {thing.label for thing in plan.things} == {1, 2, 3, 4}
    assert "not tried" in plan.things[-1].reason


def test_targets_are_thinned_by_the_seed_and_wrong_arguments_are_named():
    scene = load_scene().select(1)
    first, again, other = (take_target(scene, seed) for seed in (0, 0, 1))
    assert len(first) == TARGET_POINTS
    assert torch.equal(first.points, again.points) and not torch.equal(first.points, other.points)
    scene = load_scene()
    with pytest.raises(BadArgument, match="target"):
        plan_grasps(scene, HAND)
    with pytest.raises(BadArgument, match="scene"):
        plan_scene(dataclasses.replace(scene, labels=torch.zeros_like(scene.labels)), HAND)
    with pytest.raises(BadArgument, match="enough"):
        plan_scene(scene, HAND, enough=1.5)


def test_a_wrong_argument_of_a_scene_raises_instead_of_being_the_reason_of_each_object(monkeypatch):
    scene = load_scene()
    far = Region.box(torch.full((3,), 5.0), torch.full((3,), 6.0))
    displaced = GraspTask(displaced=True)
    for wrong, message in (
        ({"promise": 0.9, "task": displaced}, "promise: expected None"),
        ({"keep": far}, "keep: expected a region on the object"),
        ({"resist": ()}, "resist: expected at least one"),
        ({"fingers": "none"}, "fingers: expected"),
        ({"spec": ContactSpec(table=0.9)}, "table: expected"),
        ({"reachable": lambda poses: poses[:, 0, 3]}, "reachable: expected a tensor of"),
        ({"keep": lambda points: points}, "keep: expected a tensor of one finite number each"),
    ):
        for target in (None, 1):
            with pytest.raises(BadArgument, match=message):
                plan_scene(scene, HAND, starts=4, target=target, **wrong)

    def missing(scene, **_):
        raise MissingExtra("numba", "fast")

    monkeypatch.setattr("torchgrasp.planner.scene_plan.plan_grasps", missing)
    with pytest.raises(MissingExtra, match="numba is not installed"):
        plan_scene(scene, HAND, starts=4)


def test_an_object_whose_own_cloud_cannot_be_planned_keeps_its_reason(monkeypatch):
    """A table of the call that is above one object, and under another, is no error of the call."""

    def refused(scene, **_):
        raise SuspiciousScale("cloud", "a size of 3 mm", "5 mm to 2 m")

    monkeypatch.setattr("torchgrasp.planner.scene_plan.plan_grasps", refused)
    plan = plan_scene(see((0.0, 0.0, 0.06, 0.12)), HAND, starts=4)
    assert [thing.reason for thing in plan.things] == [
        "cloud: expected 5 mm to 2 m, got a size of 3 mm"
    ]
    monkeypatch.undo()
    high = see((0.0, 0.0, 0.06, 0.12), (0.15, 0.0, 0.06, 0.3))
    plan = plan_scene(high, HAND, ContactSpec(table=0.1), starts=4, enough=0.0)
    assert len(plan.things) == 2


def test_a_low_table_that_takes_the_place_of_the_scenes_is_told(crowded):
    scene, _ = crowded
    with pytest.warns(NoEffect, match="table changes nothing: it is .* below"):
        plan_grasps(scene, HAND, ContactSpec(table=-0.6), starts=4)
    plan_grasps(scene, HAND, ContactSpec(table=scene.table), starts=4)
