"""The simulated scene of one trial: table, object and a hand that can be lifted. The only file that uses SAPIEN.

Settings that differ from SAPIEN's defaults each have a measured reason: joints get an armature of 1e-3 kg m^2 (without
it the implicit drives lose a third of their torque in a contact), friction 0.8 or as told on every shape, the hand's
links feel neither gravity nor each other, sleeping is off (a sleeping body keeps stale contacts), the object's inertia
is set with its mass, and penetrations are resolved at 1 m/s at most. Every trial gets a fresh scene: only then are two
runs equal to the last bit. PhysX keeps 255 faces of a convex part at most: a ball of 30 mm loses up to 0.5 mm, and a
finely divided cylinder becomes an 18-gon.
"""

import dataclasses
import tempfile
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchgrasp.close.lift import LIFT_JOINT, lifted_urdf
from torchgrasp.errors import BadArgument, MissingExtra
from torchgrasp.hand.hand import Actuator

if TYPE_CHECKING:
    import trimesh

PATCH_RADIUS = 0.005
"""Radius [m] of the patch in which a soft fingertip touches."""

ARMATURE = 1e-3
"""Inertia [kg m^2] that each motor's rotor adds to its joint."""

TABLE = (2.0, 2.0, 0.1)
"""Size of the table [m]; its top is where the mesh is lowest."""


@dataclasses.dataclass(frozen=True)
class Reading:
    """The true state after one step: contacts of the fingertips with the object, summed over the step.

    `impulse` [N s] (3, 3) is along the contact normals (friction is not in it) and acts on the object; `weight` [N s]
    and `moment` [N s m] sum the contact points weighted by impulse, so that their quotient is the mean contact point;
    `finger` tells which fingers touch, by the tip or by the link that carries it.
    """

    impulse: np.ndarray
    moment: np.ndarray
    weight: np.ndarray
    finger: np.ndarray


