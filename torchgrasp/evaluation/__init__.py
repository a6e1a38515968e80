"""Trials of grasps in simulation, published protocols, and the evaluation of folders of objects."""

from torchgrasp.values.closing import ClosingTrace, Disturbance, ObjectMotion
from torchgrasp.evaluation.drag_trial import DragResult, EdgeLift, drag_object, lift_from_edge
from torchgrasp.evaluation.intervals import Share
from torchgrasp.evaluation.protocols import PROTOCOLS, PoseNoise, Protocol, PullSpec, find_protocol
from torchgrasp.evaluation.pull import PullResult, pull_grasp
from torchgrasp.evaluation.several_tries import LiftTry, lift_grasps
from torchgrasp.evaluation.sweep import evaluate
from torchgrasp.evaluation.summary import ProtocolResult, ViewScore, summarise
from torchgrasp.evaluation.touch import Touch, measure_touch
from torchgrasp.evaluation.trial import GraspTrial, Truth
from torchgrasp.evaluation.views import EvaluationSpec

__all__ = [
    "PROTOCOLS",
    "ClosingTrace",
    "Disturbance",
    "DragResult",
    "EdgeLift",
    "EvaluationSpec",
    "GraspTrial",
    "LiftTry",
    "ObjectMotion",
    "PoseNoise",
    "Protocol",
    "ProtocolResult",
    "PullResult",
    "PullSpec",
    "Share",
    "Touch",
    "Truth",
    "ViewScore",
    "drag_object",
    "evaluate",
    "find_protocol",
    "lift_from_edge",
    "lift_grasps",
    "measure_touch",
    "pull_grasp",
    "summarise",
]
