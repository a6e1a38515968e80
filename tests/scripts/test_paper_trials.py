"""Tables 6 and 7 and the ladder: which grasps, where the object stands, what is kept, and what counts as a failure."""

import dataclasses
import itertools
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from paper import trials
from paper.ladder import RUNGS, count_all, judge
from paper.rows import Cell, Lift, Plan, Row, TableSpec
from paper.tables6_7 import THRESHOLDS, count_held, line_weights
from paper.trials import fill, in_order, run_cells, subjects

from tests.pinch import pinch
from torchgrasp.base import join
from torchgrasp.closure import ObjectMotion
from torchgrasp.errors import BadArgument, Status
from torchgrasp.geometry.frames import inverse

ROWS = (
    Row("one", Plan(), "success", "uncertainty", "force"),
    Row("two", Plan(), "risky", "position", "position"),
    Row("three", Plan(support="paper", variance=0.06), "success", "uncertainty", "force"),
)


def grasps():
    """Return three executable grasps, ever less certain, and one that is not executable."""
    _, grasp = pinch("allegro")
    rows = []
    for k in (1, 2, 3, 4):
        std = torch.full((1, 3), 1e-3 * k, dtype=torch.float64)
        contacts = dataclasses.replace(grasp.contacts, std_m=std, variance=std**2)
        rows.append(dataclasses.replace(grasp, contacts=contacts))
    lost = dataclasses.replace(rows.pop(), status=torch.full_like(grasp.status, int(Status.TIP_ERROR)))
    return join([*rows, lost])


@pytest.fixture
def bench(monkeypatch):
    """Make planning and lifting cheap, and record what they are asked for."""
    seen = SimpleNamespace(plans=[], lifts=[])

    def plan(cloud, hand, spec, starts, seed, *, mode, shape):
        seen.plans.append((shape, spec.max_variance, mode))
        return grasps()

    def lift(grasp, hand, mesh, spec, seed, *, parts, error):
        moved = inverse(error @ inverse(grasp.obj_from_hand[0].double())) @ inverse(grasp.obj_from_hand[0].double())
        seen.lifts.append((spec, seed, moved, float(grasp.contacts.std_m.amax())))
        motion = ObjectMotion(0.002, 0.1)
        return SimpleNamespace(status=Status.OK, pushed=motion, slip=motion, contact_order=(1, 0, 2))

    monkeypatch.setattr(trials, "fit_shape", lambda cloud, *, support, seed, table: support)
    monkeypatch.setattr(trials, "plan_grasps", plan)
    monkeypatch.setattr(trials, "close_hand", lift)
    return seen


def test_rows_share_plans_and_errors_and_a_campaign_goes_on_where_it_stopped(bench, tmp_path):
    spec = TableSpec(tmp_path, hands=("allegro",), only=("cylinder", "jug"), draws=2, workers=0)
    first = list(run_cells(spec, ROWS))
    assert {x[0].object for x in first} == {"own cylinder", "own jug"}
    assert len(bench.plans) == 4  # two plans, two objects
    assert [p[1:] for p in bench.plans[:2]] == [(0.03, "joint"), (0.06, "joint")]
    # two grasps, two draws: rows meet the same errors, ranks, draws and objects other ones
    assert len(bench.lifts) == 2 * 3 * 4
    errors, stds = torch.stack([x[2] for x in bench.lifts]).reshape(2, 3, 4, 4, 4), [x[3] for x in bench.lifts]
    torch.testing.assert_close(errors[:, 0], errors[:, 1])
    assert len(errors[:, 0].reshape(8, 16).round(decimals=9).unique(dim=0)) == 8
    assert stds[:8:2] == pytest.approx([0.001, 0.002, 0.003, 0.002])  # the likeliest, then the riskiest two
    assert [x[0].closing for x in bench.lifts[:8:4]] == ["uncertainty", "position"]
    cell = first[0][0]
    assert (cell.held, len(cell.lifts), cell.refused, cell.row, cell.family) == (4, 4, 0, "one", cell.object)
    assert cell.std_m == pytest.approx(0.0015) and cell.lifts[0].certain is False  # finger 0 is the most certain
    asked = len(bench.plans), len(bench.lifts)
    assert list(run_cells(spec, ROWS)) == first and asked == (len(bench.plans), len(bench.lifts))
    more = (*ROWS, Row("four", Plan(), "certain", "paper", "impedance"))
    assert [x[:3] for x in run_cells(spec, more)] == first
    assert len(bench.plans) == asked[0] and len(bench.lifts) == asked[1] + 8  # only the new row's
    other = dataclasses.replace(spec, seed=1)
    assert not list(run_cells(dataclasses.replace(other, finished=True), ROWS))
    assert len(list(run_cells(other, ROWS[:1]))) == 2 and len(bench.plans) == asked[0] + 2  # a seed shares nothing
    assert len(list(run_cells(dataclasses.replace(other, finished=True, only=()), ROWS[:1]))) == 2


