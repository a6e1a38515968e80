"""The loop of a real robot, without a simulator: joints and forces go in, targets come out.

`FakeRobot` stands for the driver of your own hand. Replace its three methods; the loop stays.
"""

import gc

import torch

from torchgrasp import (
    ClosingReference,
    ContactSpec,
    GraspController,
    load_hand,
    load_object,
    plan_grasps,
)
from torchgrasp.control import TipContact, measure, no_contact, observe

PERIOD = 1 / 200  # seconds between two control ticks


class FakeRobot:
    """A compliant hand around an object that yields by 1 mm for 2 N."""

    def __init__(self, reference):
        self.reference = reference
        self.joints = reference.pregrasp

    def read_joints(self):
        """Return the encoders of the actuated joints, in the order of `hand.joint_names` [rad]."""
        return self.joints

    def read_fingertips(self):
        """Return each fingertip's contact in the hand's frame; NaN points and normals: none."""
        points = self.reference.contact_points(self.reference.hand.tip_centres(self.joints))
        normals = self.reference.normals
        force = 2e3 * ((self.reference.gains.target - points) * normals).sum(-1).clamp_min(0.0)
        nothing = (force == 0.0)[:, None]
        points = torch.where(nothing, torch.nan, points)
        felt = torch.where(nothing, torch.nan, normals)
        return TipContact(force, -force[:, None] * normals, points, felt)

    def send(self, targets):
        """Send a target for every joint of the URDF, in the order of `hand.tree.joint_names` [rad].

        `targets.palm` [m] is for the arm; this one does not yield.
        """
        # the drives yield to the fingertips' forces: kp (target - joint) = J^T f at rest
        forces = self.read_fingertips().forces
        torques = torch.einsum("cih,ci->h", self.reference.hand.jacobian(self.joints), forces)
        stiffness = self.reference.pick(self.reference.kp)
        rest = self.reference.pick(targets.joints) - torques / stiffness
        self.joints = self.joints + 0.05 * (rest - self.joints)


hand = load_hand("allegro")
grasp = plan_grasps(load_object("cylinder").view, hand, ContactSpec(table=0.0), starts=50).best
palm = grasp.obj_from_hand[0].numpy().round(3).tolist()
print("palm to", palm, "with the joints at the pre-grasp")

reference = ClosingReference.from_grasp(hand, grasp, force=4.0)
controller = GraspController(reference)
robot = FakeRobot(reference)
tactile = no_contact()
gc.collect()
gc.freeze()  # else Python looks through all that was imported in some tick, for 0.1 s
ticks = 0
while not controller.closed:  # then lift the arm, and go on stepping
    # `measure` filters forces and flags contacts; a sensor that does so fills a `TactileState`
    felt = robot.read_fingertips()
    tactile = measure(tactile, felt, reference.normals, hand.tips.radius.double(), PERIOD)
    robot.send(controller.step(observe(hand, robot.read_joints(), tactile), PERIOD))
    ticks += 1
pressure = tactile.reading.numpy().round(1)
print(f"closed after {ticks * PERIOD:.2f} s, the fingers press with {pressure} N")
