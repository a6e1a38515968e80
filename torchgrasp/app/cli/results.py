"""What `torchgrasp grasp` and the tools for agents make of a plan: a run, its files, and its words."""

import dataclasses
import json
from pathlib import Path
from typing import Any

from torchgrasp.app.cli.command import naming
from torchgrasp.app.report.run_data import RECORDING, VIEW, Run, verdict
from torchgrasp.data.shards import load_grasps
from torchgrasp.data.shipped import DATA, list_objects, load_object
from torchgrasp.export import save_surface
from torchgrasp.export.play import stand
from torchgrasp.files import remove_file, sha256
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.geometry.mesh import read_mesh
from torchgrasp.geometry.plane import Plane
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import hand_of
from torchgrasp.planner.drag_text import KEY
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.second_view import NextView, next_view
from torchgrasp.shape.surface import extract_surface
from torchgrasp.success.reasons import explain_success
from torchgrasp.success.task import GraspTask
from torchgrasp.values.planning import Grasps, PointCloud
from torchgrasp.values.specs import ContactSpec

GRASPS = "grasps.safetensors"
SURFACE = "surface.ply"
REPORT = "report.html"
"""Names of the files that are written beside each other into a folder."""
PLANNED_HELP = "grasps.safetensors of `torchgrasp grasp`, or its folder, or a file of `evaluate`"
ENOUGH = 0.9  # predicted success of an object that is easy enough: the others are not tried
HELPS = 0.8  # share of the deviation that may remain after a second view that is worth telling


def load_planned(path: Path) -> tuple[Grasps, Path]:
    """Return grasps of `torchgrasp grasp`, and the path of the surface that it wrote beside them.

    `path` is that of their file or its folder. Errors name it GRASPS.
    """
    file = path / GRASPS if path.is_dir() else path
    with naming(path="GRASPS"):
        return load_grasps(file), file.with_name(SURFACE)


def make_run(
    name: str,
    path: Path,
    cloud: PointCloud,
    hand: Hand,
    spec: ContactSpec,
    grasps: Grasps,
    shape: ShapeGP,
    task: GraspTask,
    **more: Any,
) -> Run:
    """Return the `Run` of a plan, the record of its inputs and results for reports.

    The record also says what lowers the predicted success of the best executable grasp most. And it
    says from where a second view would help. `name` and `path` are the object's name and the file
    of the cloud. `spec` holds the constraints on contacts, and `grasps` the results of planning.
    `shape` is the estimated shape of the object. `task` is the task for which success is predicted.
    `more` are other fields of `Run` by name.
    """
    hand = hand_of(grasps, hand)
    costs = [
        cost.sentence
        for best in grasps.executable[:1]
        for cost in explain_success(best, hand, shape, task)
    ]
    surface = extract_surface(shape)
    look = find_look(shape, grasps, spec)
    return Run(
        name, path, cloud, hand, spec, surface, grasps, costs=tuple(costs), look=look, **more
    )


def write_run(out: Path, run: Run, pages: bool) -> list[Path]:
    """Write the grasps of a run into the folder `out`; return the paths of all files.

    The estimated surface is written, too, if a grasp passed all checks. With `pages`, an HTML
    report and a 3D page are written for a person. The other files of an earlier run are removed:
    they would show another plan beside these grasps.
    """
    for name in (SURFACE, REPORT, VIEW, RECORDING):
        remove_file(out / name)
    paths = [out / GRASPS]
    run.grasps.save(paths[0])
    if len(run.executable):
        paths.append(save_surface(stand(run.surface, run.grasps.table), out / SURFACE))
    if pages:
        from torchgrasp.app.report.page import write_report  # they take long to import
        from torchgrasp.app.report.viewer import write_viewer

        paths += [write_report(out / REPORT, run, VIEW), write_viewer(out / VIEW, run)]
    return paths


def find_look(shape: ShapeGP, grasps: Grasps, spec: ContactSpec) -> NextView | None:
    """Return the camera of a second view that would make the estimated shape more certain, or None.

    It is None if the best grasp that passed all checks has a predicted success of 0.9 (`ENOUGH`) or
    more. It is also None if every view leaves at least 0.8 (`HELPS`) of the mean standard deviation
    at the contacts.
    """
    best = grasps.executable[:1]
    if len(best) and float(best.success[0]) >= ENOUGH:
        return None
    view = next_view(shape, grasps, table=spec.plane)
    return view if view.after < HELPS * view.before else None


def describe_run(run: Run, out: Path) -> dict[str, Any]:
    """Return the result of a run as a dict for JSON, with units in the names of its entries.

    The entry "best" is the best grasp that passed all checks, or None. The entry "file" is the path
    of the file with all grasps, in the folder `out`.
    """
    best = None
    for grasp in run.executable[:1]:
        joints = run.hand.expand(grasp.joints[0])
        best = {
            "success": float(grasp.success[0]),
            "joints_rad": {name: float(q) for name, q in joints.items()},
            "obj_from_hand_m": grasp.obj_from_hand[0].tolist(),
            "fingers": list(run.hand.finger_names),
            "contacts_m": grasp.contacts.points[0].tolist(),
        }
    return {
        "object": run.object_name,
        "hand": run.hand.name,
        "grasps": len(run.grasps),
        "executable": len(run.executable),
        "held": None if run.closure is None else run.closure.held,
        "verdict": verdict(run),
        "best": best,
        "drag": json.loads(run.grasps.meta.get(KEY, "null")),
        "look_next": None if run.look is None else describe_look(run.look),
        "file": str(out / GRASPS),
    }


def describe_look(view: NextView) -> dict[str, Any]:
    """Return the camera of a second view as a dict for JSON, with units in the names of its
    entries.

    "turn_deg" is None if no earlier camera is known.
    """
    return {
        "obj_from_camera_m": view.camera_pose.tolist(),
        "turn_deg": view.turn if view.turn == view.turn else None,
        "std_before_m": view.before,
        "std_after_m": view.after,
    }


def read_true_mesh(path: Path) -> "tuple[trimesh.Trimesh, list[trimesh.Trimesh] | None]":
    """Return an object's true mesh [m], which is closed, from a file, and its convex parts.

    The parts, of which simulators make collision shapes, exist for shipped objects alone. They are
    None for any other mesh.
    """
    with naming(path="--mesh", mesh="--mesh"):
        mesh = read_mesh(path)
        digest = sha256(path)
    for name in list_objects():
        if sha256(DATA / name / "mesh.ply") == digest:
            return mesh, load_object(name).parts
    return mesh, None


def table_under(mesh: "trimesh.Trimesh", table: Plane | None) -> Plane | None:
    """Return a table moved along its normal to the lowest point of the true mesh [m]; None for
    None.

    Both are in one frame. So a table whose height was guessed from the cloud is where the object
    stands.
    """
    if table is None:
        return None
    lowest = float((mesh.vertices @ table.normal.numpy()).min())
    return dataclasses.replace(table, offset=lowest)
