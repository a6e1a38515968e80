"""A check of a hand of your own: the rules that its files and its kinematics must obey."""

from torchgrasp.errors import BrokenLaw
from torchgrasp.testing.hands import check_hand

__all__ = ["BrokenLaw", "check_hand"]
