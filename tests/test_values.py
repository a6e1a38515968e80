"""Value types: checks at construction, rows, devices and dtypes, statuses."""

import dataclasses
import math
import subprocess
import sys

import numpy as np
import pytest
import torch

from torchgrasp.base import check_number, check_whole, count_status, join, pick, put
from torchgrasp.errors import BadArgument, FailedRows, GraspError, Status, TooFewPoints
from torchgrasp.specs import ContactSpec, TrialSpec
from torchgrasp.values import Certificate, ContactPlan, Contacts, PointCloud


def plan(status: list[int]) -> ContactPlan:
    b = len(status)
    contacts = Contacts(torch.rand(b, 3, 3), torch.rand(b, 3, 3), torch.rand(b, 3), torch.rand(b, 3))
    return ContactPlan(contacts, torch.rand(b, 3, 8), torch.arange(b) * 1.0, torch.tensor(status))


def test_statuses_are_sentences_with_distinct_codes():
    assert len({int(s) for s in Status}) == len(Status) == len({s.sentence for s in Status})
    assert all(len(s.sentence.split()) > 2 for s in Status)


def test_raise_for_status_counts_the_failures():
    assert plan([0, 0]).raise_for_status() is not None
    with pytest.raises(FailedRows, match=f"2 of 3 rows: {Status.TOO_CLOSE.sentence}".replace("(", r"\(")):
        plan([0, 14, 14]).raise_for_status()


def test_contacts_of_two_precisions_are_refused():
    single, double = torch.rand(2, 3, 3), torch.rand(2, 3, 3, dtype=torch.float64)
    for wrong in ((single, double), (double, single), (double, double, None, single[..., 0])):
        with pytest.raises(BadArgument, match=r"contacts: expected .*got torch\.float32 beside torch\.float64"):
            Contacts(*wrong)


def test_count_status_puts_the_most_frequent_first():
    assert list(count_status(torch.tensor([0, 13, 13]))) == [Status.NOT_CLOSED, Status.OK]


ONE_ROW = [1, -2, np.int64(1), np.array(1), torch.tensor(1), slice(1, 2), torch.tensor([1]), [1]]
ONE_ROW += [torch.tensor([False, True, False])]


@pytest.mark.parametrize("rows", ONE_ROW, ids=repr)
def test_indexing_selects_rows_of_nested_values_and_keeps_the_batch_axis(rows):
    picked = plan([0, 1 + 12, 0])[rows]
    assert len(picked) == len(picked.contacts) == 1
    assert picked.quality.tolist() == [1.0]
    assert picked.status.tolist() == [Status.NOT_CLOSED]


@pytest.mark.parametrize("row", [True, np.bool_(True), torch.tensor(True)], ids=repr)
def test_a_single_boolean_is_no_index(row):
    with pytest.raises(BadArgument, match="rows"):
        plan([0, 0])[row]


@pytest.mark.parametrize("row", [2, -3, np.int64(2), torch.tensor(2)], ids=repr)
def test_indices_beyond_the_rows_are_refused(row):
    with pytest.raises(IndexError):
        plan([0, 0])[row]


def test_contacts_of_unknown_variance_are_batches_like_others():
    contacts = Contacts(torch.rand(3, 3, 3), torch.rand(3, 3, 3))
    moved = contacts.to(torch.float64)
    assert moved.points.dtype == torch.float64 and moved.variance is None and moved.std_m is None
    assert torch.equal(contacts[1].points, contacts.points[1:2]) and contacts[1].std_m is None
    both = join([contacts, contacts[:1]])
    assert len(both) == 4 and both.variance is None
    mixed = pick(torch.tensor([True, False, True]), contacts, contacts[[1, 1, 1]])
    assert torch.equal(mixed.points, contacts.points[[0, 1, 2]]) and mixed.std_m is None
    assert torch.equal(put(contacts, torch.tensor([2]), contacts[0]).points, contacts.points[[0, 1, 0]])
    with pytest.raises(BadArgument, match=r"std_m: expected .*got None"):
        contacts.require_std()


def test_known_and_unknown_variances_do_not_mix():
    contacts = Contacts(torch.rand(2, 3, 3), torch.rand(2, 3, 3))
    known = dataclasses.replace(contacts, std_m=torch.rand(2, 3))
    for action in (
        lambda: join([contacts, known]),
        lambda: join([known, contacts]),
        lambda: pick(torch.tensor([True, False]), known, contacts),
        lambda: put(contacts, torch.tensor([0]), known[1]),
    ):
        with pytest.raises(BadArgument, match=r"std_m: expected .*got None beside a tensor"):
            action()


