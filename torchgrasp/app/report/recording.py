"""A run as a recording of the viewer Rerun (.rrd): the plan over its postures, and the closing over
time.
"""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.app.report.canvas import FINGERS, OBJECT, color_std, rgb
from torchgrasp.app.report.run_data import Run, moments_of
from torchgrasp.app.report.solids import link_poses, solids_by_link
from torchgrasp.app.report.stills import to_array
from torchgrasp.app.report.viewer import POSTURES, pose_postures
from torchgrasp.files import write_file
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import MissingExtra
from torchgrasp.foundation.lazy import spatial
from torchgrasp.geometry.frames import apply, inverse, rotate
from torchgrasp.geometry.plane import upright_frame

ROOT = "world/obj"  # entity of the frame of the cloud, in which all poses of grasps are
Index = tuple[str, str, np.ndarray]
"""A timeline: its name, "sequence" or "duration", and its values."""


@checked
def write_recording(path: Path | str, run: Run) -> Path:
    """Write a run as a recording of the viewer Rerun, atomically; `rerun FILE.rrd` opens it. Needs
    the extra `rerun`.

    Below the entity `world/obj`, the frame of the cloud [m], are `cloud`, `surface` in the colours
    of its standard deviation, and `contacts` with outward normals. On the timeline `posture`,
    `plan/hand` goes through approach, pre-grasp, grasp and squeeze of the best grasp. On the
    timeline `time` [s], `closing/hand` and `closing/object` move as in the simulation,
    `closing/forces` are the forces on the object, 1 cm for each newton, and `force/FINGER` [N] are
    curves. Returns the path. Raises `MissingExtra` without Rerun, `OutputError` if the file cannot
    be written.

    >>> write_recording("run.rrd", run)  # doctest: +SKIP
    """
    recorder = _Recorder(run)
    recorder.log_plan()
    if run.closure is not None and run.mesh is not None:
        recorder.log_closing()
    return write_file(path, recorder.memory.drain_as_bytes())


def import_rerun() -> Any:
    """Return the module `rerun`; raise `MissingExtra` if it is not installed."""
    try:
        return importlib.import_module("rerun")
    except ImportError as error:
        raise MissingExtra("rerun", "rerun") from error


