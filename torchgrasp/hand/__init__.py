"""The robot model: a hand's URDF and hand.toml, its kinematics and its collision shapes."""

from torchgrasp.hand.draft import draft_hand
from torchgrasp.hand.hand import Actuator, Hand
from torchgrasp.hand.load import find_hand, hands_folder, load_hand
from torchgrasp.hand.urdf import Urdf, read_urdf

__all__ = ["Actuator", "Hand", "Urdf", "draft_hand", "find_hand", "hands_folder", "load_hand", "read_urdf"]
