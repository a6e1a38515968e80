"""A plug-in for LeRobot: a hand that takes joint targets, and a planned grasp that gives them.

LeRobot's programs find it by its name. `--robot.type=torchgrasp_hand` is the hand, and
`--teleop.type=torchgrasp_plan` moves it as a grasp of torchgrasp is planned.
"""

from lerobot_robot_torchgrasp.config_torchgrasp_hand import TorchgraspHandConfig
from lerobot_robot_torchgrasp.config_torchgrasp_plan import TorchgraspPlanConfig
from lerobot_robot_torchgrasp.skill import GraspSkill
from lerobot_robot_torchgrasp.torchgrasp_hand import TorchgraspHand
from lerobot_robot_torchgrasp.torchgrasp_plan import TorchgraspPlan

__all__ = [
    "GraspSkill",
    "TorchgraspHand",
    "TorchgraspHandConfig",
    "TorchgraspPlan",
    "TorchgraspPlanConfig",
]
