"""The controller of a hand, real or simulated: grasp and sensors in, targets of joints and palm out."""

from torchgrasp.control.controller import GraspController
from torchgrasp.control.forces import Squeeze, squeeze
from torchgrasp.control.log import ControlLog, ControlRecorder, load_control_log
from torchgrasp.control.observation import Observation, observe
from torchgrasp.control.reference import ClosingReference, closing_gains
from torchgrasp.control.sensing import FingertipSensor, feel_flags, feel_torques
from torchgrasp.control.state import ControllerState, load_controller_state
from torchgrasp.control.tactile import TactileState, TipContact, measure, no_contact
from torchgrasp.control.targets import Targets
from torchgrasp.closure import ClosingGains
from torchgrasp.specs import SensorModel

__all__ = [
    "ClosingGains",
    "ClosingReference",
    "ControlLog",
    "ControlRecorder",
    "ControllerState",
    "FingertipSensor",
    "GraspController",
    "Observation",
    "SensorModel",
    "Squeeze",
    "TactileState",
    "Targets",
    "TipContact",
    "closing_gains",
    "feel_flags",
    "feel_torques",
    "load_control_log",
    "load_controller_state",
    "measure",
    "no_contact",
    "observe",
    "squeeze",
]
