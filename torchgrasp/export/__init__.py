"""Export and import of grasps and surfaces in the formats of other programs."""

from typing import TYPE_CHECKING

from torchgrasp.foundation.lazy import import_late

if TYPE_CHECKING:
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

__getattr__ = import_late(
    __name__,
    ArmMotion="arm_motion",
    plan_motion="arm_motion",
    ForeignGrasps="foreign",
    grasps_from_joints="foreign",
    read_foreign="foreign",
    format_isaac="isaac",
    check_surface_path="other_formats",
    format_graspgen="other_formats",
    largest_std="other_formats",
    save_dexgraspbench="other_formats",
    save_surface="other_formats",
    format_grasps="postures",
    format_keyframes="postures",
    save_play="play",
    format_motion="ros_messages",
    format_moveit="ros_messages",
    format_trajectories="ros_messages",
)
