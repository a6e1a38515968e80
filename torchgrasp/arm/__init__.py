"""A robot arm that carries the hand: which grasps it reaches, and its way through them."""

from torchgrasp.arm.arm import Arm, load_arm

__all__ = ["Arm", "load_arm"]
