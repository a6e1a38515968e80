#!/usr/bin/env python3
"""Close an Allegro or a LEAP hand on a planned grasp, and hold. Joint states come in, joint
commands go out.

`HandLoop` holds what the node does with messages; it needs no ROS. Neither hand feels with its
fingertips. The loop takes what a drive exerts beyond the free motion, stiffness times lag, as the
torque of a contact.
"""

import contextlib
import dataclasses
import gc
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import messages
import torch

from torchgrasp import ClosingReference, GraspController, load_grasps
from torchgrasp.control import ClosingOptions, feel_torques, no_contact, observe
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.hand import hand_of
from torchgrasp.values.closing import SensorModel

OPENING = 0.5  # greatest speed [rad/s] of a joint on its way to the pre-grasp
# time [s] without joint states after which nothing is sent: the driver then keeps its last targets
SILENCE = 0.1
# distance [rad] of the first state from the pre-grasp that no finger has: it is in degrees
FAR = math.pi


class Driver(NamedTuple):
    """The interface of a hand's driver; positions are in the order of the file of names."""

    commands: str  # topic of sensor_msgs/JointState
    states: str  # topic of sensor_msgs/JointState, or the LEAP's service
    zero: float  # what the driver calls the zero of the URDF [rad]


DRIVERS = {
    "allegro": Driver("allegroHand/joint_cmd", "allegroHand/joint_states", 0.0),
    "leap": Driver("cmd_leap", "leap_position", math.pi),  # flat is 180 degrees there
}


class Settings(NamedTuple):
    """Parameters of the node, by these names."""

    grasps: str = "grasps.safetensors"  # file of plan_node or of `torchgrasp grasp`
    row: int = 0  # the number in the message's id
    rate: float = 200.0  # ticks a second [Hz], 100 to 250
    force: float = 4.0  # normal force [N] of the strongest finger
    kp: float = 0.0  # stiffness [N m/rad] of the driver's position control; 0: that of hand.toml
    feel: bool = True  # False: open loop, for a stiffness that is not known


class HandLoop:
    """The loop of one hand: it opens to the pre-grasp; it closes and holds between `close` and
    `open`.
    """

    def __init__(self, settings: Settings) -> None:
        grasp = load_grasps(settings.grasps)[settings.row].raise_for_status()
        self.period = 1 / settings.rate
        reference = ClosingReference.from_grasp(
            hand_of(grasp), grasp, settings.force, kp=settings.kp or None
        )
        self.reference = dataclasses.replace(reference, sensor=SensorModel("torque"))
        self.hand = reference.hand
        self.feel = settings.feel
        kind = self.hand.name.removesuffix("_left")
        joints = self.hand.tree.joint_names
        names: dict[str, str] = json.loads(
            (Path(__file__).parent / "drivers" / f"{kind}.json").read_text()
        )
        self.driver = DRIVERS[kind]
        self.names = list(names.values())
        self.order = [joints.index(name) for name in names]  # of the driver, in the URDF's
        self.back = [list(names).index(name) for name in joints]
        self.damping = torch.tensor(
            [self.hand.actuators[joint].kd for joint in joints], dtype=torch.float64
        )
        self.pregrasp = self.reference.expand(self.reference.pregrasp)
        self.controller: GraspController | None = None
        self.measured: torch.Tensor | None = None
        self.sent = self.pregrasp
        self.before = self.pregrasp
        self.silent = 0

    def hear(self, positions: Any, names: Sequence[str] = ()) -> None:
        """Take the driver's joint positions [rad]: of a JointState, or of the LEAP's service.

        They are in the order of `names`, those of the message, which may have further joints.
        Without names they are in the driver's order. Raises `BadArgument` for a joint that the
        names lack, and for a first state far off the pre-grasp, as one in degrees.
        """
        if len(names):
            at = {name: place for place, name in enumerate(names)}
            if lacking := [name for name in self.names if name not in at]:
                found = f"joint states without {lacking[0]!r}"
                raise BadArgument("names", found, f"those of the driver: {', '.join(self.names)}")
            if len(positions) != len(names):
                return
            positions = [positions[at[name]] for name in self.names]
        if len(positions) == len(self.names) and all(map(math.isfinite, positions)):
            first = self.measured is None
            joints = torch.tensor(list(positions), dtype=torch.float64)[self.back]
            joints = joints - self.driver.zero
            off = float((joints - self.pregrasp).abs().max())
            if first and off > FAR:
                found = f"a joint {off:.1f} off the pre-grasp"
                raise BadArgument("positions", found, "radians, with the driver's zero")
            self.silent = 0
            self.measured = joints
            self.sent = self.measured if first else self.sent  # the hand opens from where it is

    def close(self) -> bool:
        """Begin to close, if the hand is at its pre-grasp; return whether it is."""
        if self.measured is None or not torch.equal(self.sent, self.pregrasp):
            return False
        if self.feel:
            options = ClosingOptions(palm_reach=0.0, stops=0)  # the arm stands still
            self.controller = GraspController(self.reference, options=options)
        else:
            self.controller = GraspController(self.reference, "open_loop")
        self.tactile = no_contact(fingers=len(self.hand.tips))
        self.before = self.measured
        return True

    def open(self) -> None:
        """Begin to open to the pre-grasp."""
        self.controller = None

    def tick(self) -> torch.Tensor | None:
        """Return the targets of the next period, in the URDF's order [rad]; None while the driver
        is silent.
        """
        self.silent += 1
        if (measured := self.measured) is None or self.silent > round(SILENCE / self.period):
            return None
        if self.controller is None:
            ahead = self.pregrasp - self.sent
            step = ahead.clamp(-OPENING * self.period, OPENING * self.period)
            self.sent = torch.where(step == ahead, self.pregrasp, self.sent + step)
        else:
            self.sent = self._step(self.controller, measured)
        return self.sent

    def _step(self, controller: GraspController, measured: torch.Tensor) -> torch.Tensor:
        """Return the controller's targets; the fingertips' forces are estimated from the lag of the
        drives.
        """
        seen = observe(self.hand, self.reference.pick(measured), self.tactile)
        torques = (
            self.reference.kp * (self.sent - measured)
            - self.damping * (measured - self.before) / self.period
        )
        self.tactile = feel_torques(
            self.tactile, self.reference, seen.jacobian, torques, self.period
        )
        self.before = measured
        return controller.step(dataclasses.replace(seen, tactile=self.tactile), self.period).joints

    def command(self, types: messages.Types, targets: torch.Tensor, stamp: Any) -> Any:
        """Return the driver's sensor_msgs/JointState of targets."""
        return types.JointState(
            header=types.Header(stamp=stamp, frame_id=""),
            name=self.names,
            position=types.floats((targets[self.order] + self.driver.zero).tolist()),
            velocity=types.floats(()),
            effort=types.floats(()),
        )


