"""A run from cloud to grasps and closing, and its verdict in words."""

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from torchgrasp.base import count_status
from torchgrasp.checks import checked
from torchgrasp.closure import ClosureResult
from torchgrasp.errors import Status
from torchgrasp.geometry.frames import inverse
from torchgrasp.geometry.plane import move, upright_frame
from torchgrasp.hand.hand import Hand
from torchgrasp.planner.explain import Explanation
from torchgrasp.scene.scene import Scene
from torchgrasp.shape.surface import Surface
from torchgrasp.specs import ContactSpec
from torchgrasp.values import ContactPlan, Grasps, PointCloud

if TYPE_CHECKING:
    import trimesh


@checked
@dataclasses.dataclass(frozen=True)
class Run:
    """Everything that a report shows.

    Args:
        object_name: name of the object in titles and sentences.
        source: file of the cloud or the scene.
        cloud: points of the object.
        hand: the hand that grasps.
        spec: what was asked of the contacts.
        surface: the estimated surface.
        grasps: the planned grasps, best first.
        stages: name, result and wall time [s] of each stage.
        plan: planned contacts.
        mesh: the true object [m], in the frame of the cloud.
        closure: the closing on the true object; with a mesh only.
        scene: the scene that the cloud was cut from.
        explanation: why no grasp is executable.

    >>> from torchgrasp import fit_shape, load_hand, load_object
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> from torchgrasp.shape import extract_surface
    >>> view, hand, grasp = load_object("jug").view, load_hand("barrett"), load_shipped_grasp("jug", "barrett")
    >>> surface = extract_surface(fit_shape(view), 24)
    >>> verdict(Run("jug", Path("jug.ply"), view, hand, ContactSpec(), surface, grasp).upright())
    'The barrett hand has 1 executable grasp of the jug.'
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

    @property
    def executable(self) -> Grasps:
        """The grasps that passed every check, best first."""
        return self.grasps[self.grasps.status == Status.OK]

    def upright(self) -> "Run":
        """Return the run in the upright frame of its cloud and table, where z is up."""
        obj_from_upright = upright_frame(self.cloud.points, self.cloud.viewpoint, self.spec.plane)
        upright_from_obj, mesh, closure = inverse(obj_from_upright), self.mesh, self.closure
        if mesh is not None:
            mesh = mesh.copy().apply_transform(upright_from_obj.numpy())
        if closure is not None:
            object_pose = upright_from_obj @ closure.object_pose.double() @ obj_from_upright
            hand_pose = upright_from_obj @ closure.hand_pose.double()
            closure = dataclasses.replace(closure, object_pose=object_pose, hand_pose=hand_pose)
        return dataclasses.replace(
            self,
            cloud=move(self.cloud, upright_from_obj),
            surface=move(self.surface, upright_from_obj),
            grasps=move(self.grasps, upright_from_obj),
            mesh=mesh,
            closure=closure,
            scene=None if self.scene is None else self.scene.to_upright(obj_from_upright),
        )


def verdict(run: Run) -> str:
    """Return the result of a run in one sentence."""
    hand, name = run.hand.name, run.object_name
    if run.closure is not None:
        return closing_sentence(run)
    if count := len(run.executable):
        return f"The {hand} hand has {count} executable grasp{'s' * (count > 1)} of the {name}."
    return refusal(run) + ("" if run.explanation is None else f" {run.explanation.advice}")


def closing_sentence(run: Run) -> str:
    """Say whether the object was held, the rise of its centre of mass, and its motion in the hand."""
    upright = run.upright()
    closure, mesh = upright.closure, upright.mesh
    assert closure is not None and mesh is not None
    if not closure.held:
        return f"The {run.hand.name} hand did not hold the {run.object_name}: {closure.status.sentence}."
    centre = torch.tensor([*mesh.center_mass, 1.0], dtype=torch.float64)
    rise = float((closure.object_pose[-1] - closure.object_pose[0])[2] @ centre)
    moved, angle = closure.object_motion
    return (
        f"The {run.hand.name} hand held the {run.object_name}: lifted {rise:.2f} m, "
        f"moved {1e3 * moved:.0f} mm and {math.degrees(angle):.0f} deg in the hand."
    )


def refusal(run: Run) -> str:
    """Say why no grasp is executable: each reason with its number of postures or initial guesses."""
    head = f"The {run.hand.name} hand has no executable grasp of the {run.object_name}"
    if len(run.grasps):
        failed, total = run.grasps.status, f"{len(run.grasps)} postures"
    elif run.plan is not None and not bool((run.plan.status == Status.OK).any()):
        failed, total = run.plan.status, f"{len(run.plan)} starts"
    else:
        return f"{head}: {Status.OUT_OF_REACH.sentence}."
    reasons = "; ".join(f"{n} of {total}: {status.sentence}" for status, n in count_status(failed).items())
    return f"{head} ({reasons}){_too_low(run)}."


def _too_low(run: Run) -> str:
    """Return the height that the hand's fingertips need on the table, if the object is lower."""
    spec = run.spec.for_fingertips(float(run.hand.tips.radius.max()))
    if spec.plane is None or not len(run.surface.vertices):
        return ""
    height, needed = float(spec.plane.height(run.surface.vertices).max()), spec.least_height
    return f": it is {1e3 * height:.0f} mm high, and this hand needs {1e3 * needed:.0f} mm" * (height < needed)
