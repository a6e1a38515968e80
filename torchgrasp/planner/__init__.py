"""The grasp planner: from a partial point cloud, or a scene, to ranked grasps of a hand."""

from torchgrasp.planner.explain import Explanation, explain_empty
from torchgrasp.planner.grasps import plan_grasps, stream_grasps
from torchgrasp.planner.request import PlanOptions, SceneOptions
from torchgrasp.planner.scene import ScenePlan, ThingPlan, plan_scene

__all__ = [
    "Explanation", "PlanOptions", "SceneOptions", "ScenePlan", "ThingPlan", "explain_empty", "plan_grasps",
    "plan_scene", "stream_grasps",
]  # fmt: skip
