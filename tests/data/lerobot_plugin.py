"""Runs LeRobot's own programs with the plug-in: python lerobot_plugin.py FOLDER, in the environment
.beside/lerobot.

The folder has plan.safetensors, a grasp of the jug by the Barrett hand. What happened is printed as
JSON.
"""

import contextlib
import functools
import importlib.machinery
import inspect
import io
import json
import os
import sys
import types
from pathlib import Path
from typing import ClassVar

import numpy as np


def replace_absent() -> None:
    """Put empty modules in place of packages for pictures and their display, which are not used."""
    import datasets  # noqa: F401  looks for torchvision before it is replaced

    names = ["", ".transforms", ".transforms.v2", ".transforms.functional"]
    for name in ["rerun", *(f"torchvision{x}" for x in (*names, ".transforms.v2.functional"))]:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
            continue
        module = types.ModuleType(name)
        module.__spec__ = importlib.machinery.ModuleSpec(name, None)
        module.Transform = object
        parent, _, last = name.rpartition(".")
        if parent:
            setattr(sys.modules[parent], last, module)
        sys.modules[name] = module


if os.environ.get("LEROBOT_REPLACE"):
    replace_absent()
# LeRobot's programs read the source of each of their options anew for the help, which is not shown
inspect.getsource = functools.cache(inspect.getsource)

from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402
from lerobot.robots import RobotConfig  # noqa: E402
from lerobot.scripts import lerobot_record, lerobot_replay  # noqa: E402
from lerobot.teleoperators import TeleoperatorConfig  # noqa: E402
from lerobot.utils.import_utils import register_third_party_plugins  # noqa: E402


class Listener:
    """A body that keeps what it is sent."""

    sent: ClassVar[list] = []

    def __init__(self, skill):
        self.names = skill.names
        self.place(skill.target(0.0))

    def place(self, start):
        self.at = dict(start)
        Listener.sent.clear()

    def move(self, target):
        self.at = dict(target)
        Listener.sent.append([target[name] for name in self.names])

    def read(self):
        return dict(self.at)

    def stop(self):
        pass


def load(folder):
    """Return what LeRobot's loader reads in a data set: names, actions, states and tasks."""
    found = LeRobotDataset("torchgrasp", root=folder)
    frames = [found[i] for i in range(len(found))]
    return {
        "names": found.features["action"]["names"],
        "action": [frame["action"].tolist() for frame in frames],
        "state": [frame["observation.state"].tolist() for frame in frames],
        "tasks": sorted({frame["task"] for frame in frames}),
        "robot": found.meta.robot_type,
        "fps": found.fps,
        "episodes": found.num_episodes,
    }


def call(program, *words):
    """Run a program of LeRobot with some words; return the class and text of its error, if any."""
    sys.argv = ["lerobot", *words]
    try:
        program.main()
    except (ValueError, RuntimeError) as error:
        return f"{type(error).__name__}: {error}"
    return ""


def own(*words):
    """Run the plug-in's own recorder; return its exit code, its words on stderr, and its JSON."""
    from lerobot_robot_torchgrasp.__main__ import main

    out = io.StringIO()
    err = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([*map(str, words)])
    return code, err.getvalue(), json.loads(out.getvalue() or "null")


def main(folder):
    """Print the results of all cases."""
    plan = str(folder / "plan.safetensors")
    found = {"before": "torchgrasp_hand" in RobotConfig.get_known_choices()}
    register_third_party_plugins()
    found["robots"] = [*RobotConfig.get_known_choices()]
    found["teleoperators"] = [*TeleoperatorConfig.get_known_choices()]
    barrett = (plan, "--hand", "barrett")
    found["dry"] = own(*barrett, "--root", folder / "dry")
    found["dry data"] = load(folder / "dry")
    mujoco = ("--body", "mujoco", "--object", "jug")
    found["mujoco"] = own(*barrett, *mujoco, "--root", folder / "mujoco")
    found["mujoco data"] = load(folder / "mujoco")
    listener = f"{Path(__file__).stem}:Listener"
    robot = ["--robot.type=torchgrasp_hand", f"--robot.plan={plan}", "--robot.hand=barrett"]
    robot += [f"--robot.body={listener}"]
    data = ["--dataset.repo_id=me/torchgrasp", "--play_sounds=false"]
    # LeRobot's own recorder, at the pace of the clock
    found["record"] = call(
        lerobot_record,
        *robot,
        "--teleop.type=torchgrasp_plan",
        f"--teleop.plan={plan}",
        "--teleop.hand=barrett",
        *data,
        f"--dataset.root={folder / 'record'}",
        "--dataset.single_task=lift the jug",
        "--dataset.num_episodes=1",
        "--dataset.episode_time_s=1",
        "--dataset.push_to_hub=false",
    )
    folders = sorted(folder.glob("record*"))
    found["record data"] = load(folders[0]) if folders else None
    found["recorded"] = heard(listener)
    replay = [*data, f"--dataset.root={folder / 'dry'}", "--dataset.episode=0"]
    found["replay"] = call(lerobot_replay, *robot, *replay)
    found["replayed"] = heard(listener)
    # the Allegro hand has other joints than the recorded one
    other = [*robot[:1], f"--robot.plan={folder / 'allegro.safetensors'}", "--robot.hand=allegro"]
    found["other replay"] = call(lerobot_replay, *other, *replay)
    refused = {
        "hand": (plan, "--hand", "allegro"),
        "row": (*barrett, "--row", 7),
        "failed": (str(folder / "failed.safetensors"), "--hand", "barrett"),
        "object": (*barrett, "--body", "mujoco"),
        "body": (*barrett, "--body", "none"),
        "fps": (*barrett, "--fps", 0),
    }
    for name, words in refused.items():
        found[f"refused {name}"] = own(*words, "--root", folder / "refused")
    found["refused root"] = own(*barrett, "--root", folder / "dry")
    found["left"] = (folder / "refused").exists()
    print(json.dumps(found))


def heard(listener):
    """Return what the body was sent, in the module of its name."""
    module, _, name = listener.partition(":")
    sent = getattr(sys.modules[module], name).sent if module in sys.modules else []
    return np.array(sent).tolist()


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent))
    main(Path(sys.argv[1]))
