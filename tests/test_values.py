"""Value types: checks at construction, rows, devices and dtypes, statuses, a short and true text."""

import copy
import dataclasses
import math
import pickle

import numpy as np
import pytest
import torch
import yourdfpy

from tests.make import ball, see
from tests.pinch import pinch
from torchgrasp import fit_shape, load_object
from torchgrasp.data import load_shipped_grasp
from torchgrasp.foundation.base import Value, check_whole, count_status, join, pick, put
from torchgrasp.foundation.errors import BadArgument, FailedRows, Status, TooFewPoints
from torchgrasp.geometry.plane import Plane
from torchgrasp.hand.load import hand_of
from torchgrasp.values.planning import Certificate, ContactPlan, Contacts, PointCloud
from torchgrasp.values.specs import ContactSpec, TrialSpec


def plan(status: list[int]) -> ContactPlan:
    b = len(status)
    contacts = Contacts(
        torch.rand(b, 3, 3), torch.rand(b, 3, 3), torch.rand(b, 3), torch.rand(b, 3)
    )
    return ContactPlan(contacts, torch.rand(b, 3, 8), torch.arange(b) * 1.0, torch.tensor(status))


def test_statuses_are_sentences_with_distinct_codes():
    assert len({int(s) for s in Status}) == len(Status) == len({s.sentence for s in Status})
    assert all(len(s.sentence.split()) > 2 for s in Status)


def test_raise_for_status_counts_the_failures():
    assert plan([0, 0]).raise_for_status() is not None
    with pytest.raises(
        FailedRows, match=f"2 of 3 rows: {Status.TOO_CLOSE.sentence}".replace("(", r"\(")
    ):
        plan([0, 14, 14]).raise_for_status()


def test_contacts_of_two_precisions_are_refused():
    single = torch.rand(2, 3, 3)
    double = torch.rand(2, 3, 3, dtype=torch.float64)
    for wrong in ((single, double), (double, single), (double, double, None, single[..., 0])):
        with pytest.raises(
            BadArgument, match=r"contacts: expected .*got torch\.float32 beside torch\.float64"
        ):
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
    assert torch.equal(
        put(contacts, torch.tensor([2]), contacts[0]).points, contacts.points[[0, 1, 0]]
    )
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
    assert (
        after.contacts.points.dtype == torch.float64
        and before.contacts.points.dtype == torch.float32
    )
    assert after.status.dtype == torch.int64
    certificate = Certificate(*torch.rand(3, 2), torch.tensor([True, False]), torch.rand(2, 6))
    assert certificate.to(torch.float64).closed.dtype == torch.bool


@pytest.mark.parametrize("value", [8.5, "8", True, None, math.nan, 2], ids=repr)
def test_what_is_no_whole_number_of_the_range_is_a_bad_argument(value):
    with pytest.raises(BadArgument, match=r"^edges: expected .*got "):
        check_whole("edges", value, 3, 1024)


def test_values_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        ContactSpec().friction = 1.0  # type: ignore[misc]


@pytest.mark.parametrize("count", [0, 3])
def test_clouds_of_too_few_points_are_refused(count):
    with pytest.raises(TooFewPoints, match=r"points: expected .*got"):
        PointCloud(torch.rand(count, 3))


def test_the_first_bad_index_is_named():
    points = torch.rand(6, 3)
    points[4, 1] = float("inf")
    with pytest.raises(BadArgument, match=r"inf at index \[4, 1\]"):
        PointCloud(points)


def test_fingertips_come_from_the_hand_unless_they_are_given():
    spec = ContactSpec()
    assert (spec.fingertip_radius, spec.least_separation) == (0.012, 0.026)
    assert (
        spec.for_fingertips(0.012)
        == spec.for_fingertips(0.0)
        == dataclasses.replace(spec, tip_radius=0.012)
    )
    wide = spec.for_fingertips(0.02)
    assert wide.fingertip_radius == 0.02 and wide.least_separation == pytest.approx(0.042)
    given = ContactSpec(tip_radius=0.005, separation=0.01)
    assert given.for_fingertips(0.02) == given
    assert (given.fingertip_radius, given.least_separation) == (0.005, 0.01)
    assert ContactSpec(tip_radius=0.0).least_separation == 0.026
    with pytest.raises(BadArgument, match="radius"):
        spec.for_fingertips(-0.001)


