"""What is asked of a grasp: trials in simulation, published protocols, campaigns and their scores."""

from torchgrasp.closure import ClosingTrace, Disturbance, ObjectMotion
from torchgrasp.evaluation.closing import GraspTrial, TrialDriver, TrialRun
from torchgrasp.evaluation.views import EvaluationSpec
from torchgrasp.evaluation.campaign import evaluate
from torchgrasp.evaluation.intervals import Share, contrast_over, count_by, difference_over, format_share, mean_over
from torchgrasp.evaluation.intervals import share_over
from torchgrasp.evaluation.lift import close_hand, lift_grasp
from torchgrasp.jobs import run_tasks
from torchgrasp.evaluation.protocols import PROTOCOLS, PoseNoise, Protocol, PullSpec, apply_error
from torchgrasp.evaluation.protocols import draw_error, draw_hand_errors, draw_object_poses, find_protocol, seed_of
from torchgrasp.evaluation.pull import PullResult, pull_grasp, run_protocol
from torchgrasp.evaluation.score import ProtocolResult, ViewScore, most_certain_first, summarise

__all__ = [
    "ClosingTrace",
    "Disturbance",
    "ObjectMotion",
    "PROTOCOLS",
    "EvaluationSpec",
    "GraspTrial",
    "PoseNoise",
    "Protocol",
    "ProtocolResult",
    "PullResult",
    "PullSpec",
    "Share",
    "TrialDriver",
    "TrialRun",
    "ViewScore",
    "apply_error",
    "close_hand",
    "contrast_over",
    "count_by",
    "difference_over",
    "draw_error",
    "draw_hand_errors",
    "draw_object_poses",
    "evaluate",
    "find_protocol",
    "format_share",
    "lift_grasp",
    "mean_over",
    "most_certain_first",
    "pull_grasp",
    "run_protocol",
    "run_tasks",
    "seed_of",
    "share_over",
    "summarise",
]
