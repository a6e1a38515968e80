"""Many clouds in one call: the grasps of each are those of a call of its own, on any number of processes."""

import pytest
import torch

from torchgrasp import ContactSpec, PointCloud, Status, load_hand, load_object, plan_grasps
from torchgrasp.base import named_tensors
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.plane import Plane, move

HAND = load_hand("barrett")
UP = torch.eye(4, dtype=torch.float64)
UP[2, 3] = 0.3
SPEC = ContactSpec(table=Plane.horizontal(0.3))
VIEWS = [move(load_object(name).view, UP) for name in ("cylinder", "jug")]
SMALL = PointCloud(VIEWS[0].points * 1e-3)


def same(first, second):
    a, b = named_tensors(first), named_tensors(second)
    return first.meta == second.meta and a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


@pytest.fixture(scope="module")
def alone():
    return [plan_grasps(view, HAND, SPEC, 12, seed=2) for view in VIEWS]


def test_a_bad_cloud_costs_no_other_its_grasps(alone):
    found = plan_grasps([VIEWS[0], SMALL, VIEWS[1]], HAND, SPEC, 12, seed=2)
    assert same(found[0], alone[0]) and same(found[2], alone[1])
    assert bool((alone[0].status == Status.OK).any())
    assert (len(found[1]) == 0 and "scale" in found[1].meta["refused"]) or "m" in found[1].meta["refused"]
    assert found[1].joints.shape == (0, HAND.dof)
    assert plan_grasps([], HAND) == []


@pytest.mark.promise("N10")
def test_processes_change_nothing(alone):
    pytest.importorskip("pebble")
    assert torch.get_num_threads() == 1 or pytest.skip("workers have one thread")
    found = plan_grasps([*VIEWS, SMALL], HAND, SPEC, 12, seed=2, workers=2)
    assert same(found[0], alone[0]) and same(found[1], alone[1])
    assert same(found[2], plan_grasps([SMALL], HAND, SPEC, 12, seed=2)[0]) and "refused" in found[2].meta


def test_what_no_row_can_have_is_refused_before_any_work(alone):
    with pytest.raises((BadArgument, TypeError), match=r"cloud"):
        plan_grasps([VIEWS[0], "cup"], HAND)
    for options, word in (
        ({"starts": 0}, "starts"),
        ({"mode": "best"}, "mode"),
        ({"observer": print}, "observer"),
        ({"reachable": torch.ones}, "reachable"),
        ({"fingers": "elbow"}, "fingers"),
    ):
        with pytest.raises((BadArgument, TypeError), match=word):
            plan_grasps(VIEWS, HAND, **options)
    with pytest.raises(BadArgument, match="workers"):
        plan_grasps(VIEWS[0], HAND, workers=2)
