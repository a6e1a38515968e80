"""A whole reproduction: interrupted anywhere it ends with the same results, and its page has the paper's numbers."""

import dataclasses
import re
from types import SimpleNamespace

import pytest
import torch
from paper import trials
from paper.fig6 import PUBLISHED as GAUSSIANS
from paper.tables6_7 import ROWS6, ROWS7
from paper.whole import page, run, tables
from paper.whole.parts import FIGURES, FULL, QUICK, TRIALS, Sizes
from paper.whole.run import Whole, reproduce

from tests.pinch import pinch
from torchgrasp.app.report.page import format_table
from torchgrasp.base import join
from torchgrasp.closure import ObjectMotion
from torchgrasp.errors import Status

TINY = Sizes(starts=8, drawn=8, postures=200, fitted=100, apart=50, folds=2, families=0, grasps=2, draws=1)
PARTS = ("table5", "table6")


@pytest.fixture
def steps(monkeypatch):
    """Make planning and lifting cheap; the step of a given number is interrupted."""
    seen = SimpleNamespace(count=0, stop=None)

    def step():
        seen.count += 1
        if seen.count == seen.stop:
            raise KeyboardInterrupt

    def plan(cloud, hand, spec, starts, seed, *, mode, shape):
        step()
        _, grasp = pinch(hand.name)
        rows = []
        for k in (1, 2, 3):
            std = torch.full((1, 3), 1e-3 * k, dtype=torch.float64)
            contacts = dataclasses.replace(grasp.contacts, std_m=std, variance=std**2)
            rows.append(dataclasses.replace(grasp, contacts=contacts))
        return join(rows)

    def lift(grasp, hand, mesh, spec, seed, *, parts, error):
        step()
        motion = ObjectMotion(1e-6 * (seed % 1000), 0.1)
        status = Status.OK if seed % 3 else Status.DROPPED
        return SimpleNamespace(status=status, pushed=motion, slip=motion, contact_order=(1, 0, 2))

    monkeypatch.setattr(trials, "fit_shape", lambda cloud, *, support, seed, table: support)
    monkeypatch.setattr(trials, "plan_grasps", plan)
    monkeypatch.setattr(trials, "close_hand", lift)
    return seen


def results(folder):
    return (folder / "results.json").read_bytes()


