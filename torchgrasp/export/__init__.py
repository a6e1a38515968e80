"""Export and import of grasps and surfaces in the formats of other programs."""

from torchgrasp.export.arm_motion import ArmMotion, plan_motion
from torchgrasp.export.foreign import ForeignGrasps, grasps_from_joints, read_foreign
from torchgrasp.export.isaac import format_isaac
from torchgrasp.export.other_formats import check_surface_path, format_graspgen, largest_std
from torchgrasp.export.other_formats import save_dexgraspbench, save_surface
from torchgrasp.export.postures import format_grasps, format_keyframes
from torchgrasp.export.play import save_play
from torchgrasp.export.ros_messages import format_motion, format_moveit, format_trajectories

__all__ = [
    "ArmMotion",
    "ForeignGrasps",
    "check_surface_path",
    "format_graspgen",
    "format_grasps",
    "format_isaac",
    "format_keyframes",
    "format_motion",
    "format_moveit",
    "format_trajectories",
    "grasps_from_joints",
    "largest_std",
    "plan_motion",
    "read_foreign",
    "save_dexgraspbench",
    "save_play",
    "save_surface",
]
