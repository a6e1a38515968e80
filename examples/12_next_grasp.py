"""A lift that fails on a real robot, and the next grasp: `GraspTry` tells what to do.

`FakeRobot` stands for the driver of your own hand and arm. Its first lift leaves the object behind.
Replace its methods; the loop stays.
"""

import torch

from torchgrasp import (
    ClosingReference,
    ContactSpec,
    GraspController,
    load_hand,
    load_object,
    plan_grasps,
)
from torchgrasp.control import GraspTry, TipContact, measure, no_contact, observe

PERIOD = 1 / 100  # seconds between two control ticks
SPEED = 0.1  # speed [m/s] of the arm in a lift


class FakeRobot:
    """A compliant hand on an arm that raises it; the object yields by 1 mm for 2 N."""

    def __init__(self, attempt, grips):
        """Open the fingers, and bring the hand to `attempt.obj_from_hand` on a free path."""
        self.reference = attempt.controller.reference
        self.joints = self.reference.pregrasp
        self.grips = grips  # whether the object stays in the hand
        self.tactile = no_contact()
        self.height = 0.0

    def feel(self):
        """Return each fingertip's contact in the hand's frame."""
        points = self.reference.contact_points(self.reference.hand.tip_centres(self.joints))
        normals = self.reference.normals
        force = 2e3 * ((self.reference.gains.target - points) * normals).sum(-1).clamp_min(0.0)
        force = force * (self.grips or self.height == 0.0)
        return TipContact(force, -force[:, None] * normals, points, normals)

    def read(self):
        """Return what the encoders and the fingertips measure."""
        hand = self.reference.hand
        radius = hand.tips.radius.double()
        self.tactile = measure(self.tactile, self.feel(), self.reference.normals, radius, PERIOD)
        return observe(hand, self.joints, self.tactile)

    def send(self, targets, height=0.0):
        """Send `targets.joints` to the hand, and `targets.palm`, `.left` and `height` to the arm."""
        pick = self.reference.pick
        jacobian = self.reference.hand.jacobian(self.joints)
        torques = torch.einsum("cih,ci->h", jacobian, self.feel().forces)
        rest = pick(targets.joints) - torques / pick(self.reference.kp)
        self.joints = self.joints + 0.1 * (rest - self.joints)
        self.height = height


def lift(robot, attempt, top=0.05):
    """Raise the closed hand to `top` [m]; return the height at which the lift ended."""
    height = 0.0
    while height < top and not attempt.fails(seen := robot.read(), height, PERIOD):
        height += SPEED * PERIOD
        robot.send(attempt.controller.step(seen, PERIOD), height)
    return height


hand = load_hand("allegro")
grasps = plan_grasps(load_object("cylinder").view, hand, ContactSpec(table=0.0), starts=50)
attempt = GraspTry(grasps, lambda grasp: GraspController(ClosingReference.from_grasp(hand, grasp)))
while attempt is not None:
    robot = FakeRobot(attempt, grips=len(attempt.tried) > 1)
    while not attempt.controller.closed:
        robot.send(attempt.controller.step(robot.read(), PERIOD))
    print(f"grasp {attempt.row} was raised by {lift(robot, attempt):.3f} m")
    if not attempt.failed:
        break
    for targets in attempt.withdraw(robot.read(), PERIOD, length=0.1):  # first lower the arm
        robot.send(targets)
    attempt = attempt.next()
