"""The data of one run, from cloud to grasps and closing, and its results in words."""

import dataclasses
import math
from pathlib import Path

from torchgrasp.cloud.agreement import check_contacts
from torchgrasp.foundation.base import count_status
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.foundation.rules import Pose
from torchgrasp.geometry.frames import inverse
from torchgrasp.geometry.plane import move, upright_frame, upright_table
from torchgrasp.hand.hand import Hand
from torchgrasp.planner.explain import Explanation
from torchgrasp.scene.scene import Scene
from torchgrasp.shape.second_view import NextView
from torchgrasp.shape.surface import Surface
from torchgrasp.values.closing import ClosureResult
from torchgrasp.values.planning import ContactPlan, Grasps, PointCloud, format_success
from torchgrasp.values.specs import ContactSpec

VIEW = "view.html"
RECORDING = "run.rrd"
"""Names of the 3D page and of the recording of a run, beside its grasps."""
GRASP_COLUMNS = (
    "rank",
    "success",
    "tip error mm",
    "clearance mm",
    "pad angle deg",
    "closure margin",
    "surface std mm",
)
"""Titles of the columns of a table of grasps; errors, angles and standard deviations are those of
the worst finger.
"""


@checked
@dataclasses.dataclass(frozen=True)
class Run:
    """The inputs and results of one planning run, for `write_report`, `write_viewer` and others.

    Cloud, surface, grasps, mesh and scene are in one frame, that of the cloud, in metres.

    Args:
        object_name: name of the object in titles and sentences.
        source: file of the cloud or the scene.
        cloud: the cloud that was planned on.
        hand: the hand of the grasps.
        spec: the constraints on contacts, such as the table and the friction.
        surface: the estimated surface of the object.
        grasps: all grasps of the plan, best first, with those that failed a check.
        stages: name, result in words and wall time [s] of each stage.
        plan: the contacts that were planned; None if they are unknown.
        mesh: the true object [m]; None if it is unknown.
        closure: result of `close_hand` for the first executable grasp on `mesh`; None without a
            closing.
        scene: the scene that the cloud was cut from; None without a scene.
        explanation: why no grasp passed all checks, and what would help; None if it is not asked
            for.
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
        return self.grasps.executable

    @property
    def title(self) -> str:
        """The title of the run's pages, which names the object and the hand."""
        return f"Grasps of {self.named_object} with the {self.hand.name} hand"

    @property
    def named_object(self) -> str:
        """The object in a sentence: "the jug", or "object 4" of a scene, whose name is a number."""
        return self.object_name if self.scene is not None else f"the {self.object_name}"

    @property
    def good(self) -> bool:
        """Whether the simulated closing held the object, as `close_hand` defines it. Without a
        closing, it is whether any grasp passed all checks.
        """
        return bool(self.closure.held) if self.closure is not None else len(self.executable) > 0

    @property
    def obj_from_upright(self) -> Pose:
        """The pose (4, 4) [m] of the frame of `upright` in the frame of the cloud."""
        return upright_frame(self.cloud.points, self.cloud.viewpoint, self.spec.plane)

    def upright(self) -> "Run":
        """Return the run in a frame whose z axis points up.

        z is the normal of the table in `spec`, and the table has the height z = 0. Without a table,
        z points to the camera. Without both, z is the direction in which the points of the cloud
        spread least.

        Raises `BadArgument` if the `executable` grasps do not touch the mesh. It is also raised if
        the table is above most points of the cloud.
        """
        obj_from_upright = self.obj_from_upright
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
    """Return the result of a run in words: of the closing if there is one, else of planning.

    For planning, the text says how many grasps passed all checks. If none did, it says why, and
    what would help.
    """
    hand = run.hand.name
    if run.closure is not None:
        return closing_sentence(run)
    count = len(run.executable)
    if count:
        grasps = "grasp" if count == 1 else "grasps"
        return f"The {hand} hand has {count} executable {grasps} of {run.named_object}."
    advice = "" if run.explanation is None else f" {run.explanation.advice}"
    return refusal(run) + advice


def closing_sentence(run: Run) -> str:
    """Return one sentence with the result of the closing on the true object.

    The run must have a `closure`. If the object was held, the sentence states its rise [m] and its
    motion in the hand [mm, deg]. Otherwise it says why the object was not held.
    """
    closure = run.closure
    assert closure is not None
    if not closure.held:
        reason = closure.status.sentence
        return f"The {run.hand.name} hand did not hold {run.named_object}: {reason}."
    moved, angle = closure.object_motion
    return (
        f"The {run.hand.name} hand held {run.named_object}: lifted {closure.rise:.2f} m, "
        f"moved {1e3 * moved:.0f} mm and {math.degrees(angle):.0f} deg in the hand."
    )


def grasp_columns(grasps: Grasps) -> tuple[str, ...]:
    """Return the titles of the columns of a table of grasps, whose cells `grasp_rows` returns.

    These are rank, success, tip error [mm], clearance [mm], pad angle [deg], closure margin and
    surface standard deviation [mm]. For grasps planned for a task, "task margin" is the last.
    """
    return (*GRASP_COLUMNS, *["task margin"] * (grasps.certificate.task_margin is not None))


def grasp_rows(grasps: Grasps, most: int = 10) -> list[tuple[str, ...]]:
    """Return the cells of a table of the first `most` grasps as text, one tuple for each grasp.

    The cells are rank, success and others, in the order of `grasp_columns`. Errors, angles and
    standard deviations are those of the worst finger; "" means an unknown standard deviation.
    """
    rows = []
    for rank, grasp in enumerate(grasps[:most], 1):
        std_m = grasp.contacts.std_m
        task = grasp.certificate.task_margin
        row = [
            str(rank),
            format_success(grasp),
            f"{1e3 * float(grasp.tip_error[0].max()):.2f}",
            f"{1e3 * float(grasp.clearance[0]):.1f}",
            f"{math.degrees(float(grasp.normal_angle[0].max())):.0f}",
            f"{float(grasp.certificate.margin[0]):.4f}",
            "" if std_m is None else f"{1e3 * float(std_m[0].max()):.1f}",
        ]
        if task is not None:
            row.append(f"{float(task[0]):.2f}")
        rows.append(tuple(row))
    return rows


def refusal(run: Run) -> str:
    """Return one sentence that says why no grasp of a run passed all checks: each reason, and how
    many postures or initial guesses it ruled out.
    """
    head = f"The {run.hand.name} hand has no executable grasp of {run.named_object}"
    if len(run.grasps):
        failed = run.grasps.status
        total = f"{len(run.grasps)} postures"
    elif run.plan is not None and not (run.plan.status == Status.OK).any():
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
