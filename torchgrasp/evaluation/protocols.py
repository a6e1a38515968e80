"""One grasp put to one protocol, whether that pulls at the object or lifts it: what was asked, what became of it."""

import dataclasses
import math
import time
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.errors import BadArgument, Status
from torchgrasp.evaluation.lift import close_hand
from torchgrasp.evaluation.pose_noise import draw_object_poses, draw_pose_errors, error_from_object_pose
from torchgrasp.evaluation.pull import PROTOCOLS as PULLS
from torchgrasp.evaluation.pull import TIMESTEP, PullProtocol, check_test, pull_grasp
from torchgrasp.hand.hand import Hand
from torchgrasp.sim.open import open_scene
from torchgrasp.sim.scene import SceneSpec
from torchgrasp.specs import ClosingMode, HoldingMode, Simulator, TrialSpec, check_simulator
from torchgrasp.values import Grasps

if TYPE_CHECKING:
    import trimesh


@dataclasses.dataclass(frozen=True)
class LiftProtocol(Value):
    """A test that lifts a grasped object off a table and holds it; the object must be up at the end.

    Args:
        name: of the protocol.
        trial: friction, mass, gravity, lift, hold and shaking; how the hand closes is no part of it (`Execution`).
        shift: largest error of where the object stands along each of the table's axes [m].
        turn: largest error of its orientation about the vertical [rad].
        draws: how many such errors are drawn for each grasp.
    """

    name: str
    trial: TrialSpec
    shift: float = 0.0
    turn: float = 0.0
    draws: int = 1

    @property
    def friction(self) -> float:
        """Of every contact."""
        return self.trial.friction


Protocol = PullProtocol | LiftProtocol

PAPER = LiftProtocol("paper", TrialSpec(), shift=0.005, turn=math.radians(5))
"""The paper's lift (Sec. 6.5), with an error of where the object stands instead of the real robot's chance."""

PROTOCOLS: dict[str, Protocol] = {
    **PULLS,
    "paper": PAPER,
    "tabletop": LiftProtocol("tabletop", TrialSpec(friction=0.6, shake=0.003)),
}
"""By name: those that pull (`torchgrasp.evaluation.pull`); the paper's lift at friction 0.8; and a lift by 0.1 m at
friction 0.6 that is held for 2 s while the hand shakes."""


@dataclasses.dataclass(frozen=True)
class Execution(Value):
    """How a grasp is executed, whatever it is put to.

    Args:
        force: normal force of the strongest finger [N]; None: 7 where the object is pulled at, 4 where it is lifted.
        closing: how the hand closes; None: open loop where the object is pulled at, as the authors of those tests do,
            and under uncertainty where it is lifted.
        holding: how the hand presses from then on; the open loop keeps its squeeze.
        simulator: "sapien" or "mujoco".
    """

    force: float | None = None
    closing: ClosingMode | None = None
    holding: HoldingMode = "force"
    simulator: Simulator = "sapien"

    def on(self, protocol: Protocol) -> tuple[float, ClosingMode]:
        """Return force and closing for a protocol."""
        pulls = isinstance(protocol, PullProtocol)
        force = (7.0 if pulls else protocol.trial.force) if self.force is None else self.force
        return force, self.closing or ("open_loop" if pulls else "uncertainty")


@dataclasses.dataclass(frozen=True)
class ProtocolResult(Value):
    """What became of one grasp.

    `rank` is its row among the executable grasps of its view and `draw` the number of its drawn error of the hand's
    pose; `moved` [m] and `turned` [rad] tell how far the object moved, against the world where it was pulled at and
    against the hand where it was lifted; `force` [N] is the fingers' mean normal force and `overlap` [m] how deep the
    hand in its grasp pose is in the object before any of them moves; `seconds` is CPU time. What was never measured is
    NaN.
    """

    rank: int
    draw: int
    passed: bool
    status: Status
    moved: float
    turned: float
    force: float
    overlap: float
    seconds: float


