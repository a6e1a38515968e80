"""Predicted success: features that decide whether a grasp holds its task. Also a model that
predicts it, and the order of grasps.
"""

from torchgrasp.success.reasons import Cost
from torchgrasp.success.task import TaskWrenches

__all__ = ["Cost", "TaskWrenches"]
