"""What the turning page shows, as numbers and texts."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.app.report.canvas import Direction, map_colors
from torchgrasp.app.report.page import GRASP_COLUMNS, grasp_rows
from torchgrasp.app.report.palette import FINGERS, OBJECT, RAMPS, TABLE, rgb
from torchgrasp.app.report.pictures import facing, to_array, view_of
from torchgrasp.app.report.run import Run, verdict
from torchgrasp.app.report.solids import link_poses, solids_of_links
from torchgrasp.app.report.turning.buffers import pack, thin_mesh, thin_rows
from torchgrasp.closure import ClosureResult
from torchgrasp.control.forces import squeeze
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.motion import APPROACH_DISTANCE
from torchgrasp.values import Grasps

MOST_GRASPS, MOST_POINTS, MOST_FACES, MOST_TICKS = 20, 10_000, 40_000, 120
"""Most grasps, points of a cloud, faces of a mesh and ticks of a replay: a page of at most 5 MiB in all."""

POSTURES = ("approach", "pre-grasp", "grasp", "squeeze")
"""Postures of the hand in the order of its motion; the last is where its drives pull to."""

COLUMNS = (0, 1, 5, 3, 6)
"""Rank, success, margin, clearance and deviation, of the columns of the report."""


def describe(run: Run) -> dict[str, Any]:
    """Return all that the page of a run shows, in an upright frame: JSON with buffers."""
    sentence, run = verdict(run), run.upright()
    best = run.executable[:MOST_GRASPS]
    good = run.closure.held if run.closure is not None else len(best) > 0
    replay = None if run.closure is None or run.mesh is None else _replay(run, run.closure)
    return {
        "title": f"Grasps of the {run.object_name} with the {run.hand.name} hand",
        "source": str(run.source),
        "verdict": sentence,
        "good": bool(good),
        "eye": _eye(facing(best[0]) if len(best) else view_of(run.cloud)),
        "table": None if run.spec.table is None else TABLE,
        "object": OBJECT,
        "fingers": [list(pair) for pair in zip(run.hand.tips.names, FINGERS, strict=False)],
        "cloud": _points(run.cloud.points),
        "others": _others(run),
        "surface": _surface(run),
        "hand": _pieces(run.hand),
        "postures": POSTURES,
        "grasps": _grasps(run.hand, best),
        "replay": replay,
    }


def _eye(direction: Direction) -> list[float]:
    """Return the unit direction to the first camera, which looks from above."""
    x, y, z = direction
    eye = np.array([x, y, max(z, 0.35 * float(np.hypot(x, y)))])
    return (eye / np.linalg.norm(eye)).tolist()


def _points(points: Float[Tensor, "n 3"]) -> dict[str, object]:
    """Return some of the points of a cloud."""
    return pack(to_array(points)[thin_rows(len(points), MOST_POINTS)])


def _others(run: Run) -> dict[str, object] | None:
    """Return points of the other things of a scene."""
    if run.scene is None:
        return None
    return _points(run.scene.points[(run.scene.labels > 0) & ~run.scene.rows_of()])


def _surface(run: Run) -> dict[str, object]:
    """Return the estimated surface, its deviation and its colours."""
    surface, std_m = run.surface, to_array(run.surface.std_m)
    kept, faces = thin_mesh(to_array(surface.vertices), surface.faces.cpu().numpy(), MOST_FACES)
    most = max(float(np.quantile(std_m, 0.99)), 1e-6) if len(std_m) else 1e-6
    return {
        "points": pack(to_array(surface.vertices)[kept]),
        "normals": pack(to_array(surface.normals)[kept]),
        "faces": pack(faces, "u4"),
        "std": pack(std_m[kept]),
        "colors": pack(np.round(255 * map_colors(std_m[kept] / most, "viridis")), "u1"),
        "most_mm": 1e3 * most,
        "ramp": [[round(255 * part) for part in rgb(f"#{color}")] for color in RAMPS["viridis"].split()],
    }


def _pieces(hand: Hand) -> list[dict[str, object]]:
    """Return the solids of the hand in the frames of their links."""
    return [
        {
            "link": solid.link,
            "color": solid.color,
            "points": pack(solid.vertices),
            "normals": pack(solid.normals),
            "faces": pack(solid.faces, "u4"),
        }
        for solid in solids_of_links(hand)
    ]


def _grasps(hand: Hand, grasps: Grasps) -> dict[str, object]:
    """Return the rows of the list, contacts, and the poses of all links in each posture."""
    rows = [[row[k] for k in COLUMNS] for row in grasp_rows(grasps, MOST_GRASPS)]
    poses = [link_poses(hand, hand.expand_joints(q), hand.tree.joint_names, p) for q, p in _postures(hand, grasps)]
    return {
        "heads": [GRASP_COLUMNS[k] for k in COLUMNS],
        "rows": rows,
        "points": pack(to_array(grasps.contacts.points)),
        "normals": pack(to_array(grasps.contacts.normals)),
        "links": pack(to_array(torch.stack(poses, 1))),
    }


def _postures(hand: Hand, grasps: Grasps) -> list[tuple[Float[Tensor, "g h"], Float[Tensor, "g 4 4"]]]:
    """Return joints and poses of the hand in each of the `POSTURES`."""
    pose, opened = grasps.obj_from_hand.double(), grasps.pregrasp.double()
    away = pose.clone()
    away[:, :3, 3] -= APPROACH_DISTANCE * grasps.approach.double()
    squeezed = squeeze(hand, grasps).joints if len(grasps) else opened
    return [(opened, away), (opened, pose), (grasps.joints.double(), pose), (squeezed, pose)]


def _replay(run: Run, closure: ClosureResult) -> dict[str, object]:
    """Return the true object, its poses and those of all links at some ticks, and the forces at all."""
    assert run.mesh is not None
    ticks = thin_rows(len(closure.time), MOST_TICKS)
    kept, faces = thin_mesh(np.asarray(run.mesh.vertices), np.asarray(run.mesh.faces), MOST_FACES)
    links = link_poses(run.hand, closure.joints[ticks], closure.joint_names, closure.hand_pose[ticks])
    return {
        "points": pack(np.asarray(run.mesh.vertices)[kept]),
        "faces": pack(faces, "u4"),
        "ticks": pack(ticks, "u4"),
        "object": pack(to_array(closure.object_pose[ticks])),
        "links": pack(to_array(links)),
        "time": pack(to_array(closure.time)),
        "forces": pack(to_array(closure.forces)),
    }
