"""Close a hand without touch sensors in open loop: limited torques, a watchdog, and a stop.

Your hand is a class with the four methods of `HandDriver`. Its drives control positions: they exert
kp (target - joint). So a target that is near the joint limits the torque.
"""

import dataclasses
import math
import threading
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from torchgrasp.control import squeeze
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.hand.hand import Hand
from torchgrasp.values.planning import Grasps


class HandDriver(Protocol):
    """What a user fills in; joints are all movable ones, in the order of `hand.tree.joint_names`."""

    def read(self) -> tuple[float, Tensor]:
        """Return the time [s] of the latest reading, and the joints (j,) [rad]."""
        ...

    def send(self, targets: Tensor) -> None:
        """Send the targets (j,) [rad] of the joints."""
        ...

    def wait(self) -> float:
        """Wait for the next tick; return the time [s], by the clock of the readings."""
        ...

    def stop(self) -> None:
        """Hold the joints where they are, or open the hand; nothing is sent after it."""
        ...


@dataclasses.dataclass(frozen=True)
class OpenLoopNumbers:
    """Parameters of a closing in open loop. All are cautious; a hand can be several times faster."""

    share: float = 0.5
    """Share of each joint's effort in the URDF that no command exceeds."""
    speed: float = 0.5
    """Greatest speed of a joint's target [rad/s]."""
    pressing: float = 1.0
    """Time from the grasp to the squeeze [s]."""
    stale: float = 0.1
    """Age of a reading [s] that stops the hand."""
    blocked: float = 0.3
    """Distance [rad] of a joint from its target that stops the hand before the squeeze."""
    far: float = math.pi
    """Distance [rad] of the first reading from the pre-grasp that no finger has: it is in degrees."""
    period: float = 0.01
    """Time between two ticks [s]."""


OPEN_LOOP = OpenLoopNumbers()


class LimitedClosing(NamedTuple):
    """The postures of a closing, and what no command exceeds.

    Attributes:
        postures: joints (j,) [rad] by name: "pregrasp", "grasp" and "squeeze".
        kp: stiffness (j,) of the drives [N m/rad].
        limits: greatest torques (j,) [N m].
    """

    postures: dict[str, Tensor]
    kp: Tensor
    limits: Tensor


def prepare(
    hand: Hand, grasp: Grasps, force: float, numbers: OpenLoopNumbers = OPEN_LOOP
) -> LimitedClosing:
    """Return the closing of a grasp, whose strongest finger presses with `force` [N].

    Raises `BadArgument` for more than one grasp, and for one that failed a check or is of another
    hand. Raises it also for a force that needs more than the limits.
    """
    if len(grasp) != 1:
        raise BadArgument("grasp", f"{len(grasp)} grasps", "one grasp, as grasps[:1]")
    status = Status(int(grasp.status[0]))
    if status != Status.OK:
        found = f"one that failed: {status.sentence}"
        raise BadArgument("grasp", found, "a grasp that passed all checks, as grasps.best")
    names = hand.tree.joint_names
    drives = [hand.actuators[name] for name in names]
    kp = torch.tensor([drive.kp for drive in drives], dtype=torch.float64)
    limits = numbers.share * torch.tensor([drive.effort for drive in drives], dtype=torch.float64)
    pressed = squeeze(hand, grasp, force).joints
    joints = {"pregrasp": grasp.pregrasp, "grasp": grasp.joints, "squeeze": pressed}
    postures = {name: hand.expand_joints(q.double())[0] for name, q in joints.items()}
    needed = kp * (postures["squeeze"] - postures["grasp"]).abs() / limits
    worst = int(needed.argmax())
    if float(needed[worst]) > 1:
        most = force / float(needed[worst])
        found = f"{force:g} N, for which {names[worst]} would exceed its limit"
        raise BadArgument("force", found, f"at most {most:.2f} N")
    return LimitedClosing(postures, kp, limits)


def close_open_loop(
    driver: HandDriver,
    closing: LimitedClosing,
    stop: threading.Event,
    numbers: OpenLoopNumbers = OPEN_LOOP,
) -> str:
    """Go from where the hand is to the pre-grasp, the grasp and the squeeze; return how it ended.

    That is "held", with the drives pressing on, or why the hand was stopped. The hand is stopped
    within a tick when `stop` is set, and when a reading is old, by another clock, or no number. It is also stopped
    when a joint is blocked before the squeeze, and by any error.
    """
    reach = closing.limits / closing.kp
    ended = "stopped by an error"
    try:
        now, before = driver.read()
        if not bool(torch.isfinite(before).all()):
            ended = "stopped at the start: a reading that is no number"
            return ended
        if float((before - closing.postures["pregrasp"]).abs().max()) > numbers.far:
            ended = "stopped at the start: a joint out of its range, as in degrees"
            return ended
        for name, posture in closing.postures.items():
            way = posture - before
            seconds = float(way.abs().max()) / numbers.speed
            if name == "squeeze":
                seconds = numbers.pressing
            ticks = max(1, round(seconds / numbers.period))
            for tick in range(1, ticks + 1):
                goal = before + tick / ticks * way
                time, joints = driver.read()
                fault = _find_fault(now - time, joints, goal, stop, name, numbers)
                if fault:
                    ended = f"stopped on the way to the {name}: {fault}"
                    return ended
                driver.send(torch.clamp(goal, joints - reach, joints + reach))
                now = driver.wait()
            before = posture
        ended = "held"
        return ended
    finally:
        if ended != "held":
            driver.stop()


def _find_fault(
    age: float,
    joints: Tensor,
    goal: Tensor,
    stop: threading.Event,
    name: str,
    numbers: OpenLoopNumbers,
) -> str:
    """Return why the hand must stop; "" if it may go on."""
    if stop.is_set():
        return "asked to stop"
    if age > numbers.stale:
        return f"no reading for {age:.2f} s"
    if age < -numbers.stale:
        return f"a reading {-age:.2f} s ahead of the clock: both must be one clock"
    if not bool(torch.isfinite(joints).all()):
        return "a reading that is no number"
    behind = float((goal - joints).abs().max())
    # in the squeeze, the object holds the joints back
    if name != "squeeze" and behind > numbers.blocked:
        return f"a joint is {behind:.2f} rad behind"
    return ""
