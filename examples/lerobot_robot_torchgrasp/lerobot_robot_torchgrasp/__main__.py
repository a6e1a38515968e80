"""Run a planned grasp and record it: python -m lerobot_robot_torchgrasp PLAN --root FOLDER ...

LeRobot's writer records one episode, without waiting for the clock. The last line is JSON.
"""

import argparse
import contextlib
import json
import sys
from pathlib import Path
from typing import Any

from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_robot_torchgrasp import (
    TorchgraspHand,
    TorchgraspHandConfig,
    TorchgraspPlan,
    TorchgraspPlanConfig,
)
from torchgrasp.foundation.errors import BadArgument, GraspError


def features(robot: TorchgraspHand) -> dict[str, dict[str, Any]]:
    """Return the features of the data set: actions and observations, in one vector each."""
    names = list(robot.action_features)
    one = {"dtype": "float32", "shape": (len(names),), "names": names}
    return {"action": one, "observation.state": dict(one)}


def record(robot: TorchgraspHand, plan: TorchgraspPlan, root: Path, task: str) -> dict[str, Any]:
    """Run the plan on the robot and record it as a data set of one episode; return what happened.

    The hand is stopped and disconnected in the end, also after an error. Raises `BadArgument` if the
    folder exists.
    """
    import numpy as np

    if root.exists():
        raise BadArgument("root", root, "a folder that is not there yet")
    fps = robot.config.fps
    with contextlib.ExitStack() as ends:
        robot.connect()
        ends.callback(robot.disconnect)
        plan.connect()
        ends.callback(plan.disconnect)
        dataset = LeRobotDataset.create(
            "torchgrasp", fps, features(robot), root=root, robot_type=robot.name, use_videos=False
        )
        ends.callback(dataset.finalize)
        for _ in range(len(plan.skill)):
            state = robot.get_observation()
            sent = robot.send_action(plan.get_action())
            frame: dict[str, Any] = {
                "observation.state": np.array([*state.values()], dtype=np.float32),
                "action": np.array([*sent.values()], dtype=np.float32),
            }
            dataset.add_frame(frame | {"task": task})
        dataset.save_episode()
        risen = getattr(robot.body, "risen", None)
    return {"frames": len(plan.skill), "fps": fps, "root": str(root), "risen": risen}


def main(words: list[str] | None = None) -> int:
    """Run the command; return the exit code."""
    given = argparse.ArgumentParser(prog="python -m lerobot_robot_torchgrasp")
    given.add_argument("plan", help="grasps.safetensors, as `torchgrasp grasp` writes it")
    given.add_argument("--root", required=True, help="folder of the data set to write")
    given.add_argument("--row", type=int, default=0, help="number of the grasp; 0 is the best")
    given.add_argument("--hand", default="allegro", help="a shipped hand, or a hand's folder")
    given.add_argument("--body", default="dry", help="dry, mujoco, or module:Class of your own")
    given.add_argument("--object", default="", help="a shipped object or a mesh, for mujoco")
    given.add_argument("--fps", type=int, default=30, help="targets a second")
    given.add_argument("--force", type=float, default=4.0, help="of the strongest finger [N]")
    given.add_argument("--task", default="grasp the object and lift it", help="task in words")
    options = vars(given.parse_args(words))
    root = Path(options.pop("root"))
    task = options.pop("task")
    common = {name: options[name] for name in ("plan", "row", "hand", "fps", "force")}
    try:
        robot = TorchgraspHand(TorchgraspHandConfig(**options))
        done = record(robot, TorchgraspPlan(TorchgraspPlanConfig(**common)), root, task)
    except GraspError as error:
        print(f"lerobot_robot_torchgrasp: {error}", file=sys.stderr)
        return 2
    print(json.dumps(done))
    return 0


if __name__ == "__main__":
    sys.exit(main())
