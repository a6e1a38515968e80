"""vnb-grasp's quick experiment (github.com/coenwerem/vnb-grasp), as its README has it.

It grasps its own cube with its own hand, a RealHand L6 on an arm, by its own protocol: it plans no
grasps of an Allegro hand, so the row tells what it measured itself.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

from messages import find_versions, print_answer

RUNNER = "examples/run_variational_belief_experiments.py"
RESULTS = "outputs/variational_belief_experiments"


def main() -> None:
    """Run the experiment in its repository, and print what it found."""
    try:
        import vnb_grasp  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        sys.exit(f"no vnb-grasp in this environment: {error}")
    root = Path(vnb_grasp.__file__).resolve().parents[1]
    if not (root / RUNNER).is_file():
        sys.exit(f"no {RUNNER} beside the package: install the clone with pip install -e")
    began = time.time()
    command = [sys.executable, RUNNER, "--quick", "--tag", "torchgrasp"]
    environment = {"MUJOCO_GL": "egl", **os.environ}
    subprocess.run(command, cwd=root, env=environment, check=True, stdout=sys.stderr)
    new = [
        path
        for path in (root / RESULTS).glob("experiment_torchgrasp_*.json")
        if path.stat().st_mtime >= began
    ]
    episodes = find_episodes([json.loads(path.read_text("utf-8")) for path in new])
    if not episodes:
        sys.exit(f"the experiment left no episodes in {RESULTS}")
    held = sum(bool(x["success"]) for x in episodes)
    spent = sum(float(x["runtime_s"]) for x in episodes)
    print_answer(
        told=f"its own hand, cube and protocol: {held} of {len(episodes)} episodes succeed, "
        f"{spent / len(episodes):.1f} s each by its own clock",
        versions=find_versions("vnb-grasp", "torch", "mujoco"),
    )


def find_episodes(content: object) -> list[dict]:
    """Return all objects with a success and a runtime, wherever the file has them."""
    if isinstance(content, dict):
        if "success" in content and "runtime_s" in content:
            return [content]
        content = list(content.values())
    if isinstance(content, list):
        return [episode for part in content for episode in find_episodes(part)]
    return []


if __name__ == "__main__":
    main()
