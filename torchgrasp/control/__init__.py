"""The controller of a real or simulated hand: it turns a grasp and sensor readings into targets of
joints and palm.
"""

from torchgrasp.values.closing import ClosingGains, ClosingOptions
from torchgrasp.control.finger_forces import squeeze
from torchgrasp.control.recovery import LiftCheck
from torchgrasp.control.sensing import FingertipSensor, feel_flags, feel_torques
from torchgrasp.control.tactile import (
    Observation,
    TactileState,
    Targets,
    TipContact,
    measure,
    no_contact,
    observe,
)

__all__ = [
    "ClosingGains",
    "ClosingOptions",
    "FingertipSensor",
    "LiftCheck",
    "Observation",
    "TactileState",
    "Targets",
    "TipContact",
    "feel_flags",
    "feel_torques",
    "measure",
    "no_contact",
    "observe",
    "squeeze",
]
