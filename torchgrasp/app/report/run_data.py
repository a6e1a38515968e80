"""The data of one run, from cloud to grasps and closing, and its results in words."""

import dataclasses
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.app.report.canvas import ALARM, INK
from torchgrasp.cloud.agreement import check_contacts
from torchgrasp.evaluation.causes import moved_in_hand, tick_of
from torchgrasp.evaluation.criterion import SLIP_ANGLE, SLIP_DISTANCE
from torchgrasp.evaluation.lift import LIFT_TIME, PUSHED_DISTANCE
from torchgrasp.foundation.base import count_status, flatnonzero
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.geometry.frames import apply, inverse, real
from torchgrasp.geometry.linalg import norm
from torchgrasp.geometry.plane import move, upright_frame, upright_table
from torchgrasp.hand.hand import Hand
from torchgrasp.planner.explain import Explanation
from torchgrasp.scene.scene import Scene
from torchgrasp.shape.second_view import NextView
from torchgrasp.shape.surface import Surface
from torchgrasp.values.closing import ClosureResult
from torchgrasp.values.planning import ContactPlan, Grasps, PointCloud
from torchgrasp.values.specs import ContactSpec

LOST = "lost"  # name of the moment at which an object was lost
CREEP = 0.01  # fingertips that stick slide more slowly than this [m/s]


@checked
@dataclasses.dataclass(frozen=True)
class Run:
    """The inputs and results of one planning run, for `write_report`, `write_viewer` and others.

    Cloud, surface, grasps, mesh and scene are in one frame, in metres.

    Args:
        object_name: name of the object in titles and sentences.
        source: file of the cloud or the scene.
        cloud: the cloud that was planned on.
        hand: the hand of the grasps.
        spec: the constraints on contacts, such as the table and the friction.
        surface: the estimated surface of the object.
        grasps: all grasps of the plan, failed ones included, best first.
        stages: name, result in words and wall time [s] of each stage.
        plan: the contacts that were planned; None if they are unknown.
        mesh: the true object [m]; None if it is unknown.
        closure: result of `close_hand` for the first executable grasp on `mesh`; None without a
            closing.
        scene: the scene that the cloud was cut from; None without a scene.
        explanation: why no grasp is executable, and what would help; None if it is not asked for.
        costs: sentences on what lowers the predicted success of the best grasp most, such as those
            of `explain_success`.
        look: where a second view would help (`next_view`); None if no second view is needed.
        command: the command line of the run, or "".
        date: date and time of the run as text, or "".
    """

    object_name: str
    source: Path
    cloud: PointCloud
    hand: Hand
    spec: ContactSpec
    surface: Surface
    grasps: Grasps
    stages: tuple[tuple[str, str, float], ...] = ()
    plan: ContactPlan | None = None
    mesh: "trimesh.Trimesh | None" = None
    closure: ClosureResult | None = None
    scene: Scene | None = None
    explanation: Explanation | None = None
    costs: tuple[str, ...] = ()
    look: NextView | None = None
    command: str = ""
    date: str = ""

    @property
    def executable(self) -> Grasps:
        """The grasps that passed every check, best first."""
        return self.grasps[self.grasps.status == Status.OK]

    @property
    def title(self) -> str:
        """The title of the run's pages, which names the object and the hand."""
        return f"Grasps of the {self.object_name} with the {self.hand.name} hand"

    @property
    def good(self) -> bool:
        """Whether the simulated closing held the object; without a closing, whether any grasp is
        executable.
        """
        return bool(self.closure.held) if self.closure is not None else len(self.executable) > 0

    def upright(self) -> "Run":
        """Return the run in a frame whose z axis points up.

        z is the normal of the table in `spec`, and the table has the height z = 0. Without a table,
        z points to the camera. Without both, it points where the points spread least.

        Raises `BadArgument` if the executable grasps do not touch the mesh. It is also raised if
        the table is above most points of the cloud.
        """
        obj_from_upright = upright_frame(self.cloud.points, self.cloud.viewpoint, self.spec.plane)
        upright_from_obj = inverse(obj_from_upright)
        mesh = self.mesh
        closure = self.closure
        if mesh is not None:
            check_contacts(self.executable, mesh)
            mesh = mesh.copy().apply_transform(upright_from_obj.numpy())
        if closure is not None:
            object_pose = upright_from_obj @ closure.object_pose.double() @ obj_from_upright
            hand_pose = upright_from_obj @ closure.hand_pose.double()
            closure = dataclasses.replace(closure, object_pose=object_pose, hand_pose=hand_pose)
        table = upright_table(self.spec.plane, obj_from_upright)
        grasps = move(self.grasps, upright_from_obj)
        known = self.grasps.table
        if known is not None:
            meta = grasps.meta | {"table": known.moved(upright_from_obj).describe()}
            grasps = dataclasses.replace(grasps, meta=meta)
        return dataclasses.replace(
            self,
            spec=dataclasses.replace(self.spec, table=table),
            cloud=move(self.cloud, upright_from_obj),
            surface=move(self.surface, upright_from_obj),
            grasps=grasps,
            mesh=mesh,
            closure=closure,
            scene=None if self.scene is None else self.scene.to_upright(obj_from_upright),
        )


