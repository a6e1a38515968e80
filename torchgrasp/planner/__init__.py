"""The grasp planner: from a partial point cloud, or a scene, to ranked grasps of a hand."""

from torchgrasp.planner.drag_text import drag_of
from torchgrasp.planner.drag_plan import DragPlan
from torchgrasp.planner.edge import EdgePlan
from torchgrasp.planner.explain import Explanation
from torchgrasp.planner.scene_plan import ScenePlan, ThingPlan

__all__ = ["DragPlan", "EdgePlan", "Explanation", "ScenePlan", "ThingPlan", "drag_of"]