def main() -> None:
    """Run the loop of a hand until the node is shut down."""
    import rclpy  # pyright: ignore[reportMissingImports]
    from rclpy.executors import ExternalShutdownException  # pyright: ignore[reportMissingImports]
    from sensor_msgs.msg import JointState  # pyright: ignore[reportMissingImports]
    from std_msgs.msg import Bool  # pyright: ignore[reportMissingImports]
    from std_srvs.srv import SetBool  # pyright: ignore[reportMissingImports]

    rclpy.init()
    node = rclpy.create_node("close_hand")
    types = messages.ros_types()
    settings = Settings(
        **{name: node.declare_parameter(name, x).value for name, x in Settings()._asdict().items()}
    )
    loop = HandLoop(settings)
    commands = node.create_publisher(JointState, loop.driver.commands, 1)
    closed = node.create_publisher(Bool, "~/closed", 1)
    poll = listen(node, loop)

    def close(request: Any, response: Any) -> Any:
        """Close an opened hand, or open it."""
        response.success = loop.close() if request.data else loop.open() is None
        response.message = "" if response.success else "the hand is not at its pre-grasp yet"
        return response

    def tick() -> None:
        """Send the next targets."""
        poll()
        if (targets := loop.tick()) is not None:
            commands.publish(loop.command(types, targets, node.get_clock().now().to_msg()))
        closed.publish(Bool(data=loop.controller is not None and loop.controller.closed))

    node.create_service(SetBool, "~/close", close)
    gc.collect()
    gc.freeze()  # else Python looks through all that was imported in some tick
    node.create_timer(loop.period, tick)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


def listen(node: Any, loop: HandLoop) -> Callable[[], None]:
    """Let the loop hear the driver; the function that is returned asks a LEAP's service again when
    it has answered.
    """
    if loop.driver.states != "leap_position":
        from sensor_msgs.msg import JointState  # pyright: ignore[reportMissingImports]

        node.create_subscription(
            JointState,
            loop.driver.states,
            lambda message: loop.hear(message.position, message.name),
            1,
        )
        return lambda: None
    from leap_hand.srv import LeapPosition  # pyright: ignore[reportMissingImports]

    client = node.create_client(LeapPosition, loop.driver.states)
    client.wait_for_service()
    asked: list[Any] = [client.call_async(LeapPosition.Request())]

    def poll() -> None:
        if asked[0].done():
            loop.hear(asked[0].result().position)
            asked[0] = client.call_async(LeapPosition.Request())

    return poll


if __name__ == "__main__":
    main()
