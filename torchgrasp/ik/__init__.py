"""Inverse kinematics: hand configurations that reach planned contacts."""

from torchgrasp.values import IKSeeds
from torchgrasp.ik.candidates import GraspCandidates, GraspProblem, check_candidates
from torchgrasp.ik.checks import GraspErrors, measure_errors
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.contact_first import solve_contact_first
from torchgrasp.ik.joint import solve_joint
from torchgrasp.ik.motion import collision_probability, lift_clearance
from torchgrasp.ik.obstacles import Obstacles
from torchgrasp.ik.posture_library import PostureLibrary, nearest_postures
from torchgrasp.ik.query import query_mixture
from torchgrasp.geometry.signed_distance import SignedDistanceField, field_from_surface
from torchgrasp.shape.surface import surface_field
from torchgrasp.ik.solve import IKSolution, solve_ik

__all__ = [
    "IKSeeds",

    "CollisionWorld", "Configuration", "GraspCandidates", "GraspErrors", "GraspProblem", "IKSolution",
    "Obstacles", "PostureLibrary", "SignedDistanceField", "check_candidates", "collision_probability",
    "field_from_surface", "lift_clearance", "measure_errors", "nearest_postures", "query_mixture",
    "solve_contact_first", "solve_ik", "solve_joint", "surface_field",
]  # fmt: skip
