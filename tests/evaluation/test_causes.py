"""The cause of a failed lift, on records of known motion: each cause, just missed and just met."""

import dataclasses
import math

import pytest
import torch

from tests.make import real
from tests.pinch import cylinder, pinch
from torchgrasp import Status, TrialSpec
from torchgrasp.app.report.evaluation_page import format_evaluation, list_causes
from torchgrasp.evaluation import GraspTrial, Truth
from torchgrasp.evaluation.causes import CAUSES, find_cause
from torchgrasp.evaluation.several_tries import LiftTry
from torchgrasp.evaluation.summary import ProtocolResult, ViewScore, summarise
from torchgrasp.geometry.frames import rigid, rotation_from_vector
from torchgrasp.values.closing import ClosingTrace, ClosureResult, Disturbance, ObjectMotion

CENTRE = real([0.0, 0.0, 0.09])
# one hundredth of a second each: arrives at 0.5 s, touches at 1 s, has pressed at 1.5 s, has risen
# at 2.5 s
TICKS = 401
SPEC = TrialSpec()
TIME = torch.arange(TICKS, dtype=torch.float64) / 100
RISE = (TIME - 1.5).clamp(0.0, 1.0)[:, None] * real([0.0, 0.0, 0.1])


def trial(off=0.0):
    """The pinch of a cylinder, whose contacts are off the true surface by a distance along their
    normals.
    """
    hand, grasp = pinch("allegro")
    contacts = grasp.contacts
    moved = dataclasses.replace(contacts, points=contacts.points + off * contacts.normals)
    return GraspTrial(
        hand, dataclasses.replace(grasp, contacts=moved), Truth(cylinder(), [cylinder()])
    )


def ramp(start, end):
    """How much of a motion between two times [s] is done at each tick."""
    return ((TIME - start) / (end - start)).clamp(0.0, 1.0)[:, None]


def record(moved=None, turned=None, rises=True, status=Status.DROPPED, order=(0, 1, 2), **changes):
    """A lift in which the object's centre moves by `moved` (t, 3) [m], besides the lift, and turns
    by `turned`.
    """
    nothing = torch.zeros(TICKS, 3, dtype=torch.float64)
    rotation = rotation_from_vector(nothing if turned is None else turned)
    shift = (nothing if moved is None else moved) + rises * RISE
    still = ObjectMotion(0.0, 0.0)
    vectors = torch.zeros(TICKS, 3, 3, dtype=torch.float64)
    stray = Disturbance(
        nothing[0], nothing[0], nothing[0], nothing[0] > 0, torch.zeros(TICKS, 0, 4, 4).double()
    )
    return ClosureResult(
        held=status is Status.OK,
        status=status,
        time=TIME,
        forces=nothing + real([1.0, 2.0, 3.0]),
        object_pose=rigid(rotation, shift + CENTRE - rotation @ CENTRE),
        hand_pose=rigid(torch.eye(3).double().expand(TICKS, 3, 3), RISE),
        joints=nothing[:, :0],
        targets=nothing[:, :0],
        joint_names=(),
        contact_order=order,
        object_motion=still,
        pushed=still,
        before_lift=still,
        rise=0.0,
        unbalanced=0.0,
        slip=still,
        start_overlap=0.004,
        disturbance=stray,
        trace=ClosingTrace(vectors, vectors, vectors, nothing, nothing, *nothing.T[:2]),
        phases=changes.pop("phases", real([0.5, 1.0, 1.5])),
        stops=0,
        attempts=1,
        seconds=0.0,
    )


def cause(off=0.0, spec=SPEC, **motion):
    return find_cause([LiftTry(0, record(**motion))], trial(off), spec)


X = real([1.0, 0.0, 0.0])
Z = real([0.0, 0.0, 1.0])
MOTIONS = (  # cause, size, a motion of the object that has the cause, one that just misses it
    (
        "pushed away",
        21.0,
        {"moved": ramp(0.0, 0.9) * 0.021 * X},
        {"moved": ramp(0.0, 0.9) * 0.0199 * X},
    ),
    (
        "ejected",
        21.0,
        {"moved": ramp(1.0, 1.4) * 0.021 * X},
        {"moved": ramp(0.5, 1.5) * 0.0389 * X},
    ),
    (
        "toppled",
        31.0,
        {"turned": ramp(0.0, 1.2) * math.radians(31) * X},
        {"turned": ramp(0.0, 1.2) * 0.52 * X},
    ),
    (
        "toppled",
        90.0,
        {"turned": ramp(0.5, 1.0) * math.pi / 2 * X},
        {"turned": ramp(0.5, 1.0) * 1.6 * Z},
    ),
    ("shape off", 11.0, {"off": 0.011}, {"off": 0.0099}),
    ("never met", 4.0, {"off": 0.004, "order": (0, 2)}, {"off": 0.004}),
    ("too weak", 3.0, {"status": Status.TOO_WEAK}, {"status": Status.DROPPED}),
    ("too weak", 3.0, {"status": Status.TOO_HEAVY}, {"status": Status.NOT_LIFTED}),
    (
        "turned",
        40.0,
        {"turned": ramp(1.5, 2.5) * math.radians(40) * X},
        {"turned": ramp(1.5, 2.5) * 0.52 * X},
    ),
    ("slid", 100.0, {"rises": False}, {"rises": True, "turned": ramp(2.0, 3.0) * X}),
)


