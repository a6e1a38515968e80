"""The closing node without ROS: every joint state and command passes through its message."""

import dataclasses

import close_node
import numpy as np
import pytest
import torch

from tests.pinch import cylinder, pinch
from tests.ros2 import bags
from torchgrasp.control import Targets
from torchgrasp.evaluation import lift
from torchgrasp.evaluation.trial import GraspTrial, TrialDriver, Truth
from torchgrasp.foundation.errors import BadArgument, FailedRows, Status
from torchgrasp.values.specs import TrialSpec


@pytest.fixture
def file(tmp_path):
    """A pinch of a cylinder by the Allegro hand, saved as a planner saves it."""
    hand, grasp = pinch("allegro")
    meta = {"hand": "allegro", "hand_sha256": hand.source.sha256}
    dataclasses.replace(grasp, meta=grasp.meta | meta).save(tmp_path / "grasps.safetensors")
    return str(tmp_path / "grasps.safetensors")


class Driver:
    """Stands for a driver and its ROS: it takes the place of a trial's controller, and knows only
    messages.
    """

    def __init__(self, loop, order, zero, names):
        self.loop = loop
        self.order = order
        self.zero = zero
        self.names = names
        self.commands = []

    def say(self, joints):
        """Let the node hear the joints [rad], which are in the URDF's order."""
        state = bags.message(
            "sensor_msgs/JointState",
            header=bags.header(""),
            name=self.names,
            position=joints.numpy()[self.order] + self.zero,
            velocity=np.zeros(16),
            effort=np.zeros(16),
        )
        self.loop.hear(bags.through_cdr(state, "sensor_msgs/JointState").position)

    def answer(self):
        """Return what the node commands, as joints in the URDF's order; None if it says nothing."""
        if (targets := self.loop.tick()) is None:
            return None
        sent = self.loop.command(bags.types(), targets, bags.time(1))
        self.commands.append(command := bags.through_cdr(sent, "sensor_msgs/JointState"))
        assert command.name == self.names
        joints = torch.empty(16, dtype=torch.float64)
        joints[self.order] = torch.from_numpy(command.position - self.zero)
        return joints

    def step(self, observation, period):
        """Return the targets, as the controller does whose place this driver takes."""
        self.say(observation.joints)
        return Targets(self.answer())

    def __getattr__(self, name):
        return getattr(self.loop.controller, name)


def allegro(loop):
    return Driver(loop, list(range(16)), 0.0, [f"joint_{k}.0" for k in range(16)])


@pytest.mark.sim
@pytest.mark.parametrize(("feel", "rate"), [(True, 100.0), (False, 50.0)])
def test_a_cylinder_is_lifted_through_messages(file, feel, rate):
    pytest.importorskip("mujoco")
    hand, grasp = pinch("allegro")
    spec = TrialSpec(
        simulator="mujoco", control_rate=rate, hold_time=0.1, approach=0.0, lift_height=0.1
    )
    run = TrialDriver(GraspTrial(hand, grasp, Truth(cylinder())), spec).open()
    run.controller = driver = allegro(
        close_node.HandLoop(close_node.Settings(file, rate=rate, feel=feel))
    )
    driver.say(driver.loop.pregrasp)
    assert driver.loop.close()
    trial = lift.RecordedLift(run)
    result = trial.result(trial.perform(), 0.0)
    assert result.held and result.contact_order and result.rise > 0.05
    assert float(result.forces[-1].max()) < 6.0  # 4 N are asked of the strongest finger
    assert len(driver.commands) > rate


def test_the_hand_opens_before_it_closes_and_opens_again(file):
    """Joints that follow at once: a joint 0.4 rad off comes to its pre-grasp in 0.8 s at 0.5 rad/s."""
    loop = close_node.HandLoop(close_node.Settings(file))
    driver = allegro(loop)
    start = loop.pregrasp.clone()
    start[12] -= 0.4
    assert driver.answer() is None and not loop.close()  # before the first joint state
    joints = start
    ticks = 0
    while not torch.equal(joints, loop.pregrasp):
        driver.say(joints)
        assert not loop.close()
        moved = driver.answer()
        assert float((moved - joints).abs().max()) <= 0.5 / 200 + 1e-12
        joints = moved
        ticks = ticks + 1
    assert ticks in (160, 161) and loop.close()
    for _ in range(100):
        driver.say(joints)
        joints = driver.answer()
    assert float((joints - loop.pregrasp).abs().max()) > 0.02
    loop.open()
    for _ in range(200):
        driver.say(joints)
        joints = driver.answer()
    assert torch.equal(joints, loop.pregrasp)


def test_a_driver_that_falls_silent_or_says_nonsense_gets_no_commands(file):
    loop = close_node.HandLoop(close_node.Settings(file))
    loop.hear([0.0] * 15)
    loop.hear([float("nan")] * 16)
    assert loop.tick() is None
    loop.hear([0.1] * 16)
    heard = [loop.tick() is not None for _ in range(30)]
    assert heard == [True] * 20 + [False] * 10  # 0.1 s at 200 Hz


def test_joint_states_in_another_order_are_read_by_their_names(file):
    loop = close_node.HandLoop(close_node.Settings(file))
    other = sorted(["wrist", *loop.names])
    loop.hear([0.01 * k for k in range(len(other))], other)
    place = {name: 0.01 * k for k, name in enumerate(other)}
    expected = [place[loop.names[k]] for k in loop.back]
    assert loop.measured.tolist() == pytest.approx(expected)
    before = loop.measured
    loop.hear([0.0] * 3, other)  # a message that is cut off
    assert loop.measured is before
    with pytest.raises(BadArgument, match="names"):
        loop.hear([0.0] * 16, ["joint_0.0", *map(str, range(15))])


def test_the_leap_gets_motors_in_its_order_about_a_half_turn(tmp_path):
    """The LEAP's driver has motors 0 to 15, and calls a flat finger 180 degrees."""
    from torchgrasp import load_hand
    from torchgrasp.export import grasps_from_joints

    hand = load_hand("leap")
    middle = ((hand.lower + hand.upper) / 2).double()[None]
    pose = torch.eye(4, dtype=torch.float64)[None]
    grasp = grasps_from_joints(hand, middle, pose, std_m=0.003)
    grasp.save(tmp_path / "leap.safetensors")
    with pytest.raises(FailedRows):  # no grasp at all
        close_node.HandLoop(close_node.Settings(str(tmp_path / "leap.safetensors")))
    passed = torch.zeros_like(grasp.status) + int(Status.OK)
    dataclasses.replace(grasp, status=passed).save(tmp_path / "leap.safetensors")
    loop = close_node.HandLoop(close_node.Settings(str(tmp_path / "leap.safetensors")))
    order = [hand.tree.joint_names.index(str(k)) for k in range(16)]
    driver = Driver(loop, order, np.pi, [str(k) for k in range(16)])
    driver.say(loop.pregrasp)
    assert torch.allclose(driver.answer(), loop.pregrasp, atol=1e-12)
    opened = hand.expand(loop.reference.pregrasp)
    for k, position in enumerate(driver.commands[-1].position):
        assert position == pytest.approx(np.pi + float(opened[str(k)]))


def test_a_first_state_in_degrees_moves_nothing(file):
    loop = close_node.HandLoop(close_node.Settings(file))
    degrees = torch.rad2deg(loop.pregrasp)[loop.order].tolist()
    with pytest.raises(BadArgument, match="positions: expected radians"):
        loop.hear(degrees)
    assert loop.tick() is None
    loop.hear(loop.pregrasp[loop.order].tolist())
    assert loop.tick() is not None
