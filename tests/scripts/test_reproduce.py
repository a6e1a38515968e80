"""scripts/reproduce.py: rows of a table share plans and errors."""

import dataclasses
import shutil

import pytest
import torch
from paper.rows import Row, TableSpec
from paper.trials import most_certain_first, riskiest_first, run_cells, subjects

from tests.pinch import pinch
from torchgrasp.foundation.base import join
from torchgrasp.foundation.errors import BadArgument


def test_rows_share_plans_and_errors(steps, tmp_path):
    rows = (
        Row("one", "camera", 0.03, "uncertainty", "force"),
        Row("two", "camera", 0.03, "position", "position"),
    )
    spec = TableSpec(tmp_path, hands=("allegro",), only=("cylinder",), draws=2, workers=0)
    ((one, two),) = first = list(run_cells(spec, rows))
    assert steps.count == 1 + 2 * 4  # one plan; two grasps and two draws in each row
    assert [lift.status for lift in one.lifts] == [lift.status for lift in two.lifts]  # equal seeds
    assert list(run_cells(spec, rows)) == first and steps.count == 9


def test_objects_of_equal_names_are_told_apart_in_results(tin, tmp_path):
    """They would share files, and the second object would get the results of the first."""
    other = shutil.copytree(tin, tmp_path / "more")
    names = {subject.label for subject in subjects(TableSpec(tmp_path, (tin,), own=False))}
    assert names == {"tin"}
    both = subjects(TableSpec(tmp_path, (tin, other), own=False))
    assert {subject.label: subject.folder for subject in both} == {
        "tin of objects": tin,
        "tin of more": other,
    }
    same = shutil.copytree(tin, tmp_path / "elsewhere" / "objects")
    with pytest.raises(BadArgument, match="objects: expected folders of different names"):
        subjects(TableSpec(tmp_path, (tin, same), own=False))


def test_the_riskiest_grasp_has_the_greatest_sum_of_variances():
    _, grasp = pinch("allegro")
    stds = [torch.full((1, 3), 1e-3 * k, dtype=torch.float64) for k in (2, 3, 1)]
    contacts = [dataclasses.replace(grasp.contacts, std_m=std, variance=std**2) for std in stds]
    some = join([dataclasses.replace(grasp, contacts=x) for x in contacts])
    ranked = riskiest_first(some).contacts.std_m[:, 0].tolist()
    assert [round(1e3 * x) for x in ranked] == [3, 2, 1]


def test_the_most_certain_finger_is_told():
    _, grasp = pinch("allegro")
    uneven = torch.tensor([[0.004, 0.002, 0.003]]).double()
    grasp = dataclasses.replace(grasp, contacts=dataclasses.replace(grasp.contacts, std_m=uneven))
    assert most_certain_first((1, 0, 2), grasp)
    assert not most_certain_first((0, 1, 2), grasp)
    assert not most_certain_first((), grasp)
    with pytest.raises(BadArgument, match="exactly one"):
        most_certain_first((0,), grasp[:0])
