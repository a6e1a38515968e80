"""Grasps and surfaces in the formats of other programs."""

from torchgrasp.export.grasp_json import format_grasps
from torchgrasp.export.mujoco_keyframes import format_keyframes
from torchgrasp.export.surface_mesh import check_surface_path, largest_std, save_surface

__all__ = ["check_surface_path", "format_grasps", "format_keyframes", "largest_std", "save_surface"]
