"""The robot model: a hand's URDF and hand.toml, its kinematics and its collision shapes."""

from torchgrasp.hand.collision_shapes import CollisionSpheres
from torchgrasp.hand.fingers import ActuatedJoints, Fingertips
from torchgrasp.hand.hand import Actuator, HandSource
from torchgrasp.hand.kinematics import KinematicTree
from torchgrasp.hand.load import find_hand, hand_of, hands_folder, with_fingers
from torchgrasp.hand.self_collision import SelfCollision
from torchgrasp.hand.abilities import (
    FingerAbility,
    HandAbilities,
    PairAbility,
    hand_abilities,
)

__all__ = [
    "ActuatedJoints",
    "Actuator",
    "CollisionSpheres",
    "FingerAbility",
    "Fingertips",
    "HandAbilities",
    "HandSource",
    "KinematicTree",
    "PairAbility",
    "SelfCollision",
    "find_hand",
    "hand_abilities",
    "hand_of",
    "hands_folder",
    "with_fingers",
]
