"""scripts/reproduce.py: an interrupted run ends with the same results; rows share plans and errors."""

import dataclasses
import itertools
import re

import pytest
import torch
from paper.ladder import RUNGS, count_all, judge
from paper.rows import Cell, Lift, Plan, Row, TableSpec
from paper.trials import in_order, most_certain_first, run_cells
from paper.whole import PARTS, Sizes, Whole, reproduce

from tests.pinch import pinch
from torchgrasp.foundation.base import join
from torchgrasp.foundation.errors import BadArgument, Status

TINY = Sizes(
    starts=8, drawn=8, postures=200, fitted=100, apart=50, folds=2, families=0, grasps=2, draws=1
)


def test_reproduce_continues_an_interrupted_run_to_equal_bytes(steps, tmp_path, capsys):
    whole = Whole(tmp_path / "whole", parts=("fig7", "table6"), workers=0)
    reproduce(whole, TINY)
    total = steps.count
    results = (whole.out / "results.json").read_bytes()
    page = (whole.out / "index.html").read_text()
    assert (
        page.count("<h2>") == 2
        and "Not finished." not in page
        and "data:image/jpeg;base64," in page
    )
    stopped = dataclasses.replace(whole, out=tmp_path / "stopped")
    steps.count = 0
    steps.stop = total // 2
    with pytest.raises(KeyboardInterrupt):
        reproduce(stopped, TINY)
    assert (stopped.out / "index.html").read_text().count("Not finished.") == 1
    steps.count = 0
    steps.stop = None
    reproduce(stopped, TINY)
    assert 0 < steps.count < total and (stopped.out / "results.json").read_bytes() == results
    capsys.readouterr()


def test_reproduce_names_unknown_and_failed_parts(tmp_path, capsys):
    with pytest.raises(SystemExit, match=r"'fig13'.* unknown"):
        reproduce(Whole(tmp_path, parts=("fig13",)), TINY)
    few = dataclasses.replace(TINY, fitted=30, apart=20)  # too few postures for sixty Gaussians
    with pytest.raises(SystemExit, match="not made: fig6"):
        reproduce(Whole(tmp_path, parts=("fig6",), workers=0), few)
    assert "fig6: " in capsys.readouterr().out


def test_parts_cover_the_paper():
    titles = " ".join(part.title for part in PARTS)
    assert {*re.findall(r"Table (\d)", titles)} == {*"34567"}
    assert {*re.findall(r"Figs?\. (\d+)", titles)} == {*"456789"} and "Figs. 9 to 12" in titles


def test_rungs_of_the_ladder_exchange_one_stage_at_a_time():
    flat = [dataclasses.asdict(row) | dataclasses.asdict(row.plan) for row in RUNGS]
    for above, below in itertools.pairwise(flat):
        changed = [
            name for name in below if name not in ("plan", "name") and above[name] != below[name]
        ]
        assert len(changed) == 1, below["name"]


def test_rows_share_plans_and_errors(steps, tmp_path):
    rows = (
        Row("one", Plan(), "success", "uncertainty", "force"),
        Row("two", Plan(), "risky", "position", "position"),
    )
    spec = TableSpec(tmp_path, hands=("allegro",), only=("cylinder",), draws=2, workers=0)
    ((one, two),) = first = list(run_cells(spec, rows))
    assert steps.count == 1 + 2 * 4  # one plan; two grasps and two draws in each row
    assert [lift.status for lift in one.lifts] == [lift.status for lift in two.lifts]  # equal seeds
    assert list(run_cells(spec, rows)) == first and steps.count == 9


def test_in_order_sorts_by_the_sum_of_variances():
    _, grasp = pinch("allegro")
    stds = [torch.full((1, 3), 1e-3 * k, dtype=torch.float64) for k in (2, 3, 1)]
    contacts = [dataclasses.replace(grasp.contacts, std_m=std, variance=std**2) for std in stds]
    some = join([dataclasses.replace(grasp, contacts=x) for x in contacts])
    ranked = [in_order(some, first).contacts.std_m[:, 0].tolist() for first in ("certain", "risky")]
    assert [[round(1e3 * x) for x in row] for row in ranked] == [[1, 2, 3], [3, 2, 1]]


def test_an_object_without_a_grasp_fails_every_lift(tmp_path):
    def cell(name: str, held: int, of: int, row: str) -> Cell:
        lifts = tuple(
            Lift("view", 0, k, Status.OK if k < held else Status.DROPPED) for k in range(of)
        )
        return Cell(name, name, "", "allegro", row, lifts, int(not of), 0.01, 2.0)

    below = [cell("x", 2, 2, "row"), cell("y", 0, 0, "row"), cell("z", 1, 2, "row")]
    assert count_all(below, 2) == {"x": (2, 2), "y": (0, 2), "z": (1, 2)}
    found = judge(
        TableSpec(tmp_path, grasps=1, draws=2),
        [below, [cell(name, 2, 2, "better") for name in "xyz"]],
    )
    assert found["row"]["held_of_all"].value == 0.5 and found["row"]["held_of_lifted"].value == 0.75
    assert found["better"]["worth"][:2] == (0.5, 0.0)


def test_the_most_certain_finger_is_told():
    _, grasp = pinch("allegro")
    uneven = torch.tensor([[0.004, 0.002, 0.003]]).double()
    grasp = dataclasses.replace(grasp, contacts=dataclasses.replace(grasp.contacts, std_m=uneven))
    assert most_certain_first((1, 0, 2), grasp)
    assert not most_certain_first((0, 1, 2), grasp)
    assert not most_certain_first((), grasp)
    with pytest.raises(BadArgument, match="exactly one"):
        most_certain_first((0,), grasp[:0])