def find_protocol(protocol: Protocol | str, execution: Execution) -> Protocol:
    """Return a protocol, by its name or as it is, after checking that it can be executed so.

    Raises:
        BadArgument: an unknown protocol, closing or simulator, or a force outside its range.

    >>> find_protocol("tabletop", Execution()).friction
    0.6
    """
    if isinstance(protocol, str):
        if protocol not in PROTOCOLS:
            raise BadArgument("protocol", repr(protocol), f"one of {', '.join(PROTOCOLS)}")
        protocol = PROTOCOLS[protocol]
    force, closing = execution.on(protocol)
    check_simulator(execution.simulator)
    if isinstance(protocol, PullProtocol):
        return check_test(protocol, force, closing, execution.holding)
    dataclasses.replace(protocol.trial, force=force, closing=closing, holding=execution.holding)  # checks itself
    return protocol


def run_protocol(
    grasp: Grasps,
    hand: Hand,
    mesh: "trimesh.Trimesh",
    parts: "list[trimesh.Trimesh]",
    protocol: Protocol,
    execution: Execution,
    seed: int = 0,
    *,
    error: Float[Tensor, "4 4"] | None = None,
) -> ProtocolResult:
    """Put one grasp to a protocol; see `pull_grasp` and `close_hand`."""
    began = time.process_time()
    force, closing = execution.on(protocol)
    grasp, hand = grasp.to("cpu", torch.float64), hand.to("cpu", torch.float64)
    overlap = grasp_overlap(grasp, hand, mesh, parts, error, execution.simulator)
    if isinstance(protocol, PullProtocol):
        pulled = pull_grasp(
            grasp, hand, mesh, protocol, force, closing, seed,
            holding=execution.holding, error=error, parts=parts, simulator=execution.simulator,
        )  # fmt: skip
        status, moved, turned, pressed = pulled.status, pulled.moved, pulled.turned, pulled.force
    else:
        given = {"holding": execution.holding, "simulator": execution.simulator}
        spec = dataclasses.replace(protocol.trial, force=force, closing=closing, **given)
        lifted = close_hand(grasp, hand, mesh, spec, seed, error=error, parts=parts)
        status, (moved, turned), pressed = lifted.status, lifted.object_motion, float(lifted.forces[-1].mean())
        pressed = math.nan if status is Status.START_OVERLAP else pressed
    spent = time.process_time() - began
    return ProtocolResult(0, 0, status is Status.OK, status, moved, turned, pressed, overlap, spent)


def draw_error(
    protocol: Protocol, grasp: Grasps, mesh: "trimesh.Trimesh", row: int, draw: int, seed: int
) -> Float[Tensor, "4 4"]:
    """Return where the hand really stands in its planned frame, in one draw for one row among a view's grasps.

    Pull tests put the hand down beside its plan, in the air; in a lift the object stands elsewhere on its table.
    """
    if isinstance(protocol, PullProtocol):
        return draw_pose_errors(protocol.shift, protocol.turn, row + 1, protocol.draws, seed)[row, draw]
    pivot = torch.tensor(mesh.center_mass.tolist(), dtype=torch.float64)
    places = draw_object_poses(protocol.shift, protocol.turn, pivot, (row + 1) * protocol.draws, seed)
    return error_from_object_pose(grasp.obj_from_hand[0].double(), places[row * protocol.draws + draw])


def grasp_overlap(
    grasp: Grasps,
    hand: Hand,
    mesh: "trimesh.Trimesh",
    parts: "list[trimesh.Trimesh]",
    error: Float[Tensor, "4 4"] | None = None,
    simulator: Simulator = "sapien",
) -> float:
    """Return how deep [m] the simulated hand in its grasp pose is in the true object, fingertips included."""
    stands = grasp.obj_from_hand[0] if error is None else grasp.obj_from_hand[0] @ error
    joints = {name: float(q) for name, q in hand.expand(grasp.joints[0]).items()}
    setup = SceneSpec(
        hand.urdf_path, stands.numpy(), joints, hand.actuators, tuple(hand.tip_links), mesh, parts,
        mass=0.1, timestep=TIMESTEP, table=False,
    )  # fmt: skip
    return open_scene(setup, simulator).penetration()