def test_paper_spec_has_no_margins():
    spec = ContactSpec.paper()
    assert spec.planned_friction == spec.friction == 0.8
    assert (
        spec.max_variance == 0.03
        and spec.separation == 0
        and spec.flatness is None
        and spec.table is None
    )
    assert TrialSpec(kp=None).kp is None


def test_the_text_of_a_large_value_has_shapes_in_at_most_12_lines():
    hand, grasp = pinch("allegro")
    grasps = grasp[[0] * 200]
    for value in (grasps, hand, load_object("jug").view):
        text = repr(value)
        assert len(text.splitlines()) <= 12 and max(map(len, text.splitlines())) <= 110
    assert "joints=float64[200, 12]" in repr(grasps).replace("\n    ", " ")
    assert repr(grasps).endswith(")") and repr(hand).startswith("Hand(name='allegro'")


def test_few_numbers_are_shown_themselves():
    cloud = load_object("jug").view
    assert cloud.viewpoint is not None
    shown = ", ".join(f"{x:.5g}" for x in cloud.viewpoint.tolist())
    assert f"viewpoint=[{shown}]" in repr(cloud).replace("\n    ", " ")
    assert "friction=0.8" in repr(ContactSpec())


def test_a_value_of_too_many_fields_is_cut():
    names = [f"a_field_of_a_long_name_{k}" for k in range(60)]
    Wide = dataclasses.make_dataclass(
        "Wide", [(name, torch.Tensor) for name in names], bases=(Value,), frozen=True
    )
    text = repr(Wide(*(torch.zeros(9) for _ in names)))
    assert len(text.splitlines()) == 12 and text.endswith("...)")


def small_shape(kernel):
    return fit_shape(ball(120), budget=30, seed=0, kernel=kernel)


VALUES = {
    "Grasps": lambda: pinch("allegro")[1],
    "Hand": lambda: pinch("allegro")[0],
    "PointCloud": lambda: load_object("jug").view,
    "ContactSpec": lambda: ContactSpec(table=Plane.horizontal(0.1)),
    "ContactPlan": lambda: plan([0, 14]),
    "Scene": lambda: see((0.0, 0.0, 0.06, 0.1)),
    "ShapeGP": lambda: small_shape("thin_plate"),
    "ShapeGP of Matern": lambda: small_shape("matern52"),
    "ShapeGP of RBF": lambda: small_shape("rbf"),
}


@pytest.mark.parametrize("name", VALUES)
def test_copies_and_pickled_values_are_equal_and_have_one_hash(name):
    value = VALUES[name]()
    for again in (
        copy.deepcopy(value),
        pickle.loads(pickle.dumps(value)),  # noqa: S301
        dataclasses.replace(value),
    ):
        assert again == value and hash(again) == hash(value) and {value: 1}[again] == 1
    assert value != name and value is not again


def test_values_differ_by_one_number_a_dtype_or_a_text_and_missing_numbers_are_equal():
    one = plan([0, 14])
    quality = one.quality.clone()
    quality[1] = torch.nan
    missing = dataclasses.replace(one, quality=quality)
    assert missing == dataclasses.replace(one, quality=quality.clone()) != one
    assert one != one.to(torch.float64) and one != one[:1]
    grasp = pinch("allegro")[1]
    assert grasp != dataclasses.replace(grasp, meta=grasp.meta | {"seed": "another"})
    assert len({grasp, grasp[[0]], grasp[[0, 0]]}) == 2
    Odds = dataclasses.make_dataclass("Odds", [("share", float)], bases=(Value,), frozen=True)
    unknown = Odds(float("nan"))
    other = Odds(float("nan"))
    assert unknown == other != Odds(0.5) and hash(unknown) == hash(other)