class _Recorder:
    """A recording in memory, to which the parts of a run are logged."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self.rr = import_rerun()
        self.stream = self.rr.RecordingStream("torchgrasp", send_properties=False)
        self.memory = self.stream.memory_recording()
        self.stream.set_log_time_enabled(False)
        self.stream.set_log_tick_enabled(False)
        self.stream.send_recording_name(f"{run.object_name}, {run.hand.name}")
        views = importlib.import_module("rerun.blueprint")
        beside = views.Vertical(
            views.TimeSeriesView(origin="/force"), views.TextLogView(origin="/moments")
        )
        self.stream.send_blueprint(
            views.Horizontal(views.Spatial3DView(origin="/world"), beside, column_shares=[3, 2])
        )

    def log_plan(self) -> None:
        """Log frames, cloud and surface, and the contacts and postures of the best grasp."""
        rr = self.rr
        run = self.run
        frame = inverse(upright_frame(run.cloud.points, run.cloud.viewpoint, run.spec.plane))
        self._log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._log(
            ROOT, rr.Transform3D(translation=to_array(frame[:3, 3]), quaternion=_quaternions(frame))
        )
        self._log(
            f"{ROOT}/cloud", rr.Points3D(to_array(run.cloud.points), colors=_bytes("#c2452d"))
        )
        shades = np.uint8(255 * color_std(to_array(run.surface.std_m))[0])
        solid = (
            to_array(run.surface.vertices),
            run.surface.faces.cpu().numpy(),
            to_array(run.surface.normals),
        )
        self._log(f"{ROOT}/surface", self._mesh(*solid, vertex_colors=shades))
        if not len(run.executable):
            return
        best = run.executable[:1]
        tips = run.hand.tips
        options = {
            "colors": [_bytes(color) for color in FINGERS[: len(tips)]],
            "labels": list(tips.names),
        }
        points = to_array(best.contacts.points[0])
        normals = to_array(best.contacts.normals[0])
        self._log(
            f"{ROOT}/contacts", rr.Arrows3D(origins=points, vectors=0.035 * normals, **options)
        )
        steps = "posture", "sequence", np.arange(len(POSTURES))
        self._log_hand(f"{ROOT}/plan/hand", steps, pose_postures(run.hand, best)[0])
        self._send("postures", steps, rr.TextLog.columns(text=list(POSTURES)))

    def log_closing(self) -> None:
        """Log the motion of the hand and of the true object, the forces, and the key moments."""
        rr = self.rr
        run = self.run
        place = f"{ROOT}/closing"
        upright = self.run.upright()
        closure = run.closure
        mesh = run.mesh
        assert (
            closure is not None
            and mesh is not None
            and upright.closure is not None
            and upright.mesh is not None
        )
        seconds = to_array(closure.time)
        names = run.hand.tips.names
        time = "time", "duration", seconds
        links = link_poses(run.hand, closure.joints, closure.joint_names, closure.hand_pose)
        self._log_hand(f"{place}/hand", time, links)
        solid = (np.asarray(x) for x in (mesh.vertices, mesh.faces, mesh.vertex_normals))
        self._log_body(
            f"{place}/object",
            time,
            closure.object_pose,
            self._mesh(*solid, albedo_factor=_bytes(OBJECT)),
        )
        hand_pose = closure.hand_pose.double()
        trace = closure.trace
        points = apply(hand_pose, trace.points.double())
        forces = rotate(hand_pose, trace.forces.double())
        felt = (points.isfinite() & forces.isfinite()).all(-1)
        colors = np.array([_bytes(color) for color in FINGERS])[felt.nonzero()[:, 1]]
        arrows = {
            "origins": to_array(points[felt]),
            "vectors": 0.01 * to_array(forces[felt]),
            "colors": colors,
        }
        self._send(
            f"{place}/forces", time, rr.Arrows3D.columns(**arrows).partition(felt.sum(1).tolist())
        )
        for finger, name in enumerate(names):
            self._send(
                f"force/{name}",
                time,
                rr.Scalars.columns(scalars=to_array(closure.forces[:, finger])),
            )
        moments = moments_of(
            upright.closure, torch.tensor(np.array(upright.mesh.center_mass)), names
        )
        at = "time", "duration", seconds[[moment.tick for moment in moments]]
        self._send("moments", at, rr.TextLog.columns(text=[moment.name for moment in moments]))

    def _log(self, place: str, thing: Any) -> None:
        """Log what does not change."""
        self.stream.log(place, thing, static=True)

    def _send(self, place: str, index: Index, columns: Any) -> None:
        """Log what changes along a timeline."""
        name, kind, values = index
        self.stream.send_columns(place, [self.rr.TimeColumn(name, **{kind: values})], columns)

    def _mesh(
        self, vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, **color: Any
    ) -> Any:
        """Return a mesh for a recording."""
        solid = {"vertex_positions": vertices, "triangle_indices": faces, "vertex_normals": normals}
        return self.rr.Mesh3D(**solid, **color)

    def _log_hand(self, place: str, index: Index, poses: Float[Tensor, "n l 4 4"]) -> None:
        """Log the links of the hand, which move along a timeline."""
        for name, solid in solids_by_link(self.run.hand).items():
            mesh = self._mesh(
                solid.vertices, solid.faces, solid.normals, albedo_factor=_bytes(solid.color)
            )
            self._log_body(f"{place}/{name}", index, poses[:, solid.link], mesh)

    def _log_body(self, place: str, index: Index, poses: Float[Tensor, "n 4 4"], mesh: Any) -> None:
        """Log a mesh that moves along a timeline, and is on no other one."""
        name, kind, values = index
        known = poses.isfinite().all(-1).all(-1)  # a simulation may have diverged
        self.stream.set_time(name, **{kind: values[0]})
        self.stream.log(place, mesh)
        self.stream.reset_time()
        places = {
            "translation": to_array(poses[known, :3, 3]),
            "quaternion": _quaternions(poses[known]),
        }
        self._send(
            place, (name, kind, values[known.numpy()]), self.rr.Transform3D.columns(**places)
        )


def _quaternions(poses: Float[Tensor, "*n 4 4"]) -> np.ndarray:
    """Return the rotations of poses as quaternions xyzw."""
    return spatial.transform.Rotation.from_matrix(to_array(poses[..., :3, :3])).as_quat()


def _bytes(color: str) -> list[int]:
    """Return red, green and blue of a colour, from 0 to 255."""
    return [round(255 * part) for part in rgb(color)]
