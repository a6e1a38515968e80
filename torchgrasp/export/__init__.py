"""Grasps and surfaces in the formats of other programs, written and read."""

from torchgrasp.export.benchmark_files import format_graspgen, save_dexgraspbench
from torchgrasp.export.foreign import grasps_from_joints
from torchgrasp.export.foreign_files import ForeignGrasps, read_foreign
from torchgrasp.export.grasp_json import format_grasps
from torchgrasp.export.mujoco_keyframes import format_keyframes
from torchgrasp.export.ros_messages import format_moveit, format_trajectories
from torchgrasp.export.surface_mesh import check_surface_path, largest_std, save_surface

__all__ = [
    "ForeignGrasps",
    "check_surface_path",
    "format_graspgen",
    "format_grasps",
    "format_keyframes",
    "format_moveit",
    "format_trajectories",
    "grasps_from_joints",
    "largest_std",
    "read_foreign",
    "save_dexgraspbench",
    "save_surface",
]