def test_a_hand_is_pickled_without_what_was_derived_from_it():
    hand = pinch("allegro")[0]
    before = len(pickle.dumps(hand))
    hand.derived["library"] = torch.zeros(100_000)
    assert hand.motion and len(pickle.dumps(hand)) == before


def test_what_is_no_value_of_numbers_is_equal_to_itself_alone():
    jug = load_object("jug")
    assert jug == jug and jug != load_object("jug") and hash(jug) == hash(jug)
    assert torch.equal(copy.deepcopy(jug).view.points, jug.view.points)


def test_the_best_grasp_is_the_first_executable_one_or_the_reasons():
    grasp = pinch("allegro")[1]
    three = dataclasses.replace(
        grasp[[0, 0, 0]],
        status=torch.tensor([13, 0, 0]),
        score=torch.tensor([9.0, 2.0, 1.0]).double(),
    )
    assert three.best == three[1] and float(three.best.score) == 2.0
    assert three.executable == three[1:] and len(three[:1].executable) == 0
    with pytest.raises(FailedRows, match=Status.NOT_CLOSED.sentence[:30]):
        three[:1].best
    with pytest.raises(FailedRows, match="explain_empty"):
        three[:0].best
    with pytest.raises(FailedRows, match="too small"):
        dataclasses.replace(three[:0], meta={"refused": "too small"}).best


def test_the_success_of_one_grasp_formats_as_a_number_and_computes_as_a_tensor():
    grasp = pinch("allegro")[1]
    best = dataclasses.replace(grasp[[0]], status=torch.tensor([0]), score=torch.zeros(1).double())
    assert f"{best.success:.2f}" == "0.50" and f"{best.best.success:.0%}" == "50%"
    assert type(best.success + 0) is torch.Tensor and best.success.tolist() == [0.5]
    assert torch.equal(copy.deepcopy(best.success), best.success)
    sent = pickle.loads(pickle.dumps(best.success))  # noqa: S301
    assert type(sent) is torch.Tensor and torch.equal(sent, best.success)
    both = join([best, best])
    assert f"{both.success}" == str(both.success) and both.success.shape == (2,)
    with pytest.raises(TypeError):
        f"{both.success:.2f}"


def test_the_text_of_grasps_begins_with_what_a_user_asks_first():
    grasps = load_shipped_grasp("jug", "barrett")[[0, 0]]
    assert repr(grasps).startswith(
        "Grasps(2 of 2 executable, best predicted success 94%, hand barrett, joints="
    )
    assert repr(grasps[:0]).startswith("Grasps(0 of 0 executable, hand barrett, ")


def test_the_joints_of_a_hand_are_all_joints_of_its_urdf_and_the_finger_that_rests_is_parked():
    """Sixteen of the Allegro, of which a grasp of three fingers moves twelve."""
    grasp = load_shipped_grasp("jug", "allegro")
    hand = hand_of(grasp)
    robot = yourdfpy.URDF.load(hand.urdf_path, load_meshes=False, build_scene_graph=False)
    joints = hand.expand(grasp.joints[0])
    assert len(joints) == 16 and set(joints) == set(robot.actuated_joint_names) > set(
        hand.joint_names
    )
    assert [float(joints[name]) for name in hand.joint_names] == grasp.joints[0].tolist()


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64])
def test_numbers_of_numpy_are_taken_without_a_warning(kind):
    assert ContactSpec(friction=kind(0.5)).friction == 0.5
    with pytest.raises(BadArgument, match=r"friction: expected .*got -0\.5"):
        ContactSpec(friction=kind(-0.5))


def test_sentences_of_statuses_say_what_is_measured_and_counted():
    """Pulls measure motion in the world from the start; a cluster may try more than twice."""
    assert "in the hand" not in Status.MOVED.sentence and "closing" in Status.MOVED.sentence
    assert "twice" not in Status.WORKER_DIED.sentence
