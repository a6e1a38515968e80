"""Planning of grasps on one view of a dataset object, and their trials on the true mesh under a
protocol.
"""

import contextlib
import dataclasses
import functools
import logging
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.agreement import check_mesh, check_stand
from torchgrasp.cloud.camera import look_at
from torchgrasp.control.finger_forces import check_all_executable
from torchgrasp.data import read_entry, read_object_mesh, read_view
from torchgrasp.data.shards import load_grasps
from torchgrasp.evaluation.protocols import Protocol, draw_error, draw_slide, seed_of
from torchgrasp.evaluation.pull import run_protocol
from torchgrasp.evaluation.summary import ProtocolResult, ViewScore
from torchgrasp.evaluation.touch import measure_touch
from torchgrasp.evaluation.trial import GraspTrial, Truth
from torchgrasp.foundation.base import Value, count_status
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import (
    BadArgument,
    GraspError,
    MissingExtra,
    OutputError,
    Status,
    one_line,
)
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.foundation.rules import Count, Seed
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.hand.hand import Hand, HandSource
from torchgrasp.hand.hand_toml import Fingers
from torchgrasp.hand.load import hand_of, load_hand
from torchgrasp.planner.grasps import plan_grasps
from torchgrasp.planner.objects import digest
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.surface import surface_field
from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.planning import Grasps, PointCloud
from torchgrasp.values.specs import MASSES, ContactSpec

REFUSAL = "refusal"  # key of the metadata of saved grasps with the reason why a view has none
# greatest friction coefficient for which grasps are planned; that of some protocols is greater
MOST_FRICTION = 1.0
Ranks = Literal["best", "spread"]
"""Which grasps of a view are tried: the "best", or the same number "spread" over all ranks."""


@checked
@dataclasses.dataclass(frozen=True)
class EvaluationSpec(Value):
    """Options of `evaluate`: which views are planned on, and which of their grasps are tried.

    Args:
        grasps: largest number of grasps to try for each view.
        ranks: "best" tries the best-ranked grasps, "spread" tries grasps spread evenly over all
            ranks.
        starts: number of random initial guesses of the contact planner.
        complete: whether to plan on clouds of all sides with normals, as if the shape were known.
            They are the views "whole" of `read_view`.
        only: names of the objects to evaluate; empty means all.
        planned: whether to read the grasps that an earlier call of `evaluate` saved in its
            `folder`, instead of planning. A view whose file is missing, of another cloud or hand,
            or with failed grasps is refused (`BAD_OBJECT`).
        seed: seed of the planner, of the random pose errors of the trials (`PoseNoise`), and of the
            trials.
        views: largest number of views of each object, the first by name. None means all views.
        fingers: the fingers that grasp (`load_hand`); None means the hand's own. "auto" takes for
            each view the fingers most likely to succeed.

    Raises `BadArgument` for a number below 1 of `grasps`, `starts` or `views`, and for unknown
    `ranks`. Unknown `fingers` are refused when a view is planned (`BAD_OBJECT`).
    """

    grasps: Count = 20
    ranks: Ranks = "best"
    starts: Count = 1000
    complete: bool = False
    only: tuple[str, ...] = ()
    planned: bool = False
    seed: Seed = 0
    views: Count | None = None
    fingers: Fingers | None = None

    @property
    def tried(self) -> str:
        """Text that says which grasps of a view are tried, such as "the 20 best of each view"."""
        if self.ranks == "spread":
            return f"up to {self.grasps} of each view, spread over all ranks"
        return (
            f"the {self.grasps} best of each view" if self.grasps > 1 else "the best of each view"
        )


def choose_rows(executable: int, most: int, ranks: Ranks) -> list[int]:
    """Return the indices of the grasps to try among a view's executable grasps.

    `executable` is the number of these grasps. At most `most` indices are returned. The grasps are
    in the order of their ranks, the best first. `ranks` says which are tried: the "best", or grasps
    "spread" evenly over all ranks.
    """
    most = min(most, executable)
    if ranks == "best" or most < 2:
        return list(range(most))
    return [round(k * (executable - 1) / (most - 1)) for k in range(most)]


@dataclasses.dataclass(frozen=True)
class ObjectView:
    """A hand and a view of an object: the input of one planning task, named by their files.

    Attributes:
        objects: folder of objects.
        object: name of the object.
        view: name of the view.
        hand: files and fingers of the hand.
    """

    objects: Path
    object: str
    view: str
    hand: HandSource

    @property
    def score(self) -> ViewScore:
        """The `ViewScore` of the view before planning. It has the names of object, view, family and
        group, but no grasps.
        """
        entry = read_entry(self.objects, self.object)
        return ViewScore(self.object, self.view, 0, 0.0, family=entry.family, group=entry.group)

    def file(self, folder: Path) -> Path:
        """Return the path of the view's file of grasps below `folder`: OBJECT/VIEW.safetensors."""
        return folder / self.object / f"{self.view}.safetensors"

    def load_hand(self) -> Hand:
        """Load the hand of the view from its folder, with the grasping fingers of `hand.option`."""
        return load_hand(self.hand.urdf_path.parent, self.hand.option)


