"""Folders that play grasps in a simulator. Each has models of hand, object and table, the motion as
data, and a short script.
"""

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.agreement import check_contacts
from torchgrasp.control.finger_forces import check_all_executable
from torchgrasp.control.holding import PUSH
from torchgrasp.control.protocol import POSE_TIME
from torchgrasp.export.postures import named_postures, quaternion
from torchgrasp.files import render, write_file
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import spatial, trimesh
from torchgrasp.foundation.rules import Positive
from torchgrasp.geometry.frames import inverse, rotate
from torchgrasp.geometry.mesh import read_mesh
from torchgrasp.geometry.plane import Plane, upright_frame
from torchgrasp.hand.drives import stiff_drives
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.urdf import Joint, Link, pose_of
from torchgrasp.ik.motion import opened_pose
from torchgrasp.shape.surface import Surface
from torchgrasp.sim.convex_parts import hull, read_solid
from torchgrasp.sim.mujoco_scene import scene_mjcf
from torchgrasp.sim.sapien_bodies import split_hull
from torchgrasp.sim.scene_spec import (
    ARMATURE,
    MOUNT_DRIVE,
    SceneSpec,
    Slide,
    edge_of,
    mounted_urdf,
    pair_masks,
)
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.planning import Grasps
from torchgrasp.values.specs import TrialSpec

Player = Literal["mujoco", "maniskill", "newton", "isaaclab", "usd"]
"""The simulators and the scene format for which `save_play` writes a folder."""
TEMPLATES = Path(__file__).parent / "templates"
USD = {"isaaclab": ("hand.usda", "object.usda"), "usd": ("hand.usda", "object.usda", "scene.usda")}
"""Files in USD's text format, by player."""
UPRIGHT = 1e-12  # largest difference of a normal's z from 1 on a table that counts as level
ORIGIN = (0.0, 0.0, 0.0)
OWN = "torchgrasp_"
"""Prefix of the mount's links and joints: those of a hand may have any other name."""
AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclasses.dataclass(frozen=True)
class PlayNumbers:
    """Parameters of an exported motion that a simulator plays: mount, approach and lift."""

    room: float = 0.1
    """Range of motion [m] of the hand's mount, the joints that carry the hand, beyond approach and
    lift.
    """
    speed: float = 0.2
    """Speed [m/s] of the approach: the mean speed in our trials."""
    lift: float = 1.0
    """Time [s] of the lift."""
    friction: float = 0.1
    """Lower bound of the coefficient of friction in the choice of the pressing force."""
    force: float = 100.0
    """Largest normal force [N] of the strongest finger, far beyond what hands exert."""
    mass: float = 0.1
    """Mass [kg] of each link of the mount."""
    inertia: float = 1e-4
    """Moment of inertia [kg m^2] of each link of the mount, about every axis."""


PLAY = PlayNumbers()


