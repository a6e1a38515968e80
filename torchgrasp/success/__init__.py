"""Predicted success: what decides whether a grasp holds its task, a model that reads it, and the order of grasps."""

from torchgrasp.success.explain import Cost, explain_success
from torchgrasp.success.task import GraspTask, TaskWrenches

__all__ = ["Cost", "GraspTask", "TaskWrenches", "explain_success"]