def test_a_view_without_a_grasp_is_refused_and_kept(bench, monkeypatch, tmp_path):
    def fail(*_, **__):
        raise BadArgument("cloud", "a speck", "an object")

    monkeypatch.setattr(trials, "plan_grasps", fail)
    spec = TableSpec(tmp_path, hands=("allegro",), only=("jug",), workers=0)
    ((cell, _, _),) = run_cells(spec, ROWS)
    assert (cell.lifts, cell.refused) == ((), 1) and "a speck" in cell.note and math.isnan(cell.std_m)
    monkeypatch.setattr(trials, "plan_grasps", lambda *_, **__: pytest.fail("planned again"))
    (again,) = fill(spec, ROWS[:1], subjects(spec)[0], "allegro")
    assert again.refused == 1 and math.isnan(again.std_m) and not bench.lifts


def test_families_come_from_the_folders_and_one_object_may_stand_for_each(tmp_path):
    entries = {"a": {"views": {}}, "b": {"family": "tin", "group": "solid"}, "c": {"family": "tin"}}
    for name, entry in entries.items():
        (tmp_path / name).mkdir()
        trimesh.creation.box((0.05, 0.05, 0.1)).export(tmp_path / name / "mesh.ply")
        entry["views"] = {"view0": {"T_object_camera": np.eye(4).tolist()}}
    (tmp_path / "manifest.json").write_text(json.dumps({"objects": entries}))
    spec = TableSpec(tmp_path, (tmp_path,))
    few = dataclasses.replace(spec, own=False, representatives=True)
    assert [(s.label, s.family, s.group) for s in subjects(few)] == [("a", "a", ""), ("b", "tin", "solid")]


def test_grasps_are_ordered_by_the_sum_of_variances():
    some = grasps()[torch.tensor([1, 2, 0])]
    ranked = [in_order(some, first).contacts.std_m[:, 0].tolist() for first in ("success", "certain", "risky")]
    assert [[round(1e3 * x) for x in row] for row in ranked] == [[2, 3, 1], [1, 2, 3], [3, 2, 1]]


def cell(name: str, hand: str, held: int, of: int, refused: int = 0) -> Cell:
    """Return a cell of an object that is a family of its own."""
    lifts = tuple(Lift("view", 0, k, Status.OK if k < held else Status.DROPPED) for k in range(of))
    return Cell(name, name, "", hand, "row", lifts, refused, 0.01, 2.0)


def test_an_object_without_a_grasp_fails_as_often_as_it_would_have_been_lifted(tmp_path):
    spec = TableSpec(tmp_path, grasps=1, draws=2)
    below = [cell("x", "allegro", 2, 2), cell("y", "allegro", 0, 0, 1), cell("z", "allegro", 1, 2)]
    above = [cell("x", "allegro", 2, 2), cell("y", "allegro", 2, 2), cell("z", "allegro", 2, 2)]
    assert count_all(below, 2) == {"x": (2, 2), "y": (0, 2), "z": (1, 2)}
    assert count_held(below) == {"x": (2, 2), "z": (1, 2)}
    better = [dataclasses.replace(c, row="better") for c in above]
    found = judge(spec, [below, better])
    assert found["row"]["graspable"][::3] == (2 / 3, 3) and found["row"]["worth"] is None
    assert found["row"]["held_of_all"].value == 0.5 and found["row"]["held_of_lifted"].value == 0.75
    assert found["better"]["worth"][:2] == (0.5, 0.0) and found["better"]["plan_cpu_s"] == 2.0


def test_rungs_exchange_one_stage_at_a_time():
    def stages(row: Row) -> dict[str, object]:
        flat = dataclasses.asdict(row) | dataclasses.asdict(row.plan)
        return {name: value for name, value in flat.items() if name not in ("plan", "name")}

    for above, below in itertools.pairwise(RUNGS):
        changed = [name for name, value in stages(below).items() if stages(above)[name] != value]
        assert len(changed) == 1, below.name
    assert stages(RUNGS[0]) == {
        "first": "certain", "closing": "paper", "holding": "impedance",
        "mode": "paper", "support": "paper", "margins": False, "variance": None,
    }  # fmt: skip


def test_a_trend_is_the_least_squares_line_through_the_shares() -> None:
    shares = np.array([0.9, 0.7, 0.4])
    slope = np.polyfit(THRESHOLDS, shares, 1)[0]
    assert shares @ line_weights(THRESHOLDS) == pytest.approx(-slope * (THRESHOLDS[-1] - THRESHOLDS[0]))


@pytest.mark.sim
def test_a_greater_threshold_admits_less_certain_contacts(tmp_path) -> None:
    pytest.importorskip("sapien")
    rows = [Row(f"{t}", Plan(support="paper", variance=t), "risky", "uncertainty", "force") for t in (0.03, 0.10)]
    spec = TableSpec(tmp_path, hands=("allegro",), only=("cylinder",), starts=16, workers=0)
    (found,) = run_cells(spec, rows)
    assert [len(cell.lifts) for cell in found] == [2, 2] and found[0].std_m < found[1].std_m
    assert all(not math.isnan(lift.pushed) for lift in found[0].lifts)
