"""Controllers of a real or simulated hand. From a grasp and sensor readings they compute targets of
the joints and the palm.
"""

from torchgrasp.values.closing import ClosingGains, ClosingOptions
from torchgrasp.control.drag import DragController
from torchgrasp.control.finger_forces import squeeze
from torchgrasp.control.recovery import LiftCheck
from torchgrasp.control.regrasp import GraspTry
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
    "DragController",
    "FingertipSensor",
    "GraspTry",
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