class PlannedView(NamedTuple):
    """The result of planning on a view.

    Attributes:
        score: score of the view, before any trial.
        cloud: cloud [m] of the view; None for a bad object.
        grasps: executable grasps of the view; None for a bad object.
    """

    score: ViewScore
    cloud: PointCloud | None = None
    grasps: Grasps | None = None


def plan_views(
    views: Sequence[ObjectView], protocol: Protocol, spec: EvaluationSpec, device: str
) -> list[Grasps | None]:
    """Plan on several views at once on a torch `device`. Return the executable grasps of each view,
    those that passed all checks.

    `protocol` gives the task of the grasps, and `spec` the options of planning.

    The result is None for a view whose cloud cannot be read or planned on; `plan_view` then plans
    it anew.
    """
    clouds = dict[int, PointCloud]()
    planned = dict[int, Grasps]()
    where = torch.device(device)
    for k, view in enumerate(views):
        with contextlib.suppress(GraspError):  # which `plan_view` meets again
            clouds[k] = read_view(view.objects, view.object, view.view).to(where)
    name = torch.cuda.get_device_name(where) if where.type == "cuda" else device
    try:
        plans = _plan(list(clouds.values()), views[0], protocol, spec)
        for k, found in zip(clouds, plans, strict=True):
            good = dataclasses.replace(found, meta=found.meta | {"device": name})
            planned[k] = good[found.status == Status.OK].to("cpu")
    except Exception as error:  # of the library: a cloud that breaks it costs no other its grasps
        logging.getLogger(__name__).warning(
            "%d views are planned one by one: %s", len(views), error
        )
    return [planned.get(k) for k in range(len(views))]


def _plan(
    cloud: Any, view: ObjectView, protocol: Protocol, spec: EvaluationSpec, **more: Any
) -> Any:
    """Plan grasps on the cloud of a view, or on several clouds."""
    friction = Distribution.of(protocol.trial.friction).clamped(0.0, MOST_FRICTION)
    contacts = ContactSpec(friction=friction.simplest, table=Plane.horizontal(0.0))
    more |= {"fingers": spec.fingers, "task": protocol.task}
    return plan_grasps(cloud, view.load_hand(), contacts, spec.starts, spec.seed, **more)


def plan_view(
    view: ObjectView, protocol: Protocol, spec: EvaluationSpec, planned: Path | Grasps | None = None
) -> PlannedView:
    """Return the executable grasps of a view for a protocol, with the view's score and its cloud.
    Executable grasps passed all checks of the planner. `spec` has the options of planning.

    If there are none, the score's `refusal` says why. `planned` are grasps that exist already: the
    path of their file, or what `plan_views` returned. If `planned` is None or holds no grasp, the
    view is planned here.
    """
    hand = view.load_hand()
    score = view.score
    started = time.process_time()
    try:
        # A bad mesh is refused before planning; its parts are cached.
        mesh, _ = _read_solid(view.objects, view.object)
        cloud = read_view(view.objects, view.object, view.view)
        check_mesh(cloud, mesh)
        check_stand(mesh, Plane.horizontal(0.0))
        _of_object(view, protocol)
        if isinstance(planned, Path):
            return _read_planned(planned, score, cloud, hand)
        started = time.process_time()  # planning alone is timed
        stages: dict[str, Any] = {}
        found = planned or _plan(
            cloud,
            view,
            protocol,
            spec,
            observer=lambda name, _, value: stages.setdefault(name, value),
        )
    except (MissingExtra, OutputError):
        raise
    except GraspError as error:
        note = one_line(error)
        spent = time.process_time() - started
        bad = {"refusal": Status.BAD_OBJECT, "note": note, "seconds": spent}
        return PlannedView(dataclasses.replace(score, **bad))
    grasps = found.executable
    status = found.status if len(found) else stages["plan"].status
    failed = count_status(status[status != Status.OK])
    refusal = Status.OK if len(grasps) else next(iter(failed), Status.OUT_OF_REACH)
    score = dataclasses.replace(
        score,
        executable=len(grasps),
        refusal=refusal,
        fingers=found.meta["finger_names"],
        seconds=time.process_time() - started,
    )
    return PlannedView(score, cloud, grasps)


def _read_planned(path: Path, score: ViewScore, cloud: PointCloud, hand: Hand) -> PlannedView:
    """Read the grasps of a view that an earlier call planned with the same cloud and hand.

    Failed grasps are refused: they would count as executable.
    """
    grasps = load_grasps(path)
    made = {"cloud_sha256": digest(cloud), "hand_sha256": hand.source.sha256}
    if {key: grasps.meta.get(key) for key in made} != made:
        raise BadArgument("folder", f"{path} of another cloud or hand", "grasps of this view")
    check_all_executable(grasps)
    reason = Status.__members__.get(grasps.meta.get(REFUSAL, ""), Status.OUT_OF_REACH)
    refusal = Status.OK if len(grasps) else reason
    fingers = grasps.meta.get("finger_names", "")
    score = dataclasses.replace(score, executable=len(grasps), refusal=refusal, fingers=fingers)
    return PlannedView(score, cloud, grasps)


