"""Published tests of a grasp by pulling at the object in six directions, as their authors define them.

The hand is fixed and nothing else is there: no table, no gravity. Open loop the joints go from pre-grasp to grasp to
squeeze, then a constant force pulls at the object's mass centre along one axis of the world. Each direction starts
anew; the grasp passes if in none the object moves or turns too far from where it was before the hand closed. PhysX has
no torsional coefficient of friction: a contact patch of radius r resists friction x force x r, so that the protocol's
torsional coefficient (a length) over its sliding one is r.
"""

import dataclasses
import itertools
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from torchgrasp.base import Value
from torchgrasp.close.parts import check_parts, convex_parts, read_mesh
from torchgrasp.close.scene import Scene
from torchgrasp.close.squeeze import squeeze_joints
from torchgrasp.errors import BadArgument, Status
from torchgrasp.frames import rotation_angle
from torchgrasp.hand.hand import Hand
from torchgrasp.values import Grasps

if TYPE_CHECKING:
    import trimesh

TIMESTEP = 1 / 500
"""Of the simulator [s]."""

DIRECTIONS = tuple(np.array(sign) * axis for axis in np.eye(3) for sign in (-1.0, 1.0))
"""-x, +x, -y, +y, -z, +z of the world."""


@dataclasses.dataclass(frozen=True)
class PullProtocol(Value):
    """A test that pulls at a grasped object.

    Args:
        name: of the protocol.
        pull: force over mass [m/s^2] in each direction.
        mass: of the object [kg]; None: by `density`.
        density: of the object [kg/m^3], where `mass` is None.
        friction: sliding, of every contact.
        patch: radius [m] of the contact patch, for torsional friction.
        seconds: for which each pull lasts.
        distance: from its start by which the object's centre may move [m].
        angle: by which the object may turn [rad].
        kp: stiffness of all joint drives [N m/rad]; None: the hand's own.
        overlap: of hand and object at the pre-grasp that is refused [m].
    """

    name: str
    pull: float
    mass: float | None
    density: float
    friction: float
    patch: float
    seconds: float
    distance: float
    angle: float
    kp: float | None
    overlap: float = 0.01


CLOSE_SECONDS = 0.4
"""Time [s] from pre-grasp to grasp, and as much from grasp to squeeze."""

CHECK_SECONDS = 0.2
"""How often [s] the object is looked at while it is pulled."""

PROTOCOLS = {
    "multidex": PullProtocol("multidex", 0.5, None, 500.0, 3.0, 0.0, 1.0, 0.02, math.inf, None),
    "dexgraspbench": PullProtocol("dexgraspbench", 10.0, 0.1, 0.0, 0.6, 0.02 / 0.6, 2.0, 0.05, math.radians(15), 5.0),
    "dexgraspbench-hard": PullProtocol(
        "dexgraspbench-hard", 10.0, 0.1, 0.0, 0.3, 0.002 / 0.3, 2.0, 0.05, math.radians(15), 5.0
    ),
}
"""By name: MultiDex as D(R,O) runs it (arXiv 2410.01702), DexGraspBench's force-closure test for floating objects
(as of BODex, arXiv 2412.16490), and the same with halved friction as in Dexonomy (arXiv 2504.18829)."""


@dataclasses.dataclass(frozen=True)
class PullResult(Value):
    """What became of one grasp under a protocol.

    `passed` tells whether all six directions did; `directions` counts those tried until the first failure; `moved` [m]
    and `turned` [rad] are the largest of them; `force` [N] is the fingers' mean normal force before the first pull.
    """

    passed: bool
    status: Status
    directions: int
    moved: float
    turned: float
    force: float
    seconds: float


