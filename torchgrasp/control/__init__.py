"""The controller of a real or simulated hand: it turns a grasp and sensor readings into targets of joints and palm."""

from torchgrasp.closure import ClosingGains, ClosingOptions
from torchgrasp.control.controller import GraspController
from torchgrasp.control.forces import squeeze
from torchgrasp.control.recovery import LiftCheck
from torchgrasp.control.reference import ClosingReference, closing_gains
from torchgrasp.control.sensing import FingertipSensor, feel_flags, feel_torques
from torchgrasp.control.tactile import Observation, TactileState, Targets, TipContact, measure, no_contact, observe

__all__ = [
    "ClosingGains", "ClosingOptions", "ClosingReference", "FingertipSensor", "GraspController", "LiftCheck",
    "Observation", "TactileState", "Targets", "TipContact", "closing_gains", "feel_flags", "feel_torques", "measure",
    "no_contact", "observe", "squeeze",
]  # fmt: skip
