"""From one noisy view to a held object, for every object of a folder and both hands."""

import math
import time
from typing import Any

import trimesh

from benchmarks.common import Options, Row, bench
from torchgrasp import ContactSpec, PointCloud, Status, TrialSpec, close_hand, load_hand, plan_grasps
from torchgrasp.base import count_status
from torchgrasp.data import list_views, read_object_mesh, read_view
from torchgrasp.evaluation import EvaluationSpec, evaluate, summarise
from torchgrasp.evaluation.intervals import format_share
from torchgrasp.files import format_line


def bench_one(
    cloud: PointCloud, mesh: trimesh.Trimesh, hand_name: str, starts: int, seed: int, close: int
) -> dict[str, Any]:
    """Plan for one cloud and hand, then close on the true mesh with the first `close` grasps."""
    hand = load_hand(hand_name)
    messages: list[str] = []
    began = time.perf_counter()
    grasps = plan_grasps(
        cloud,
        hand,
        ContactSpec(table=0.0),
        starts,
        seed,
        observer=lambda stage, text, value: messages.append(f"{stage}: {text}"),
    )
    seconds = time.perf_counter() - began
    good = grasps[grasps.status == Status.OK]
    row: dict[str, Any] = {
        "hand": hand_name,
        "seconds": round(seconds, 1),
        "grasps": len(good),
        "stages": messages,
        "blocked": {s.name: n for s, n in count_status(grasps.status).items() if s is not Status.OK},
        "trials": [],
    }
    if len(good):
        row["tip_mm"] = round(1e3 * float(good.tip_error[0].max()), 2)
        row["clearance_mm"] = round(1e3 * float(good.clearance[0]), 1)
    for i in range(min(close, len(good))):
        result = close_hand(good[i], hand, mesh, TrialSpec(), seed=seed)
        row["trials"].append(
            {
                "held": result.held,
                "status": result.status.name,
                "moved_mm": round(1e3 * result.object_motion.distance, 1),
                "turned_deg": round(math.degrees(result.object_motion.angle), 1),
                "force_n": [round(float(f), 2) for f in result.forces[-50:].mean(0)],
                "seconds": round(result.seconds, 1),
            }
        )
    return row


COLUMNS = {"object": -12, "hand": -8, "s": 5, "grasps": 6, "tip mm": 6, "clear mm": 8, "best grasp": -20, "held": 5}
"""Heads and widths of the table: seconds to plan, executable grasps, the best grasp, and how many trials held."""


def table_line(r: dict[str, Any]) -> str:
    """Return one line of the table."""
    best = "-"
    if r["trials"]:
        first = r["trials"][0]
        best = f"{first['status'].lower()} {first['moved_mm']:.0f} mm {first['turned_deg']:.0f} deg"
    held = f"{sum(t['held'] for t in r['trials'])}/{len(r['trials'])}"
    numbers = (r["seconds"], r["grasps"], r.get("tip_mm", "-"), r.get("clearance_mm", "-"))
    return format_line((r["object"], r["hand"], *numbers, best, held), list(COLUMNS.values()))


def count_rows(rows: list[dict[str, Any]]) -> list[Row]:
    """Return how many objects have a grasp and how many best grasps held, for each hand."""
    found = []
    for hand in sorted({r["hand"] for r in rows}):
        mine = [r for r in rows if r["hand"] == hand]
        grasped = sum(r["grasps"] > 0 for r in mine)
        held = sum(bool(r["trials"]) and r["trials"][0]["held"] for r in mine)
        tried = [t for r in mine for t in r["trials"]]
        trials = f"{sum(t['held'] for t in tried)} of {len(tried)} trials"
        text = f"{grasped} with a grasp, the best grasp held on {held}, {trials}"
        found.append(Row(f"{hand}: {len(mine)} objects", "-", text, None, {"rows": mine}))
    return found


@bench("grasp/lifts", objects=True)
def lifts(o: Options) -> list[Row]:
    """Plan from one noisy view of every object, for each hand, and lift the true mesh with the best grasps."""
    print(format_line(list(COLUMNS), list(COLUMNS.values())))
    rows = []
    for name, view in list_views(o.objects[0], only=o.names, most=1):
        cloud, mesh = read_view(o.objects[0], name, view), read_object_mesh(o.objects[0], name)
        for hand in o.hands:
            rows.append({"object": name} | bench_one(cloud, mesh, hand, o.starts, o.seed, o.grasps))
            print(table_line(rows[-1]), flush=True)
    return count_rows(rows)


@bench("grasp/pulls", objects=True)
def pulls(o: Options) -> list[Row]:
    """Pull at the best grasps of every view, as DexGraspBench does."""
    spec, rows = EvaluationSpec(o.grasps, starts=o.starts, only=o.names, seed=o.seed), []
    for hand in o.hands:
        found = summarise(list(evaluate(o.objects[0], load_hand(hand), "dexgraspbench", spec, workers=o.workers)))
        for name in ("gsr", "top1", "objects"):
            share = found[name]
            rows.append(Row(f"{hand}, dexgraspbench, {name}", "-", format_share(share), None, {name: share}))
    return rows
