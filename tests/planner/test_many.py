"""Many clouds in one call: the grasps of each are those of a call of its own, on any number of
processes.
"""

import dataclasses

import pytest
import torch

from tests.make import cup_view, load_hand, same_bits
from torchgrasp import ContactSpec, GraspTask, PointCloud, Status, load_object, plan_grasps
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.plane import Plane, move
from torchgrasp.planner.many import estimate_shapes, plan_stacks
from torchgrasp.planner.request import Request

HAND = load_hand("barrett")
UP = torch.eye(4, dtype=torch.float64)
UP[2, 3] = 0.3
SPEC = ContactSpec(table=Plane.horizontal(0.3))
VIEWS = [move(load_object(name).view, UP) for name in ("cylinder", "jug")]
SMALL = PointCloud(VIEWS[0].points * 1e-3)


def same(first, second):
    return first.meta == second.meta and same_bits(first, second)


@pytest.fixture(scope="module")
def found():
    """The grasps of two clouds with a bad cloud between them."""
    return plan_grasps([VIEWS[0], SMALL, VIEWS[1]], HAND, SPEC, 6)


def test_a_bad_cloud_costs_no_other_its_grasps(found):
    assert same(found[2], plan_grasps(VIEWS[1], HAND, SPEC, 6))
    assert bool((found[0].status == Status.OK).any()) and bool((found[2].status == Status.OK).any())
    assert len(found[1]) == 0 and "m" in found[1].meta["refused"]
    assert found[1].joints.shape == (0, HAND.dof)
    assert plan_grasps([], HAND) == []


@pytest.mark.promise("N10")
def test_processes_change_nothing(found):
    pytest.importorskip("pebble")
    assert torch.get_num_threads() == 1 or pytest.skip("workers have one thread")
    again = plan_grasps([VIEWS[0], SMALL, VIEWS[1]], HAND, SPEC, 6, workers=2)
    assert all(same(one, other) for one, other in zip(again, found, strict=True))


def test_processes_refuse_a_hand_that_is_not_as_in_its_files():
    """They read the files, and would plan with wider limits."""
    pytest.importorskip("pebble")
    actuated = dataclasses.replace(HAND.actuated, upper=HAND.lower + 0.1)
    narrow = dataclasses.replace(HAND, actuated=actuated)
    with pytest.raises(BadArgument, match="it is read again here"):
        plan_grasps(VIEWS, narrow, SPEC, 2, workers=1)


def test_what_no_row_can_have_is_refused_before_any_work():
    with pytest.raises((BadArgument, TypeError), match=r"cloud"):
        plan_grasps([VIEWS[0], "cup"], HAND)
    for option in ({"observer": print}, {"reachable": torch.ones}, {"fingers": "elbow"}):
        with pytest.raises(BadArgument, match=next(iter(option))):
            plan_grasps(VIEWS, HAND, **option)
    with pytest.raises(BadArgument, match="workers"):
        plan_grasps(VIEWS[0], HAND, workers=2)


@pytest.mark.parametrize(("name", "fingers", "workers"), [("barrett", 3, 1), ("allegro", 4, 0)])
def test_clouds_that_are_planned_at_once_have_the_grasps_of_each_alone(name, fingers, workers):
    hand = load_hand(name) if fingers == 3 else load_hand(name, fingers)
    clouds = [load_object("jug").view, SMALL, cup_view(0.004)]
    spec = ContactSpec(table=0.0)
    task = GraspTask(0.1)
    requests = [Request(cloud, hand, spec, 4, task=task) for cloud in clouds]
    together = list(plan_stacks(requests, estimate_shapes(requests, workers), torch.device("cpu")))
    assert "refused" in together[1].meta
    for found, cloud in zip(together[::2], clouds[::2], strict=True):
        alone = plan_grasps(cloud, hand, spec, 4, task=task)
        assert found.meta == alone.meta and len(found) == len(alone)
        assert share_found(alone, found) > 0.9  # rounding may move a few


def share_found(expected, found):
    """The share of grasps that another result has, too: with this status, these joints, pose, score
    and interval.
    """
    rows = [
        torch.cat(
            [x.status[:, None], x.joints, x.obj_from_hand.flatten(1), x.score[:, None], x.interval],
            1,
        )
        for x in (expected, found)
    ]
    return float((torch.cdist(*rows, p=torch.inf).amin(1) < 1e-6).double().mean())
