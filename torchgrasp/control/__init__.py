"""The controller of a hand, real or simulated: grasp and sensors in, targets of joints and palm out."""

from torchgrasp.control.controller import GraspController
from torchgrasp.control.forces import Squeeze, squeeze
from torchgrasp.control.observation import Observation, observe
from torchgrasp.control.reference import ClosingReference, closing_gains
from torchgrasp.control.tactile import TactileState, TipContact, measure, no_contact
from torchgrasp.control.targets import Targets
from torchgrasp.closing import ClosingGains

__all__ = [
    "ClosingGains",
    "ClosingReference",
    "GraspController",
    "Observation",
    "Squeeze",
    "TactileState",
    "Targets",
    "TipContact",
    "closing_gains",
    "measure",
    "no_contact",
    "observe",
    "squeeze",
]
