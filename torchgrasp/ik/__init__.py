"""Inverse kinematics: hand configurations that reach planned contacts."""

from torchgrasp.ik.candidates import GraspProblem
from torchgrasp.ik.clearance import CollisionWorld, Obstacles
from torchgrasp.ik.joint import solve_joint
from torchgrasp.ik.seeds import PostureLibrary, nearest_postures
from torchgrasp.ik.solve import IKSolution, solve_ik
from torchgrasp.values import IKSeeds

__all__ = [
    "CollisionWorld", "GraspProblem", "IKSeeds", "IKSolution", "Obstacles", "PostureLibrary", "nearest_postures",
    "solve_ik", "solve_joint",
]  # fmt: skip
