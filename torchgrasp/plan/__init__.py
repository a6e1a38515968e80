"""Where to touch: contacts under the shape's uncertainty, with a certificate of closure."""

from torchgrasp.plan.certify import certify
from torchgrasp.plan.closure_probability import ClosureProbability, closure_probability
from torchgrasp.plan.feasibility import check_feasibility
from torchgrasp.plan.internal_forces import internal_forces, least_friction_forces
from torchgrasp.plan.objectives import Cost, Objective
from torchgrasp.plan.problem import Jet, Shape
from torchgrasp.plan.solve import plan_contacts
from torchgrasp.plan.wrench import closed_exact, wrenches

__all__ = [
    "ClosureProbability",
    "Cost",
    "Jet",
    "Objective",
    "Shape",
    "certify",
    "check_feasibility",
    "closed_exact",
    "closure_probability",
    "internal_forces",
    "least_friction_forces",
    "plan_contacts",
    "wrenches",
]
