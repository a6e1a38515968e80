"""The contents of a scene in SAPIEN. They are the world, the table, bodies of convex parts, and the
hand on its mount.

Settings that differ from SAPIEN's defaults:

* Joints get an armature (inertia of the motor): without it the implicit drives lose torque in a
  contact.
* The hand's links feel no gravity, and collide with each other only in the pairs that the scene
  names.
* Sleeping is off, because a sleeping body keeps stale contacts.
* The object's inertia is set with its mass.
* A link without <inertial> adds almost nothing to the link to which it is fixed. SAPIEN takes the
  density of water, and a moment of inertia of 1e-6 kg m^2 or more.
* Penetrations are resolved at 1 m/s at most.
* The solver is PGS: with TGS a held object creeps, far inside the friction cones. Only TGS knows
  contact patches; with 32 iterations a step the object creeps slower than with 10.
* Lengths are in centimetres, the unit `CENTIMETRES`. PhysX is made for things of a metre: in metres
  it misses whole contacts of a fingertip with a convex part, and drops vertices. The foot of a
  finely faceted part is a shape of its own.

A `material` is PhysX's material of a surface, with its friction.
"""

import dataclasses
import math
import warnings
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from torchgrasp.files import temporary_folder, write_file
from torchgrasp.foundation.errors import MendedInput
from torchgrasp.foundation.lazy import import_extra, trimesh
from torchgrasp.foundation.told import warn_user
from torchgrasp.hand.urdf import Urdf
from torchgrasp.sim.scene_spec import (
    ARMATURE,
    MOUNT_DRIVE,
    Body,
    SceneSpec,
    mounted_urdf,
    pair_masks,
)


@dataclasses.dataclass(frozen=True)
class BodyNumbers:
    """Settings of PhysX, the engine of SAPIEN, for contacts and for bodies made of convex hulls."""

    contact_offset: float = 0.002
    """Distance [m] between two shapes below which PhysX creates their contacts, before they touch.
    """
    iterations: int = 32
    """Iterations of the solver for positions in each step; with more, held objects creep less."""
    hull: int = 129
    """Largest number of vertices of a hull of which PhysX keeps all: its limit is 255 faces."""
    foot: int = 100
    """Number of lowest vertices of a larger hull that make a shape of their own."""
    depenetration: float = 1.0
    """Greatest speed [m/s] at which PhysX moves overlapping bodies apart."""
    least_mass: float = 1e-6
    """Mass [kg] of a link that has none: PhysX takes no zero."""
    least_inertia: float = 1e-9
    """Moment of inertia [kg m^2] of this link about every axis."""


BODIES = BodyNumbers()
CENTIMETRES = 100.0
"""PhysX's units of length in a metre. Masses and times keep their units, so forces and impulses are
as many times as large, and torques and moments of inertia its square.
"""


def open_world(gravity: float, timestep: float, patches: bool) -> tuple[Any, Any]:
    """Return (system, scene): an empty PhysX system on the CPU, and the SAPIEN scene that uses it.

    `gravity` [m/s^2] is the size of the downward acceleration, and `timestep` is in seconds. If
    `patches` is true, PhysX's solver TGS is selected, which simulates contact patches. Otherwise it
    is PGS.
    """
    sapien, physx = import_sapien()
    physx.set_scene_config(
        gravity=np.array([0, 0, -CENTIMETRES * gravity], np.float32),
        enable_tgs=patches,
        enable_pcm=True,
    )
    physx.set_shape_config(contact_offset=CENTIMETRES * BODIES.contact_offset, rest_offset=0.0)
    physx.set_body_config(
        solver_position_iterations=BODIES.iterations,
        solver_velocity_iterations=1,
        sleep_threshold=0.0,
    )
    system = physx.PhysxCpuSystem()
    scene = sapien.Scene([system])
    scene.timestep = timestep
    return system, scene


def surface_of(friction: float) -> Any:
    """Return PhysX's surface material with the friction coefficient `friction`, static and dynamic.

    Its restitution is 0: nothing bounces on it.
    """
    _, physx = import_sapien()
    return physx.PhysxMaterial(friction, friction, 0.0)


