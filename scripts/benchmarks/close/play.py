"""Exported folders, played in other simulators: how often the verdict is that of our own trial of
the same motion.

The best grasps of one view of each object are lifted in open loop, in place, under protocol
"table-lift" with the masses of `MASSES` in turn, some of which are too heavy. `scripts/beside`
makes the simulators' environments.
"""

import dataclasses
import itertools
import json
import os
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from benchmarks.common import ROOT, Options, Row, bench
from torchgrasp import load_grasps
from torchgrasp.data import list_views, read_object_mesh
from torchgrasp.evaluation import PROTOCOLS, EvaluationSpec, evaluate
from torchgrasp.evaluation.intervals import count_by, format_share, share_over
from torchgrasp.export import save_play
from torchgrasp.export.play import pressing_force
from torchgrasp.hand.load import load_hand
from torchgrasp.sim.convex_parts import convex_parts

PLAYERS = {
    "MuJoCo 3": ("mujoco", ".venv"),
    "MuJoCo 4": ("mujoco", ".beside/mujoco4"),
    "ManiSkill": ("maniskill", ".beside/maniskill"),
    "Newton": ("newton", ".beside/newton"),
}
"""Format and environment of each simulator that plays."""

MASSES = (0.1, 0.249, 1.0, 4.0)
"""Masses [kg] of the objects in turn. The last is beyond what most joints can press."""

TRIALS = {
    "our trial of the same motion": {"closing": "open_loop"},
    "the same in MuJoCo": {"closing": "open_loop", "simulator": "mujoco"},
    "our trial with tactile fingertips": {},
}
"""Our own trials by name: changes of the protocol. The bar is for the first."""

LEAST_SAME = 0.95
"""Share of equal verdicts with our own trial of the same motion: the project's own bar."""

RUNNER = """
import json, runpy, sys
for folder, numbers in json.loads(sys.argv[1]):
    sys.argv[1:], sys.path[0] = numbers, folder
    runpy.run_path(f"{folder}/play.py", run_name="__main__")
    sys.modules.pop("environment", None)  # of ManiSkill's folder
"""
"""Runs the scripts of several folders in one process, which loads the simulator once."""


class Played(NamedTuple):
    """A grasp, by folder and number, and how far the object rose [m], and whether that is half of
    the lift.
    """

    folder: str
    grasp: int
    rise: float
    held: bool


def play_all(environment: str, folders: Iterable[tuple[Path, int]]) -> list[Played]:
    """Play the first grasps of each folder with its own script in an environment, below the
    project's root.
    """
    tasks = [(str(folder), [str(k) for k in range(number)]) for folder, number in folders]
    python = ROOT / environment / "bin" / "python"
    kept = {name: text for name, text in os.environ.items() if name != "PYTHONPATH"}
    call = [str(python), "-W", "ignore", "-c", RUNNER, json.dumps(tasks)]
    done = subprocess.run(call, capture_output=True, text=True, check=False, env=kept)
    if done.returncode:
        raise RuntimeError(done.stderr[-2000:])
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('{"grasp"')]
    places = [folder for folder, numbers in tasks for _ in numbers]
    return [Played(place, **line) for place, line in zip(places, lines, strict=True)]


@bench("close/play", objects=True)
def play(o: Options) -> list[Row]:
    """Try and export the best grasps of each object, play them in each simulator, and compare the
    verdicts.
    """
    units: dict[tuple[str, int], str] = {}
    own: dict[str, dict[tuple[str, int], bool]] = {name: {} for name in TRIALS}
    folders: dict[str, list[tuple[Path, int]]] = {player: [] for player, _ in PLAYERS.values()}
    for hand, objects, (k, mass) in itertools.product(
        map(load_hand, o.hands), o.objects, enumerate(MASSES)
    ):
        listed = [name for name, _ in list_views(objects, most=1)]
        names = [name for name in listed if not o.names or name in o.names][k :: len(MASSES)]
        shelf = o.out / "play" / f"{hand.name}_{objects.name}_{mass}"
        out = o.out / "play" / "folders"
        for name, changes in TRIALS.items() if names else ():
            protocol = dataclasses.replace(PROTOCOLS["table-lift"], tries=1).with_trial(
                mass=mass, **changes
            )
            if protocol.trial.closing == "open_loop":
                protocol = protocol.with_trial(force=pressing_force(protocol.trial, mass))
            kept = any(shelf.glob("*/*.safetensors"))
            spec = EvaluationSpec(
                o.grasps, starts=o.starts, only=tuple(names), seed=o.seed, views=1, planned=kept
            )
            for score in evaluate(objects, hand, protocol, spec, folder=shelf, workers=o.workers):
                label = f"{hand.name}_{score.object}"
                units |= {(label, x.rank): score.unit for x in score.attempts}
                own[name] |= {(label, x.rank): x.passed for x in score.attempts}
        for file in sorted(shelf.glob("*/*.safetensors")):
            grasps = load_grasps(file)[: o.grasps]
            mesh = read_object_mesh(objects, file.parent.name)
            for player, places in folders.items() if len(grasps) else ():
                place = out / player / f"{hand.name}_{file.parent.name}"
                trial = dataclasses.replace(PROTOCOLS["table-lift"].trial, mass=mass)
                save_play(hand, grasps, place, player, mesh, trial, parts=convex_parts(mesh))
                places.append((place, len(grasps)))
    rows = []
    for name, (player, environment) in PLAYERS.items():
        played = {
            (Path(x.folder).name, x.grasp): x.held for x in play_all(environment, folders[player])
        }
        rows += [
            _row(f"{name}, {trial}", played, held, units, trial) for trial, held in own.items()
        ]
    return rows


def _row(
    what: str,
    played: dict[tuple[str, int], bool],
    own: dict[tuple[str, int], bool],
    units: dict,
    trial: str,
) -> Row:
    """Return how often a simulator and a trial of ours have the same verdict, and how many each
    lifts.
    """
    same = share_over(count_by((units[key], played[key] == own[key]) for key in own))
    differ = [(*key, own[key], played[key]) for key in own if own[key] != played[key]]
    words = f"{len(own) - len(differ)} of {len(own)}: {format_share(same)}; "
    words += f"lifted {sum(played.values())}, by our trial {sum(own.values())}"
    judged = trial == next(iter(TRIALS))
    met = (len(own) - len(differ)) / len(own) >= LEAST_SAME if judged else None
    bar = f">= {LEAST_SAME:.0%}" if judged else "-"
    return Row(what, bar, words, met, {"same": same, "differ": differ})
