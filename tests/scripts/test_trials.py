"""Trials of the predicted success: tasks are drawn within bounds, ranks are of both ends, jobs are
the same again.
"""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

pytest.importorskip("manifold3d")
pytest.importorskip("mujoco")

from train import tasks
from train import trials as runner
from train.household import CALIBRATING, FAMILIES, family_of
from train.measured import read_trials
from train.tasks import FORCE, FRICTION, MASS, Task, draw_ordinary, draw_task
from train.trials import choose_ranks, half_of, read_rows, run_trials

from torchgrasp.data.shards import load_shard
from torchgrasp.foundation.errors import Status
from torchgrasp.success.features import FEATURES
from torchgrasp.values.planning import PointCloud


def test_tasks_lie_within_their_bounds_and_half_keep_the_planned_friction():
    draw = np.random.default_rng(0)
    tasks = [draw_task(draw, 0.9) for _ in range(400)]
    assert all(
        FRICTION[0] <= x.friction <= FRICTION[1] and MASS[0] <= x.mass <= MASS[1] for x in tasks
    )
    assert all(
        x.lift or x.force is not None for x in tasks
    )  # a pulled object weighs nothing that a hand may feel
    assert all(x.force is None or FORCE[0] <= x.force <= FORCE[1] for x in tasks)
    for share in (
        (x.friction == 0.9 for x in tasks),
        (x.errs for x in tasks),
        (2 * x.lift for x in tasks),
    ):
        assert 0.4 < np.mean(list(share)) < 0.6


def test_a_task_says_what_its_trial_is():
    lift = Task(True, "uncertainty", 0.6, 0.3, None, True)
    pull = Task(False, "open_loop", 0.4, 0.05, 5.0, True)
    trial = lift.protocol.trial
    assert (trial.mass, trial.friction, trial.patch, trial.pressing) == (0.3, 0.6, 0.0, "grip")
    assert trial.table_friction == pytest.approx(0.15)
    assert (lift.protocol.criterion, lift.protocol.tries, lift.protocol.noise.translation) == (
        "held",
        1,
        0.03,
    )
    trial = pull.protocol.trial
    assert (trial.force, trial.closing, trial.gravity, trial.simulator) == (
        5.0,
        "open_loop",
        0.0,
        "mujoco",
    )
    assert trial.friction * trial.patch == pytest.approx(0.02)
    assert pull.protocol.noise.translation == 0.005


def test_ranks_are_of_the_best_and_of_the_rest():
    ranks = choose_ranks(100, np.random.default_rng(1))
    assert ranks == sorted(set(ranks)) and sum(rank < 20 for rank in ranks) == runner.BEST
    assert len(ranks) == runner.BEST + runner.SPREAD and max(ranks) < 100


@pytest.mark.parametrize(("axis", "far"), [(2, True), (0, True), (1, False)])
def test_half_of_a_view_holds_the_points_at_its_end_and_what_is_hidden_behind_them(axis, far):
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 0.1
    region = half_of(PointCloud(points), axis, far)
    middle = (points[:, axis].amin() + points[:, axis].amax()) / 2
    assert torch.equal(region(points) < 0, (points[:, axis] > middle) == far)
    hidden = points.mean(0, keepdim=True)
    hidden[0, (axis + 1) % 3] = 0.15
    hidden[0, axis] = 0.09 if far else 0.01
    assert region(hidden) < 0


def test_ordinary_tasks_are_lighter_and_keep_the_planned_friction():
    draw = np.random.default_rng(0)
    tasks = [draw_ordinary(draw, 0.7) for _ in range(200)]
    assert all(x.friction == 0.7 and not x.errs and MASS[0] <= x.mass <= 0.25 for x in tasks)
    assert all(x.force is None or x.force >= 4.0 for x in tasks)
    known = [x.known for x in tasks]
    assert [(x.mass, x.lift, x.displaced) for x in known] == [
        (x.mass, x.lift, x.errs) for x in tasks
    ]


def test_each_object_of_a_folder_is_tried_with_each_hand_before_it_comes_again(monkeypatch):
    box = trimesh.creation.box((0.05, 0.04, 0.06))
    read = []

    def read_mesh(folder, name):
        read.append(name)
        return box

    monkeypatch.setattr(runner, "read_object_mesh", read_mesh)
    monkeypatch.setattr(runner, "read_entry", lambda _, name: SimpleNamespace(family=name[0]))
    monkeypatch.setattr(runner, "convex_parts", lambda mesh: [mesh])
    shelf = runner.Shelf(Path("objects"), ("cup", "pen"))
    bodies = [shelf.read(k) for k in range(12)]
    assert read == ["cup"] * 4 + ["pen"] * 4 + ["cup"] * 4
    assert [body.family for body in bodies[3:5]] == ["c", "p"]
    assert bodies[0].mesh is box and bodies[0].parts == [box]


@pytest.fixture(autouse=True)
def short_trials(monkeypatch, kept):
    """Try with few ticks, and estimate the shape of each view once."""
    for name in ("LIFT", "PULL"):
        short = getattr(tasks, name).with_trial(control_rate=50.0, hold_time=0.1)
        monkeypatch.setattr(tasks, name, short)


@pytest.mark.sim
def test_the_best_grasp_is_tried_for_each_ordinary_task_on_families_that_calibrate(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(runner, "STARTS", 8)
    monkeypatch.setattr(runner, "TASKS", 1)
    number = next(k for k in range(0, 400, 4) if family_of(k) in CALIBRATING)
    data = run_trials("allegro", 4, tmp_path, 0, first=number, best=True)
    assert len(data.jobs) == 1 and data.jobs[0].family in CALIBRATING and data.jobs[0].grasps <= 1
    assert not len(
        run_trials(
            "allegro", 4, tmp_path / "other", 0, first=number + 4 * len(FAMILIES) + 1, best=True
        ).jobs
    )


@pytest.mark.sim
def test_trials_are_kept_and_read_with_their_tasks(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "STARTS", 8)
    monkeypatch.setattr(runner, "BEST", 1)
    monkeypatch.setattr(runner, "SPREAD", 0)
    data = run_trials("allegro", 1, tmp_path, 0, first=4)
    [(row, cloud, grasps, [trial])] = read_rows(
        [load_shard(tmp_path / "allegro" / "shard-000000.safetensors", {})]
    )
    assert (row.object, row.status, trial.status in Status) == ("body00004", Status.OK, True)
    assert len(cloud) == row.points and len(grasps) == 1 and trial.rank < 20
    assert json.loads(row.meta["ranks"]) == [trial.rank]
    measured = read_trials([tmp_path / "allegro"])
    assert (measured.passed.tolist(), measured.rank.tolist()) == ([trial.passed], [trial.rank])
    columns = dict(zip(FEATURES, measured.features[0], strict=True))
    assert (columns["friction"], columns["mass"]) == (trial.task.friction, trial.task.mass)
    again = run_trials("allegro", 1, tmp_path / "again", 0, first=4)
    assert (tmp_path / "again" / "allegro" / "shard-000000.safetensors").read_bytes() == (
        tmp_path / "allegro" / "shard-000000.safetensors"
    ).read_bytes()
    assert again.card["counts"] == data.card["counts"]