def verdict(run: Run) -> str:
    """Return the result of a run in one sentence."""
    hand = run.hand.name
    name = run.object_name
    if run.closure is not None:
        return closing_sentence(run)
    count = len(run.executable)
    if count:
        grasps = "grasp" if count == 1 else "grasps"
        return f"The {hand} hand has {count} executable {grasps} of the {name}."
    advice = "" if run.explanation is None else f" {run.explanation.advice}"
    return refusal(run) + advice


def closing_sentence(run: Run) -> str:
    """Return one sentence with the result of the closing on the true object.

    If the object was held, it says how far it rose [m], and how it moved in the hand [mm, deg];
    otherwise why not.
    """
    upright = run.upright()
    closure = upright.closure
    mesh = upright.mesh
    assert closure is not None and mesh is not None
    if not closure.held:
        reason = closure.status.sentence
        return f"The {run.hand.name} hand did not hold the {run.object_name}: {reason}."
    centre = real([*mesh.center_mass, 1.0])
    rise = float((closure.object_pose[-1] - closure.object_pose[0])[2] @ centre)
    moved, angle = closure.object_motion
    return (
        f"The {run.hand.name} hand held the {run.object_name}: lifted {rise:.2f} m, "
        f"moved {1e3 * moved:.0f} mm and {math.degrees(angle):.0f} deg in the hand."
    )


def refusal(run: Run) -> str:
    """Return one sentence that says why no grasp is executable: each reason with its count."""
    head = f"The {run.hand.name} hand has no executable grasp of the {run.object_name}"
    if len(run.grasps):
        failed = run.grasps.status
        total = f"{len(run.grasps)} postures"
    elif run.plan is not None and not bool((run.plan.status == Status.OK).any()):
        failed = run.plan.status
        total = f"{len(run.plan)} starts"
    else:
        return f"{head}: {Status.OUT_OF_REACH.sentence}."
    counts = count_status(failed).items()
    reasons = "; ".join(f"{n} of {total}: {status.sentence}" for status, n in counts)
    return f"{head} ({reasons}){_too_low(run)}."


def _too_low(run: Run) -> str:
    """Return a remark if the object is too low for the hand's fingertips; "" otherwise."""
    spec = run.spec.for_fingertips(float(run.hand.tips.radius.max()))
    if spec.plane is None or not len(run.surface.vertices):
        return ""
    height = float(spec.plane.height(run.surface.vertices).max())
    needed = spec.least_height
    if height >= needed:
        return ""
    return f": it is {1e3 * height:.0f} mm high, and this hand needs {1e3 * needed:.0f} mm"


def mass_centre(mesh: "trimesh.Trimesh") -> Float[Tensor, "3"]:
    """Return the centre of mass [m] of a closed mesh."""
    return real(np.array(mesh.center_mass))


class Moment(NamedTuple):
    """A key moment of a closing: the index of its control tick, and its name in the film strip."""

    tick: int
    name: str

    @property
    def color(self) -> str:
        """The colour "#rrggbb" of the moment's title and line in the film strip."""
        return ALARM if self.name == LOST else INK


def touching(closure: ClosureResult) -> Bool[Tensor, "t f"]:
    """Return a mask (t, f) of the fingertips that touch the object at each of t control ticks."""
    return closure.trace.normals.isfinite().all(-1)


def first_touches(closure: ClosureResult) -> list[int]:
    """Return the index of the control tick at which each finger first touched the object.

    The order is that of `closure.contact_order`; fingers that never touched are left out.
    """
    touched = touching(closure)
    return [int(touched[:, finger].int().argmax()) for finger in closure.contact_order]


def find_loss(closure: ClosureResult, centre: Float[Tensor, "3"]) -> int | None:
    """Return the index of the control tick at which the object was lost; None if it was held.

    An object is lost if it was pushed away, put down, let go, or slipped too far. `centre` is its
    centre of mass [m] in the frame of the grasp, where z is up.
    """
    if closure.held:
        return None
    last = len(closure.time) - 1
    pressed = tick_of(closure, 2)
    if closure.status in (Status.START_OVERLAP, Status.UNSTABLE):
        return last
    if closure.status is Status.TOO_HEAVY:
        return int(closure.hand_pose[:, 2, 3].argmax())
    if closure.status is Status.EJECTED:
        middle = centre.double().expand(len(closure.time), 1, 3)
        world = apply(closure.object_pose.double(), middle)[:, 0]  # (t, 3)
        away = norm(world - world[0]) > PUSHED_DISTANCE
        return int(away.int().argmax()) if bool(away.any()) else last
    # else it slipped too far, or at most one finger still touched it: the earlier of both
    distance, angle = moved_in_hand(closure, centre)
    gone = (distance > SLIP_DISTANCE) | (angle > SLIP_ANGLE)
    gone[: pressed + 1] = False
    held = torch.nonzero(touching(closure).sum(1) >= 2)
    let_go = min(int(held[-1]) + 1, last) if len(held) else pressed
    return min(let_go, int(gone.int().argmax()) if bool(gone.any()) else last)


