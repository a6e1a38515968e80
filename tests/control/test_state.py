"""A controller that was stopped and goes on elsewhere: the same commands to the bit, in every mode and phase."""

import dataclasses

import pytest
import torch

from tests.point_fingers import PERIOD, TOUCHING, observation, real, reference
from torchgrasp.control import GraspController, load_controller_state
from torchgrasp.control.holding.grip import GripHold
from torchgrasp.errors import BadArgument, ModelFileError
from torchgrasp.geometry.plane import Plane
from torchgrasp.specs import SensorModel

MODES = [
    ("uncertainty", "force"), ("fixed", "grip"), ("uncertainty", "impedance"), ("paper", "law"),
    ("position", "position"), ("paper_position", "force"), ("open_loop", "force"),
]  # fmt: skip


def known():
    return dataclasses.replace(reference(), table=Plane(real([0, 1, 0]), -0.1))


def seen(tick: int):
    """What is observed at a tick: the fingers come near, touch one after the other, and feel a growing load."""
    generator = torch.Generator().manual_seed(tick)
    contact = torch.tensor([tick > 40, tick > 60, tick > 70]) if tick < 80 else TOUCHING
    reading = (2.0 * contact + 0.1 * torch.rand(3, generator=generator)).tolist()
    found = observation(max(0.02 - 3e-4 * tick, -0.001), tuple(reading), contact)
    load = torch.tensor([0.0, min(tick / 100, 3.0), 0.0]) / 3 + 0.1 * torch.rand(3, 3, generator=generator)
    tactile = dataclasses.replace(found.tactile, forces=found.tactile.forces + load.double())
    tactile = dataclasses.replace(
        tactile, average=tactile.reading, sliding=0.02 * torch.rand(3, generator=generator).double()
    )
    return dataclasses.replace(found, tactile=tactile)


@pytest.mark.parametrize(("closing", "holding"), MODES)
@pytest.mark.parametrize("stop", [0, 1, 65, 260])
def test_a_restored_controller_commands_the_same_bits(closing, holding, stop, tmp_path, monkeypatch):
    monkeypatch.setattr("torchgrasp.control.adaptive.stability.load_stability", lambda hand: None)
    whole, first, second = (GraspController(known(), closing, holding) for _ in range(3))
    told = [whole.step(seen(k), PERIOD) for k in range(stop + 120)]
    for k in range(stop):
        first.step(seen(k), PERIOD)
    first.state().save(tmp_path / "state.safetensors")
    second.step(seen(3), PERIOD)  # it may have been in use
    second.restore(load_controller_state(tmp_path / "state.safetensors"))
    assert (second.closed, second.status) == (first.closed, first.status)
    for k in range(stop, stop + 120):
        found = second.step(seen(k), PERIOD)
        assert torch.equal(found.joints, told[k].joints) and torch.equal(found.palm, told[k].palm)
    assert second.closed == whole.closed
    assert (second.hold is None) == (whole.hold is None)


def test_what_grip_has_learned_goes_with_it():
    one, other = GraspController(known(), holding="grip"), GraspController(known(), holding="grip")
    for k in range(400):
        one.step(seen(k), PERIOD)
    other.restore(one.state())
    assert isinstance(one.hold, GripHold) and isinstance(other.hold, GripHold)
    assert other.hold.weight == one.hold.weight > 0
    assert other.hold.friction.mean == one.hold.friction.mean != 0.8


def test_what_drives_have_felt_goes_with_it():
    blind = dataclasses.replace(known(), sensor=SensorModel(dead=known().hand.finger_names[:1]))
    one, other = GraspController(blind), GraspController(blind)
    for k in range(75):
        one.step(seen(k), PERIOD)
    other.restore(one.state())
    for k in range(75, 200):
        assert torch.equal(one.step(seen(k), PERIOD).joints, other.step(seen(k), PERIOD).joints)


def test_a_state_is_a_copy():
    one = GraspController(known())
    state = one.state()
    kept = state.numbers.clone()
    for k in range(100):
        one.step(seen(k), PERIOD)
    assert torch.equal(state.numbers, kept) and not torch.equal(one.state().numbers, kept)


def test_states_of_other_controllers_and_files_are_refused(tmp_path):
    one = GraspController(known(), "fixed")
    for other in (GraspController(known()), GraspController(known(), "fixed", "grip")):
        with pytest.raises(BadArgument, match=r"state: expected .*got .*closing (uncertainty|fixed)"):
            one.restore(other.state())
    state = one.state()
    with pytest.raises(BadArgument, match="state"):
        one.restore(dataclasses.replace(state, numbers=state.numbers[1:]))
    for k in range(len(state.numbers)):  # a bit of a file suffices: 1e300 as a joint would move a hand anywhere
        changed = state.numbers.clone()
        changed[k] = changed[k].nextafter(real(9.0))
        with pytest.raises(BadArgument, match=r"state: expected .*got numbers that are not those of its digest"):
            one.restore(dataclasses.replace(state, numbers=changed))
    (tmp_path / "no.safetensors").write_bytes(b"no")
    with pytest.raises(ModelFileError):
        load_controller_state(tmp_path / "no.safetensors")
