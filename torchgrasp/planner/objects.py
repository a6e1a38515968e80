"""The objects of a plan: a batch of c objects, derived once, in three steps: seen, shaped, posed.

`ShapedObject.of` takes the first two steps, which know neither hand nor constraints. `pose` takes
the third step for one object: it adds the hand, the constraints, the initial guesses and the
obstacles. `join_objects` makes a batch of posed objects on one device. The upright frame of an
object has a z axis that points up.
"""

import dataclasses
import functools
import hashlib
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.arm.reach import reach_poses, with_arm
from torchgrasp.cloud.agreement import check_shape, warn_of_low_table
from torchgrasp.cloud.check import FEW_POINTS, remove_duplicates, warn_of_step
from torchgrasp.cloud.neighbours import Neighbours
from torchgrasp.cloud.surroundings import find_surroundings
from torchgrasp.contacts.problem import ContactProblem, ShapeLike, rows_of
from torchgrasp.contacts.region import seen_from
from torchgrasp.contacts.starts import (
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
from torchgrasp.geometry.field_batch import FieldBatch
from torchgrasp.geometry.frames import inverse
from torchgrasp.geometry.plane import Plane, move, round_upright, upright_frame, upright_table
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.candidates import GraspProblem, Reachable, ask_reachable
from torchgrasp.ik.clearance import CollisionWorld, Obstacles
from torchgrasp.ik.joint import JointProblem
from torchgrasp.ik.motion import lift_clearance
from torchgrasp.ik.seeds import PostureLibrary
from torchgrasp.planner.request import Request
from torchgrasp.planner.schedule import BatchSize, batch_sizes
from torchgrasp.posture_model.mixture import GraspMixture, load_mixture, mixture_path
from torchgrasp.scene.occupancy import estimate_occupancy
from torchgrasp.scene.scene import Scene
from torchgrasp.shape.batch import ShapeBatch
from torchgrasp.shape.completion.silhouette import silhouettes
from torchgrasp.shape.fit import FitOptions, fit_upright
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import Mesh, collision_field, extract_mesh
from torchgrasp.success.body import EstimatedBody
from torchgrasp.success.features import GRIP, weight_about
from torchgrasp.success.loads import squeezing_forces, squeezing_strength
from torchgrasp.success.promise import describe_promise
from torchgrasp.success.task import loads_of
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.planning import Certificate, Contacts, Grasps, PointCloud
from torchgrasp.values.specs import ContactSpec

TARGET_POINTS = 1000
"""Largest number of a scene target's points that are used: they lie a few millimetres apart."""
BURIED = 0.003
"""Depth [m] by which a rising object may enter obstacles further than at rest: noise of the grid.
"""

CloudIndex = Int[Tensor, "b"]
"""The index of the object (its cloud) to which each of b contact sets or grasps belongs."""


class LearnedModel(NamedTuple):
    """The learned posture model that a planning mode uses, a mixture of Gaussians. The mode "joint"
    uses none.
    """

    mixture: GraspMixture | None = None  # the model; None in the mode "joint"
    sha256: str = "none"  # SHA-256 of its file; "none" without a model


@dataclasses.dataclass(frozen=True)
class ShapedObject:
    """One object as the camera saw it, and its estimated shape, in an upright frame (z axis up).

    `cloud` and `scene` are what was seen. `cloud` and `table` (a plane, or a height [m] along z)
    are in the caller's frame. All else is in the upright frame. `obj_from_upright` [m] is the
    transform from the upright frame to the caller's. `shape` is the estimated shape, `surface` its
    mesh [m], and `body` the estimates from which success is predicted. `vague` says that the camera
    hardly saw the object. It saw few points, one plane, a part beyond the image border, or much of
    it behind another object. It is also so if the outline is a guess (`Scene.doubts`). `obstacles`
    surround a scene's target; None without a scene.
    """

    cloud: PointCloud
    scene: Scene | None
    table: Plane | float | None
    obj_from_upright: Float[Tensor, "4 4"]
    shape: ShapeGP
    surface: Mesh
    body: EstimatedBody
    vague: bool
    obstacles: Obstacles | None

    @classmethod
    def of(cls, request: Request) -> "ShapedObject":
        """Return the object of a planning request in its upright frame (z up), with its estimated
        shape.
        """
        # seen: the object's points, the table, and the frame in which z points up
        cloud = request.cloud
        spec = request.contact_spec
        scene = None
        if isinstance(cloud, Scene):
            scene = cloud
            cloud = take_target(scene, request.seed)
            if spec.plane is not None:  # it takes the place of the scene's own
                warn_of_low_table(cloud, spec.plane)
            spec = dataclasses.replace(
                spec, table=scene.table if spec.table is None else spec.table
            )
        cloud = remove_duplicates(cloud)
        warn_of_step(cloud.points)
        frame = upright_frame(cloud.points, cloud.viewpoint, spec.plane)
        # shaped: the Gaussian process, its surface and the distances from the surface
        upright = round_upright(cloud, frame)
        neighbours = Neighbours(upright.points.double())
        shape = request.shape
        if shape is None:
            options = FitOptions(support="paper" if request.mode == "paper" else "camera")
            floor = None if spec.table is None else 0.0
            in_image = scene is not None
            shape = fit_upright(upright, request.seed, floor, options, in_image, neighbours)
        else:
            shape = shape.moved(inverse(frame))
        surface = extract_mesh(shape)
        field = collision_field(shape, surface)
        if request.shape is not None:
            check_shape(field, move(cloud, inverse(frame)))
        body = EstimatedBody.around(shape, surface.vertices, field)
        # the surroundings of a scene's target
        obstacles = None
        vague = _is_vague(upright, neighbours)
        if scene is None:
            vague = vague or _is_surrounded(shape, spec.table is not None)
        else:
            vague = vague or bool(scene.covers) or bool(scene.doubts)
            scene = scene.to_upright(frame)
            if scene.target is not None:
                obstacles = Obstacles.of(estimate_occupancy(scene, scene.target))
        return cls(cloud, scene, spec.table, frame, shape, surface, body, vague, obstacles)


@dataclasses.dataclass(frozen=True)
class Objects:
    """A batch of c objects, each in its upright frame (z up), ready to be planned for one hand.

    The fields from `shape` on hold one value for each object, or the value of a single object.

    Args:
        request: the arguments of the plan.
        hand: the hand, on the device of the objects.
        given_spec: the constraints on contacts in the caller's frame.
        specs: the constraints on contacts of each object in its upright frame. Their radius within
            which a contact must be flat is a number, not None.
        each: the c objects with their shapes.
        sizes: the sizes of the plan's batches.
        starts: the s initial guesses of f contacts (s, f, 3) for each object, in normalised units.
        shape: the estimated shapes.
        constraints: the contact planning problem (`ContactProblem`), in normalised units.
        body: the bodies for predictions of success.
        world: what the hand must not touch, in the upright frame.
        loads: w loads of the task for each object (force [N], torque [N m] about the origin of the
            upright frame). None if grasps need not resist loads.
        model: the learned model of the mode.
        buried: whether obstacles prevent that the object is lifted.
        descends: whether the hand may move down while it closes.
        postures: size of the posture library; None means the default.
    """

    request: Request
    hand: Hand
    given_spec: ContactSpec
    specs: tuple[ContactSpec, ...]
    each: tuple[ShapedObject, ...]
    sizes: tuple[BatchSize, ...]
    starts: tuple[Float[Tensor, "s f 3"], ...]
    shape: ShapeLike
    constraints: ContactProblem
    body: EstimatedBody
    world: CollisionWorld
    loads: Float[Tensor, "c w 6"] | None
    model: LearnedModel
    buried: bool = False
    descends: bool = False
    postures: int | None = None

    def __len__(self) -> int:
        """Return the number of objects."""
        return len(self.each)

    @property
    def device(self) -> torch.device:
        """The device on which the objects are planned."""
        return self.body.center.device

    @property
    def spec(self) -> ContactSpec:
        """The constraints on contacts of the first object, in its upright frame.

        Those of the others differ only in the radius within which a contact must be flat.
        """
        return self.specs[0]

    @property
    def spec_without_margin(self) -> ContactSpec:
        """The constraints on contacts of the first object, but planned with the whole mean
        friction.

        Other constraints use only a share of it, their `friction_margin`; here it is 1.
        """
        return dataclasses.replace(self.spec, friction_margin=1.0)

    @property
    def strongest(self) -> float:
        """The greatest normal force [N] with which a finger presses in the task."""
        return self.request.grasp_task.pressing(self.lifts) or GRIP

    def strength(self, grasps: Grasps) -> Float[Tensor, "g"]:
        """Return how hard [N] the hand can squeeze in each of g grasps, at most `strongest`."""
        contacts = grasps.contacts
        forces = squeezing_forces(contacts)
        return squeezing_strength(self.hand, grasps, contacts, forces, self.strongest)

    @property
    def lifts(self) -> bool:
        """Whether the task lifts the objects."""
        return self.request.grasp_task.lifts(self.spec.plane)

    def weight_on(self, contacts: Contacts, cloud: CloudIndex) -> Float[Tensor, "b 6"]:
        """Return the weight of each contact set's object, as a wrench in the upright frame.

        It is a force [N], then a torque [N m] about the contacts' centroid. The mass is the mean of
        the task's distribution. `cloud` (b,) is the index of each contact set's object.
        """
        center = self.body.rows(cloud).center.to(contacts.points)
        mass = Distribution.of(self.request.grasp_task.mass).mean
        return weight_about(contacts.points, center, mass)

    @property
    def library(self) -> PostureLibrary:
        """The library of random hand postures for initial guesses, on the device of the objects;
        the hand caches it.
        """
        hand = settle_hand(self.hand, self.each[0].shape.device)
        return settle(PostureLibrary.of(hand, self.postures, self.request.seed), self.device)

    @property
    def reachable(self) -> Reachable | None:
        """The function that says which hand poses the arm reaches and the user's function accepts.

        It is None without an arm and such a function: all poses are then accepted. It takes poses
        (k, 4, 4) [m] in the upright frame, and returns booleans (k,).
        """
        arm = self.request.arm
        frame = self.each[0].obj_from_upright
        by_arm = None if arm is None else functools.partial(reach_poses, arm)
        asked = [x for x in (self.request.reachable, by_arm) if x is not None]
        if not asked:
            return None
        return lambda poses: torch.stack(
            [ask_reachable(x, frame.to(poses) @ poses) for x in asked]
        ).all(0)

    def relaxed_specs(self) -> Iterator[ContactSpec]:
        """Yield ever weaker constraints on contacts of a single object, in the caller's frame.

        They are those of `ContactSpec.relaxed`. First the radius shrinks within which the surface
        at a contact must be flat.
        """
        radius = float(self.hand.tips.radius.max())
        return iter(self.given_spec.relaxed(self.spec.ring_radius, radius))

    def relaxed(self, spec: ContactSpec) -> "Objects":
        """Return the same single object with the constraints `spec`, one of `relaxed_specs`.

        The hand may then move down while it closes.
        """
        (object_,) = self.each
        request = self.request
        return pose(object_, request, self.hand, self.model, spec, self.postures, descends=True)

    def reach(
        self, contacts: Contacts, certificate: Certificate, cloud: CloudIndex
    ) -> GraspProblem:
        """Return the inverse-kinematics problem of bringing the fingertips to each of b contact
        sets.

        Contacts [m] are in the upright frame, and `certificate` proves their force closure. `cloud`
        (b,) is the index of each contact set's object.
        """
        center = self.body.rows(cloud).center
        world = self.world.rows(cloud)
        return GraspProblem(
            self.hand, contacts, certificate, world, center, self.reachable, self.descends
        )

    def slide(self, cloud: CloudIndex) -> JointProblem:
        """Return the problem in which hand and contacts move together, for b contact sets.

        `cloud` (b,) is the index of each contact set's object.
        """
        constraints = self.constraints.rows(cloud)
        return JointProblem(
            self.hand, rows_of(self.shape, cloud), constraints, self.world.rows(cloud)
        )

    def on_arm(self, grasps: Grasps) -> Grasps:
        """Return the grasps, with the arm's posture at each grasp if there is an arm.

        The arm must follow approach and lift within its limits and without a collision. Executable
        grasps get the status `UNREACHABLE` if it cannot.
        """
        arm = self.request.arm
        if arm is None:
            return grasps
        frame = self.each[0].obj_from_upright
        arm = settle(arm.moved(inverse(frame)), self.device)
        # the third row is the caller's z axis, along which the arm lifts without a table
        return with_arm(arm, self.hand, grasps, self.world, frame[2, :3])

    def tell(self, stage: str, message: str, value: Any) -> None:
        """Report a stage to the observer.

        `stage` is its name, `message` a line of text, and `value` its result, which is moved to the
        caller's frame.
        """
        if self.request.observer is not None:
            self.request.observer(stage, message, self._moved(value))

    def give_back(self, grasps: Grasps) -> Grasps:
        """Return grasps of the upright frame in the caller's frame, on the device of the caller's
        cloud.

        The batch must hold a single object. The result's `meta` names the frames, units and inputs
        of the plan.
        """
        request = self.request
        spec = self.given_spec
        (object_,) = self.each
        meta = {
            "hand": self.hand.name,
            "hand_sha256": self.hand.source.sha256,
            "cloud_sha256": digest(object_.cloud),
            "joint_names": ",".join(self.hand.joint_names),
            "finger_names": ",".join(self.hand.finger_names),
            "frames": (
                "obj: the frame of the cloud; hand: the base link of the hand's URDF; "
                "a_from_b maps b into a"
            ),
            "units": "metre, radian",
            "unit_m": repr(float(object_.shape.scale)),
            "friction": str(Distribution.of(spec.friction)),
            "planned_friction": f"{spec.planned_friction:g}",
            "table": "none" if spec.plane is None else spec.plane.describe(),
            "mode": request.mode,
            "ranking": request.order,
            "task": request.grasp_task.describe(),
            "promise": "none" if request.promise is None else describe_promise(request.promise),
            "mixture_sha256": self.model.sha256,
            "seed": str(request.seed),
        }
        if request.resist is not None:
            meta["resist"] = (
                f"{request.resist} with {Distribution.of(request.grasp_task.mass).most:g} kg"
            )
        moved = self._moved(grasps.to(object_.shape.device))
        return dataclasses.replace(moved, meta=grasps.meta | meta)

    def _moved(self, value: Any) -> Any:
        """Return a value, moved from the upright frame to the caller's frame."""
        frame = self.each[0].obj_from_upright
        return value.moved(frame) if isinstance(value, ShapeGP) else move(value, frame)


def pose_request(request: Request, hand: Hand) -> Objects:
    """Return the one object of a request in its upright frame, ready to be planned for a hand.

    The object is found in the cloud or scene, and its shape is estimated. Then `pose` adds the
    `hand`, the constraints, the initial guesses and the obstacles.
    """
    model = find_model(request)  # first, so that a missing model is told before any work
    return pose(ShapedObject.of(request), request, hand, model)


def pose(
    object_: ShapedObject,
    request: Request,
    hand: Hand,
    model: LearnedModel,
    spec: ContactSpec | None = None,
    postures: int | None = None,
    descends: bool = False,
) -> Objects:
    """Return one object with its hand, constraints, initial guesses and obstacles (upright frame).

    Args:
        object_: the object, with its estimated shape.
        request: the arguments of the plan.
        hand: the hand of the plan.
        model: the learned model of the mode.
        spec: constraints in the caller's frame; None means those of the request, with the object's
            table.
        postures: size of the posture library; None means the default.
        descends: whether the hand may move down while it closes.
    """
    shape = object_.shape
    hand = settle_hand(hand, shape.device)
    if spec is None:
        spec = dataclasses.replace(request.contact_spec, table=object_.table)
    # the constraints of this hand's fingertips, in the upright frame
    upright = dataclasses.replace(
        spec,
        table=upright_table(spec.plane, object_.obj_from_upright),
        region=seen_from(spec.region, object_.obj_from_upright),
    )
    check_starts(shape, upright, request.starts)
    tips = hand.tips
    upright = upright.for_fingertips(float(tips.radius.max()))
    upright = dataclasses.replace(upright, fingertips=len(tips))
    flat = settle_flatness(shape, upright, request.seed)
    # guesses are drawn batch by batch, in chunks that are planned at once
    sizes = batch_sizes(request.mode, request.starts, object_.scene is not None)
    chunks = [count for size in sizes for count in start_chunks(size.starts)]
    starts = torch.cat(list(drawn_starts(shape, flat, chunks, request.seed)))
    # what the hand must not touch
    obstacles = object_.obstacles
    if obstacles is not None:
        obstacles = dataclasses.replace(obstacles, hard=not flat.spec.contact_allowed)
    loads = None
    if request.resist is not None:
        frame = inverse(object_.obj_from_upright).to(object_.body.center)
        mass = Distribution.of(request.grasp_task.mass).most
        on_table = flat.spec.plane is not None
        loads = loads_of(request.resist, mass, object_.body.center, frame, on_table)[None]
    if model.mixture is not None:
        model = model._replace(mixture=model.mixture.to(shape.device))
    return Objects(
        request=request,
        hand=hand,
        given_spec=spec,
        specs=(flat.spec,),
        each=(object_,),
        sizes=tuple(sizes),
        starts=(starts,),
        shape=shape,
        constraints=ContactProblem.of(shape, flat.spec),
        body=object_.body,
        world=CollisionWorld(object_.body.field, flat.spec.plane, obstacles),
        loads=loads,
        model=model,
        buried=is_buried(object_.surface, obstacles),
        descends=descends,
        postures=postures,
    )


def join_objects(parts: Sequence[Objects], device: torch.device) -> Objects:
    """Return single objects as one batch of objects on a device.

    Each has been prepared by `pose` for one hand. None may be in a scene.
    """
    first = parts[0]
    shape = ShapeBatch.of([part.each[0].shape for part in parts], device)
    rings = shape.scales.new_tensor([part.spec.ring_radius for part in parts])
    bodies = [part.body for part in parts]
    field = FieldBatch.of([body.field for body in bodies]).to(device)  # pyright: ignore[reportArgumentType]
    center = torch.stack([body.center for body in bodies]).to(device)
    size, height, breadth = (
        shape.scales.new_tensor([getattr(body, name) for body in bodies])
        for name in ("size", "height", "breadth")
    )
    plane = first.spec.plane
    loads = [part.loads for part in parts if part.loads is not None]
    return dataclasses.replace(
        first,
        hand=settle_hand(first.hand, device),
        specs=tuple(part.spec for part in parts),
        each=tuple(part.each[0] for part in parts),
        starts=tuple(part.starts[0] for part in parts),
        shape=shape,
        constraints=ContactProblem.of(shape, first.spec, rings),
        body=EstimatedBody(shape, field, center, size, height, breadth),
        world=CollisionWorld(field, None if plane is None else plane.to(device)),
        loads=torch.cat(loads).to(center) if loads else None,
    )


def find_model(request: Request) -> LearnedModel:
    """Return the learned model of the request's hand, if its mode uses one.

    Raises `BadArgument` for a mode that needs a model which the hand does not have.
    """
    if request.mode == "joint":
        return LearnedModel()
    folder = request.hand.urdf_path.parent
    # of postures of all sizes alike, so that Eq. (21) knows small objects
    own = folder / "paper.safetensors"
    path = own if request.mode == "paper" and own.is_file() else mixture_path(folder)
    if not path.is_file():
        found = f"'{request.mode}' with the {request.hand.name} hand, which has no learned model"
        allowed = "'joint', or a hand whose model `torchgrasp hand train` has learned"
        raise BadArgument("mode", found, allowed)
    return LearnedModel(load_mixture(path), sha256(path))


def _is_vague(cloud: PointCloud, neighbours: Neighbours) -> bool:
    """Return whether a cloud hardly shows its object: it has few points, lies in one plane, or is
    cut off. The `neighbours` are those of its points.
    """
    in_image = cloud.frustum is not None and cloud.viewpoint is not None
    cut = in_image and silhouettes(cloud.to("cpu")).cut
    return cut or len(cloud) < FEW_POINTS or neighbours.flat


def _is_surrounded(shape: ShapeGP, on_table: bool) -> bool:
    """Return whether points of a table surround the object of a shape. `on_table` is whether the
    table is known: it is then at z = 0.
    """
    cloud = shape.cloud
    if cloud.normals is None:
        return False
    plane = Plane.horizontal(0.0) if on_table else None
    return find_surroundings(cloud.points, cloud.normals, plane) > 0


def is_buried(surface: Mesh, obstacles: Obstacles | None) -> bool:
    """Return whether obstacles prevent that an object is lifted.

    They do if the rising object would enter them more than 3 mm (`BURIED`) deeper than at rest.
    `surface` is the object's mesh [m], in the frame of the obstacles. None means no obstacles.
    """
    if obstacles is None or not obstacles.hard:
        return False
    standing = float(obstacles.field.query(surface.vertices)[0].min())
    return lift_clearance(surface.vertices, obstacles) < min(standing, 0.0) - BURIED


def settle_hand(hand: Hand, device: torch.device) -> Hand:
    """Return the hand on a device; the hand caches one copy for each device."""
    if hand.lower.device != device and device not in hand.derived:
        hand.derived[device] = hand.to(device)
    return hand.derived.get(device, hand)


@checked
def take_target(scene: Scene, seed: Seed) -> PointCloud:
    """Return at most 1000 (`TARGET_POINTS`) random points of a scene's target, as a cloud.

    Raises `BadArgument` unless the target is the label of an object.
    """
    if scene.target not in scene.things:
        allowed = f"one of the labels {list(scene.things)}: scene.select(label)"
        raise BadArgument("target", scene.target, allowed)
    cloud = scene.cloud()
    generator = torch.Generator().manual_seed(seed)
    rows = torch.randperm(len(cloud), generator=generator, device="cpu")
    return cloud.select(rows[:TARGET_POINTS].sort().values.to(cloud.points.device))


def digest(cloud: PointCloud) -> str:
    """Return the SHA-256 of a cloud's points in hexadecimal. The metadata of grasps identify the
    cloud by it.
    """
    points = cloud.points.detach().cpu().double().contiguous().numpy()
    return hashlib.sha256(points.tobytes()).hexdigest()