def place(scene: Any, name: str, body: Any, height: float = 0.0) -> None:
    """Add a `body` of PhysX to a SAPIEN scene, as an entity called `name`.

    The body's origin is put at a `height` [m] on the world's z axis; it is not rotated.
    """
    sapien, _ = import_sapien()
    entity = sapien.Entity()
    entity.name = name
    entity.add_component(body)
    entity.set_pose(sapien.Pose([0.0, 0.0, CENTIMETRES * height]))
    scene.add_entity(entity)


def table(material: Any, spec: SceneSpec) -> Any:
    """Return PhysX's static body of the table of a scene, with PhysX's surface `material`.

    The body's origin lies on the tabletop, and z is up. If `spec.edge` is None, the body is a half
    space. Otherwise it is the surface of a box, in triangles. On a solid box a rocking object would
    gain energy until it falls over.
    """
    sapien, physx = import_sapien()
    body = physx.PhysxRigidStaticComponent()
    if spec.edge is None:
        top = physx.PhysxCollisionShapePlane(material)
        # Its normal is its x axis.
        half = math.sqrt(0.5)
        top.set_local_pose(sapien.Pose(q=[half, 0.0, -half, 0.0]))
    else:
        ledge = spec.ledge
        box = trimesh.creation.box(2 * CENTIMETRES * ledge.half)
        corners = box.vertices.astype(np.float32)
        faces = box.faces.astype(np.uint32)
        scale = np.ones(3, np.float32)
        top = physx.PhysxCollisionShapeTriangleMesh(corners, faces, scale, material)
        frame = np.eye(4)
        frame[:3, :3] = ledge.axes
        frame[:2, 3] = CENTIMETRES * ledge.centre[:2]
        frame[2, 3] = -CENTIMETRES * ledge.half[2]
        top.set_local_pose(sapien.Pose(frame))
    body.attach(top)
    return body


def rigid_body(material: Any, spec: Body, hulls: Iterable[np.ndarray], patch: float) -> Any:
    """Return PhysX's dynamic body of uniform density, made of convex hulls.

    `spec` gives mass, centre of mass and inertia, and `material` is PhysX's surface material.
    `hulls` are the vertices (v, 3) [m] of each hull, in the frame of `spec.mesh`. `patch` [m] is
    the radius of contact patches.
    """
    sapien, physx = import_sapien()
    body = physx.PhysxRigidDynamicComponent()
    for vertices in (some for hull in hulls for some in split_hull(hull)):
        corners = (CENTIMETRES * vertices).astype(np.float32)
        shape = physx.PhysxCollisionShapeConvexMesh(corners, np.ones(3, np.float32), material)
        shape.min_patch_radius = CENTIMETRES * patch
        body.attach(shape)
    moments, axes = np.linalg.eigh(spec.inertia)
    axes = axes * np.array([1.0, 1.0, np.sign(np.linalg.det(axes))])
    frame = np.eye(4)
    frame[:3, :3] = axes
    frame[:3, 3] = CENTIMETRES * spec.mesh.center_mass
    body.mass = spec.mass
    body.cmass_local_pose = sapien.Pose(frame)
    body.inertia = (CENTIMETRES**2 * moments).astype(np.float32)
    body.max_depenetration_velocity = CENTIMETRES * BODIES.depenetration
    body.linear_damping = body.angular_damping = 0.0
    return body