@checked
def save_play(
    hand: Hand,
    grasps: Grasps,
    folder: Path | str,
    player: Player,
    mesh: "Surface | trimesh.Trimesh | Path | str",
    spec: TrialSpec | None = None,
    *,
    parts: "Sequence[trimesh.Trimesh] | None" = None,
) -> Path:
    """Write a folder with a script that plays the grasps in a simulator; return the folder.

    `python play.py 0` in the folder plays the first grasp. The script needs only the simulator and
    NumPy. The hand moves along its approach, closes without sensors, presses, lifts and holds. Then
    a line of JSON says how far the object rose [m]. It also says whether this is at least half of
    the lift. `play.json` has the motion, the drives, the contacts and the object; its text "frames"
    explains the numbers.

    Args:
        hand: the hand.
        grasps: one or more grasps of the hand.
        folder: the folder to write.
        player: the simulator: "mujoco", "maniskill", "newton" or "isaaclab". "usd" means a USD
            scene, whose script writes the grasp's motion as a USD file and does not play it.
        mesh: closed mesh of the object [m] in the frame of the grasps, that of the planned cloud.
            It may be the estimated `Surface`, whose points below the table are moved up to it.
        spec: mass, friction, force, stiffness, heights, times and timestep; None means
            `TrialSpec()`.
        parts: convex parts [m] of the mesh; None means that `convex_parts` computes them.

    Raises:
        BadArgument: there are no grasps, or grasps failed a check.
        BadArgument: joints are of another hand, or the grasps do not touch the mesh.
        BadArgument: the planned table has an edge, and the player is not "mujoco".
        BadArgument: the player is "isaaclab" or "usd", and a link or joint of the hand has a name
            that USD forbids.
        MeshError: the mesh is open or malformed.
        OutputError: a file cannot be written.

    >>> import tempfile
    >>> from torchgrasp import load_hand, load_object
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> jug, grasp = load_object("jug"), load_shipped_grasp("jug", "barrett")
    >>> hand, folder = load_hand("barrett"), tempfile.mkdtemp()
    >>> folder = save_play(hand, grasp, folder, "mujoco", jug.mesh, parts=jug.parts)
    >>> sorted(path.name for path in folder.iterdir())
    ['object.ply', 'play.json', 'play.py', 'scene.xml']
    """
    if not len(grasps):
        raise BadArgument("grasps", "none", "at least one grasp")
    check_all_executable(grasps)
    table = grasps.table
    if table is not None and table.edge is not None and player != "mujoco":
        raise BadArgument("player", f"{player!r}, for a table with an edge", "'mujoco'")
    hand = hand.to("cpu")
    grasps = grasps.to("cpu", torch.float64)
    spec = spec or TrialSpec()
    folder = Path(folder)
    if isinstance(mesh, Surface):
        mesh = stand(mesh, grasps.table).mesh()
    solid = read_mesh(mesh)
    check_contacts(grasps, solid)
    solid, pieces = read_solid(solid, parts)
    world_from_obj = _world_from_obj(grasps, solid)
    if not torch.equal(world_from_obj, torch.eye(4, dtype=torch.float64)):
        motion = world_from_obj.numpy()
        solid, *pieces = (body.copy().apply_transform(motion) for body in (solid, *pieces))
    edge = None if table is None else edge_of(table.moved(world_from_obj))
    scene = _scene(hand, spec, solid, pieces, edge)
    write_file(folder / "object.ply", _mesh_file(solid, "ply"))
    if player in ("mujoco", "newton"):
        write_file(folder / "scene.xml", scene_mjcf(scene))
    values = _describe(hand, grasps, world_from_obj, scene, spec)
    if player in USD:
        values |= describe_bodies(scene)
    if player == "maniskill":
        write_file(folder / "hand.urdf", mounted_urdf(scene))
        split = [some for corners in scene.hulls[0] for some in split_hull(corners)]
        # others may lie there of an earlier call
        values["body"]["files"] = [f"part_{k}.obj" for k in range(len(split))]
        for name, corners in zip(values["body"]["files"], split, strict=True):
            write_file(folder / name, _mesh_file(hull(100.0 * corners), "obj"))
    filters = {
        "json": json.dumps,
        "vector": lambda numbers: f"({', '.join(repr(float(x)) for x in numbers)})",
    }
    for name in ("play.json", *USD.get(player, ())):
        write_file(folder / name, render(TEMPLATES / f"{name}.jinja", filters, **values))
    for path in TEMPLATES.glob(f"{player}*.py.txt"):
        name = path.name.removeprefix(player).removesuffix(".py.txt").removeprefix("_") or "play"
        write_file(folder / f"{name}.py", path.read_text("utf-8"))
    return folder


def stand(surface: Surface, table: Plane | None) -> Surface:
    """Return an estimated surface whose vertices below the table are moved up to the table's plane,
    along its normal. So the object stands on a flat base.

    On the round base of an estimated surface the object would rock. Surface and table are in one
    frame. For a `table` of None the surface is returned as it is.
    """
    if table is None:
        return surface
    vertices = surface.vertices
    below = table.height(vertices).clamp(max=0)[:, None] * table.normal.to(vertices)
    return dataclasses.replace(surface, vertices=vertices - below)


def _world_from_obj(grasps: Grasps, mesh: "trimesh.Trimesh") -> Float[Tensor, "4 4"]:
    """Return the frame of the grasps, or one upright on the planned table where the table is
    tilted.
    """
    table = grasps.table
    if table is None or float(table.normal[2]) > 1 - UPRIGHT:
        return torch.eye(4, dtype=torch.float64)
    return inverse(upright_frame(torch.from_numpy(np.array(mesh.vertices)), None, table))


