"""The controller of a hand, real or simulated: grasp and sensors in, joint targets out."""

from torchgrasp.control.controller import GraspController
from torchgrasp.control.forces import Squeeze, squeeze
from torchgrasp.control.observation import Observation, observe
from torchgrasp.control.reference import ClosingReference, closing_gains
from torchgrasp.control.tactile import TactileState, TipContact, measure, no_contact
from torchgrasp.closing import ClosingGains

__all__ = [
    "ClosingGains",
    "ClosingReference",
    "GraspController",
    "Observation",
    "Squeeze",
    "TactileState",
    "TipContact",
    "closing_gains",
    "measure",
    "no_contact",
    "observe",
    "squeeze",
]
