"""What the adapters of planners read and print; it imports nothing beyond Python's own modules.

An adapter is a script that runs in its planner's own environment, with the path of a task as its
only argument. The task is a JSON object:

* mesh: path of the true mesh [m], a watertight .ply file.
* view: path of a cloud [m] from one side, a text file with three numbers a line; camera: its
  position [m]. A planner that sees the mesh ignores them.
* friction: coefficient of friction; seconds: CPU seconds to search; seed: of every random number.

The adapter prints one line of JSON last, an answer:

* fingers: the option of our Allegro hand, "default" (three fingers) or "four".
* sees: "mesh" or "view", as the row shall say; settings: one sentence; versions: by package.
* tried: starts; seconds: CPU seconds of the search and of what prepares it for this object.
* joint_names, and grasps: a list of objects with `joints` [rad] in this order, and either `pose`, a
  position [m] and a quaternion (w, x, y, z) of the hand's root link in the object's frame, or
  `tips`, the centres [m] of its fingertip spheres there, in the order of the fingers.
* told: instead of grasps, what the planner measured by its own protocol, in one sentence.
"""

import importlib.metadata
import json
import sys
from pathlib import Path
from typing import Any

JOINTS = [f"joint_{k}" for k in range(16)]
"""Joints of the Allegro hand in Wonik's order: index, middle, ring, thumb."""


def read_task() -> dict[str, Any]:
    """Return the task that the command line names."""
    return json.loads(Path(sys.argv[1]).read_text("utf-8"))


def print_answer(**fields: Any) -> None:
    """Print an answer as the last line."""
    print("\n" + json.dumps(fields), flush=True)


def find_versions(*packages: str) -> dict[str, str]:
    """Return the versions of installed packages."""
    return {name: importlib.metadata.version(name) for name in packages}
