"""The robot model: a hand's URDF and hand.toml, its kinematics and its collision shapes."""

from torchgrasp.hand.collision_spheres import CollisionSpheres
from torchgrasp.hand.fingertips import Fingertips
from torchgrasp.hand.hand import Actuator, Hand, HandSource
from torchgrasp.hand.joints import ActuatedJoints
from torchgrasp.hand.kinematics import KinematicTree
from torchgrasp.hand.self_collision import SelfCollision
from torchgrasp.hand.load import find_hand, hand_of, hands_folder, load_hand, with_fingers
from torchgrasp.hand.urdf import Joint, Link, Mimic, Shape, Urdf, read_urdf

__all__ = [
    "ActuatedJoints",
    "Actuator",
    "CollisionSpheres",
    "Fingertips",
    "Hand",
    "HandSource",
    "Joint",
    "KinematicTree",
    "Link",
    "Mimic",
    "SelfCollision",
    "Shape",
    "Urdf",
    "find_hand",
    "hand_of",
    "hands_folder",
    "load_hand",
    "read_urdf",
    "with_fingers",
]