def _scene(
    hand: Hand,
    spec: TrialSpec,
    mesh: "trimesh.Trimesh",
    parts: "Sequence[trimesh.Trimesh]",
    edge: tuple[float, float, float] | None,
) -> SceneSpec:
    """Return the scene with all joints at zero, and the hand's mount along the axes of its root
    link. The table ends at an `edge`.
    """
    reach = spec.approach + spec.lift_height + PLAY.room
    axes = zip("xyz", AXES, strict=True)
    slides = [Slide(f"{OWN}mount_{x}", axis, -reach, reach, 0.0) for x, axis in axes]
    drives = stiff_drives(hand, spec.kp)
    mass = (
        Distribution.of(spec.mass).mean
        if spec.density is None
        else spec.density * float(mesh.volume)
    )
    return SceneSpec(
        hand.urdf_path,
        np.eye(4),
        dict.fromkeys(drives, 0.0),
        drives,
        tuple(hand.tips.links),
        mesh,
        list(parts),
        mass,
        Distribution.of(spec.friction).mean,
        spec.gravity,
        spec.timestep,
        patch=spec.patch,
        self_pairs=hand.self_pairs,
        table_friction=spec.table_friction,
        mount=tuple(slides),
        edge=edge,
    )


@checked
def pressing_force(spec: TrialSpec, mass: Positive) -> float:
    """Return the normal force [N] with which the strongest finger presses in a folder of
    `save_play`.

    It is `spec.force`. If `spec.force` is None, two opposite fingers hold two loads: the weight of
    a `mass` [kg] and a push of 2.5 N (`PUSH`). They do so with half of the mean friction
    coefficient, which counts as at least 0.1 (`PLAY.friction`). This force is at most
    `spec.max_force`, and at most 100 N (`PLAY.force`).

    >>> round(pressing_force(TrialSpec(friction=0.8), 0.25), 1)
    6.2
    """
    if spec.force is not None:
        return spec.force
    needed = (mass * spec.gravity + PUSH) / max(Distribution.of(spec.friction).mean, PLAY.friction)
    return min(needed, spec.max_force or PLAY.force, PLAY.force)


def _describe(
    hand: Hand,
    grasps: Grasps,
    world_from_obj: Float[Tensor, "4 4"],
    scene: SceneSpec,
    spec: TrialSpec,
) -> dict[str, Any]:
    """Return the values of play.json, by name."""
    mount = {slide.name: MOUNT_DRIVE for slide in scene.slides}
    masks = pair_masks(scene.self_pairs, first=1)
    _, postures = named_postures(hand, grasps, pressing_force(spec, scene.mass), spec.kp)
    poses = world_from_obj @ grasps.obj_from_hand
    opened = opened_pose(hand, grasps.pregrasp, grasps.obj_from_hand, grasps.table)
    rise = (world_from_obj @ opened - poses)[:, :3, 3]
    far = -spec.approach * rotate(world_from_obj, grasps.approach)
    up = torch.tensor([0.0, 0.0, spec.lift_height], dtype=torch.float64).expand_as(rise)
    # by the phase that ends: displacement of the hand in the world, posture, duration [s]
    motion = {
        "approach": (rise + far, "pregrasp", 0.0),
        "pregrasp": (rise, "pregrasp", spec.approach / PLAY.speed),
        "grasp": (0 * rise, "grasp", POSE_TIME),
        "squeeze": (0 * rise, "squeeze", POSE_TIME),
        "lift": (up, "squeeze", PLAY.lift),
        "hold": (up, "squeeze", spec.hold_time),
    }
    ends = np.cumsum([duration for _, _, duration in motion.values()])
    return {
        "hand": hand.name,
        "timestep": spec.timestep,
        "gravity": spec.gravity,
        "armature": ARMATURE,
        "friction": {"hand": scene.friction, "table": scene.body_friction},
        "table_height": scene.table_height,
        "lift_height": spec.lift_height,
        "body": {
            "mass": scene.mass,
            "centre": scene.mesh.center_mass.tolist(),
            **_principal(scene.body.inertia),
        },
        "drives": {name: x._asdict() for name, x in (mount | scene.drives).items()},
        "collision": {link.name: masks.get(link.name, (0, 0)) for link in scene.urdf.links},
        "times": dict(zip(motion, ends.tolist(), strict=True)),
        "grasps": [
            {
                "position": pose[:3, 3].tolist(),
                "quaternion": quaternion(pose),
                "targets": {
                    phase: dict(zip(mount, (moved[row] @ pose[:3, :3]).tolist(), strict=True))
                    | {joint: float(q[row]) for joint, q in postures[posture].items()}
                    for phase, (moved, posture, _) in motion.items()
                },
            }
            for row, pose in enumerate(poses)
        ],
    }


