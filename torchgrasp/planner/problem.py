"""The planning problem: values derived from the arguments of `plan_grasps`, in an upright frame."""

import dataclasses
import functools
import hashlib
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.arm.reach import reach_poses, with_arm
from torchgrasp.cloud.check import FEW_POINTS, remove_duplicates
from torchgrasp.cloud.neighbours import is_flat
from torchgrasp.contacts.region import seen_from
from torchgrasp.contacts.starts import (
    FlatCandidates,
    check_starts,
    drawn_starts,
    settle_flatness,
    start_chunks,
)
from torchgrasp.files import sha256
from torchgrasp.foundation.base import settle
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Seed
from torchgrasp.geometry.frames import inverse
from torchgrasp.geometry.plane import move, round_upright, upright_frame
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.candidates import Reachable, ask_reachable
from torchgrasp.ik.clearance import CollisionWorld, Obstacles
from torchgrasp.ik.motion import lift_clearance
from torchgrasp.planner.request import Request
from torchgrasp.planner.schedule import TRIED, TRIED_IN_SCENE, BatchSize, schedule
from torchgrasp.posture_model.mixture import GraspMixture, load_mixture, mixture_path
from torchgrasp.scene.occupancy import estimate_occupancy
from torchgrasp.scene.scene import Scene
from torchgrasp.shape.completion.silhouette import silhouettes
from torchgrasp.shape.fit import FitOptions, fit_upright
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import Mesh, collision_field, extract_mesh
from torchgrasp.success.body import EstimatedBody
from torchgrasp.success.promise import describe_promise
from torchgrasp.success.task import loads_of
from torchgrasp.values.planning import Grasps, PointCloud
from torchgrasp.values.specs import ContactSpec

TARGET_POINTS = (
    1000  # most points of a scene's target that are used: they lie a few millimetres apart
)


