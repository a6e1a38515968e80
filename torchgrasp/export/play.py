"""Folders that play grasps in a simulator: models of hand, object and table, the motion as data, and a short script."""

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.checks import Positive, checked
from torchgrasp.control.holding import PUSH
from torchgrasp.control.paper.closings import POSE_TIME
from torchgrasp.errors import BadArgument
from torchgrasp.export.postures import named_postures, quaternion
from torchgrasp.files import format_json, write_file
from torchgrasp.geometry.frames import inverse
from torchgrasp.geometry.plane import upright_frame
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.motion import opened_pose
from torchgrasp.lazy import trimesh
from torchgrasp.sim.convex_parts import hull, read_solid
from torchgrasp.sim.mujoco_scene import scene_mjcf
from torchgrasp.sim.sapien_bodies import split_hull
from torchgrasp.sim.scene_spec import ARMATURE, MOUNT_DRIVE, SceneSpec, Slide, mounted_urdf, pair_masks
from torchgrasp.specs import TrialSpec
from torchgrasp.values import Grasps

Player = Literal["mujoco", "maniskill", "newton"]
"""The simulators for which `save_play` writes a folder."""


@checked
def save_play(
    hand: Hand,
    grasps: Grasps,
    folder: Path | str,
    player: Player,
    mesh: "trimesh.Trimesh | Path | str",
    spec: TrialSpec | None = None,
    *,
    parts: "Sequence[trimesh.Trimesh] | None" = None,
) -> Path:
    """Write a folder in which `python play.py 0` plays the first grasp, with the simulator and NumPy alone.

    The hand comes along its approach, closes in open loop, presses, lifts and holds. The script prints one line of
    JSON: how far the object rose [m], and whether that is half of the lift. `play.json` has the motion, drives,
    contacts and the object; its text "frames" explains the numbers.

    Args:
        hand: the hand.
        grasps: one or more grasps of the hand.
        folder: the folder to write.
        player: the simulator.
        mesh: closed mesh of the object [m] in the frame of the grasps: the true one, or the estimated surface.
        spec: mass, friction, force, stiffness, heights, times and timestep; `TrialSpec()` by default.
        parts: convex parts of the mesh; by default they are computed (`convex_parts`).

    Raises `BadArgument` for no grasps or joints of another hand, `MeshError` for an open mesh, and `OutputError`.

    >>> import tempfile
    >>> from torchgrasp import load_hand, load_object
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> jug, grasp = load_object("jug"), load_shipped_grasp("jug", "barrett")
    >>> folder = save_play(load_hand("barrett"), grasp, tempfile.mkdtemp(), "mujoco", jug.mesh, parts=jug.parts)
    >>> sorted(path.name for path in folder.iterdir())
    ['object.ply', 'play.json', 'play.py', 'scene.xml']
    """
    if not len(grasps):
        raise BadArgument("grasps", "none", "at least one grasp")
    hand, grasps, spec, folder = hand.to("cpu"), grasps.to("cpu", torch.float64), spec or TrialSpec(), Path(folder)
    solid, pieces = read_solid(mesh, parts)
    world_from_obj = _world_from_obj(grasps, solid)
    if not torch.equal(world_from_obj, torch.eye(4, dtype=torch.float64)):
        solid, *pieces = (body.copy().apply_transform(world_from_obj.numpy()) for body in (solid, *pieces))
    scene = _scene(hand, spec, solid, pieces)
    write_file(folder / "object.ply", _mesh_file(solid, "ply"))
    write_file(folder / "play.json", format_json(describe_play(hand, grasps, world_from_obj, scene, spec)))
    if player in ("mujoco", "newton"):
        write_file(folder / "scene.xml", _on_base(scene_mjcf(scene)))
    elif player == "maniskill":
        write_file(folder / "hand.urdf", mounted_urdf(scene))
        for k, corners in enumerate(some for hull in scene.hulls[0] for some in split_hull(hull)):
            write_file(folder / f"part_{k}.obj", _mesh_file(hull(100.0 * corners), "obj"))
    for path in (Path(__file__).parent / "templates").glob(f"{player}*.py.txt"):
        name = path.name.removeprefix(f"{player}").removesuffix(".py.txt").removeprefix("_") or "play"
        write_file(folder / f"{name}.py", path.read_text("utf-8"))
    return folder


def _world_from_obj(grasps: Grasps, mesh: "trimesh.Trimesh") -> Float[Tensor, "4 4"]:
    """Return the frame of the grasps, or one upright on the planned table where the table is tilted."""
    table = grasps.table
    if table is None or float(table.normal[2]) > 1 - 1e-12:
        return torch.eye(4, dtype=torch.float64)
    return inverse(upright_frame(torch.from_numpy(np.array(mesh.vertices)), None, table))