def split_hull(hull: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the vertices (v, 3) [m] of a convex hull, and for a large hull those of its foot.

    PhysX drops some vertices of a hull with more than 129 vertices (`BODIES.hull`). The foot of
    such a hull consists of its 100 lowest vertices (`BODIES.foot`) and the mean of all.
    """
    yield hull
    if len(hull) > BODIES.hull:
        yield np.vstack([hull[hull[:, 2].argsort(kind="stable")[: BODIES.foot]], hull.mean(0)])


def mounted_hand(scene: Any, material: Any, spec: SceneSpec) -> Any:
    """Load the hand on its mount into a SAPIEN scene, in the initial posture of `spec`; return
    SAPIEN's articulation of hand and mount.

    Of PhysX's `material` only the friction coefficients are used. Raises `BadArgument` for a joint
    without a start position or drive, and `HandFileError` for a malformed URDF.
    """
    loader = scene.create_urdf_loader()
    loader.fix_root_link = True
    loader.scale = CENTIMETRES
    loader.set_material(material.static_friction, material.dynamic_friction, 0.0)
    with temporary_folder() as folder:
        hand = loader.load(str(write_file(folder / "hand.urdf", mounted_urdf(spec))))
    for link in hand.links:
        # the loader scales masses as volumes, and moments of inertia as those of equal density
        link.mass = link.mass / CENTIMETRES**3
        link.inertia = link.inertia / CENTIMETRES**3
        link.max_linear_velocity = CENTIMETRES * link.max_linear_velocity
    _set_missing_masses(hand, spec.urdf)
    slides = {slide.name: slide for slide in spec.slides}
    spec.check_drives([j.name for j in hand.active_joints if j.name not in slides])
    start = []
    for joint in hand.active_joints:
        joint.set_friction(0.0)
        # PhysX's units of a position, and of a stiffness, damping or rotor; their product is that
        # of a force or torque
        unit = CENTIMETRES if joint.type == "prismatic" else 1.0
        square = 1.0 if joint.type == "prismatic" else CENTIMETRES**2
        if joint.name in slides:
            drive = MOUNT_DRIVE
            position = slides[joint.name].start
        else:
            drive = spec.drives[joint.name]
            position = float(spec.joints[joint.name])
            joint.set_armature(np.array([square * ARMATURE], np.float32))
        limit = unit * square * drive.effort
        joint.set_drive_properties(square * drive.kp, square * drive.kd, force_limit=limit)
        position = unit * position
        joint.set_drive_target(position)
        start.append(position)
    hand.set_qpos(np.array(start, np.float32))
    everything_else = 1  # SAPIEN's default collision group, the first bit
    masks = pair_masks(spec.self_pairs, first=1)
    for link in hand.links:
        link.disable_gravity = True
        for shape in link.collision_shapes:
            kind, hits = masks.get(link.name, (0, 0))
            shape.set_collision_groups([kind, everything_else | hits, 0, 0])
            if link.name in spec.tip_links:
                shape.min_patch_radius = CENTIMETRES * spec.patch
    return hand


def _set_missing_masses(hand: Any, urdf: Urdf) -> None:
    """Make links without mass as light as PhysX allows, in SAPIEN's articulation of a hand.

    Fixed joints make groups of links that move as one body. `MendedInput` warns of a group in which
    no link has a mass: SAPIEN then takes that of water in its shapes.
    """
    heads = dict[str, str]()  # the first link of each link's group
    for link in urdf.links:
        above = (joint.child for joint in urdf.joints_above(link.name) if joint.kind != "fixed")
        heads[link.name] = next(above, urdf.root)
    masses = dict.fromkeys(heads.values(), 0.0)
    masses[urdf.root] = 1.0  # that of the mount
    for link in urdf.links:
        masses[heads[link.name]] += link.mass
    missing = [link.name for link in urdf.links if link.mass == 0]
    light = [name for name in missing if masses[heads[name]] > 0]
    for link in hand.links:
        if link.name in light:
            link.mass = BODIES.least_mass
            link.inertia = np.full(3, CENTIMETRES**2 * BODIES.least_inertia, np.float32)
    bodies = [head for head, mass in masses.items() if mass == 0]
    if bodies:
        found = f"links without mass ({', '.join(bodies)}), which are simulated as of water"
        warn_user(MendedInput, f"{urdf.path}: {found}; give each an <inertial>")


def import_sapien() -> tuple[Any, Any]:
    """Import and return the modules (`sapien`, `sapien.physx`).

    SAPIEN's warning about missing Vulkan is hidden, because physics works without Vulkan. Raises
    `MissingExtra` if SAPIEN is not installed.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        engine = import_extra("sapien", "sim", "sapien")
        return engine, import_extra("sapien.physx", "sim", "sapien")