def pull_grasp(
    grasp: Grasps,
    hand: Hand,
    mesh: "trimesh.Trimesh | Path | str",
    protocol: PullProtocol | str = "dexgraspbench",
    force: float = 6.0,
    *,
    parts: "Sequence[trimesh.Trimesh] | None" = None,
) -> PullResult:
    """Close a hand on the true object open loop and pull at the object in six directions.

    Args:
        grasp: one row.
        hand: the hand that it was planned for.
        mesh: the true object [m], closed: a trimesh or a file.
        protocol: one of `PROTOCOLS` by name, or another.
        force: normal force of the strongest finger [N] in the squeeze.
        parts: convex bodies to use for the mesh instead of its own decomposition.

    Raises:
        BadArgument: an unknown protocol, not exactly one row, or a grasp of another hand.
        MeshError: the mesh is missing, open or without volume.
        MissingExtra: the simulator is not installed.
    """
    began = time.process_time()
    if isinstance(protocol, str):
        if protocol not in PROTOCOLS:
            raise BadArgument("protocol", repr(protocol), f"one of {', '.join(PROTOCOLS)}")
        protocol = PROTOCOLS[protocol]
    if len(grasp) != 1:
        raise BadArgument("grasp", f"{len(grasp)} rows", "exactly one: index the grasps, as in grasps[0]")
    grasp, hand = grasp.to("cpu", torch.float64), hand.to("cpu", torch.float64)
    poses = [grasp.pregrasp[0], grasp.joints[0], squeeze_joints(grasp, hand, force, protocol.kp)[0]]
    mesh = read_mesh(mesh)
    bodies = convex_parts(mesh) if parts is None else check_parts(parts)
    trial = _Pull(grasp, hand, mesh, bodies, protocol, poses)
    status, moved, turned, pressed, tried = Status.OK, 0.0, 0.0, math.nan, 0
    for direction in DIRECTIONS:
        found, forces = trial.run(direction)
        status, tried = found[0], tried + 1
        moved, turned = max(moved, found[1]), max(turned, found[2])
        pressed = forces if math.isnan(pressed) else pressed
        if status is not Status.OK:
            break
    passed = status is Status.OK
    return PullResult(passed, status, tried, moved, turned, pressed, time.process_time() - began)


class _Pull:
    """One grasp under one protocol: a fresh scene for each direction, so that no run depends on another."""

    def __init__(
        self,
        grasp: Grasps,
        hand: Hand,
        mesh: "trimesh.Trimesh",
        parts: "list[trimesh.Trimesh]",
        protocol: PullProtocol,
        poses: list[torch.Tensor],
    ) -> None:
        self.hand, self.mesh, self.parts, self.protocol = hand, mesh, parts, protocol
        self.pose = grasp.obj_from_hand[0].numpy()
        self.mass = protocol.density * float(mesh.volume) if protocol.mass is None else protocol.mass
        self.poses = [{name: float(q) for name, q in hand.expand(pose).items()} for pose in poses]
        drives = hand.actuators
        if protocol.kp is not None:
            drives = {name: drive._replace(kp=protocol.kp) for name, drive in drives.items()}
        self.drives = drives

    def run(self, direction: np.ndarray) -> tuple[tuple[Status, float, float], float]:
        """Close, pull along one direction, and return status, motion [m], turn [rad] and the mean force [N] before."""
        rule = self.protocol
        scene = Scene(
            self.hand.urdf_path, self.pose, self.poses[0], self.drives, tuple(self.hand.tip_links), self.mesh,
            self.parts, self.mass, rule.friction, 0.0, TIMESTEP, 0.0, table=False, patch=rule.patch,
        )  # fmt: skip
        if not scene.penetration() <= rule.overlap:
            return (Status.START_OVERLAP, 0.0, 0.0), math.nan
        ladder = [np.array([pose[name] for name in scene.joint_names]) for pose in self.poses]
        start, far = scene.object_pose(), (0.0, 0.0)
        steps = round(CLOSE_SECONDS / TIMESTEP)
        seen = np.zeros((3, 3))
        for low, high in itertools.pairwise(ladder):
            for k in range(steps):
                scene.drive(low + (high - low) * (k + 1) / steps)
                reading = scene.step()
                seen = 0.98 * seen + 0.02 * reading.impulse / TIMESTEP
        force = float(np.linalg.norm(seen, axis=-1).mean())
        status = self._judge(scene, start)
        if status[0] is not Status.OK:
            return (Status.EJECTED if status[0] is Status.MOVED else status[0], *status[1:]), force
        scene.pull(rule.pull * self.mass * direction)
        for _ in range(round(rule.seconds / CHECK_SECONDS)):
            for _ in range(round(CHECK_SECONDS / TIMESTEP)):
                scene.step()
            status = self._judge(scene, start)
            far = (max(far[0], status[1]), max(far[1], status[2]))
            if status[0] is not Status.OK:
                break
        return (status[0], *far), force

    def _judge(self, scene: Scene, start: np.ndarray) -> tuple[Status, float, float]:
        """Compare the object's pose with where it was."""
        now = scene.object_pose()
        if not np.isfinite(now).all():
            return Status.UNSTABLE, math.inf, math.inf
        centre = np.append(scene.centre, 1.0)
        moved = float(np.linalg.norm((now @ centre - start @ centre)[:3]))
        turned = float(rotation_angle(torch.from_numpy(start[:3, :3].T @ now[:3, :3])))
        fine = moved < self.protocol.distance and turned < self.protocol.angle
        return Status.OK if fine else Status.MOVED, moved, turned
