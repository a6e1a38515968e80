"""Published tests of a grasp by pulling at the object in six directions, as their authors define them.

The hand is fixed and nothing else is there: no table, no gravity. The hand closes, by default open loop from pre-grasp
to grasp to squeeze, then a constant force pulls at the object's mass centre along one axis of the world. Each direction
starts anew; the grasp passes if in none the object moves or turns too far from where it was before the hand closed.
PhysX has no torsional coefficient of friction: a contact patch of radius r resists friction x force x r, so that the
protocol's torsional coefficient (a length) over its sliding one is r.
"""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.control.controller import GraspController, check_modes
from torchgrasp.control.reference import ClosingReference
from torchgrasp.errors import BadArgument, Status
from torchgrasp.frames import rotation_angle
from torchgrasp.hand.hand import Hand
from torchgrasp.mesh import read_mesh
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.sim.convex_parts import check_parts, convex_parts
from torchgrasp.sim.hand import SimulatedHand
from torchgrasp.sim.open import open_scene
from torchgrasp.sim.scene import Scene, SceneSpec
from torchgrasp.specs import ClosingMode, HoldingMode, Simulator, check_simulator
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
        shift: largest error of the hand's position along each of its axes [m].
        turn: largest error of its orientation about each of its axes [rad].
        draws: how many such errors are drawn for each grasp.
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
    shift: float = 0.0
    turn: float = 0.0
    draws: int = 1


CONTROL_RATE = 100.0
"""Of the controllers [Hz]."""

CHECK_SECONDS = 0.2
"""How often [s] the object is looked at while it is pulled."""

_DEXGRASPBENCH = PullProtocol("dexgraspbench", 10.0, 0.1, 0.0, 0.6, 0.02 / 0.6, 2.0, 0.05, math.radians(15), 5.0)
PROTOCOLS = {
    "multidex": PullProtocol("multidex", 0.5, None, 500.0, 3.0, 0.0, 1.0, 0.02, math.inf, None),
    "dexgraspbench": _DEXGRASPBENCH,
    "dexgraspbench-hard": dataclasses.replace(
        _DEXGRASPBENCH, name="dexgraspbench-hard", friction=0.3, patch=0.002 / 0.3
    ),
    "pose-noise": dataclasses.replace(_DEXGRASPBENCH, name="pose-noise", shift=0.005, turn=math.radians(5), draws=20),
}
"""By name: MultiDex as D(R,O) runs it (arXiv 2410.01702), DexGraspBench's force-closure test for floating objects
(as of BODex, arXiv 2412.16490), the same with halved friction as in Dexonomy (arXiv 2504.18829), and the same with the
hand put down beside where it was planned, by as much as in Get a Grip (CoRL 2024)."""


