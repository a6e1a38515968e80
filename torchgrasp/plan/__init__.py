"""The contact planner: contact points on an uncertain surface, with certificates of force closure."""

from torchgrasp.plan.certify import certify
from torchgrasp.plan.closure_probability import ClosureProbability, closure_probability
from torchgrasp.plan.forces import least_friction_forces
from torchgrasp.plan.problem import Shape
from torchgrasp.plan.region import Region
from torchgrasp.plan.solve import plan_contacts

__all__ = [
    "ClosureProbability", "Region", "Shape", "certify", "closure_probability", "least_friction_forces", "plan_contacts",
]  # fmt: skip
