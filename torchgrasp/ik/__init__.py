"""Inverse kinematics: hand configurations that reach planned contacts.

A configuration is a hand's pose and joints. Initial guesses of it, the seeds (module `seeds`), are
refined in rounds (`attempts`). Then their errors and collisions are checked (`candidates`). Four
solvers share these steps. `solve_ik` reaches given contacts, and `solve_contact_first` makes grasps
on fixed contacts. `solve_joint` also moves the contacts along the surface, and `solve_as_paper` is
the paper's solver.
"""

from torchgrasp.ik.candidates import GraspProblem
from torchgrasp.ik.clearance import CollisionWorld, Obstacles
from torchgrasp.ik.joint import solve_joint
from torchgrasp.ik.motion import opened_pose
from torchgrasp.ik.seeds import PostureLibrary, nearest_postures
from torchgrasp.ik.solve import IKSolution
from torchgrasp.values.planning import IKSeeds

__all__ = [
    "CollisionWorld",
    "GraspProblem",
    "IKSeeds",
    "IKSolution",
    "Obstacles",
    "PostureLibrary",
    "nearest_postures",
    "opened_pose",
    "solve_joint",
]
