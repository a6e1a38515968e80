"""A hand without touch sensors: it closes in open loop with limited torques; Ctrl-C freezes it.

`MockHand` stands for the driver of your own hand. Replace its four methods; drivers/open_loop.py,
which has the loop with its watchdog, stays.
"""

import signal
import sys
import threading
from pathlib import Path

import torch

from torchgrasp import load_hand
from torchgrasp.data import load_shipped_grasp

sys.path.append(str(Path(__file__).parent / "drivers"))
from open_loop import OPEN_LOOP, close_open_loop, prepare


class MockHand:
    """A hand whose drives are springs with dampers; an object stops its joints at the grasp."""

    def __init__(self, closing, damping=0.1):
        self.rate = closing.kp / damping
        ends = torch.stack([closing.postures["pregrasp"], closing.postures["grasp"]])
        self.low = ends.amin(0)
        self.high = ends.amax(0)
        self.joints = closing.postures["pregrasp"]
        self.target = self.joints
        self.time = 0.0

    def read(self):
        """Return the time [s] of the latest reading, and the joints of the URDF [rad]."""
        return self.time, self.joints

    def send(self, targets):
        """Send the targets of all joints [rad]."""
        self.target = targets

    def wait(self):
        """Wait for the next tick, and return the time [s]; here the hand moves."""
        moved = self.joints + OPEN_LOOP.period * self.rate * (self.target - self.joints)
        self.joints = torch.clamp(moved, self.low, self.high)
        self.time += OPEN_LOOP.period
        return self.time

    def stop(self):
        """Hold the joints where they are."""
        self.target = self.joints


hand = load_hand("allegro")
grasp = load_shipped_grasp("jug", "allegro")  # or load_grasps("grasps.safetensors")[:1]
closing = prepare(hand, grasp, force=3.0)
driver = MockHand(closing)
stop = threading.Event()

before = signal.signal(signal.SIGINT, lambda *_: stop.set())
print(close_open_loop(driver, closing, stop))  # held: now lift the arm
signal.signal(signal.SIGINT, before)  # Ctrl-C ends the program again
torque = closing.kp * (driver.target - driver.joints)
for name, pressing, most in zip(hand.tree.joint_names, torque, closing.limits, strict=True):
    if abs(pressing) > 0.05:
        print(f"{name} presses with {pressing:.2f} N m of {most:.2f}")