def _principal(inertia: np.ndarray) -> dict[str, list[float]]:
    """Return the principal moments of an `inertia` (3, 3) [kg m^2], and the quaternion (w, x, y, z)
    of its axes.
    """
    moments, axes = np.linalg.eigh(inertia)
    # a rotation, not a reflection
    turn = axes * [1.0, 1.0, np.sign(np.linalg.det(axes))]
    return {"moments": moments.tolist(), "axes": quaternion(turn)}


def describe_bodies(scene: SceneSpec) -> dict[str, Any]:
    """Return the description of a scene's object and hand that fills the templates of USD files:
    three lists, by name.

    "parts" has an entry for each convex part of the object. "links" and "joints" have one for each
    link or joint of the hand, and of the mount that carries the hand. The poses of links are those
    with all joints at zero. Lengths are in metres, masses in kilograms. Raises `BadArgument` for
    names of links or joints that USD does not allow.
    """
    urdf = scene.urdf
    moment = PLAY.inertia
    still = Link(f"{OWN}base", PLAY.mass, ORIGIN, (moment, 0.0, 0.0, moment, 0.0, moment), ())
    # a mount of slides along the axes of the hand's root link carries the hand
    names = [still.name, *(f"{slide.name}_link" for slide in scene.slides)]
    joints = list[Joint]()
    for x, parent, child in zip(scene.slides, names, names[1:], strict=False):
        slide = Joint(x.name, "prismatic", parent, child, ORIGIN, ORIGIN, x.axis, x.lower, x.upper)
        joints.append(slide)
    joints.append(Joint(f"{OWN}wrist", "fixed", names[-1], urdf.root, ORIGIN, ORIGIN))
    joints += urdf.joints
    links = [*(dataclasses.replace(still, name=name) for name in names), *urdf.links]
    if wrong := [x.name for x in (*links, *joints) if not x.name.isidentifier()]:
        allowed = "names of letters, digits and _, which USD allows"
        raise BadArgument("hand", repr(wrong[0]), allowed)
    # the mount is at the root
    poses = dict.fromkeys(names, np.eye(4))
    poses |= {link.name: urdf.pose_at_zero(link.name) for link in urdf.links}
    meet = {frozenset(pair) for pair in scene.self_pairs}
    drives = dict.fromkeys((slide.name for slide in scene.slides), MOUNT_DRIVE) | scene.drives
    return {
        "parts": [hull(corners) for corners in scene.hulls[0]],
        "links": [
            {
                "name": link.name,
                "mass": link.mass,
                "centre": link.com,
                "place": poses[link.name][:3, 3],
                "rotation": quaternion(poses[link.name][:3, :3]),
                "passes": [
                    x.name for x in links[k + 1 :] if frozenset((x.name, link.name)) not in meet
                ],
                "shapes": [
                    vars(x) | {"place": x.xyz, "rotation": quaternion(pose_of(x)[:3, :3])}
                    for x in link.shapes
                ],
                **_principal(link.inertia_matrix),
            }
            for k, link in enumerate(links)
        ],
        "joints": [
            vars(x)
            | {
                "place": x.xyz,
                "axis": quaternion(_along(x.axis)),
                "rotation": quaternion(pose_of(x)[:3, :3] @ _along(x.axis)),
                "drive": None if x.kind == "fixed" else drives[x.name],
                "armature": ARMATURE * (x in urdf.joints),
                "degrees": math.degrees(1.0) if x.kind == "revolute" else 1.0,
            }
            for x in joints
        ],
    }


def _along(axis: Sequence[float]) -> np.ndarray:
    """Return a rotation (3, 3) that turns the x axis to the unit vector `axis`."""
    return spatial.transform.Rotation.align_vectors([axis], AXES[:1])[0].as_matrix()


def _mesh_file(mesh: "trimesh.Trimesh", kind: str) -> bytes:
    """Return the content of a mesh's file of a `kind`, such as "ply"."""
    content = mesh.export(file_type=kind)
    return content if isinstance(content, bytes) else str(content).encode()
