"""The recorder of the plug-in for LeRobot, with stand-ins for LeRobot's classes."""

import importlib
import sys
import types

import pytest

from tests.data.others import ROOT
from torchgrasp.data.shipped import load_shipped_grasp


class Named:
    """A class of LeRobot that keeps nothing."""

    def __init__(self, *_):
        pass

    @classmethod
    def register_subclass(cls, name):
        return lambda kind: kind


class FullDisk:
    """A data set that cannot be made."""

    @classmethod
    def create(cls, *_, **__):
        raise OSError("no space left on device")


@pytest.fixture
def plugin(monkeypatch):
    """The plug-in's recorder, imported beside the stand-ins."""
    classes = {
        "lerobot": (),
        "lerobot.robots": ("Robot", "RobotConfig"),
        "lerobot.teleoperators": ("Teleoperator", "TeleoperatorConfig"),
        "lerobot.utils": (),
        "lerobot.utils.errors": ("DeviceAlreadyConnectedError", "DeviceNotConnectedError"),
        "lerobot.datasets": (),
        "lerobot.datasets.lerobot_dataset": ("LeRobotDataset",),
    }
    for name, inside in classes.items():
        module = types.ModuleType(name)
        for kind in inside:
            base = Exception if kind.endswith("Error") else Named
            setattr(module, kind, type(kind, (base,), {}))
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "lerobot_robot_torchgrasp"))
    name = "lerobot_robot_torchgrasp"
    yield importlib.import_module(f"{name}.__main__")
    for loaded in [x for x in sys.modules if x.partition(".")[0] == name]:
        del sys.modules[loaded]


def test_the_hand_is_stopped_if_the_data_set_cannot_be_made(plugin, tmp_path, monkeypatch):
    file = tmp_path / "plan.safetensors"
    load_shipped_grasp("jug", "barrett").save(file)
    robot = plugin.TorchgraspHand(plugin.TorchgraspHandConfig(plan=str(file), hand="barrett"))
    plan = plugin.TorchgraspPlan(plugin.TorchgraspPlanConfig(plan=str(file), hand="barrett"))
    monkeypatch.setattr(plugin, "LeRobotDataset", FullDisk)
    with pytest.raises(OSError, match="no space left"):
        plugin.record(robot, plan, tmp_path / "set", "grasp the jug")
    assert not robot.is_connected and not plan.is_connected
