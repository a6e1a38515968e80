"""A run as a recording of the viewer Rerun (.rrd): the plan over its postures, and the closing over
time.
"""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from torchgrasp.app.report.canvas import FINGERS, OBJECT, color_std, rgb
from torchgrasp.app.report.closing_moments import mass_centre, moments_of
from torchgrasp.app.report.raster import FULL
from torchgrasp.app.report.run_data import Run
from torchgrasp.app.report.solids import link_poses, solids_by_link
from torchgrasp.app.report.stills import mesh_arrays
from torchgrasp.app.report.viewer import POSTURES, pose_postures
from torchgrasp.files import write_file
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.lazy import import_extra, spatial
from torchgrasp.geometry.frames import apply, inverse, rotate, to_array
from torchgrasp.geometry.mesh import with_true_normals

ROOT = "world/obj"  # entity of the frame of the cloud, in which all poses of grasps are
CLOUD_COLOR = "#c2452d"  # seen before the light colours of surface and object
NORMAL_LENGTH = 0.035  # of the arrows of contact normals [m]
FORCE_LENGTH = 0.01  # of the arrow of a force [m/N]
COLUMN_SHARES = (3, 2)  # widths of the 3D view and of the curves beside it
Index = tuple[str, str, np.ndarray]
"""A timeline: its name, "sequence" or "duration", and its values."""


@checked
def write_recording(path: Path | str, run: Run) -> Path:
    """Write a run as a recording for the viewer Rerun, atomically; return the path.

    `rerun FILE.rrd` opens it. Lengths are in metres. The entity `world/obj` is the frame of the
    cloud. It holds these entities:

    * `cloud`, and `surface` coloured by its standard deviation.
    * `contacts` of the best grasp, as arrows along the outward normals.
    * `plan/hand`: the best grasp on the timeline `posture`: approach, pre-grasp, grasp and squeeze.
      Squeeze is the targets of the finger drives, with which the fingers press.
    * `closing/hand` and `closing/object`: the simulated closing, on the timeline `time` [s].
    * `closing/forces`: the forces on the object as arrows, 1 cm for each newton.

    Three entities are outside it. `force/FINGER` is the curve of a fingertip's force [N]. The texts
    `postures` and `moments` name the postures, and the key moments of the closing.

    An executable grasp is one that passed all checks. A run without one has no `contacts`, `plan`
    and `postures`. A run without a closing or a mesh has no `closing`, `force` and `moments`.

    Args:
        path: the file to write, FILE.rrd.
        run: the inputs and results that are recorded.

    Raises:
        MissingExtra: Rerun (extra `rerun`) is not installed.
        BadArgument: the run has a closing, and its executable grasps do not touch its mesh.
        BadArgument: the table of the run is above most points of its cloud.
        OutputError: the file cannot be written.

    >>> write_recording("run.rrd", run)  # doctest: +SKIP
    """
    recorder = _Recorder(run)
    recorder.log_plan()
    if run.closure is not None and run.mesh is not None:
        recorder.log_closing()
    return write_file(path, recorder.memory.drain_as_bytes())


def import_rerun() -> Any:
    """Return the module `rerun`; raise `MissingExtra` if it is not installed."""
    return import_extra("rerun", "rerun", "rerun")


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
        space = views.Spatial3DView(origin="/world")
        curves = views.TimeSeriesView(origin="/force")
        beside = views.Vertical(curves, views.TextLogView(origin="/moments"))
        page = views.Horizontal(space, beside, column_shares=list(COLUMN_SHARES))
        self.stream.send_blueprint(page)

    def log_plan(self) -> None:
        """Log frames, cloud and surface, and the contacts and postures of the best grasp."""
        rr = self.rr
        run = self.run
        frame = inverse(run.obj_from_upright)
        self._log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        at = {"translation": to_array(frame[:3, 3]), "quaternion": _quaternions(frame)}
        self._log(ROOT, rr.Transform3D(**at))
        cloud = rr.Points3D(to_array(run.cloud.points), colors=_bytes(CLOUD_COLOR))
        self._log(f"{ROOT}/cloud", cloud)
        shades, _ = color_std(run.surface)
        surface = self._mesh(*mesh_arrays(run.surface), vertex_colors=np.uint8(FULL * shades))
        self._log(f"{ROOT}/surface", surface)
        if not len(run.executable):
            return
        best = run.executable[:1]
        tips = run.hand.tips
        contacts = rr.Arrows3D(
            origins=to_array(best.contacts.points[0]),
            vectors=NORMAL_LENGTH * to_array(best.contacts.normals[0]),
            colors=[_bytes(color) for color in FINGERS[: len(tips)]],
            labels=list(tips.names),
        )
        self._log(f"{ROOT}/contacts", contacts)
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
        assert closure is not None
        assert run.mesh is not None
        mesh = with_true_normals(run.mesh)
        assert upright.closure is not None
        assert upright.mesh is not None
        seconds = to_array(closure.time)
        names = run.hand.tips.names
        time = "time", "duration", seconds
        links = link_poses(run.hand, closure.joints, closure.joint_names, closure.hand_pose)
        self._log_hand(f"{place}/hand", time, links)
        solid = (np.asarray(x) for x in (mesh.vertices, mesh.faces, mesh.vertex_normals))
        body = self._mesh(*solid, albedo_factor=_bytes(OBJECT))
        self._log_body(f"{place}/object", time, closure.object_pose, body)
        hand_pose = closure.hand_pose.double()
        trace = closure.trace
        points = apply(hand_pose, trace.points.double())
        forces = rotate(hand_pose, trace.forces.double())
        # only fingers that touch have an arrow: the counts say how many at each tick
        felt = (points.isfinite() & forces.isfinite()).all(-1)
        palette = np.array([_bytes(color) for color in FINGERS])
        arrows = rr.Arrows3D.columns(
            origins=to_array(points[felt]),
            vectors=FORCE_LENGTH * to_array(forces[felt]),
            colors=palette[felt.nonzero()[:, 1]],
        )
        self._send(f"{place}/forces", time, arrows.partition(felt.sum(1).tolist()))
        for finger, name in enumerate(names):
            curve = rr.Scalars.columns(scalars=to_array(closure.forces[:, finger]))
            self._send(f"force/{name}", time, curve)
        moments = moments_of(upright.closure, mass_centre(upright.mesh), names)
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
            color = _bytes(solid.color)
            mesh = self._mesh(solid.vertices, solid.faces, solid.normals, albedo_factor=color)
            self._log_body(f"{place}/{name}", index, poses[:, solid.link], mesh)

    def _log_body(self, place: str, index: Index, poses: Float[Tensor, "n 4 4"], mesh: Any) -> None:
        """Log a mesh that moves along a timeline, and is on no other one."""
        name, kind, values = index
        known = poses.isfinite().all(-1).all(-1)  # a simulation may have diverged
        self.stream.set_time(name, **{kind: values[0]})
        self.stream.log(place, mesh)
        self.stream.reset_time()
        moves = self.rr.Transform3D.columns(
            translation=to_array(poses[known, :3, 3]), quaternion=_quaternions(poses[known])
        )
        self._send(place, (name, kind, values[known.numpy()]), moves)


def _quaternions(poses: Float[Tensor, "*n 4 4"]) -> np.ndarray:
    """Return the rotations of poses as quaternions xyzw."""
    return spatial.transform.Rotation.from_matrix(to_array(poses[..., :3, :3])).as_quat()


def _bytes(color: str) -> list[int]:
    """Return red, green and blue of a colour, from 0 to 255."""
    return [round(FULL * part) for part in rgb(color)]