def explain_loss(
    closure: ClosureResult, centre: Float[Tensor, "3"], fingers: tuple[str, ...]
) -> str:
    """Return a sentence on when and in which phase the object was lost, and on the cause.

    The cause is the finger that failed first, or the status of the closing. `centre` is the
    object's centre of mass [m] in the frame of the grasp, where z is up; `fingers` are the names of
    the fingers. The text is "" if the object was held.
    """
    tick = find_loss(closure, centre)
    if tick is None:
        return ""
    pressed = tick_of(closure, 2)
    rises = bool(closure.phases[2].isfinite())
    time = float(closure.time[tick])
    start = float(closure.time[pressed])
    if not rises or tick <= pressed:
        phase = "closed"
    else:
        phase = "rose" if time < start + LIFT_TIME else "held it"
    absent = [name for k, name in enumerate(fingers) if k not in closure.contact_order]
    if absent:
        reason = f"{' and '.join(absent)} never touched the object"
    else:
        reason = _first_to_go(closure, tick, fingers)
    # these ends are no fault of a finger
    if closure.status in (Status.START_OVERLAP, Status.UNSTABLE, Status.TOO_HEAVY) or not reason:
        reason = closure.status.sentence
    lost = "Put down from" if closure.status is Status.TOO_HEAVY else "Lost at"
    return f"{lost} {time:.2f} s, while the hand {phase}: {reason}."


def _first_to_go(closure: ClosureResult, tick: int, fingers: tuple[str, ...]) -> str:
    """Return a text that names the finger that first slid or let go for good before a tick; "" if
    none did.
    """
    touched = touching(closure)[: tick + 1]
    sliding = closure.trace.sliding[: tick + 1].nan_to_num(0.0)
    firm = touched & (sliding < CREEP)
    # The first tick after which each finger was never firm again; the finger with the earliest gave
    # way first.
    ticks = [torch.nonzero(column) for column in firm.T]
    since = [int(found[-1]) + 1 if len(found) else 0 for found in ticks]
    finger = min(range(len(since)), key=since.__getitem__)
    begin = since[finger]
    if begin > tick:
        return ""
    name = fingers[finger]
    time = float(closure.time[begin])
    if not bool(touched[begin, finger]):
        return f"{name} let go first, at {time:.2f} s"
    force = closure.trace.forces[begin, finger]
    normal = closure.trace.normals[begin, finger]
    press = float((force @ normal).abs())
    across = float(torch.linalg.vector_norm(force - (force @ normal) * normal))
    loads = f"under {across:.1f} N across at {press:.1f} N of normal force"
    return f"{name} slid first, from {time:.2f} s on, {loads}"


def moments_of(
    closure: ClosureResult, centre: Float[Tensor, "3"], fingers: tuple[str, ...]
) -> list[Moment]:
    """Return the key moments that the film strip of a closing shows, in the order of time.

    `centre` is the object's centre of mass [m] in the frame of the grasp, where z is up; `fingers`
    are the names of the fingers.
    """
    found = [Moment(tick_of(closure, 0), "open hand")]
    if closure.contact_order:
        first = fingers[closure.contact_order[0]]
        found.append(Moment(first_touches(closure)[0], f"{first} touches first"))
    # each closing begins where the control of the forces begins to act
    acts = torch.cat([torch.zeros(1, dtype=torch.bool), closure.trace.blend.isfinite().any(1)])
    begins = flatnonzero(acts[1:] & ~acts[:-1])
    if closure.attempts == len(begins) > 1:
        found.append(Moment(int(begins[-1]), f"closing {len(begins)} begins"))
    all_touch = len(closure.contact_order) == len(fingers)
    ends = ((1, "all touch" if all_touch else "the closing ends"), (2, "pressed"))
    for k, name in ends:
        if bool(closure.phases[k].isfinite()):
            found.append(Moment(tick_of(closure, k), name))
    lost = find_loss(closure, centre)
    if lost is not None:
        found.append(Moment(lost, LOST))
    found.append(Moment(len(closure.time) - 1, "the end"))
    # of two at one tick, the later is kept
    found.sort(key=lambda moment: (moment.tick, moment.name == LOST))
    later = [*(moment.tick for moment in found[1:]), len(closure.time)]
    return [m for m, tick in zip(found, later, strict=True) if m.tick < tick]
