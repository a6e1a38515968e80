"""The criterion of a lift, on authored motions just above and just below each limit; no simulator
is needed.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchgrasp import Status, TrialSpec
from torchgrasp.control import TipContact
from torchgrasp.evaluation.lift import LIFT_TIME, RecordedLift
from torchgrasp.evaluation.trial import TrialRun
from torchgrasp.geometry.frames import rotation_from_vector

CENTRE = np.array([0.06, -0.03, 0.09])
"""Centre of mass [m] of the authored object in its own frame."""
CLOSED = 5
"""Number of ticks in which the authored hand closes."""


def at(place=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0)):
    """The pose of the object whose centre of mass is displaced by `place` [m] and which turned
    about it by `turn`.
    """
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_vector(torch.tensor(turn, dtype=torch.float64)).numpy()
    pose[:3, 3] = np.array(place) + CENTRE - pose[:3, :3] @ CENTRE
    return pose


class Authored(TrialRun):
    """A run of a trial in which hand, object and contacts move as the test says.

    `motion` gives the object's pose, and `fingers` the number of touching fingers, at a time [s]
    from the begin of the lift (negative while the hand closes) and a height [m] of the hand.
    """

    starts = True
    felt = (0.0, 0.0)
    slid = np.zeros(3)

    def __init__(self, motion, fingers=lambda time: 3, spec=None, touched=True, strained=False):
        self.spec = TrialSpec(hold_time=0.3) if spec is None else spec
        self.motion = motion
        self.fingers = fingers
        self.strained = lambda: strained
        self.height = 0.0
        self.tick = -CLOSED
        self.turned = np.eye(4)
        zero = torch.zeros(3, 3, dtype=torch.float64)
        self.robot = SimpleNamespace(
            period=1 / self.spec.control_rate,
            truth=TipContact(zero[0], zero, zero, zero, zero[0]),
            steps=0,
            sent=np.zeros(4),
            first_touch=[1.0 if touched else math.inf] * 3,
            unbalanced=lambda: 0.0,
            finger=np.zeros(3, dtype=bool),
        )
        self.robot.ticks = lambda seconds: max(1, round(seconds / self.robot.period))
        self.controller = SimpleNamespace(blend=zero[0], hold=None, status=Status.OK)
        self.scene = SimpleNamespace(
            centre=CENTRE,
            lift=self.lift,
            joints=lambda: np.zeros(4),
            neighbour_poses=lambda: np.zeros((0, 4, 4)),
            hand_pose=lambda: at((0.0, 0.0, self.height)),
            object_pose=lambda: self.motion(self.time, self.height),
        )

    @property
    def time(self):
        return self.tick * self.robot.period

    def lift(self, height, speed):
        self.height = height

    def approach(self):
        return iter(())

    def close(self):
        for _ in range(CLOSED):
            self.step()
            yield

    def step(self):
        self.tick += 1
        self.robot.finger = np.arange(3) < self.fingers(self.time)


def verdict(*arguments, **options):
    return RecordedLift(Authored(*arguments, **options)).perform()


def slipping(place=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0), begin=0.1):
    """The motion of an object that follows the hand and moves in the hand at a time after the begin
    of the lift.
    """
    return lambda time, height: at(
        np.array([0, 0, height]) + np.array(place) * (time > begin),
        turn if time > begin else [0.0] * 3,
    )


def test_an_object_that_follows_the_hand_is_held():
    assert verdict(slipping()) is Status.OK


@pytest.mark.parametrize("lift", [0.03, 0.035])
@pytest.mark.parametrize(
    ("share", "found"), [(0.501, Status.OK), (0.499, Status.NOT_LIFTED), (0.11, Status.NOT_LIFTED)]
)
def test_the_centre_rises_by_half_of_the_lift(lift, share, found):
    """Lifts so low that an object which stays behind slips by less than 20 mm."""
    spec = TrialSpec(lift_height=lift, hold_time=0.3)
    assert (1 - share) * lift < 0.02 or found is not Status.OK
    assert verdict(lambda time, height: at([0.0, 0.0, share * height]), spec=spec) is found


def test_an_object_that_rose_and_fell_is_dropped():
    falling = lambda time, height: at([0.0, 0.0, height if time < 1.1 else 0.0])  # noqa: E731
    assert verdict(falling) is Status.DROPPED


@pytest.mark.parametrize(
    "axis", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0), (0.6, 0.0, 0.8)]
)
@pytest.mark.parametrize(("distance", "found"), [(0.0199, Status.OK), (0.0201, Status.SLIPPED)])
def test_an_object_slips_by_less_than_20_mm(axis, distance, found):
    assert verdict(slipping(place=distance * np.array(axis))) is found


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.6, 0.8)])
@pytest.mark.parametrize(
    ("degrees", "found"), [(29.9, Status.OK), (30.1, Status.SLIPPED), (179.0, Status.SLIPPED)]
)
def test_an_object_turns_by_less_than_30_degrees(axis, degrees, found):
    assert verdict(slipping(turn=math.radians(degrees) * np.array(axis))) is found


def test_motion_before_the_hand_has_pressed_is_no_slip():
    """The object moves by 40 mm and turns by 90 degrees while the fingers close."""
    assert verdict(slipping([0.04, 0.0, 0.0], [0.0, 0.0, math.pi / 2], begin=-0.03)) is Status.OK
    assert verdict(slipping([0.04, 0.0, 0.0], begin=0.005)) is Status.SLIPPED


def test_motion_with_the_hand_is_no_slip():
    """Hand and object turn and move together, as with an arm that shakes: the motion in the hand is
    zero.
    """
    run = Authored(None)
    carried = lambda: at([0.1 * run.height, 0.0, run.height], [0.0, 0.0, 10.0 * run.height])  # noqa: E731
    run.scene.hand_pose = run.scene.object_pose = carried
    assert RecordedLift(run).perform() is Status.OK


@pytest.mark.parametrize(
    ("count", "found"), [(3, Status.OK), (2, Status.OK), (1, Status.DROPPED), (0, Status.DROPPED)]
)
def test_two_fingers_touch_at_the_end(count, found):
    assert verdict(slipping(), lambda time: count if time > 0.2 else 3) is found


@pytest.mark.parametrize(("most", "found"), [(11, Status.OK), (10, Status.DROPPED)])
@pytest.mark.parametrize("late", [True, False])
def test_they_touch_in_most_of_the_last_fifth_of_a_second(most, found, late):
    """At 100 Hz 20 ticks count: two fingers touch in 11 or 10 of them, the last or the first;
    before them, none.
    """
    end = round(100 * (LIFT_TIME + 0.3))
    first = end - most if late else end - 20
    touching = lambda time: 2 if first < round(100 * time) <= first + most else 0  # noqa: E731
    assert verdict(slipping(), touching) is found


@pytest.mark.parametrize(
    ("hold", "found"), [(0.48, Status.OK), (0.52, Status.SLIPPED), (2.0, Status.SLIPPED)]
)
def test_an_object_is_held_until_the_end_of_the_hold_time(hold, found):
    """The object slips out of the limits half a second after the lift."""
    spec = TrialSpec(hold_time=hold)
    run = Authored(slipping([0.0, 0.03, 0.0], begin=LIFT_TIME + 0.5), spec=spec)
    assert RecordedLift(run).perform() is found
    assert run.time == pytest.approx(LIFT_TIME + hold, abs=1e-9)


@pytest.mark.parametrize(
    ("touched", "pushed", "strained", "found"),
    [
        (False, 0.06, True, Status.NO_CONTACT),
        (True, 0.051, True, Status.EJECTED),
        (True, 0.049, True, Status.TOO_WEAK),
        (True, 0.049, False, Status.NOT_LIFTED),
    ],
)
def test_the_first_reason_is_told_for_an_object_that_stays_behind(touched, pushed, strained, found):
    """It stays where the closing fingers pushed it."""
    stays = lambda time, height: at([pushed * (time > -0.03), 0.0, 0.0])  # noqa: E731
    assert verdict(stays, touched=touched, strained=strained) is found


@pytest.mark.parametrize(("gone", "found"), [(0.59, True), (0.61, False)])
def test_a_trial_ends_early_when_the_object_is_far_away(gone, found):
    """Half a metre beyond the lift of 0.1 m."""
    run = Authored(lambda time, height: at([gone * (time > 0.5), 0.0, 0.0]))
    assert RecordedLift(run).perform() is not Status.OK
    assert (run.time > 1.0) is found


def test_a_simulation_that_diverged_is_unstable():
    assert (
        verdict(lambda time, height: at([math.nan if time > 0.2 else 0.0, 0.0, 0.0]))
        is Status.UNSTABLE
    )