def test_a_run_that_is_stopped_ends_with_the_same_bytes(steps, tmp_path, capsys):
    whole = Whole(tmp_path / "whole", parts=PARTS, workers=0)
    reproduce(whole, TINY)
    total, whole_results = steps.count, results(whole.out)
    stopped = dataclasses.replace(whole, out=tmp_path / "stopped")
    for stop in (1, total // 2):  # counted from each new beginning
        steps.count, steps.stop = 0, stop
        with pytest.raises(KeyboardInterrupt):
            reproduce(stopped, TINY)
        assert results(stopped.out) != whole_results
    kept = {path: path.stat().st_mtime_ns for path in stopped.out.rglob("*.json") if path.parent.name != "stopped"}
    steps.count, steps.stop = 0, None
    reproduce(stopped, TINY)
    assert 0 < steps.count < total and results(stopped.out) == whole_results
    assert {path: path.stat().st_mtime_ns for path in kept} == kept  # what was finished was left alone
    steps.count = 0
    reproduce(stopped, TINY)
    assert steps.count == 0 and results(stopped.out) == whole_results
    capsys.readouterr()


def test_the_page_says_what_was_made_and_what_was_not(steps, tmp_path, capsys):
    whole = Whole(tmp_path, parts=("fig7", "table6"), workers=0)
    steps.stop = 2
    with pytest.raises(KeyboardInterrupt):
        reproduce(whole, TINY)
    half = (tmp_path / "index.html").read_text()
    assert half.count("Not finished.") == 1 and "data:image/jpeg;base64," in half
    steps.stop = None
    reproduce(whole, TINY)
    done = (tmp_path / "index.html").read_text()
    assert "Not finished." not in done and done.count("<h2>") == 2 and "<script" not in done
    assert "families 0 of all" in done and "draws 1 of 10" in done
    capsys.readouterr()


def test_results_have_no_times_and_times_have_nothing_else():
    numbers = {"rows": [{"points": 3, "filter_s": 0.5}], "cells": [{"seconds": 1.0}], "ladder": {"plan_cpu_s": 2.0}}
    assert page._round(numbers) == {"rows": [{"points": 3}], "cells": [{}], "ladder": {}}
    assert page.only_times(numbers) == {"rows/0/filter_s": 0.5, "ladder/plan_cpu_s": 2.0}


def test_an_unknown_part_is_named(tmp_path):
    with pytest.raises(SystemExit, match=r"'fig13'.* are none; table3, "):
        reproduce(Whole(tmp_path, parts=("fig13",)), TINY)


def test_a_part_that_fails_is_named_and_the_others_are_made(steps, tmp_path, capsys):
    few = dataclasses.replace(TINY, fitted=30, apart=20)  # too few postures for sixty Gaussians
    with pytest.raises(SystemExit, match="not made: fig6"):
        reproduce(Whole(tmp_path, parts=("fig6", "fig7"), workers=0), few)
    assert (tmp_path / "index.html").read_text().count("Not finished.") == 1 and (tmp_path / "fig7.png").is_file()
    assert "Fig. 6: " in capsys.readouterr().out


def test_every_part_of_the_paper_is_there_once():
    titles = " ".join(part.title for part in (*FIGURES, *TRIALS))
    assert re.findall(r"Table (\d)", titles) == ["3", "4", "5", "6", "7"]
    assert re.findall(r"Figs?\. (\d+)", titles) == ["4", "5", "6", "7", "8", "9"] and "Figs. 9 to 12" in titles
    assert sorted(page.ORDER) == sorted(part.name for part in (*FIGURES, *TRIALS))
    fields = {field.name for field in dataclasses.fields(Sizes)}
    assert {field for part in FIGURES for field in part.sizes.values()} <= fields
    assert all(getattr(QUICK, name) <= getattr(FULL, name) for name in fields)
    assert {part.name for part in (*FIGURES, *TRIALS) if getattr(part, "numbers", True)} == set(tables.TABLES)


def test_the_objects_of_folders_are_as_few_families_as_asked(tmp_path, monkeypatch):
    found = [trials.Subject(None, "jug", "own jug", "")]
    found += [trials.Subject(tmp_path, f"thing{k}", f"family{k}", "solid") for k in range(5)]
    monkeypatch.setattr("paper.whole.parts.subjects", lambda spec: found)
    spec = TRIALS[0].spec(tmp_path, (tmp_path,), dataclasses.replace(QUICK, families=2), 1)
    assert spec.only == ("jug", "thing0", "thing1") and (spec.grasps, spec.draws) == (QUICK.grasps, QUICK.draws)
    assert (TRIALS[2].spec(tmp_path, (), FULL, 1).grasps, TRIALS[2].spec(tmp_path, (), FULL, 1).draws) == (1, 1)


def cell(row, name, hand, held, of):
    lifts = [{"status": "OK" if k < held else "DROPPED"} for k in range(of)]
    return {"row": row, "object": name, "hand": hand, "lifts": lifts}


def test_tables_6_and_7_stand_beside_the_papers_objects_and_hand():
    names = [row.name for row in ROWS6]
    assert names == ["0.03", "0.06", "0.10"] and "paper, impedance" in [row.name for row in ROWS7]
    numbers = {"held": [0.5, 0.25, 0.75, 8, 4], "graspable": 3, "objects": 4}
    cells = [cell("0.03", "own jug", "allegro", 1, 4), cell("0.03", "own jug", "barrett", 4, 4)]
    cells += [cell("0.03", "jug", "allegro", 4, 4)]  # of a folder
    table = tables.held({"rows": dict.fromkeys(names, numbers), "cells": cells})
    assert table.rows[0][:4] == ("0.03", "no grasp", "no grasp", "25 of 4")
    assert table.rows[0][4:] == ("50 [25, 75] of 8", "3 of 4", "40, 63, 57")
    assert all(len(row) == len(table.heads) for row in table.rows)


def test_tables_are_as_wide_as_their_heads_and_name_the_best(tmp_path):
    chosen = {"components": [5, 10], "bic": [3.0, 2.0], "log_likelihood": [[1.0, 1.0], [0.0, 0.0]], "error": [[1], [2]]}
    found = tables.fig6(dict.fromkeys(GAUSSIANS, chosen))
    assert found.rows == [(hand, "10", "5", "5", str(theirs)) for hand, theirs in GAUSSIANS.items()]
    rung = {"graspable": [1.0, 0.5, 1.0, 4, 2], "held_of_all": [0.5, None, None, 4, 1], "worth": None}
    found = tables.ladder({"ladder": {"all": {"paper": rung}, "allegro": {"paper": rung}}})
    assert len(found.rows[0]) == len(found.heads) and found.rows[0][1:] == ("100 [50, 100] of 4", "50 of 4", "")
    row = {"object": "jug", "setting": "paper", "threshold": 0.03, "grasps": 0, "milliseconds": 1.0}
    found = tables.table4({"starts": 9, "rows": [row | {"quality": None, "spread": None, "probability": None}]})
    assert len(found.rows[0]) == len(found.heads) and found.rows[0][3:7] == ("0", "1.00", "-", "-")
    assert "26.52 ± 13.58" in format_table(found.heads, found.rows)


def test_workers_are_asked_for_what_is_missing_alone(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(run, "run_tasks", lambda f, tasks, *_: asked.append([t[0] for t in tasks]) or iter([]))
    assert list(run.make_figures(Whole(tmp_path), [], TINY)) == [] and asked == []
    list(run.make_figures(Whole(tmp_path), list(FIGURES[:2]), TINY))
    assert asked == [["table3", "fig4"]]