def _scene(hand: Hand, spec: TrialSpec, mesh: "trimesh.Trimesh", parts: "Sequence[trimesh.Trimesh]") -> SceneSpec:
    """Return the scene with all joints at zero, and the hand's mount along the axes of its root link."""
    reach = spec.approach + spec.lift_height + 0.1  # [m]
    axes = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
    slides = [Slide(f"mount_{x}", axis, -reach, reach, 0.0) for x, axis in axes.items()]
    drives = {name: x if spec.kp is None else x._replace(kp=spec.kp) for name, x in hand.actuators.items()}
    mass = spec.mass if spec.density is None else spec.density * float(mesh.volume)
    return SceneSpec(
        hand.urdf_path, np.eye(4), dict.fromkeys(drives, 0.0), drives, tuple(hand.tips.links), mesh, list(parts), mass,
        spec.friction, spec.gravity, spec.timestep, patch=spec.patch, self_pairs=hand.self_pairs,
        table_friction=spec.table_friction, mount=tuple(slides),
    )  # fmt: skip


@checked
def pressing_force(spec: TrialSpec, mass: Positive) -> float:
    """Return the normal force [N] of the strongest finger in play, by default what an object of a `mass` [kg] needs.

    Two opposite fingers then hold the weight and a push of `PUSH` with half of the friction, as planned.

    >>> round(pressing_force(TrialSpec(friction=0.8), 0.25), 1), pressing_force(TrialSpec(force=3.0), 0.25)
    (6.2, 3.0)
    """
    least, most = 0.1, 100.0  # friction; force [N], far beyond what hands exert
    needed = min((mass * spec.gravity + PUSH) / max(spec.friction, least), spec.max_force or most, most)
    return needed if spec.force is None else spec.force


def describe_play(
    hand: Hand, grasps: Grasps, world_from_obj: Float[Tensor, "4 4"], scene: SceneSpec, spec: TrialSpec
) -> dict[str, Any]:
    """Return the content of play.json."""
    moments, axes = np.linalg.eigh(scene.body.inertia)
    frame = torch.eye(4, dtype=torch.float64)
    frame[:3, :3] = torch.from_numpy(axes * [1.0, 1.0, np.sign(np.linalg.det(axes))])
    mount = {slide.name: MOUNT_DRIVE for slide in scene.slides}
    masks = pair_masks(scene.self_pairs, first=1)
    _, postures = named_postures(hand, grasps, pressing_force(spec, scene.mass), spec.kp)
    poses = world_from_obj @ grasps.obj_from_hand
    rise = (world_from_obj @ opened_pose(hand, grasps.pregrasp, grasps.obj_from_hand, grasps.table) - poses)[:, :3, 3]
    far = -spec.approach * (grasps.approach @ world_from_obj[:3, :3].T)
    up = torch.tensor([0.0, 0.0, spec.lift_height], dtype=torch.float64).expand_as(rise)
    motion = {  # by the name of the phase that ends: displacement of the hand in the world, posture, duration [s]
        "approach": (rise + far, "pregrasp", 0.0),
        "pregrasp": (rise, "pregrasp", spec.approach / 0.2),  # the mean speed [m/s] of our trials
        "grasp": (0 * rise, "grasp", POSE_TIME),
        "squeeze": (0 * rise, "squeeze", POSE_TIME),
        "lift": (up, "squeeze", 1.0),
        "hold": (up, "squeeze", spec.hold_time),
    }
    return {
        "format": "torchgrasp play",
        "version": 1,
        "units": "m, rad, kg, s, N, N m; quaternions are (w, x, y, z)",
        "frames": "z is up. Joints mount_x, mount_y, mount_z move the hand's root link along its own axes, from its "
        "pose in the grasp. Each phase ends at its time with its targets; between them targets move smoothly.",
        "hand": hand.name,
        "timestep": spec.timestep,
        "gravity": spec.gravity,
        "friction": {"hand": scene.friction, "table": scene.body_friction},
        "table_height": scene.table_height,
        "lift_height": spec.lift_height,
        "object": {
            "mass": scene.mass,
            "centre": scene.mesh.center_mass.tolist(),
            "moments": moments.tolist(),
            "axes": quaternion(frame),
        },
        "armature": ARMATURE,
        "drives": {name: x._asdict() for name, x in (mount | scene.drives).items()},
        "collision": {name: list(masks.get(name, (0, 0))) for name in (link.name for link in scene.urdf.links)},
        "times": dict(zip(motion, np.cumsum([x[2] for x in motion.values()]).tolist(), strict=True)),
        "grasps": [
            {
                "position": pose[:3, 3].tolist(),
                "quaternion": quaternion(pose),
                "success": float(grasps.success[row]),
                "targets": {
                    phase: dict(zip(mount, (moved[row] @ pose[:3, :3]).tolist(), strict=True))
                    | {joint: float(q[row]) for joint, q in postures[posture].items()}
                    for phase, (moved, posture, _) in motion.items()
                },
            }
            for row, pose in enumerate(poses)
        ],
    }


def _mesh_file(mesh: "trimesh.Trimesh", kind: str) -> bytes:
    """Return the content of a mesh's file of a kind, as "ply"."""
    content = mesh.export(file_type=kind)
    return content if isinstance(content, bytes) else str(content).encode()


def _on_base(mjcf: str) -> str:
    """Return a model in MJCF whose hand is on a body "base" that a script can place."""
    root = ET.fromstring(mjcf)
    world = root.find("worldbody")
    assert world is not None
    mount = world.find("body[@name='mount_x']")
    assert mount is not None
    world.remove(mount)
    ET.SubElement(world, "body", name="base").append(mount)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"
