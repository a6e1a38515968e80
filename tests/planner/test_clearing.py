"""What to take away before a target can be grasped, beside renderings without it."""

import dataclasses

import pytest
import torch

from tests.make import load_hand, see
from torchgrasp import Status, plan_scene
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.foundation.errors import BadArgument, FailedRows, MissingExtra
from torchgrasp.planner.changes import near_target
from torchgrasp.planner.clearing import CLEARING, order_to_clear
from torchgrasp.scene.removal import take_away

TARGET = (0.0, 0.0, 0.05, 0.10)
NEAR = (0.0, 0.07, 0.05, 0.12)
NEXT = (-0.09, -0.02, 0.06, 0.08)
FAR = (0.0, -0.4, 0.05, 0.10)


@pytest.fixture(scope="module")
def crowd():
    """The target, whose label is 1, two neighbours with labels 2 and 3, and a far object 4."""
    return see(TARGET, NEAR, NEXT, FAR).select(1)


def test_an_object_that_is_taken_away_leaves_the_image_of_the_others(crowd):
    found = take_away(crowd, 2)
    bare = see(TARGET, NEXT, FAR)
    assert found.things == (1, 3, 4) and found.target == 1
    measured = (found.image.depth > 0) & (bare.image.depth > 0)
    # the other objects hide or show what they did; noise of the camera aside
    apart = (found.image.depth - bare.image.depth).abs()[measured]
    assert float((apart < 0.005).double().mean()) > 0.99
    assert float((crowd.image.depth - bare.image.depth).abs()[measured].gt(0.02).sum()) > 200
    height = found.table.height(found.points[found.labels == 0])
    assert float(height.abs().quantile(0.99)) < 0.01  # the table, and no rim of the object
    for label in (1, 3, 4):
        assert torch.equal(found.points[found.labels == label], crowd.cloud(label).points)


def test_the_target_and_what_is_no_object_cannot_be_taken_away(crowd):
    for label in (1, 9):
        with pytest.raises(BadArgument, match=r"beside the target: \[2, 3, 4\]"):
            take_away(crowd, label)


def test_without_a_table_nothing_is_measured_where_the_object_was(crowd):
    found = take_away(dataclasses.replace(crowd, table=None), 2)
    row, column = crowd.pixels[crowd.labels == 2].unbind(-1)
    assert not bool(found.image.depth[row, column].any())
    assert bool((found.image.depth[found.pixels[:, 0], found.pixels[:, 1]] > 0).all())


def planned(blocked: set[int], least: int = 0):
    """Return a planner whose targets have a grasp as soon as no label of `blocked` is seen."""
    grasp = load_shipped_grasp("jug", "barrett")
    lost = dataclasses.replace(grasp, status=torch.full_like(grasp.status, int(Status.NO_APPROACH)))

    def plan(scene, *, starts, **_):
        if len(scene.things) < least:
            raise FailedRows("no shape")
        return lost if blocked & {*scene.things} else grasp

    return plan


def test_what_is_in_the_way_goes_first_and_the_nearest_if_no_single_one_helps(crowd):
    near = near_target(crowd)
    assert near == [2, 3]
    assert order_to_clear(crowd, planned({3}), 8) == (3,)
    assert order_to_clear(crowd, planned({2}), 8) == (2,)
    assert order_to_clear(crowd, planned({2, 3}), 8) == (2, 3)
    assert order_to_clear(crowd, planned({4}), 8) == ()  # out of reach
    assert order_to_clear(crowd, planned(set(), least=9), 8) == ()  # it cannot be planned at all


def test_an_error_of_the_call_is_no_count_of_grasps(crowd):
    def plan(scene, **_):
        raise MissingExtra("numba", "fast")

    with pytest.raises(MissingExtra):
        order_to_clear(crowd, plan, 8)


def test_few_starts_count(crowd):
    asked = []

    def plan(scene, *, starts):
        asked.append(starts)
        return planned(set())(scene, starts=starts)

    order_to_clear(crowd, plan, 1000)
    order_to_clear(crowd, plan, 8)
    assert {*asked} == {CLEARING.starts, 8}


def test_a_scene_says_what_to_clear_for_its_target_alone(crowd, monkeypatch):
    def plan(scene, **_):
        raise FailedRows("no grasp")

    monkeypatch.setattr("torchgrasp.planner.scene_plan.plan_grasps", plan)
    monkeypatch.setattr("torchgrasp.planner.scene_plan.order_to_clear", lambda *_: (3,))
    found = plan_scene(crowd, load_hand("barrett"), target=1)
    assert found.clear == (3,) and [thing.label for thing in found.things] == [1]
    with pytest.raises(BadArgument, match=r"a label of an object: \[1, 2, 3, 4\]"):
        plan_scene(crowd, load_hand("barrett"), target=7)
