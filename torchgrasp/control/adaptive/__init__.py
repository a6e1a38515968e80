"""Adaptive control: impedance, learned stability, and a shape revised by touch."""

from torchgrasp.control.adaptive.belief import Belief
from torchgrasp.control.adaptive.impedance import Impedance
from torchgrasp.control.adaptive.stability import PreferredForces, StabilityModel, load_stability

__all__ = ["Belief", "Impedance", "PreferredForces", "StabilityModel", "load_stability"]