class Scene:
    """Table, object and hand in one SAPIEN scene; positions in the object's frame, which is the world's.

    Args:
        urdf_path: of the hand.
        world_from_hand: pose of the hand (4, 4).
        joints: start position of every joint of the URDF by name [rad].
        drives: stiffness, damping and largest torque of every joint by name.
        tip_links: the three fingertips' links, in the order of the fingers.
        mesh: the closed object, for its table height, mass centre and inertia.
        parts: convex bodies that make up its surface.
        mass: of the object [kg].
        friction: of every contact.
        gravity: [m/s^2].
        timestep: [s].
        travel: how far the hand can be lifted [m].
        table: whether there is one.
        patch: radius [m] of the patch in which a fingertip touches; its torsional friction is friction x force x patch.

    Raises:
        MissingExtra: SAPIEN is not installed.
    """

    def __init__(
        self,
        urdf_path: Path | str,
        world_from_hand: np.ndarray,
        joints: dict[str, float],
        drives: dict[str, Actuator],
        tip_links: tuple[str, ...],
        mesh: "trimesh.Trimesh",
        parts: "list[trimesh.Trimesh]",
        mass: float,
        friction: float = 0.8,
        gravity: float = 9.81,
        timestep: float = 1 / 500,
        travel: float = 0.1,
        table: bool = True,
        patch: float = PATCH_RADIUS,
    ) -> None:
        sapien, physx = _import_sapien()
        physx.set_scene_config(gravity=np.array([0, 0, -gravity], np.float32), enable_tgs=True, enable_pcm=True)
        physx.set_shape_config(contact_offset=0.002, rest_offset=0.0)
        physx.set_body_config(solver_position_iterations=10, solver_velocity_iterations=1, sleep_threshold=0.0)
        self.system = physx.PhysxCpuSystem()
        self.scene = sapien.Scene([self.system])
        self.scene.timestep = self.timestep = timestep
        self._material = physx.PhysxMaterial(friction, friction, 0.0)
        self._sapien, self._physx, self._patch = sapien, physx, patch
        self._pull = np.zeros(3, np.float32)
        if table:
            self._add_table(float(mesh.bounds[0, 2]))
        self._add_object(mesh, parts, mass)
        self._add_hand(urdf_path, world_from_hand, joints, drives, tip_links, travel)

    # ------------------------------------------------------------------------------------------------- building

    def _add_table(self, height: float) -> None:
        """Put a box under the object."""
        shape = self._physx.PhysxCollisionShapeBox(np.array(TABLE, np.float32) / 2, self._material)
        body = self._physx.PhysxRigidStaticComponent()
        body.attach(shape)
        self._place("table", body, [0.0, 0.0, height - TABLE[2] / 2])

    def _add_object(self, mesh: "trimesh.Trimesh", parts: "list[trimesh.Trimesh]", mass: float) -> None:
        """Put the object where its mesh is; mass centre and inertia are those of the mesh, filled evenly."""
        body = self._physx.PhysxRigidDynamicComponent()
        for part in parts:
            vertices = np.asarray(part.vertices, np.float32)
            shape = self._physx.PhysxCollisionShapeConvexMesh(vertices, np.ones(3, np.float32), self._material)
            shape.min_patch_radius = self._patch
            body.attach(shape)
        moments, axes = np.linalg.eigh(np.asarray(mesh.moment_inertia) * (mass / mesh.volume))
        axes = axes * np.array([1.0, 1.0, np.sign(np.linalg.det(axes))])
        frame = np.eye(4)
        frame[:3, :3], frame[:3, 3] = axes, mesh.center_mass
        body.mass = mass
        body.cmass_local_pose = self._sapien.Pose(frame)
        body.inertia = moments.astype(np.float32)
        body.max_depenetration_velocity = 1.0
        body.linear_damping = body.angular_damping = 0.0
        self.centre = np.asarray(mesh.center_mass, float)
        self.body = body
        self._place("object", body, [0.0, 0.0, 0.0])

    def _place(self, name: str, body: Any, position: list[float]) -> None:
        """Add an entity of one body to the scene."""
        entity = self._sapien.Entity()
        entity.name = name
        entity.add_component(body)
        entity.set_pose(self._sapien.Pose(position))
        self.scene.add_entity(entity)

    def _add_hand(
        self,
        urdf_path: Path | str,
        world_from_hand: np.ndarray,
        joints: dict[str, float],
        drives: dict[str, Actuator],
        tip_links: tuple[str, ...],
        travel: float,
    ) -> None:
        """Load the hand, strip what the simulator gets wrong, and set it to its start."""
        loader = self.scene.create_urdf_loader()
        loader.fix_root_link = True
        loader.set_material(self._material.static_friction, self._material.dynamic_friction, 0.0)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "hand.urdf"
            file.write_text(lifted_urdf(urdf_path, world_from_hand, travel), encoding="utf-8")
            self.hand = loader.load(str(file))
        self._active = self.hand.active_joints
        self.joint_names = tuple(j.name for j in self._active if j.name != LIFT_JOINT)
        missing = [n for n in self.joint_names if n not in joints or n not in drives]
        if missing:
            raise BadArgument("joints", f"no position or drive for {missing}", "one for every joint of the URDF")
        start = []
        for joint in self._active:
            joint.set_friction(0.0)
            if joint.name == LIFT_JOINT:
                joint.set_drive_properties(1e4, 1e3, force_limit=1e4)
                self._lift, position = joint, 0.0
            else:
                drive, position = drives[joint.name], float(joints[joint.name])
                joint.set_armature(np.array([ARMATURE], np.float32))
                joint.set_drive_properties(drive.kp, drive.kd, force_limit=drive.effort)
            joint.set_drive_target(position)
            start.append(position)
        self.hand.set_qpos(np.array(start, np.float32))
        self._driven = [j for j in self._active if j.name != LIFT_JOINT]
        self._order = [k for k, j in enumerate(self._active) if j.name != LIFT_JOINT]
        links = {link.name: link for link in self.hand.links}
        self.tips = [links[name] for name in tip_links]
        for link in self.hand.links:
            link.disable_gravity = True
            for shape in link.collision_shapes:
                groups = shape.get_collision_groups()
                groups[2] |= 1  # shapes that share such a bit do not collide: the hand with itself
                shape.set_collision_groups(groups)
                if link.name in tip_links:
                    shape.min_patch_radius = self._patch
        root = next(j.child_link for j in self.hand.joints if j.name == "torchgrasp_wrist")
        self._hand_root = root
        self._map_contacts()
        self._map_joints()

    def _map_contacts(self) -> None:
        """Remember which finger a link belongs to: its tip, and the link that the tip is fixed to."""
        self._tip_of = {link.name: i for i, link in enumerate(self.tips)}
        self._finger_of = dict(self._tip_of)
        for i, tip in enumerate(self.tips):
            if tip.joint.dof == 0:
                self._finger_of.setdefault(tip.parent.name, i)

    def _map_joints(self) -> None:
        """Prepare the geometric Jacobian: each driven joint's frame in its link, and the tips that it moves."""
        self._frames = [j.pose_in_child.to_transformation_matrix() for j in self._driven]
        self._slides = np.array([j.type == "prismatic" for j in self._driven])
        self._moves = np.zeros((len(self.tips), len(self._driven)))
        for t, tip in enumerate(self.tips):
            link = tip
            while link is not None:
                for k, joint in enumerate(self._driven):
                    if joint.child_link.name == link.name:
                        self._moves[t, k] = 1.0
                link = link.parent

    # -------------------------------------------------------------------------------------------------- running

    def step(self) -> Reading:
        """Advance by one timestep and report the contacts between fingertips and object."""
        if self._pull.any():
            self.body.add_force_torque(self._pull, np.zeros(3, np.float32))
        self.scene.step()
        impulse, moment, weight = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
        finger = np.zeros(3, dtype=bool)
        for contact in self.system.get_contacts():
            first, second = (b.entity.name for b in contact.bodies)
            if first == "object":
                link, sign = second, 1.0
            elif second == "object":
                link, sign = first, -1.0
            else:
                continue
            which = self._finger_of.get(link)
            if which is None:
                continue
            for point in contact.points:
                size = float(np.linalg.norm(point.impulse))
                if size > 0.0:
                    finger[which] = True
                    if link in self._tip_of:
                        impulse[which] += sign * point.impulse
                        moment[which] += size * point.position
                        weight[which] += size
        return Reading(impulse, moment, weight, finger)

    def drive(self, targets: np.ndarray) -> None:
        """Set the target [rad] of every driven joint, in the order of `joint_names`."""
        for joint, target in zip(self._driven, targets, strict=True):
            joint.set_drive_target(float(target))

    def pull(self, force: np.ndarray) -> None:
        """Let a force [N] act on the object's mass centre from now on, in the world's axes."""
        self._pull = np.asarray(force, np.float32)

    def lift(self, height: float) -> None:
        """Set the target of the lift joint [m]."""
        self._lift.set_drive_target(float(height))

    def joints(self) -> np.ndarray:
        """Return the position of every driven joint [rad], in the order of `joint_names`."""
        return np.asarray(self.hand.get_qpos(), float)[self._order]

    def object_pose(self) -> np.ndarray:
        """Return the object's pose (4, 4) in the world."""
        return np.asarray(self.body.entity.pose.to_transformation_matrix(), float)

    def hand_pose(self) -> np.ndarray:
        """Return the pose (4, 4) of the hand's root link in the world, after at least one step."""
        return np.asarray(self._hand_root.entity_pose.to_transformation_matrix(), float)

    def tip_poses(self) -> np.ndarray:
        """Return the poses (3, 4, 4) of the fingertips' links in the world."""
        return np.stack([np.asarray(t.entity_pose.to_transformation_matrix(), float) for t in self.tips])

    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return d points / d driven joints (3, 3, j) in the world, each point fixed to its fingertip [m/rad or 1]."""
        frames = np.stack(
            [
                np.asarray(j.child_link.entity_pose.to_transformation_matrix(), float) @ f
                for j, f in zip(self._driven, self._frames, strict=True)
            ]
        )
        arms = points[:, None, :] - frames[None, :, :3, 3]
        axes = np.broadcast_to(frames[:, :3, 0], arms.shape)
        columns = np.where(self._slides[:, None], axes, np.cross(axes, arms)) * self._moves[..., None]
        return columns.transpose(0, 2, 1)

    def penetration(self) -> float:
        """Return how deep [m] the hand is in the object or the table after one step without the object's weight."""
        self.body.disable_gravity = True
        self.scene.step()
        self.body.disable_gravity = False
        deepest = 0.0
        for contact in self.system.get_contacts():
            if {b.entity.name for b in contact.bodies} != {"object", "table"}:
                deepest = max([deepest, *(-p.separation for p in contact.points)])
        return float(deepest)


def _import_sapien() -> tuple[Any, Any]:
    """Import SAPIEN; its warning about a missing system Vulkan does not concern physics."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import sapien
            import sapien.physx as physx
    except ImportError as error:
        raise MissingExtra("sapien", "sim") from error
    return sapien, physx