@dataclasses.dataclass(frozen=True)
class PullResult(Value):
    """What became of one grasp under a protocol.

    `passed` tells whether all six directions did; `directions` counts those tried until the first failure; `moved` [m]
    and `turned` [rad] are the largest of them; `force` [N] is the fingers' mean normal force before the first pull, NaN
    where the hand never closed; `seconds` is CPU time.
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
    force: float = 7.0,
    closing: ClosingMode = "open_loop",
    seed: int = 0,
    *,
    holding: HoldingMode = "force",
    error: Float[Tensor, "4 4"] | None = None,
    belief: ShapeGP | None = None,
    parts: "Sequence[trimesh.Trimesh] | None" = None,
    simulator: Simulator = "sapien",
) -> PullResult:
    """Close a hand on the true object and pull at the object in six directions.

    Args:
        grasp: one row.
        hand: the hand that it was planned for.
        mesh: the true object [m], closed: a trimesh or a file.
        protocol: one of `PROTOCOLS` by name, or another.
        force: normal force of the strongest finger [N] in the squeeze.
        closing: how the hand closes, at 100 Hz: through its three poses, or by one of the controllers (`CLOSINGS`).
        seed: of the noise of the fingertips that the controllers feel with.
        holding: how it presses from then on, but for the open loop, which keeps its squeeze (`HOLDINGS`).
        error: where the hand really stands in its planned frame (`misplace`), of which it knows nothing.
        belief: the shape that the grasp was planned on, which touches revise while the hand closes (`close_hand`), in
            each direction anew; None: they do not.
        parts: convex bodies to use for the mesh instead of its own decomposition.
        simulator: "sapien" or "mujoco".

    Raises:
        BadArgument: an unknown protocol, closing, holding or simulator, a force outside (0, 1000) N, not exactly one
            row, a grasp of another hand, a pre-grasp outside the joint limits, or a belief for a closing that does not
            follow the law (Eq. 25).
        MeshError: the mesh is missing, open or without volume.
        MissingExtra: the simulator is not installed.
    """
    began = time.process_time()
    protocol = check_test(protocol, force, closing, holding)
    check_modes(closing, holding, belief)
    check_simulator(simulator)
    if len(grasp) != 1:
        raise BadArgument("grasp", f"{len(grasp)} rows", "exactly one: index the grasps, as in grasps[0]")
    grasp, hand = grasp.to("cpu", torch.float64), hand.to("cpu", torch.float64)
    hand.check_joints(grasp.pregrasp)
    reference = ClosingReference.from_grasp(hand, grasp, force, protocol.kp)
    mesh = read_mesh(mesh)
    bodies = convex_parts(mesh) if parts is None else check_parts(parts)
    stands = grasp.obj_from_hand[0] if error is None else grasp.obj_from_hand[0] @ error.double()
    trial = _Pull(grasp, mesh, bodies, protocol, stands, closing, holding, reference, belief, seed, simulator)
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


def check_test(protocol: PullProtocol | str, force: float, closing: str, holding: str = "force") -> PullProtocol:
    """Return the protocol, by its name or as it is, after checking what a test is asked for.

    Raises:
        BadArgument: an unknown protocol, closing or holding, or a force outside (0, 1000) N.
    """
    if isinstance(protocol, str) and protocol not in PROTOCOLS:
        raise BadArgument("protocol", repr(protocol), f"one of {', '.join(PROTOCOLS)}")
    check_modes(closing, holding)
    if not 0.0 < force < 1e3:
        raise BadArgument("force", force, "a number in (0, 1000) [N]")
    return PROTOCOLS[protocol] if isinstance(protocol, str) else protocol


class _Pull:
    """One grasp under one protocol: a fresh scene for each direction, so that no run depends on another."""

    def __init__(
        self,
        grasp: Grasps,
        mesh: "trimesh.Trimesh",
        parts: "list[trimesh.Trimesh]",
        protocol: PullProtocol,
        stands: Float[Tensor, "4 4"],
        closing: ClosingMode,
        holding: HoldingMode,
        reference: ClosingReference,
        belief: ShapeGP | None,
        seed: int,
        simulator: Simulator,
    ) -> None:
        self.simulator: Simulator = simulator
        hand = reference.hand
        self.hand, self.mesh, self.parts, self.protocol = hand, mesh, parts, protocol
        self.closing: ClosingMode = closing
        self.holding: HoldingMode = holding
        self.stands = stands.numpy()
        self.reference, self.belief, self.seed = reference, belief, seed
        self.mass = protocol.density * float(mesh.volume) if protocol.mass is None else protocol.mass
        self.start = {name: float(q) for name, q in hand.expand(grasp.pregrasp[0]).items()}
        self.drives = hand.actuators
        if protocol.kp is not None:
            self.drives = {name: drive._replace(kp=protocol.kp) for name, drive in self.drives.items()}

    def run(self, direction: np.ndarray) -> tuple[tuple[Status, float, float], float]:
        """Close, pull along one direction, and return status, motion [m], turn [rad] and the mean force [N] before."""
        rule = self.protocol
        setup = SceneSpec(
            self.hand.urdf_path, self.stands, self.start, self.drives, tuple(self.hand.tip_links), self.mesh,
            self.parts, self.mass, rule.friction, 0.0, TIMESTEP, 0.0, table=False, patch=rule.patch,
        )  # fmt: skip
        scene = open_scene(setup, self.simulator)
        if not scene.penetration() <= rule.overlap:
            return (Status.START_OVERLAP, 0.0, 0.0), math.nan
        generator = torch.Generator().manual_seed(self.seed)
        robot = SimulatedHand(scene, self.reference, CONTROL_RATE, generator)
        before, far = scene.object_pose(), (0.0, 0.0)
        hold = self._close(robot)
        force = float(robot.force.mean())
        status = self._judge(scene, before)
        if status[0] is not Status.OK:
            return (Status.EJECTED if status[0] is Status.MOVED else status[0], *status[1:]), force
        scene.pull(rule.pull * self.mass * direction)
        for _ in range(round(rule.seconds / CHECK_SECONDS)):
            for _ in range(robot.ticks(CHECK_SECONDS)):
                hold()
            status = self._judge(scene, before)
            far = (max(far[0], status[1]), max(far[1], status[2]))
            if status[0] is not Status.OK:
                break
        return (status[0], *far), force

    def _close(self, robot: SimulatedHand) -> Callable[[], None]:
        """Close the hand and return what holds it closed for one tick more."""
        controller = GraspController(robot.reference, self.closing, self.holding, self.belief)
        observation = robot.tick(controller.targets)

        def go_on() -> None:
            """Let the controller act for a tick."""
            nonlocal observation
            observation = robot.tick(controller.step(observation, robot.period))

        while not controller.closed:
            go_on()
        return go_on

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
