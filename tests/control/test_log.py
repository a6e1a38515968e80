"""A log of a controlled hand, read back: the same observations and commands to the bit."""

import dataclasses

import pytest
import torch

from tests.control.test_state import known, seen
from tests.point_fingers import PERIOD
from torchgrasp.control import ControlRecorder, GraspController, load_control_log
from torchgrasp.errors import BadArgument, ModelFileError


def test_a_log_that_is_read_back_gives_the_same_commands(tmp_path):
    controller, recorder = GraspController(known(), holding="grip"), ControlRecorder()
    for k in range(200):
        recorder.add(seen(k), PERIOD, controller.step(seen(k), PERIOD))
    recorder.log().save(tmp_path / "log.safetensors")
    log = load_control_log(tmp_path / "log.safetensors")
    again = GraspController(known(), holding="grip")
    assert len(log) == 200
    for k, (observation, period, targets) in enumerate(log.ticks()):
        assert period == PERIOD
        for field in ("joints", "tips", "jacobian"):
            assert torch.equal(getattr(observation, field), getattr(seen(k), field))
        for field in ("reading", "forces", "contact", "average", "sliding"):
            assert torch.equal(getattr(observation.tactile, field), getattr(seen(k).tactile, field))
        for field in ("points", "normals"):
            found, expected = getattr(observation.tactile, field), getattr(seen(k).tactile, field)
            assert torch.equal(found.isnan(), expected.isnan()) and torch.equal(
                found.nan_to_num(), expected.nan_to_num()
            )
        found = again.step(observation, period)
        assert torch.equal(found.joints, targets.joints) and torch.equal(found.palm, targets.palm)
    assert again.closed and controller.closed


def test_an_empty_log_and_a_broken_file_are_refused(tmp_path):
    with pytest.raises(BadArgument, match="no ticks"):
        ControlRecorder().log()
    controller, recorder = GraspController(known()), ControlRecorder()
    recorder.add(seen(0), PERIOD, controller.step(seen(0), PERIOD))
    log = recorder.log()
    assert dataclasses.replace(log[0:1]).period.tolist() == [PERIOD]
    log.save(tmp_path / "log.safetensors")
    whole = (tmp_path / "log.safetensors").read_bytes()
    (tmp_path / "log.safetensors").write_bytes(whole[:-8])
    with pytest.raises(ModelFileError):
        load_control_log(tmp_path / "log.safetensors")
