"""The whole chain: from a partial cloud, or a scene, to ranked grasps of a hand."""

from torchgrasp.pipeline.explain import Explanation, Trial, explain_empty
from torchgrasp.pipeline.funnel import Funnel, Losses
from torchgrasp.pipeline.grasps import plan_grasps, stream_grasps
from torchgrasp.pipeline.pool import run_tasks
from torchgrasp.pipeline.stages import spread_rows
from torchgrasp.pipeline.story import describe
from torchgrasp.pipeline.task import TARGET_POINTS, PlanOptions, take_target
from torchgrasp.pipeline.things import ScenePlan, ThingPlan, plan_scene

__all__ = [
    "TARGET_POINTS", "Explanation", "Funnel", "Losses", "PlanOptions", "ScenePlan", "ThingPlan", "Trial", "describe",
    "explain_empty", "plan_grasps", "plan_scene", "run_tasks", "spread_rows", "stream_grasps", "take_target",
]  # fmt: skip
