"""The whole chain: from a partial cloud, or a scene, to ranked grasps of a hand."""

from torchgrasp.planner.explain import Explanation, Trial, explain_empty
from torchgrasp.planner.funnel import Funnel, Losses
from torchgrasp.planner.grasps import plan_grasps, stream_grasps
from torchgrasp.jobs import run_tasks
from torchgrasp.planner.stages import spread_rows
from torchgrasp.planner.story import describe
from torchgrasp.planner.task import TARGET_POINTS, PlanOptions, take_target
from torchgrasp.planner.things import ScenePlan, ThingPlan, plan_scene

__all__ = [
    "TARGET_POINTS", "Explanation", "Funnel", "Losses", "PlanOptions", "ScenePlan", "ThingPlan", "Trial", "describe",
    "explain_empty", "plan_grasps", "plan_scene", "run_tasks", "spread_rows", "stream_grasps", "take_target",
]  # fmt: skip