def test_iteration_yields_batches_of_one_and_ends():
    assert [float(row.quality) for row in plan([0, 0, 0])] == [0.0, 1.0, 2.0]


def test_to_returns_a_new_value_and_keeps_integers():
    before = plan([0])
    after = before.to(torch.float64)
    assert after.contacts.points.dtype == torch.float64 and before.contacts.points.dtype == torch.float32
    assert after.status.dtype == torch.int64
    certificate = Certificate(*torch.rand(3, 2), torch.tensor([True, False]), torch.rand(2, 6))
    assert certificate.to(torch.float64).closed.dtype == torch.bool


@pytest.mark.parametrize("value", [8.5, "8", True, None, math.nan, 2], ids=repr)
def test_what_is_no_whole_number_of_the_range_is_a_bad_argument(value):
    with pytest.raises(BadArgument, match=r"^edges: expected .*got "):
        check_whole("edges", value, 3, 1024)


@pytest.mark.parametrize("value", ["0.8", False, None, math.inf], ids=repr)
def test_what_is_no_number_of_the_range_is_a_bad_argument(value):
    with pytest.raises(BadArgument, match=r"^friction: expected .*got "):
        check_number("friction", value, 0.0, 10.0)


def test_values_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        ContactSpec().friction = 1.0  # type: ignore[misc]


@pytest.mark.parametrize(
    ("points", "error"),
    [
        (torch.rand(3, 3), TooFewPoints),
        (torch.rand(0, 3), TooFewPoints),
        (torch.rand(5, 2), BadArgument),
        (torch.randint(9, (5, 3)), BadArgument),
        (torch.full((5, 3), float("nan")), BadArgument),
        (torch.rand(5, 3).half(), BadArgument),
        ([[0.0, 0, 0]] * 5, BadArgument),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_bad_clouds_are_refused(points, error):
    with pytest.raises((error, TypeError)) as caught:  # TypeError: the annotation check that runs in tests only
        PointCloud(points)
    if isinstance(caught.value, GraspError):
        assert "points" in str(caught.value) and "expected" in str(caught.value)


def test_the_first_bad_index_is_named():
    points = torch.rand(6, 3)
    points[4, 1] = float("inf")
    with pytest.raises(BadArgument, match=r"inf at index \[4, 1\]"):
        PointCloud(points)


@pytest.mark.promise("I10")
@pytest.mark.parametrize(
    "bad",
    [dict(friction=-0.1), dict(friction=11.0), dict(edges=2), dict(max_variance=0.0), dict(max_variance=float("nan"))],
)
def test_bad_specs_are_refused(bad):
    with pytest.raises(BadArgument, match=next(iter(bad))):
        ContactSpec(**bad)


@pytest.mark.parametrize("bad", [dict(closing="guess"), dict(mass=0.0), dict(timestep=1.0)])
def test_bad_trials_are_refused(bad):
    with pytest.raises((BadArgument, TypeError), match=next(iter(bad))):
        TrialSpec(**bad)


def test_fingertips_come_from_the_hand_unless_they_are_given():
    spec = ContactSpec()
    assert (spec.fingertip_radius, spec.least_separation) == (0.012, 0.026)
    assert spec.for_fingertips(0.012) == spec.for_fingertips(0.0) == dataclasses.replace(spec, tip_radius=0.012)
    wide = spec.for_fingertips(0.02)
    assert wide.fingertip_radius == 0.02 and wide.least_separation == pytest.approx(0.042)
    given = ContactSpec(tip_radius=0.005, separation=0.01)
    assert given.for_fingertips(0.02) == given
    assert (given.fingertip_radius, given.least_separation) == (0.005, 0.01)
    assert ContactSpec(tip_radius=0.0).least_separation == 0.026


def test_paper_spec_has_no_margins():
    spec = ContactSpec.paper()
    assert spec.planned_friction == spec.friction == 0.8
    assert spec.max_variance == 0.03 and spec.separation == 0 and spec.flatness is None and spec.table is None


@pytest.mark.parametrize("kind", ["ContactSpec", "TrialSpec"])
def test_none_is_refused_by_name_where_the_type_has_no_none(kind):
    # in a process of its own, where no annotation is checked before the value is
    lines = [f"from torchgrasp import {kind}, GraspError", "try:", f"    {kind}(friction=None)"]
    code = "\n".join([*lines, "except GraspError as error:", "    print(error)"])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("friction: expected ")
    assert ContactSpec(flatness=None).flatness is None and TrialSpec(kp=None).kp is None
