"""Both simulators against statics, by the checks of the benchmark: forces, torques, friction, torsion."""

import importlib
import math
from pathlib import Path

import pytest

from tests.pinch import cylinder, pinch
from torchgrasp.hand.load import load_hand

pytestmark = [
    pytest.mark.sim,
    pytest.mark.filterwarnings("ignore"),
    pytest.mark.parametrize("simulator", ["sapien", "mujoco"]),
]


@pytest.fixture
def checks(monkeypatch, simulator):
    pytest.importorskip("sapien")
    pytest.importorskip("mujoco")
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "scripts"))
    return importlib.import_module("benchmarks.close.statics")


@pytest.mark.parametrize("angle", [0.0, 22.5, 45.0])
def test_friction_is_a_cone_in_every_direction(checks, simulator, angle):
    assert checks.sliding_friction(simulator, math.radians(angle)) == pytest.approx(checks.FRICTION, abs=0.02)
    assert checks.creep(simulator, math.radians(angle)) < 2e-3  # 0.02 inside the cone; 0.02 outside it moves by 25 mm


@pytest.mark.parametrize("radius", [0.003, 0.02 / 0.6])
def test_a_patch_resists_torsion(checks, simulator, radius):
    assert checks.torsional_friction(simulator, radius) == pytest.approx(radius, rel=0.02)


def test_the_table_carries_the_weight(checks, simulator):
    assert checks.resting_force(simulator, load_hand("barrett")) < 0.005


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_a_lifted_object_hangs_on_the_fingertips_and_the_drives_feel_it(checks, simulator, name):
    held = checks.hold(*pinch(name), cylinder(), simulator, 4.0, None)
    assert held.weight < 0.01
    assert held.torque < 0.005
    assert held.force == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("force", [0.5, 2.0])
def test_the_controller_presses_as_it_was_asked_to_in_spite_of_noise(checks, simulator, force):
    held = checks.hold(*pinch("allegro"), cylinder(), simulator, force, 0, lift=False)
    assert held.force == pytest.approx(1.0, abs=0.1)
