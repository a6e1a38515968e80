"""Clouds of real depth cameras: grasps are planned on them, and lifted where the true mesh is known.

The "real_scans" of a manifest have a "file", the camera's place "camera_origin_in_scan_frame" if it is known, and
"mesh", the name of the true object, with its pose "T_object_scan". A scan without a pose has no known table either.
"""

import json
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks.common import Row
from benchmarks.perturb import PERTURBATIONS, household_mass, perturb_trial
from torchgrasp.cloud import read_cloud
from torchgrasp.data import read_mass, read_object_mesh
from torchgrasp.errors import GraspError, Status
from torchgrasp.evaluation import PROTOCOLS, close_hand, seed_of
from torchgrasp.geometry.plane import move
from torchgrasp.hand.load import load_hand
from torchgrasp.planner import plan_grasps
from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Grasps, PointCloud


def bench_scans(folders: tuple[Path, ...], hands: tuple[str, ...], grasps: int, starts: int, seed: int) -> list[Row]:
    """Plan on every real scan of the folders' manifests, and lift the best grasps with the true mass."""
    rows: list[Row] = []
    for folder in folders:
        scans = json.loads((folder / "manifest.json").read_text("utf-8")).get("real_scans", {})
        for name, scan in scans.items():
            rows += [_try_scan(folder, name, scan, hand, grasps, starts, seed) for hand in hands]
    return rows


def _try_scan(folder: Path, name: str, scan: dict[str, Any], hand: str, most: int, starts: int, seed: int) -> Row:
    """Return what became of one scan with one hand."""
    began = time.process_time()
    posed = "T_object_scan" in scan
    spec = ContactSpec(table=0.0 if posed else None)
    try:
        grasps = plan_grasps(_read_scan(folder, scan), load_hand(hand), spec, starts, seed)
    except GraspError as error:
        return Row(f"{name}, {hand}", "-", f"refused: {error}", None, {})
    grasps = grasps[grasps.status == Status.OK]
    seconds = time.process_time() - began
    words = f"{len(grasps)} executable in {seconds:.1f} CPU s"
    numbers: dict[str, Any] = {"executable": len(grasps), "seconds": seconds}
    if posed and len(grasps):
        numbers["lifts"] = _lift(folder, scan["mesh"], hand, grasps[:most], seed)
        held = sum(lift["status"] == Status.OK.name for lift in numbers["lifts"])
        told = ", ".join(f"{x['status'].lower()} {1e3 * x['slip']:.1f} mm" for x in numbers["lifts"])
        words += f"; held {held} of {len(numbers['lifts'])}: {told}"
    return Row(f"{name}, {hand}", "-", words, None, numbers)


def _read_scan(folder: Path, scan: dict[str, Any]) -> PointCloud:
    """Return the cloud of a scan, where its pose is known in the frame of its object."""
    cloud, camera = read_cloud(folder / scan["file"]), scan.get("camera_origin_in_scan_frame")
    seen = None if camera is None else torch.tensor(camera, dtype=torch.float64)
    cloud = PointCloud(cloud.points.double(), None, seen)
    if "T_object_scan" in scan:
        cloud = move(cloud, torch.tensor(scan["T_object_scan"], dtype=torch.float64))
    return cloud


def _lift(folder: Path, name: str, hand: str, grasps: Grasps, seed: int) -> list[dict[str, Any]]:
    """Lift the true object with its true mass."""
    mesh = read_object_mesh(folder, name)
    parts, lifts = convex_parts(mesh), []
    mass = household_mass(float(mesh.volume), read_mass(folder, name))
    for rank in range(len(grasps)):
        drawn = seed_of(seed, name, "scan", rank, 0)
        trial = perturb_trial(PROTOCOLS["household"].trial, PERTURBATIONS["mass"], mass, drawn)
        done = close_hand(grasps[rank], load_hand(hand), mesh, trial, drawn, parts=parts)
        lifts.append({"rank": rank, "status": done.status.name, "slip": done.slip.distance})
    return lifts