@dataclasses.dataclass(frozen=True)
class Problem:
    """The planning problem of one hand: object, shape, constraints and obstacles in the upright
    frame.

    The upright frame has the table's normal as z axis. `request`, the object's `cloud` and
    `given_spec` are in the caller's frame, all other fields in the upright frame. Derived values
    are computed when first used. `descends` allows hands that go down while they close. `postures`
    is the size of the posture library.
    """

    request: Request
    hand: Hand
    cloud: PointCloud
    given_spec: ContactSpec
    obj_from_upright: Float[Tensor, "4 4"]
    shape: ShapeGP
    scene: Scene | None
    mixture: GraspMixture | None
    mixture_sha256: str
    descends: bool = False
    postures: int | None = None

    @classmethod
    def of(cls, request: Request, hand: Hand) -> "Problem":
        """Find the object of a request, its upright frame and its shape; return the planning
        problem of the hand.
        """
        cloud = request.cloud
        spec = request.contact_spec
        scene = None
        if isinstance(cloud, Scene):
            scene = cloud
            cloud = take_target(cloud, request.seed)
            spec = dataclasses.replace(
                spec, table=scene.table if spec.table is None else spec.table
            )
        cloud = remove_duplicates(cloud)
        mixture = None
        mixture_sha256 = "none"
        if request.mode != "joint":
            folder = request.hand.urdf_path.parent
            own = (
                folder / "paper.safetensors"
            )  # of postures of all sizes alike, so that Eq. (21) knows small objects
            path = own if request.mode == "paper" and own.is_file() else mixture_path(folder)
            mixture = load_mixture(path)
            mixture_sha256 = sha256(path)
        frame = upright_frame(cloud.points, cloud.viewpoint, spec.plane)
        if request.shape is None:
            options = FitOptions(support="paper" if request.mode == "paper" else "camera")
            table = None if spec.table is None else 0.0
            shape = fit_upright(round_upright(cloud, frame), request.seed, table, options)
        else:
            shape = request.shape.moved(inverse(frame))
        scene = None if scene is None else scene.to_upright(frame)
        mixture = None if mixture is None else mixture.to(shape.device)
        return cls(
            request,
            settle_hand(hand, shape.device),
            cloud,
            spec,
            frame,
            shape,
            scene,
            mixture,
            mixture_sha256,
        )

    def prepared(self) -> "Problem":
        """Return this problem after the values that stages need were computed; raise `BadArgument`
        as they do.
        """
        _ = self.drawn, self.body, self.vague
        return self

    def for_request(self, request: Request, hand: Hand, postures: int) -> "Problem":
        """Return the problem of another request on the same object and table, with a small library
        of `postures`.
        """
        spec = dataclasses.replace(request.contact_spec, table=self.given_spec.table)
        new = {"request": request, "hand": settle_hand(hand, self.shape.device), "given_spec": spec}
        dropped = "flat", "drawn", "batches", "obstacles", "world", "buried", "reachable", "loads"
        return self.replace(*dropped, postures=postures, **new)

    def replace(self, *dropped: str, **changes: Any) -> "Problem":
        """Return the problem with changed fields; it keeps all derived values except those
        `dropped`.
        """
        problem = dataclasses.replace(self, **changes)
        vars(problem).update(
            (name, x) for name, x in vars(self).items() if name not in (*changes, *dropped)
        )
        return problem

    @cached_property
    def flat(self) -> FlatCandidates:
        """The contact constraints, with the radius on which a contact must be flat, and the flat
        candidate contacts.
        """
        table = None if self.given_spec.table is None else 0.0
        region = self.given_spec.region
        spec = dataclasses.replace(
            self.given_spec, table=table, region=seen_from(region, self.obj_from_upright)
        )
        check_starts(self.shape, spec, self.request.starts)
        tips = self.hand.tips
        spec = dataclasses.replace(
            spec.for_fingertips(float(tips.radius.max())), fingertips=len(tips)
        )
        return settle_flatness(self.shape, spec, self.request.seed)

    @cached_property
    def batches(self) -> list[BatchSize]:
        """The batches of the plan; only mode "joint" has more than one."""
        most = TRIED if self.scene is None else TRIED_IN_SCENE
        request = self.request
        return (
            schedule(request.starts, most)
            if request.mode == "joint"
            else [BatchSize(request.starts, most)]
        )

    def draw(self) -> Iterator[Float[Tensor, "_ f 3"]]:
        """Yield the initial guesses of all batches, in chunks (`start_chunks`)."""
        sizes = (size for batch in self.batches for size in start_chunks(batch.starts))
        return drawn_starts(self.shape, self.flat, sizes, self.request.seed)

    @cached_property
    def drawn(self) -> Float[Tensor, "s f 3"]:
        """The initial guesses of all batches."""
        return torch.cat(list(self.draw()))

    @property
    def spec(self) -> ContactSpec:
        """The constraints on the contacts of this hand's fingertips, in the upright frame (z points
        up).
        """
        return self.flat.spec

    @cached_property
    def surface(self) -> Mesh:
        """The estimated surface, as a mesh."""
        return extract_mesh(self.shape)

    @cached_property
    def body(self) -> EstimatedBody:
        """The estimated body, with its distance field."""
        return EstimatedBody.around(
            self.shape, self.surface.vertices, collision_field(self.shape, self.surface)
        )

    @property
    def center(self) -> Float[Tensor, "3"]:
        """The centre [m] of the estimated surface: the mean of its vertices."""
        return self.surface.vertices.mean(0)

    @cached_property
    def vague(self) -> bool:
        """Whether the cloud hardly shows the object: few points, one plane, or a part beyond the
        image border.
        """
        cloud = self.cloud
        cut = (
            cloud.frustum is not None
            and cloud.viewpoint is not None
            and silhouettes(cloud.to("cpu")).cut
        )
        return cut or len(cloud) < FEW_POINTS or is_flat(cloud.points)

    @cached_property
    def obstacles(self) -> Obstacles | None:
        """The obstacles around the target of a scene, or None if the request has no scene."""
        scene = self.scene
        if scene is None or scene.target is None:
            return None
        return Obstacles.of(
            estimate_occupancy(scene, scene.target), hard=not self.spec.contact_allowed
        )

    @cached_property
    def world(self) -> CollisionWorld:
        """The object, table and obstacles that the hand's links must not touch, as distance fields."""
        return CollisionWorld(self.body.field, self.spec.plane, self.obstacles)

    @cached_property
    def buried(self) -> bool:
        """Whether obstacles prevent lifting: the rising object would enter them over 3 mm deeper
        than at rest.
        """
        if self.obstacles is None or not self.obstacles.hard:
            return False
        standing = float(self.obstacles.field.query(self.surface.vertices)[0].min())
        return lift_clearance(self.surface.vertices, self.obstacles) < min(standing, 0.0) - 0.003

    @cached_property
    def loads(self) -> Float[Tensor, "w 6"] | None:
        """The wrenches [N, N m] about the origin that grasps must resist; None if the request names
        none.
        """
        resist = self.request.resist
        mass = self.request.grasp_task.mass
        upright = inverse(self.obj_from_upright).to(self.body.center)
        table = self.spec.plane is not None
        return None if resist is None else loads_of(resist, mass, self.body.center, upright, table)

    @cached_property
    def reachable(self) -> Reachable | None:
        """The function that says which hand poses the arm and the user's function accept, in the
        upright frame.
        """
        given = self.request.reachable
        arm = self.request.arm
        frame = self.obj_from_upright
        asked = [x for x in (given, arm and functools.partial(reach_poses, arm)) if x is not None]
        if not asked:
            return None
        return lambda poses: torch.stack(
            [ask_reachable(x, frame.to(poses) @ poses) for x in asked]
        ).all(0)

    def on_arm(self, grasps: Grasps) -> Grasps:
        """Return grasps with the postures of the arm, if there is one; those that it cannot reach
        have failed.
        """
        if (arm := self.request.arm) is None:
            return grasps
        arm = settle(arm.moved(inverse(self.obj_from_upright)), self.shape.device)
        return with_arm(
            arm, self.hand, grasps, self.world, self.obj_from_upright[2, :3]
        )  # the caller's z axis

    def tell(self, stage: str, message: str, value: Any) -> None:
        """Report a stage to the observer, with the result of the stage in the caller's frame."""
        if self.request.observer is not None:
            self.request.observer(stage, message, self._moved(value))

    def give_back(self, grasps: Grasps) -> Grasps:
        """Return grasps in the caller's frame; their metadata name the frames, units and inputs of
        the plan.
        """
        hand = self.hand
        spec = self.given_spec
        request = self.request
        meta = {
            "hand": hand.name,
            "hand_sha256": hand.source.sha256,
            "cloud_sha256": digest(self.cloud),
            "joint_names": ",".join(hand.joint_names),
            "finger_names": ",".join(hand.finger_names),
            "frames": "obj: the frame of the cloud; hand: the base link of the hand's URDF; a_from_b maps b into a",
            "units": "metre, radian",
            "unit_m": repr(float(self.shape.scale)),
            "friction": f"{spec.friction:g}",
            "planned_friction": f"{spec.planned_friction:g}",
            "table": "none" if spec.plane is None else spec.plane.describe(),
            "mode": request.mode,
            "ranking": request.order,
            "task": request.grasp_task.describe(),
            "promise": "none" if request.promise is None else describe_promise(request.promise),
            "mixture_sha256": self.mixture_sha256,
            "seed": str(request.seed),
        }
        if request.resist is not None:
            meta["resist"] = f"{request.resist} with {request.grasp_task.mass:g} kg"
        return dataclasses.replace(self._moved(grasps), meta=grasps.meta | meta)

    def _moved(self, value: Any) -> Any:
        """Return a value of any type, converted from the upright frame to the caller's frame."""
        frame = self.obj_from_upright
        return value.moved(frame) if isinstance(value, ShapeGP) else move(value, frame)


def settle_hand(hand: Hand, device: torch.device) -> Hand:
    """Return the hand on a device; the hand caches a copy on another device, with the caches of the
    copy.
    """
    if hand.lower.device != device and device not in hand.derived:
        hand.derived[device] = hand.to(device)
    return hand.derived.get(device, hand)


@checked
def take_target(scene: Scene, seed: Seed) -> PointCloud:
    """Return at most `TARGET_POINTS` random points of a scene's target, which must be the label of
    an object.
    """
    if scene.target not in scene.things:
        raise BadArgument(
            "target", scene.target, f"one of the labels {list(scene.things)}: scene.select(label)"
        )
    cloud = scene.cloud()
    generator = torch.Generator().manual_seed(seed)
    rows = (
        torch.randperm(len(cloud), generator=generator, device="cpu")[:TARGET_POINTS].sort().values
    )
    return cloud.select(rows.to(cloud.points.device))


def digest(cloud: PointCloud) -> str:
    """Return the SHA-256 of a cloud's points; grasps store it to identify the cloud that they were
    planned on.
    """
    return hashlib.sha256(
        cloud.points.detach().cpu().double().contiguous().numpy().tobytes()
    ).hexdigest()
