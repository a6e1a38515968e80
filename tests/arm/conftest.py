"""The UR5e with an Allegro hand, and grasps of the shipped cylinder that it reaches, each made
once.
"""

import pytest

from tests.arm.ur5e import ur5e
from tests.make import load_hand
from torchgrasp import ContactSpec, load_object, plan_grasps


@pytest.fixture(scope="session")
def hand():
    return load_hand("allegro")


@pytest.fixture(scope="session")
def arm(hand):
    return ur5e(hand)


@pytest.fixture(scope="session")
def grasps(arm, hand):
    return plan_grasps(
        load_object("cylinder").view, hand, ContactSpec(table=0.0), starts=24, arm=arm
    )
