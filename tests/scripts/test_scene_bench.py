"""Scenes for benchmarks: arranged and dropped objects, masks with errors, lifts among neighbours."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from benchmarks.scene.clutter import (
    SceneScore,
    Try,
    change_masks,
    clear_scene,
    run_scene_trial,
    summarise_scenes,
)
from benchmarks.scene.drop import PlacedScene, drop
from benchmarks.scene.scenes import scatter

from tests.make import box
from tests.pinch import QUICK, cylinder, pinch
from torchgrasp.cloud.camera import look_at
from torchgrasp.foundation.errors import Status

pytestmark = pytest.mark.filterwarnings("ignore")
SIZE = (0.04, 0.04, 0.06)


def place(*meshes):
    """A scene of convex meshes, named by number."""
    names = tuple(str(k) for k in range(len(meshes)))
    return PlacedScene(names, meshes, tuple((mesh,) for mesh in meshes), look_at(40.0, 50.0, 0.9))


def test_scatter_places_meshes_upright_and_apart():
    meshes = [trimesh.creation.box([0.05 + 0.01 * i, 0.15, 0.1]) for i in range(5)]
    poses = scatter(meshes, torch.Generator().manual_seed(3), 0.3, 0.02)
    placed = [
        mesh.copy().apply_transform(pose.numpy()) for mesh, pose in zip(meshes, poses, strict=True)
    ]
    assert all(
        abs(x.bounds[0, 2]) < 1e-12 and np.hypot(*x.vertices[:, :2].T).max() <= 0.3 for x in placed
    )
    corners = [torch.from_numpy(mesh.sample(2000, seed=0)[:, :2]) for mesh in placed]
    assert (
        min(float(torch.cdist(corners[i], corners[j]).min()) for i in range(5) for j in range(i))
        >= 0.02 - 1e-9
    )


def test_change_masks_uses_chessboard_distance():
    labels = torch.zeros(20, 20, dtype=torch.int64)
    labels[5:10, 5:10] = 1
    labels[5:10, 12:15] = 2
    grown = change_masks(labels, 3)
    shrunk = change_masks(labels, -1)
    assert int((grown == 1).sum()) == 11 * 11 and int((grown == 2).sum()) == 11 * 5
    assert int((shrunk == 1).sum()) == 9 and torch.equal(change_masks(labels, 0), labels)


@pytest.mark.sim
def test_dropped_scenes_are_repeatable_at_rest_and_within_reach():
    scene = drop(None, (2, 2), 4)
    again = drop(None, (2, 2), 4)
    assert all(
        np.array_equal(a.vertices, b.vertices)
        for a, b in zip(scene.meshes, again.meshes, strict=True)
    )
    assert -2e-3 < min(mesh.bounds[0, 2] for mesh in scene.meshes) < 1e-3
    assert np.linalg.norm(scene.centres()[:, :2], axis=1).max() < 0.25


@pytest.mark.sim
def test_run_scene_trial_lifts_the_target_and_reports_a_carried_neighbour():
    hand, grasp = pinch("allegro")
    free = run_scene_trial(place(box(SIZE, (-0.3, 0.3)), cylinder()), 2, grasp, hand, QUICK)
    assert (
        free.status is Status.OK
        and free.name == "1"
        and not free.early
        and free.moved < 1e-3
        and not free.toppled
    )
    plate = trimesh.creation.box([0.05, 0.05, 0.01]).apply_translation([0.0, 0.0, 0.185])
    assert run_scene_trial(place(cylinder(), plate), 1, grasp, hand, QUICK).moved > 0.02


@pytest.mark.sim
def test_clear_scene_lifts_objects_until_none_has_a_grasp():
    hand, grasp = pinch("allegro")

    def planner(scene, seed):
        middles = {label: scene.points[scene.rows_of(label)].mean(0) for label in scene.things}
        found = {
            label: grasp if float(middle[:2].norm()) < 0.06 else None
            for label, middle in middles.items()
        }
        things = (
            SimpleNamespace(label=k, grasps=x, reason="" if x else "a box")
            for k, x in found.items()
        )
        return SimpleNamespace(things=tuple(things))

    result = clear_scene(place(cylinder(), box(SIZE, (-0.25, 0.2))), hand, planner, QUICK)
    assert [(one.name, one.status) for one in result.tries] == [("0", Status.OK)]
    assert result.left == ("1",) and result.reason == "a box"


def test_summarise_scenes_counts_first_tries_all_tries_and_objects():
    good = Try("tin", Status.OK, 0.001, 0, (), np.zeros((2, 4, 4)))
    lost = dataclasses.replace(
        good, status=Status.DROPPED, moved=0.03, toppled=2, early=("neighbour",)
    )
    scores = [
        SceneScore(("tin", "cup"), (good, lost, good)),
        SceneScore(("tin", "cup"), (lost,), ("tin", "cup"), "the rest is flat"),
        SceneScore(("cup", "jug"), (), ("cup", "jug"), "all are flat"),
    ]
    found = summarise_scenes(scores)
    assert found["lifted at the first try"][::3] == (1 / 3, 3) and found["planned"][::3] == (
        2 / 3,
        3,
    )
    assert all(found[f"{name} a neighbour"][::3] == (2 / 4, 4) for name in ("moved", "toppled"))
    assert found["cleared"][::3] == (2 / 6, 6) and found["failures"] == {
        "DROPPED": 2,
        "NO_GRASP": 1,
    }
