"""Trials among neighbours: what counts as moved, toppled and early; masks that are off; tables that are cleared."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from tests.pinch import QUICK, cylinder, pinch
from torchgrasp.cloud.camera import look_at
from torchgrasp.errors import BadArgument, Status
from torchgrasp.evaluation.clutter import change_masks, clear_scene, look, run_scene_trial
from torchgrasp.evaluation.placed import PlacedScene

simulated = [pytest.mark.sim, pytest.mark.filterwarnings("ignore")]


def place(*meshes):
    """A scene of convex meshes, numbered by name."""
    names = tuple(str(k) for k in range(len(meshes)))
    return PlacedScene(names, meshes, tuple((mesh,) for mesh in meshes), look_at(40.0, 50.0, 0.9))


def box(centre, size=(0.04, 0.04, 0.06)):
    mesh = trimesh.creation.box(size)
    mesh.apply_translation([*centre, size[2] / 2])
    return mesh


def moved_up(grasp, shift):
    """The grasp of an object that stands elsewhere."""
    shift = torch.tensor(shift, dtype=torch.float64)
    pose = grasp.obj_from_hand.clone()
    pose[:, :3, 3] += shift
    contacts = dataclasses.replace(grasp.contacts, points=grasp.contacts.points + shift)
    return dataclasses.replace(grasp, obj_from_hand=pose, contacts=contacts)


def test_masks_grow_and_shrink_by_chessboard_distance():
    labels = torch.zeros(20, 20, dtype=torch.int64)
    labels[5:10, 5:10], labels[5:10, 12:15] = 1, 2
    row, column = torch.meshgrid(torch.arange(20), torch.arange(20), indexing="ij")
    distance = [
        torch.stack([(r - row).abs().maximum((c - column).abs()) for r, c in (labels == k).nonzero().tolist()]).amin(0)
        for k in (1, 2)
    ]
    grown = change_masks(labels, 3)
    assert torch.equal(grown == 1, distance[0] <= 3)
    assert torch.equal(grown == 2, (distance[1] <= 3) & (distance[0] > 3))
    shrunk = change_masks(labels, -1)
    assert torch.equal((shrunk == 1).nonzero(), (labels == 1).nonzero()[[6, 7, 8, 11, 12, 13, 16, 17, 18]])
    assert torch.equal(change_masks(labels, 0), labels)


def test_the_camera_sees_each_object_where_it_is():
    placed = place(box((0.0, 0.0)), box((0.1, 0.05)))
    scene = look(placed, seed=1)
    assert scene.things == (1, 2) and len(scene.points) == len(scene.pixels) == len(scene.labels)
    for label, mesh in enumerate(placed.meshes, 1):
        outside = torch.from_numpy(np.array(mesh.bounds))
        points = scene.points[scene.rows_of(label)]
        gap = (outside[0] - points).maximum(points - outside[1]).clamp_min(0).norm(dim=-1)
        assert len(points) > 200 and float(gap.median()) < 0.001
    assert float(scene.points[scene.labels == 0][:, 2].abs().median()) < 0.003
    assert len(look(placed, 1, 3).points) == len(scene.points)
    assert len(look(placed, 1, -3).cloud(1)) < len(scene.cloud(1)) < len(look(placed, 1, 3).cloud(1))


@pytest.mark.parametrize("mark", [pytest.param(None, marks=simulated)])
def test_the_target_is_lifted_and_neighbours_are_judged(mark):
    pytest.importorskip("sapien")
    hand, grasp = pinch("allegro")
    free = run_scene_trial(place(box((-0.3, 0.3)), cylinder()), 2, grasp, hand, QUICK)
    assert free.lifted and free.name == "1" and not free.early
    assert free.moved < 1e-3 and free.toppled == 0 and free.push == 0
    assert float(free.motion[1, 2, 3]) == pytest.approx(0.1, abs=0.01)
    leaning = box((0.0, 0.08), (0.10, 0.008, 0.15))  # a plate beside the fingers, which open against it
    pushed = run_scene_trial(place(cylinder(), leaning), 1, grasp, hand, QUICK)
    assert pushed.push > 0
    with pytest.raises(BadArgument, match="label"):
        run_scene_trial(place(cylinder()), 2, grasp, hand)


@pytest.mark.parametrize("mark", [pytest.param(None, marks=simulated)])
def test_what_the_target_carried_is_moved_or_toppled(mark):
    """A plate lies on the target: it goes up with it, or falls."""
    pytest.importorskip("sapien")
    hand, grasp = pinch("allegro")
    plate = trimesh.creation.box([0.05, 0.05, 0.01])
    plate.apply_translation([0.0, 0.0, 0.185])
    result = run_scene_trial(place(cylinder(), plate), 1, grasp, hand, QUICK)
    assert result.moved > 0.02


@pytest.mark.parametrize("mark", [pytest.param(None, marks=simulated)])
def test_a_table_is_cleared_thing_by_thing_and_what_cannot_be_had_is_left(mark):
    """The planner knows grasps of the two cylinders; the box has none. The second cylinder's first grasp misses."""
    pytest.importorskip("sapien")
    hand, grasp = pinch("allegro")
    far, seen = [0.3, 0.3, 0.0], []
    other = cylinder().apply_translation(far)
    placed = place(cylinder(), box((-0.25, 0.2)), other)

    def planner(scene, seed):
        seen.append(scene.things)
        things = []
        for label in scene.things:
            middle = scene.points[scene.rows_of(label)].mean(0)
            found, reason = None, "a box"
            if float((middle[:2] - torch.tensor([0.3, 0.3])).norm()) < 0.06:
                found = moved_up(grasp, far if len(seen) > 2 else [0.3, 0.3, 0.25])
            elif float(middle[:2].norm()) < 0.06:
                found = grasp
            things.append(SimpleNamespace(label=label, grasps=found, reason="" if found else reason))
        return SimpleNamespace(things=tuple(things))

    result = clear_scene(placed, hand, planner, QUICK)
    assert [one.name for one in result.tries] == ["0", "2", "2"]
    assert [one.status for one in result.tries] == [Status.OK, Status.NO_CONTACT, Status.OK]
    assert result.left == ("1",) and result.reason == "a box" and result.names == ("0", "1", "2")
    assert seen == [(1, 2, 3), (1, 2), (1, 2), (1,)]
    assert len(clear_scene(placed, hand, planner, QUICK, most=1).tries) == 1