def try_grasp(
    view: ObjectView, grasps: Grasps, protocol: Protocol, spec: EvaluationSpec, at: tuple[int, int]
) -> ProtocolResult:
    """Try grasp `at[0]` of a view in simulation with random pose error number `at[1]`, and return
    the result.

    If a lift fails and the protocol allows more tries, the other `grasps` follow. Raises
    `BadArgument` if the protocol has a second look (`Protocol.relook`), but the view's camera
    position is unknown.
    """
    protocol = _of_object(view, protocol)
    others = [k for k in range(len(grasps)) if k != at[0] and protocol.tries > 1]
    grasp = grasps[[at[0], *others]]
    hand = hand_of(grasp, view.load_hand())
    seed = seed_of(spec.seed, view.object, view.view, *at)
    truth = _draw_truth(view, grasp, protocol, seed)
    surface = None
    components = protocol.trial.components
    # only these controllers locate the object on its surface
    if protocol.trial.table and (components.stops or components.attempts > 1):
        surface = _fit_surface(view.objects, view.object, view.view)
    attempt = GraspTrial(hand, grasp, truth, seed_of(seed, "touch"), surface=surface)
    found = run_protocol(attempt, protocol, *at)
    mesh, _ = _read_solid(view.objects, view.object)
    touch = measure_touch(hand, grasp[0], mesh)
    return dataclasses.replace(
        found,
        predicted=float(grasp.success[0]),
        gap_mm=1000 * float(touch.largest),
        deepest_mm=1000 * float(touch.deepest),
        touch=touch.verdicts[0],
    )


def _of_object(view: ObjectView, protocol: Protocol) -> Protocol:
    """Return the protocol with the object's real mass, if it asks for one and the manifest has it.

    Raises `BadArgument` for a mass that no trial takes, such as one in grams.
    """
    mass = read_entry(view.objects, view.object).mass if protocol.real_mass else None
    if mass is None:
        return protocol
    if not MASSES.low <= mass <= MASSES.high:
        allowed = f"{MASSES.low:g} to {MASSES.high:g} kg for {protocol.name!r}"
        raise BadArgument("mass_kg", f"{mass:g}", allowed)
    return protocol.with_trial(mass=mass)


def _draw_truth(view: ObjectView, grasp: Grasps, protocol: Protocol, seed: int) -> Truth:
    """Return the true world of a trial. It has the object with a random pose error, and the camera
    of a second look.
    """
    mesh, parts = _read_solid(view.objects, view.object)
    error = None
    slide = None
    if protocol.displaced == "approach":
        slide = draw_slide(protocol.noise, seed)
    else:
        error = draw_error(protocol, grasp, mesh, seed)
    camera = None
    if protocol.relook:
        camera = _camera_of(read_view(view.objects, view.object, view.view))
    return Truth(mesh, parts, error, slide=slide, camera=camera)


def _camera_of(cloud: PointCloud) -> Float[Tensor, "4 4"]:
    """Return the pose of a camera at the viewpoint of a cloud that looks at the cloud."""
    if cloud.viewpoint is None:
        found = "a view without the camera's position"
        raise BadArgument("relook", found, "views with a viewpoint")
    middle = cloud.points.double().mean(0)
    x, y, z = (cloud.viewpoint.double().reshape(-1, 3)[0] - middle).tolist()
    azimuth = math.atan2(y, x)
    elevation = math.atan2(z, math.hypot(x, y))
    return look_at(math.degrees(azimuth), math.degrees(elevation), math.hypot(x, y, z), middle)


def _fit_surface(objects: Path, name: str, view: str) -> SignedDistanceField:
    """Return the estimated surface of a view as a distance field, to locate the object by touch."""
    stamps = _stamps(objects, "manifest.json", f"{name}/{view}_noisy.ply")
    return _kept_surface(objects, name, view, stamps)


def _read_solid(objects: Path, name: str) -> "tuple[trimesh.Trimesh, list[trimesh.Trimesh]]":
    """Return the mesh and convex parts of a dataset object."""
    return _kept_solid(objects, name, _stamps(objects, "manifest.json", f"{name}/mesh.ply"))


def _stamps(objects: Path, *files: str) -> tuple[tuple[int, int], ...]:
    """Return time and size of files, which change with their contents; 0 for one that is missing."""
    found = [(objects / x).stat() if (objects / x).is_file() else None for x in files]
    return tuple((0, 0) if x is None else (x.st_mtime_ns, x.st_size) for x in found)


@functools.lru_cache(maxsize=2)
def _kept_surface(objects: Path, name: str, view: str, stamps: tuple) -> SignedDistanceField:
    """Return the estimated surface of a view, whose files have the `stamps`."""
    return surface_field(fit_shape(read_view(objects, name, view), table=Plane.horizontal(0.0)))


@functools.lru_cache(maxsize=2)
def _kept_solid(
    objects: Path, name: str, stamps: tuple
) -> "tuple[trimesh.Trimesh, list[trimesh.Trimesh]]":
    """Return the mesh and convex parts of an object, whose files have the `stamps`."""
    mesh = read_object_mesh(objects, name)
    return mesh, convex_parts(mesh)
