"""The driver of a hand without touch sensors: no torque beyond the limit, and no motion after a
stop.
"""

import contextlib
import dataclasses
import io
import runpy
import signal
import threading
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import open_loop
import pytest
import torch
from open_loop import OPEN_LOOP, LimitedClosing, OpenLoopNumbers, close_open_loop, prepare

from tests.make import load_hand
from torchgrasp.data import load_shipped_grasp
from torchgrasp.foundation.errors import BadArgument, Status

EXAMPLE = Path(open_loop.__file__).parents[1] / "11_open_loop_driver.py"


@pytest.fixture(scope="module")
def mock() -> Any:
    """The hand of the example, as a class that also keeps what happens in each tick."""
    with contextlib.redirect_stdout(io.StringIO()):
        base = runpy.run_path(str(EXAMPLE))["MockHand"]

    class Watched(base):
        def __init__(self, closing, *, each: Callable[[Any], None] = lambda hand: None, **options):
            super().__init__(closing, **options)
            self.closing = closing
            self.each = each
            self.torques: list[np.ndarray] = []
            self.stops = 0

        def send(self, targets):
            super().send(targets)
            assert not self.stops, "nothing is sent after a stop"
            self.torques.append((self.closing.kp * (targets - self.joints)).abs().numpy())

        def wait(self):
            self.each(self)
            return super().wait()

        def stop(self):
            super().stop()
            self.stops += 1

    return Watched


def closing_of(force: float = 3.0, numbers: OpenLoopNumbers = OPEN_LOOP) -> LimitedClosing:
    return prepare(load_hand("allegro"), load_shipped_grasp("jug", "allegro"), force, numbers)


def efforts() -> np.ndarray:
    """The efforts [N m] that the URDF states, by its own joints."""
    hand = load_hand("allegro")
    found = {}
    for joint in ET.parse(hand.urdf_path).iter("joint"):
        limit = joint.find("limit")
        if limit is not None:
            found[joint.get("name")] = float(limit.get("effort", "nan"))
    return np.array([found[name] for name in hand.tree.joint_names])


def assert_still(driver: Any) -> None:
    """Assert that the hand was stopped once, and that it stays where it is."""
    assert driver.stops == 1
    joints = driver.joints
    driver.each = lambda hand: None
    for _ in range(50):
        driver.wait()
    assert torch.equal(driver.joints, joints)


def test_the_hand_presses_with_the_planned_torques_and_goes_on(mock):
    closing = closing_of()
    driver = mock(closing)
    assert close_open_loop(driver, closing, threading.Event()) == "held"
    assert driver.stops == 0
    postures = closing.postures
    torque = closing.kp * (driver.target - driver.joints)
    planned = closing.kp * (postures["squeeze"] - postures["grasp"])
    # the object of the mock stops joints that go on closing, and lets others go back
    on = planned * (postures["grasp"] - postures["pregrasp"]) > 0
    torch.testing.assert_close(torque[on], planned[on], atol=0.01, rtol=0.0)
    assert int(on.sum()) > 5 and float(torque.abs().max()) > 0.1


@pytest.mark.parametrize("damping", [0.1, 1.0, 5.0])
@pytest.mark.parametrize("share", [0.33, 0.5])
def test_no_torque_exceeds_the_limit(mock, damping, share):
    """A slow hand lags: its torque is limited, and it is stopped, as a blocked one."""
    numbers = dataclasses.replace(OPEN_LOOP, share=share)
    closing = closing_of(numbers=numbers)
    driver = mock(closing, damping=damping)
    driver.joints = driver.target = closing.postures["pregrasp"] - 0.2
    driver.low = driver.joints
    ended = close_open_loop(driver, closing, threading.Event(), numbers)
    most = np.max(driver.torques, axis=0)
    assert np.all(most <= share * efforts() * (1 + 1e-9))
    if damping == 5.0:
        assert "behind" in ended and np.max(most / (share * efforts())) > 0.999
        assert_still(driver)


@pytest.mark.parametrize("tick", [1, 40, 150])
def test_a_stop_ends_all_motion_within_a_tick(mock, tick):
    stop = threading.Event()
    closing = closing_of()
    driver = mock(closing, each=lambda hand: len(hand.torques) < tick or stop.set())
    ended = close_open_loop(driver, closing, stop)
    assert ended.startswith("stopped on the way to the ") and ended.endswith(": asked to stop")
    assert len(driver.torques) == tick
    assert_still(driver)


