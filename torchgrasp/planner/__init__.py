"""The grasp planner: from a partial point cloud, or a scene, to ranked grasps of a hand."""

from torchgrasp.planner.explain import Explanation
from torchgrasp.planner.scene_plan import ScenePlan, ThingPlan

__all__ = ["Explanation", "ScenePlan", "ThingPlan"]
