"""The grasp planner: from a partial point cloud, or a scene, to ranked grasps of a hand."""

from torchgrasp.planner.explain import Explanation
from torchgrasp.planner.request import PlanOptions, SceneOptions
from torchgrasp.planner.scene import ScenePlan, ThingPlan

__all__ = ["Explanation", "PlanOptions", "SceneOptions", "ScenePlan", "ThingPlan"]
