"""The robot model: a hand's URDF and hand.toml, its kinematics and its collision shapes."""

from torchgrasp.hand.collision_shapes import CollisionSpheres
from torchgrasp.hand.fingers import ActuatedJoints, Fingertips
from torchgrasp.hand.hand import Actuator, Hand, HandSource
from torchgrasp.hand.kinematics import KinematicTree
from torchgrasp.hand.load import find_hand, hand_of, hands_folder, load_hand, with_fingers
from torchgrasp.hand.self_collision import SelfCollision

__all__ = [
    "ActuatedJoints", "Actuator", "CollisionSpheres", "Fingertips", "Hand", "HandSource", "KinematicTree",
    "SelfCollision", "find_hand", "hand_of", "hands_folder", "load_hand", "with_fingers",
]  # fmt: skip