@pytest.mark.parametrize(("expected", "size", "motion", "missed"), MOTIONS)
def test_each_cause_is_found_with_its_size_and_not_just_below_its_limit(
    expected, size, motion, missed
):
    found, measured = cause(**motion)
    assert found == expected
    assert measured == pytest.approx(
        size, abs=0.3
    )  # a cylinder of 32 sides is within 0.15 mm of a round one
    assert cause(**missed)[0] != expected


def test_the_push_is_the_cause_only_of_an_object_that_was_in_the_hand_before_it():
    pushed = dataclasses.replace(SPEC, push=(0.0, 1.5, -2.0))
    early, late = (ramp(start, start + 0.5) * 0.1 * X for start in (1.6, 2.7))
    assert cause(spec=pushed, moved=late) == ("dropped when pushed", 2.5)
    assert cause(spec=pushed, moved=early)[0] == cause(moved=late)[0] == "slid"


def test_the_first_cause_counts_and_the_first_motion_in_the_hand():
    everything = {
        "moved": ramp(0.6, 0.9) * 0.05 * X,
        "turned": ramp(0.5, 1.2) * 0.6 * X,
        "off": 0.02,
        "order": (),
    }
    assert [cause(**everything)[0], cause(**everything | {"turned": None})[0]] == [
        "toppled",
        "pushed away",
    ]
    turn = ramp(1.5, 2.5) * 1.0 * X
    slide = ramp(1.5, 2.5) * 0.1 * Z
    assert cause(turned=turn, moved=0.1 * slide)[0] == "turned"
    assert cause(turned=0.6 * turn, moved=-slide)[0] == "slid"


def test_the_motion_of_an_object_that_slides_by_itself_is_not_the_hands():
    slid = trial()
    slid = dataclasses.replace(slid, truth=dataclasses.replace(slid.truth, slide=0.05 * X))
    found = [
        find_cause([LiftTry(0, record(moved=ramp(0.2, 0.4) * x * X))], slid, SPEC)[0]
        for x in (0.05, 0.031, 0.0)
    ]
    assert found == ["slid", "slid", "pushed away"]


def test_a_later_try_is_judged_from_where_the_try_before_left_the_object():
    """It stands 50 mm aside and turned by half a turn, and is then pushed by 21 mm."""
    first = record(
        moved=ramp(0.0, 0.9) * 0.05 * X, turned=ramp(0.0, 0.9) * math.pi * Z, rises=False
    )
    second = record(moved=ramp(0.0, 0.9) * 0.021 * X)
    aside = rigid(torch.eye(3).double(), -0.05 * X)
    about = dataclasses.replace(
        second, object_pose=rigid(torch.eye(3).double(), 0.05 * X) @ second.object_pose @ aside
    )
    assert find_cause([LiftTry(0, first), LiftTry(0, about)], trial(), SPEC) == (
        "pushed away",
        pytest.approx(21.0),
    )


def test_a_held_overlapping_or_unfinished_trial():
    assert cause(status=Status.OK)[0] == cause(status=Status.UNSTABLE)[0] == ""
    assert cause(status=Status.START_OVERLAP) == ("start overlap", 4.0)
    lost = {
        "phases": real([0.5, math.nan, math.nan]),
        "moved": ramp(1.0, 4.0) * 0.6 * X,
        "rises": False,
    }
    assert cause(**lost) == ("pushed away", pytest.approx(600.0))


def test_causes_are_counted_by_group_and_shown_with_their_median_size():
    lost = ProtocolResult(0, 0, False, Status.SLIPPED, cause="slid", size=25.0)
    turned = dataclasses.replace(lost, passed=True, cause="turned", size=40.0)
    held = ProtocolResult(0, 0, True, Status.OK)
    attempts = {"pen": (lost, turned, held), "jug": (dataclasses.replace(lost, size=31.0), held)}
    scores = [
        ViewScore(name, "view0", 9, 1.0, tries, group=name) for name, tries in attempts.items()
    ]
    found = summarise(scores)
    assert found["causes"] == {
        "slid": {"count": 2, "by_group": {"pen": 1, "jug": 1}, "median": 28.0},
        "turned": {"count": 1, "by_group": {"pen": 1}, "median": 40.0},
    }
    assert list_causes(found) == [
        ("slid", "2 (1 pen, 1 jug), median 28 mm"),
        ("turned", "1 (1 pen), median 40 deg"),
    ]
    assert CAUSES["turned"][1] in format_evaluation("Lifts", {}, scores)
    assert summarise([ViewScore("pen", "view0", 9, 1.0, (held,))])["causes"] == {}
