"""`torchgrasp evaluate`: the library's grasps under published protocols, in simulation."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Any, Literal

from torchgrasp.app.cli.common import check_seed, load_fingers, naming
from torchgrasp.app.cli.grasps import import_simulator
from torchgrasp.app.report.evaluation import SHARE_NAMES, write_evaluation
from torchgrasp.data import list_entries, list_views
from torchgrasp.errors import DatasetError, Status
from torchgrasp.evaluation.campaign import evaluate as evaluate_views
from torchgrasp.evaluation.intervals import format_share
from torchgrasp.evaluation.protocols import find_protocol
from torchgrasp.evaluation.score import ViewScore, summarise
from torchgrasp.evaluation.views import EvaluationSpec, Ranks
from torchgrasp.files import format_columns, format_json, format_line, hold_folder, write_file
from torchgrasp.specs import ClosingMode, HoldingMode, Simulator


def evaluate(
    objects: Path,
    hand: str,
    out: Path,
    fingers: str = "default",
    protocol: Literal[
        "multidex", "dexgraspbench", "dexgraspbench-hard", "pose-noise", "paper", "tabletop", "household"
    ] = "dexgraspbench",
    closing: ClosingMode | None = None,
    holding: HoldingMode = "force",
    simulator: Simulator = "sapien",
    force: float | None = None,
    grasps: int = 20,
    ranks: Ranks = "best",
    starts: int = 1000,
    complete: bool = False,
    only: tuple[str, ...] = (),
    views: int | None = None,
    planned: Path | None = None,
    workers: int = 1,
    seed: int = 0,
) -> int:
    """Plan on each noisy view of a folder's objects and test the best grasps in simulation.

    Prints a line for each view, then shares with 95 % intervals over families of objects. Writes evaluate.json,
    evaluate.html, and a folder of grasps.

    Args:
        objects: folder with manifest.json, and for each object mesh.ply and noisy views.
        hand: name of a shipped hand, as allegro, barrett, leap or shadow, or the folder of another.
        fingers: which grasp: an option of the hand, a number of fingers, or their names as in index,middle,thumb;
            "auto": for each view the option whose best grasps are likeliest to succeed.
        out: folder of the results; it is made where it does not exist, and no other run may use it meanwhile.
        protocol: which test; see torchgrasp.evaluation.protocols.
        closing: how the hand closes; by default in open loop before a pull, under uncertainty before a lift.
        holding: how the hand presses from then on.
        simulator: sapien or mujoco.
        force: normal force of the strongest finger [N]; by default 7 before a pull, 4 before a lift, 6 in
            protocol "household".
        grasps: the most that are tried of each view.
        ranks: which of them: the best, or as many spread over all ranks.
        starts: random starts of the contact planner.
        complete: plan on the whole cloud instead of each view.
        only: names of objects to keep; by default all.
        views: the most of each object; by default all.
        planned: folder "grasps" of an earlier run, whose grasps are tested.
        workers: processes; the results do not depend on their number.
        seed: of every random draw.
    """
    check_seed(seed)
    import_simulator(simulator)
    the_hand, among = load_fingers(hand, fingers)
    changes: dict[str, Any] = {"closing": closing, "force": force, "holding": holding, "simulator": simulator}
    changes = {name: x for name, x in changes.items() if x is not None}
    with naming(force="--force", grasps="--grasps", views="--views"):
        test = find_protocol(protocol).with_trial(**changes)
        spec = EvaluationSpec(grasps, ranks, starts, complete, only, planned is not None, seed, views, among)
    scores = []
    with naming(folder="--out", path="--out"), hold_folder(out):
        with naming(objects="--objects", workers="--workers"):
            found = evaluate_views(objects, the_hand, test, spec, folder=planned or out / "grasps", workers=workers)
            widths = name_widths(objects, spec)
            for score in found:
                print_score(score, widths)
                scores.append(score)
        summary = summarise(scores)
        print_summary(protocol, spec.tried, summary)
        asked = {"hand": hand, "tried": spec.tried, "hand_sha256": the_hand.source.sha256, **dataclasses.asdict(spec)}
        asked["fingers"] = among or the_hand.source.option
        asked["protocol"] = dataclasses.asdict(test)
        content = {"asked": asked, "summary": summary, "views": [dataclasses.asdict(score) for score in scores]}
        write_file(out / "evaluate.json", format_json(content))
        write_evaluation(out / "evaluate.html", f"Grasps of the {hand} hand under {protocol}", asked, scores)
    return 0


def name_widths(objects: Path, spec: EvaluationSpec) -> tuple[int, int]:
    """Return the letters of the longest names of objects, as they are printed, and of views."""
    names, views = list_entries(objects, spec.only), [""]
    for name in names:
        with contextlib.suppress(DatasetError):  # a bad entry is refused when it is its turn
            views += [view for _, view in list_views(objects, spec.complete, [name], spec.views)]
    return max(len(ascii(name)) for name in names), max(map(len, views))


def print_score(score: ViewScore, widths: tuple[int, int] = (12, 6)) -> None:
    """Print the line of a view, its names in columns so wide."""
    failed = [attempt.status for attempt in score.attempts if attempt.status is not Status.OK]
    reasons = ", ".join(f"{failed.count(status)} {status.name.lower()}" for status in dict.fromkeys(failed))
    reasons = reasons if score.attempts else score.note or score.refusal.sentence
    passed = f"{sum(attempt.passed for attempt in score.attempts)}/{len(score.attempts)}"
    cells = (score.object, score.view, score.executable, passed, reasons)
    print(format_line(cells, (-widths[0], -widths[1], 5, 7, -1)), flush=True)


def print_summary(protocol: str, tried: str, summary: dict[str, Any]) -> None:
    """Print shares, those of each group of objects, failures by stage, and cost."""
    rows = [(text, format_share(summary[key])) for key, text in SHARE_NAMES.items()]
    for name, group in summary["by_group"].items():
        rows += [(f"{name}: {text}", format_share(group[key])) for key, text in SHARE_NAMES.items()]
    if summary["refused"]:
        rows.append(
            ("views without a grasp", f"{summary['refused']}: a failure of the best one, not in the grasps tried")
        )
    if len(summary["fingers"]) > 1:
        rows.append(("views by fingers", "; ".join(f"{n} {names}" for names, n in summary["fingers"].items())))
    for stage, reasons in summary["failures"].items():
        rows.append((f"failed in {stage}", ", ".join(f"{n} {name.lower()}" for name, n in reasons.items())))
    print(f"\n{protocol}, {tried}\n{format_columns(rows, left={0, 1})}")
    means = [summary[key] for key in ("force_n", "overlap_mm", "overlap_mm_max", "plan_cpu_s", "trial_cpu_s", "cpu_s")]
    force, overlap, most, plan, trial, total = ("-" if mean is None else f"{mean:.2f}" for mean in means)
    if summary["slip_mm"]:
        (slip, farthest), (turn, widest) = summary["slip_mm"], summary["slip_deg"]
        held = f"median {slip:.1f} mm and {turn:.1f} deg, 95 % below {farthest:.1f} mm and {widest:.1f} deg"
        print(f"slip of what held: {held}")
    print(f"mean normal force of a finger {force} N, overlap at the grasp {overlap} mm (most {most} mm)")
    print(f"CPU time {plan} s to plan on a view, {trial} s for an attempt, {total} s in all")
