"""From one noisy view to a held object, for every object of a folder and both hands."""

import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import torch
import trimesh

from torchgrasp import ContactSpec, PointCloud, Status, TrialSpec, close_hand, load_hand, plan_grasps, read_cloud
from torchgrasp.base import count_status
from torchgrasp.files import write_file


@dataclasses.dataclass(frozen=True)
class Scene:
    """One object of the bench: what the planner sees, and the mesh that the simulator alone uses."""

    name: str
    cloud: PointCloud
    mesh: trimesh.Trimesh


def read_scene(folder: Path, entry: dict[str, Any], view: str, camera_is_known: bool) -> Scene:
    """Read a noisy view without normals and the true mesh, both at the object's suggested scale."""
    scale = float(entry["suggested_scale"])
    cloud = read_cloud(folder / f"{view}_noisy.ply")
    camera = torch.tensor(entry["views"][view]["T_object_camera"], dtype=torch.float64)[:3, 3]
    mesh = trimesh.load(folder / "mesh.ply", force="mesh")
    mesh.apply_scale(scale)
    return Scene(folder.name, PointCloud(cloud.points * scale, None, camera * scale if camera_is_known else None), mesh)


def bench_one(scene: Scene, hand_name: str, starts: int, seed: int, close: int, spec: ContactSpec) -> dict[str, Any]:
    """Plan for one object and hand, then close on the first `close` grasps."""
    hand = load_hand(hand_name)
    messages: list[str] = []
    began = time.perf_counter()
    grasps = plan_grasps(
        scene.cloud, hand, spec, starts, seed, observer=lambda stage, text, value: messages.append(f"{stage}: {text}")
    )
    seconds = time.perf_counter() - began
    good = grasps[grasps.status == Status.OK]
    row: dict[str, Any] = {
        "object": scene.name,
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
        result = close_hand(good[i], hand, scene.mesh, TrialSpec(), seed=seed)
        row["trials"].append(
            {
                "held": result.held,
                "status": result.status.name,
                "moved_mm": round(1e3 * result.object_motion[0], 1),
                "turned_deg": round(57.29578 * result.object_motion[1], 1),
                "force_n": [round(float(f), 2) for f in result.forces[-50:].mean(0)],
                "seconds": round(result.seconds, 1),
            }
        )
    return row


HEADER = f"{'object':12}{'hand':9}{'s':>6}{'grasps':>8}{'tip mm':>8}{'clear mm':>9}  {'top grasp':20}{'held':>7}"


def table_line(r: dict[str, Any]) -> str:
    """Return one line of the table: seconds to plan, executable grasps, the best one, and how many trials held."""
    top = "-"
    if r["trials"]:
        first = r["trials"][0]
        top = f"{first['status'].lower()} {first['moved_mm']:.0f} mm {first['turned_deg']:.0f} deg"
    held = f"{sum(t['held'] for t in r['trials'])}/{len(r['trials'])}"
    return (
        f"{r['object']:12}{r['hand']:9}{r['seconds']:6.1f}{r['grasps']:8}{r.get('tip_mm', '-')!s:>8}"
        f"{r.get('clearance_mm', '-')!s:>9}  {top:20}{held:>7}"
    )


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
    print(HEADER)
    entries = json.loads((objects / "manifest.json").read_text())["objects"]
    rows = []
    for name in sorted(entries):
        if only and name not in only:
            continue
        scene = read_scene(objects / name, entries[name], view, camera)
        for hand in hands:
            rows.append(bench_one(scene, hand, starts, seed, close, ContactSpec(table=0.0)))
            print(table_line(rows[-1]), flush=True)
    print_counts(rows)
    threads = torch.get_num_threads()
    text = json.dumps({"bench": "grasp", "view": view, "seed": seed, "threads": threads, "rows": rows}, indent=1)
    write_file(out, text)
