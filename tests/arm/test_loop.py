"""A UR5e with an Allegro hand on its flange lifts the shipped cylinder in MuJoCo, as the hand does
without an arm.
"""

import numpy as np
import pytest
import torch

from torchgrasp import Status, load_object
from torchgrasp.evaluation.trial import GraspTrial, Truth


@pytest.mark.sim
def test_the_arm_brings_the_hand_and_lifts(arm, hand, grasps):
    pytest.importorskip("mujoco")
    from tests.arm.carried import TRIAL, ArmDriver, lift_with_arm

    body = load_object("cylinder")
    trial = GraspTrial(hand, grasps[0], Truth(body.mesh, body.parts), 0)
    done = lift_with_arm(trial, arm)
    assert done.status is Status.OK and done.rise > TRIAL.lift_height / 2
    begin = grasps.obj_from_hand[0, :3, 3] - TRIAL.approach * grasps.approach[0]
    end = grasps.obj_from_hand[0, :3, 3]
    assert torch.allclose(done.hand_pose[0, :3, 3], begin, atol=2e-3)
    assert (done.hand_pose[-1, :3, 3] - end - torch.tensor([0, 0, TRIAL.lift_height])).norm() < 0.02
    scene = ArmDriver(trial, TRIAL, arm).open().scene
    limits = np.array([scene.model.actuator(name).forcerange for name in arm.joint_names])
    assert limits.max(1).tolist() == [150, 150, 150, 28, 28, 28]
