"""From one noisy view to a held object, for every object of a folder and both hands."""

import json
import math
import time
from pathlib import Path
from typing import Any

import torch
import trimesh

from torchgrasp import ContactSpec, PointCloud, Status, TrialSpec, close_hand, load_hand, plan_grasps
from torchgrasp.base import count_status
from torchgrasp.data import list_views, read_object_mesh, read_view
from torchgrasp.files import format_line, write_file


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


def print_counts(rows: list[dict[str, Any]]) -> None:
    """Print how many objects have a grasp and how many top grasps were held, for each hand."""
    for hand in sorted({r["hand"] for r in rows}):
        mine = [r for r in rows if r["hand"] == hand]
        found = sum(r["grasps"] > 0 for r in mine)
        held = sum(bool(r["trials"]) and r["trials"][0]["held"] for r in mine)
        tried = [t for r in mine for t in r["trials"]]
        all_held = f"{sum(t['held'] for t in tried)} of {len(tried)} trials held"
        print(f"{hand}: {found} of {len(mine)} objects with a grasp, the top one held on {held}, {all_held}")


def grasp(
    objects: Path,
    hands: tuple[str, ...] = ("allegro", "barrett"),
    only: tuple[str, ...] = (),
    view: str = "view0",
    starts: int = 1000,
    seed: int = 0,
    close: int = 1,
    camera: bool = True,
    out: Path = Path("out/bench_grasp.json"),
) -> None:
    """Plan from one noisy view of every object, for each hand, and close on the true mesh in simulation.

    Args:
        objects: folder with manifest.json and a folder for each object.
        hands: hands to plan for.
        only: objects to keep; all by default.
        view: which view of each object is seen.
        starts: starts of the contact planner.
        seed: of every random draw.
        close: how many of the best grasps of each object and hand are closed.
        camera: whether the camera's position is given, as in the manifest, or must be estimated.
        out: where the numbers are written as JSON.
    """
    torch.set_num_threads(1)  # the batches are small: a second thread brings nothing here
    print(format_line(list(COLUMNS), list(COLUMNS.values())))
    rows = []
    for name in dict.fromkeys(name for name, _ in list_views(objects, only=only)):
        cloud, mesh = read_view(objects, name, view, camera), read_object_mesh(objects, name)
        for hand in hands:
            rows.append({"object": name} | bench_one(cloud, mesh, hand, starts, seed, close))
            print(table_line(rows[-1]), flush=True)
    print_counts(rows)
    threads = torch.get_num_threads()
    text = json.dumps({"bench": "grasp", "view": view, "seed": seed, "threads": threads, "rows": rows}, indent=1)
    write_file(out, text)