def test_control_c_stops_the_hand_as_in_the_example(mock):
    stop = threading.Event()
    closing = closing_of()

    def interrupt(hand):
        if len(hand.torques) == 20:
            signal.raise_signal(signal.SIGINT)

    driver = mock(closing, each=interrupt)
    before = signal.signal(signal.SIGINT, lambda *_: stop.set())
    try:
        assert "asked to stop" in close_open_loop(driver, closing, stop)
    finally:
        signal.signal(signal.SIGINT, before)
    assert len(driver.torques) == 20
    assert_still(driver)


def test_old_readings_stop_the_hand(mock):
    """The age of a reading may be a tenth of a second; then nothing more is sent."""
    closing = closing_of()
    driver = mock(closing)
    frozen = driver.read()
    driver.read = lambda: frozen
    ended = close_open_loop(driver, closing, threading.Event())
    assert "no reading for 0.1" in ended
    assert len(driver.torques) <= 12
    assert driver.stops == 1


def test_readings_by_another_clock_stop_the_hand(mock):
    """They would never be old: the time of the day beside that since the start."""
    closing = closing_of()
    driver = mock(closing)
    driver.read = lambda: (1.7e9, driver.joints)
    ended = close_open_loop(driver, closing, threading.Event())
    assert "one clock" in ended and driver.stops == 1
    assert len(driver.torques) == 1


def test_a_reading_that_is_no_number_stops_the_hand(mock):
    closing = closing_of()
    driver = mock(closing)
    driver.each = lambda hand: setattr(hand, "read", lambda: (hand.time, hand.joints * torch.nan))
    assert "no number" in close_open_loop(driver, closing, threading.Event())
    assert (len(driver.torques), driver.stops) == (1, 1)


def test_a_first_reading_that_is_no_number_moves_nothing(mock):
    closing = closing_of()
    driver = mock(closing)
    driver.joints = driver.joints * torch.nan
    ended = close_open_loop(driver, closing, threading.Event())
    assert ended == "stopped at the start: a reading that is no number"
    assert (len(driver.torques), driver.stops) == (0, 1)


def test_readings_in_degrees_move_nothing(mock):
    closing = closing_of()
    driver = mock(closing)
    driver.joints = closing.postures["grasp"] * 180 / torch.pi
    assert "degrees" in close_open_loop(driver, closing, threading.Event())
    assert not driver.torques and driver.stops == 1


def test_a_finger_that_meets_something_before_the_grasp_stops_the_hand(mock):
    closing = closing_of()
    driver = mock(closing)
    driver.low = driver.high = driver.joints
    ended = close_open_loop(driver, closing, threading.Event())
    assert ended.startswith("stopped on the way to the grasp: a joint is 0.3")
    assert_still(driver)


def test_an_error_of_the_driver_stops_the_hand(mock):
    closing = closing_of()

    def unplug(hand):
        raise OSError("unplugged")

    driver = mock(closing, each=unplug)
    with pytest.raises(OSError, match="unplugged"):
        close_open_loop(driver, closing, threading.Event())
    assert_still(driver)


def test_what_the_hand_cannot_do_is_refused_before_it_moves():
    with pytest.raises(
        BadArgument, match=r"force: expected at most .*would exceed its limit"
    ) as told:
        closing_of(40.0)
    # with less than the stated force it can
    most = float(str(told.value).split("at most ")[1].split(" N")[0])
    closing_of(0.99 * most)
    grasp = load_shipped_grasp("jug", "allegro")
    with pytest.raises(BadArgument, match="one grasp"):
        prepare(load_hand("allegro"), grasp[[0, 0]], 3.0)
    failed = dataclasses.replace(grasp, status=torch.tensor([int(Status.TIP_ERROR)]))
    with pytest.raises(BadArgument, match=r"grasp: expected a grasp that passed .* got one that"):
        prepare(load_hand("allegro"), failed, 3.0)
    # its fingers and joints have the same names
    with pytest.raises(BadArgument, match=r"hand: expected allegro, .* got allegro_left"):
        prepare(load_hand("allegro_left"), grasp, 3.0)
