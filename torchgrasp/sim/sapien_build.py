"""Build a scene in SAPIEN.

Settings that differ from SAPIEN's defaults each have a measured reason:

* Joints get an armature: without it the implicit drives lose a third of their torque in a contact.
* The hand's links feel no gravity, and each other only in the pairs that the scene names.
* Sleeping is off, because a sleeping body keeps stale contacts.
* The object's inertia is set with its mass.
* Penetrations are resolved at 1 m/s at most.

PhysX keeps 255 faces of a convex part: a ball of 30 mm loses 0.5 mm.
"""

import warnings
from typing import Any, NamedTuple

import numpy as np

from torchgrasp.errors import MissingExtra
from torchgrasp.files import temporary_folder, write_file
from torchgrasp.sim.collision_masks import pair_masks
from torchgrasp.sim.mount import MOUNT_DRIVE, mount_slides, mounted_urdf
from torchgrasp.sim.scene import ARMATURE, TABLE, Body, SceneSpec

EVERYTHING_ELSE, FREE_BIT = 1, 1
"""Collision group of what is no hand, as SAPIEN sets it, and the number of the first bit after it."""


class Built(NamedTuple):
    """SAPIEN's own objects: physics system, scene, the object's body, the hand, and the neighbours' bodies."""

    system: Any
    scene: Any
    body: Any
    hand: Any
    neighbours: list[Any]


def build(spec: SceneSpec) -> Built:
    """Return a scene with table, object and hand at their start.

    Raises:
        BadArgument: a joint of the hand without a position or drive.
        MissingExtra: SAPIEN is not installed.
    """
    sapien, physx = import_sapien()
    system, scene = open_world(sapien, physx, spec.gravity, spec.timestep)
    material = physx.PhysxMaterial(spec.friction, spec.friction, 0.0)
    if spec.table:
        place(sapien, scene, "table", table(physx, material), spec.table_height - TABLE[2] / 2)
    bodies = [rigid_body(sapien, physx, material, body, spec.patch) for body in (spec.body, *spec.neighbours)]
    for k, body in enumerate(bodies):
        place(sapien, scene, "neighbour" if k else "object", body)
    return Built(system, scene, bodies[0], _hand(scene, material, spec), bodies[1:])


def open_world(sapien: Any, physx: Any, gravity: float, timestep: float) -> tuple[Any, Any]:
    """Return an empty physics system and its scene; gravity [m/s^2], timestep [s]."""
    physx.set_scene_config(gravity=np.array([0, 0, -gravity], np.float32), enable_tgs=True, enable_pcm=True)
    physx.set_shape_config(contact_offset=0.002, rest_offset=0.0)
    physx.set_body_config(solver_position_iterations=10, solver_velocity_iterations=1, sleep_threshold=0.0)
    system = physx.PhysxCpuSystem()
    scene = sapien.Scene([system])
    scene.timestep = timestep
    return system, scene


def place(sapien: Any, scene: Any, name: str, body: Any, height: float = 0.0) -> None:
    """Add an entity of one body to the scene, at a height [m]."""
    entity = sapien.Entity()
    entity.name = name
    entity.add_component(body)
    entity.set_pose(sapien.Pose([0.0, 0.0, height]))
    scene.add_entity(entity)


def table(physx: Any, material: Any) -> Any:
    """Return a box to put under the object."""
    body = physx.PhysxRigidStaticComponent()
    body.attach(physx.PhysxCollisionShapeBox(np.array(TABLE, np.float32) / 2, material))
    return body


def rigid_body(sapien: Any, physx: Any, material: Any, spec: Body, patch: float) -> Any:
    """Return a body with the mass centre and inertia of an even filling, and soft contacts of a radius [m]."""
    body = physx.PhysxRigidDynamicComponent()
    for part in spec.parts:
        vertices = np.asarray(part.vertices, np.float32)
        shape = physx.PhysxCollisionShapeConvexMesh(vertices, np.ones(3, np.float32), material)
        shape.min_patch_radius = patch
        body.attach(shape)
    moments, axes = np.linalg.eigh(spec.inertia)
    axes = axes * np.array([1.0, 1.0, np.sign(np.linalg.det(axes))])
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = axes, spec.mesh.center_mass
    body.mass = spec.mass
    body.cmass_local_pose = sapien.Pose(frame)
    body.inertia = moments.astype(np.float32)
    body.max_depenetration_velocity = 1.0
    body.linear_damping = body.angular_damping = 0.0
    return body


def _hand(scene: Any, material: Any, spec: SceneSpec) -> Any:
    """Load the hand on its mount and set it to its start."""
    loader = scene.create_urdf_loader()
    loader.fix_root_link = True
    loader.set_material(material.static_friction, material.dynamic_friction, 0.0)
    with temporary_folder() as folder:
        hand = loader.load(str(write_file(folder / "hand.urdf", mounted_urdf(spec))))
    slides = {slide.name: slide for slide in mount_slides(spec)}
    spec.check_drives([j.name for j in hand.active_joints if j.name not in slides])
    start = []
    for joint in hand.active_joints:
        joint.set_friction(0.0)
        if joint.name in slides:
            drive, position = MOUNT_DRIVE, slides[joint.name].start
        else:
            drive, position = spec.drives[joint.name], float(spec.joints[joint.name])
            joint.set_armature(np.array([ARMATURE], np.float32))
        joint.set_drive_properties(drive.kp, drive.kd, force_limit=drive.effort)
        joint.set_drive_target(position)
        start.append(position)
    hand.set_qpos(np.array(start, np.float32))
    masks = pair_masks(spec.self_pairs, FREE_BIT)
    for link in hand.links:
        link.disable_gravity = True
        for shape in link.collision_shapes:
            kind, hits = masks.get(link.name, (0, 0))
            shape.set_collision_groups([kind, EVERYTHING_ELSE | hits, 0, 0])
            if link.name in spec.tip_links:
                shape.min_patch_radius = spec.patch
    return hand


def import_sapien() -> tuple[Any, Any]:
    """Import SAPIEN, silencing its warning about a missing Vulkan: physics needs none."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import sapien
            import sapien.physx as physx
    except ImportError as error:
        raise MissingExtra("sapien", "sim") from error
    return sapien, physx
