"""`torchgrasp evaluate`: the library's grasps under published protocols, in simulation."""

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal

from torchgrasp.cli.common import check_folder, check_seed, naming
from torchgrasp.cli.grasps import check_simulator
from torchgrasp.close.control import ClosingMode
from torchgrasp.close.evaluate import ViewScore, summarise
from torchgrasp.close.evaluate import evaluate as evaluate_views
from torchgrasp.close.protocol import PROTOCOLS
from torchgrasp.errors import Status
from torchgrasp.files import write_file
from torchgrasp.hand.load import load_hand


def evaluate(
    objects: Path,
    hand: str,
    out: Path,
    protocol: Literal["multidex", "dexgraspbench", "dexgraspbench-hard", "pose-noise"] = "dexgraspbench",
    closing: ClosingMode = "open_loop",
    grasps: int = 20,
    starts: int = 1000,
    force: float = 7.0,
    complete: bool = False,
    only: tuple[str, ...] = (),
    seed: int = 0,
) -> int:
    """Plan on each noisy view of a folder's objects and put the best grasps through a protocol in simulation.

    Prints a line for each view, then the shares with 95 % Wilson intervals, and writes evaluate.json.

    Args:
        objects: folder with manifest.json, and for each object mesh.ply and noisy views.
        hand: allegro, allegro_biotac, barrett, or the folder of another hand.
        out: folder of the results; it is made where it does not exist.
        protocol: which test: see torchgrasp.close.protocol.
        closing: open loop through pre-grasp, grasp and squeeze, or by a controller that feels with the fingertips.
        grasps: the most that are tried of each view, the best first.
        starts: random starts of the contact planner.
        force: normal force of the strongest finger [N] in the squeeze.
        complete: plan on the whole cloud instead of each view.
        only: names of objects to keep; by default all.
        seed: of every random draw.
    """
    with naming("--out", "path"):
        check_folder(out)
    check_seed(seed)
    check_simulator()
    with naming("--hand", "hand", "name"):
        the_hand = load_hand(hand)
    with naming("--objects", "objects", "path"), naming("--grasps", "grasps"), naming("--force", "force"):
        scores = evaluate_views(
            objects, the_hand, protocol, grasps, starts, seed, force, closing, complete, only, print_score
        )
    summary = summarise(scores)
    print_summary(protocol, summary)
    asked = {"protocol": dataclasses.asdict(PROTOCOLS[protocol]), "hand": hand, "grasps": grasps, "starts": starts}
    asked |= {"force": force, "closing": closing, "complete": complete, "seed": seed}
    rows = [
        {**dataclasses.asdict(s), "results": [{**dataclasses.asdict(r), "status": r.status.name} for r in s.results]}
        for s in scores
    ]
    text = json.dumps({"asked": asked, "summary": summary, "views": rows}, indent=1)
    with naming("--out", "path"):
        write_file(out / "evaluate.json", text)
    return 0


def print_score(score: ViewScore) -> None:
    """Print one line."""
    failed = [result.status for result in score.results if result.status is not Status.OK]
    reasons = ", ".join(f"{failed.count(status)} {status.name.lower()}" for status in dict.fromkeys(failed))
    passed = f"{sum(result.passed for result in score.results)}/{len(score.results)}"
    print(f"{score.object:14}{score.view:8}{score.executable:7}{passed:>9}  {reasons}", flush=True)


def print_summary(protocol: str, summary: dict[str, Any]) -> None:
    """Print the shares and what they cost."""
    print()
    for key, text in (("gsr", "grasps that pass"), ("top1", "best grasps that pass"), ("objects", "objects with one")):
        value, low, high, total = summary[key]
        print(f"{text:22} {value:6.1%}  [{low:.1%}, {high:.1%}] of {total}")
    print(f"{protocol}: {summary['refused']} views without a grasp, failures {summary['failures'] or 'none'}")
    force = "-" if summary["force_n"] is None else f"{summary['force_n']:.2f} N"
    plan, trial = summary["plan_cpu_s"], summary["trial_cpu_s"]
    print(f"mean normal force of a finger {force}; CPU time {plan:.1f} s to plan a view, {trial:.2f} s to try a grasp")
