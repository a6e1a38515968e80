"""Contact points on an uncertain surface, with certificates of force closure."""

from torchgrasp.contacts.closure_probability import ClosureProbability
from torchgrasp.contacts.balance import least_friction_forces
from torchgrasp.contacts.problem import ShapeLike

__all__ = ["ClosureProbability", "ShapeLike", "least_friction_forces"]
