"""Drafts of hands whose fingers slide: forces in N, speeds in m/s, and drives that hold them."""

import re

import mujoco
import numpy as np
import pytest

from tests.mjcf_hands import BEND, CURL, ROUND, SWIVEL, THREE, finger, model
from torchgrasp.app.author.draft import new_hand
from torchgrasp.hand.load import load_hand

pytestmark = pytest.mark.usefixtures("few_draws")

SLIDE = '<limit lower="-0.01" upper="0.02" effort="{0}" velocity="{1}"/>'


def sliding(claw, effort="0", velocity="0", bends=False):
    """Return the claw with fingers that slide at their root, and bend there only if asked to."""
    text = claw.read_text().replace("revolute", "fixed")
    if bends:
        text = claw.read_text()
    text = text.replace('type="fixed"><parent link="base"', 'type="prismatic"><parent link="base"')
    text = text.replace('"revolute"><parent link="base"', '"prismatic"><parent link="base"')
    text = text.replace('<axis xyz="0 0 1"/>', '<axis xyz="1 0 0"/>')
    old = '<limit lower="-0.5" upper="0.5" effort="1.5" velocity="3"/>'
    claw.write_text(text.replace(old, SLIDE.format(effort, velocity)))
    return claw


def written(draft, folder):
    """Write a draft, and return its hand."""
    folder.mkdir()
    (folder / "hand.toml").write_text(draft.toml)
    (folder / "hand.urdf").write_text(draft.urdf)
    return load_hand(folder)


def test_a_sliding_joint_without_a_drive_gets_newtons_and_metres(claw, tmp_path):
    draft = new_hand(sliding(claw))
    (told,) = [x for x in draft.repairs if "without effort" in x]
    assert "10 N, 0.1 m/s" in told and "rad/s" not in told and "N m" not in told
    drive = written(draft, tmp_path / "out").actuators["left_swivel"]
    assert (drive.effort, drive.velocity) == (10.0, 0.1)


def test_the_drives_of_a_gripper_hold_its_fingers(claw, tmp_path):
    """The effort of a joint is reached within its range, and the damping is critical or more."""
    draft = new_hand(sliding(claw, effort="40"))
    hand = written(draft, tmp_path / "out")
    drive = hand.actuators["left_swivel"]
    assert drive.effort / drive.kp < float((hand.upper - hand.lower)[0])
    mass = 0.02 + 0.04 + 0.02 + 0.005
    assert drive.kd >= 2 * np.sqrt(drive.kp * mass)
    assert re.search(r"kp = .* \[N/m\]", draft.toml) and "N m/rad" not in draft.toml
    assert not draft.warnings


def test_sliding_joints_beside_turning_ones_are_told(claw):
    draft = new_hand(sliding(claw, effort="40", velocity="0.1", bends=True))
    (warning,) = draft.warnings
    assert "weak for joints that slide: left_swivel, right_swivel, thumb_swivel" in warning


def test_a_joint_is_as_strong_as_the_motor_that_follows_it(tmp_path):
    """A motor that slides bends the finger by an equality: both do the same work."""
    slide = SWIVEL._replace(more='type="slide"', low=-0.02, high=0.02)
    fingers = "".join(finger(*place, (slide, BEND, CURL), ROUND) for place in THREE)
    names = [name for name, *_ in THREE]
    motors = "".join(f'<motor joint="{n}_swivel" forcerange="-40 40"/>' for n in names)
    ties = "".join(
        f'<joint joint1="{n}_bend" joint2="{n}_swivel" polycoef="0 50 0 0 0"/>'
        f'<joint joint1="{n}_curl" joint2="{n}_bend" polycoef="0 0.5 0 0 0"/>'
        for n in names
    )
    rest = f"<actuator>{motors}</actuator><equality>{ties}</equality>"
    file = tmp_path / "hand.xml"
    file.write_text(model("slider", fingers, rest))
    mujoco.MjModel.from_xml_path(str(file))
    draft = new_hand(file)
    hand = written(draft, tmp_path / "out")
    leaders = {name.partition("_")[2] for name in hand.joint_names}
    assert leaders == {"bend"}
    force = hand.actuators["left_swivel"].effort
    assert force == 40.0
    # dx = dq / 50
    np.testing.assert_allclose(hand.actuators["left_bend"].effort, force / 50)
