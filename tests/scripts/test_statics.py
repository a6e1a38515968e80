"""Both simulators against statics, by the benchmark's own measurements: forces, torques, friction, torsion."""

import math

import pytest
from benchmarks.close import statics

from tests.pinch import cylinder, pinch
from torchgrasp.hand.load import load_hand

pytestmark = [
    pytest.mark.sim,
    pytest.mark.filterwarnings("ignore"),
    pytest.mark.parametrize("simulator", ["sapien", "mujoco"]),
]


@pytest.fixture(autouse=True)
def both_simulators():
    pytest.importorskip("sapien")
    pytest.importorskip("mujoco")


@pytest.mark.parametrize("angle", [0.0, 22.5, 45.0])
def test_friction_is_a_cone_in_every_direction(simulator, angle):
    assert statics.sliding_friction(simulator, math.radians(angle)) == pytest.approx(statics.FRICTION, abs=0.02)
    assert statics.creep(simulator, math.radians(angle)) < 2e-3  # 0.02 inside the cone; 0.02 outside it moves by 25 mm


@pytest.mark.parametrize("radius", [0.003, 0.02 / 0.6])
def test_a_patch_resists_torsion(simulator, radius):
    assert statics.torsional_friction(simulator, radius) == pytest.approx(radius, rel=0.02)


def test_the_table_carries_the_weight(simulator):
    assert statics.resting_force(simulator, load_hand("barrett")) < 0.005


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_a_lifted_object_hangs_on_the_fingertips_and_the_drives_feel_it(simulator, name):
    held = statics.hold(*pinch(name), cylinder(), simulator, 4.0, None)
    assert held.weight < 0.01
    assert held.torque < 0.005
    assert held.force == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("force", [0.5, 2.0])
def test_the_controller_presses_as_it_was_asked_to_in_spite_of_noise(simulator, force):
    held = statics.hold(*pinch("allegro"), cylinder(), simulator, force, 0, lift=False)
    assert held.force == pytest.approx(1.0, abs=0.1)
