"""The planner's entry points: from a point cloud or a scene to ranked grasps, or to batches."""

from collections.abc import Iterator, Sequence
from typing import Annotated, Any, overload

from torchgrasp.arm.arm import Arm
from torchgrasp.data.accept import CloudLike, HandLike, SeenLike, as_cloud, as_hand, as_seen
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Count, Range, Seed
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.hand.hand_toml import Fingers
from torchgrasp.ik.candidates import Reachable
from torchgrasp.planner.many import plan_many
from torchgrasp.planner.request import Budget, Observer, Promised, Request, Where
from torchgrasp.planner.run import plan_request, stream_request
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.success.task import GraspTask, Resist
from torchgrasp.values.planning import Grasps
from torchgrasp.values.specs import ContactSpec, Mode, Ranking


@overload
def plan_grasps(
    cloud: SeenLike,
    hand: HandLike,
    spec: ContactSpec | None = None,
    starts: Count = 1000,
    seed: Seed = 0,
    *,
    fingers: Fingers | None = None,
    task: GraspTask | None = None,
    promise: Promised | None = None,
    reachable: Reachable | None = None,
    arm: Arm | None = None,
    keep: Where | None = None,
    avoid: Where | None = None,
    resist: Resist | None = None,
    mode: Mode = "joint",
    ranking: Ranking | None = None,
    time_budget: Budget | None = None,
    shape: ShapeGP | None = None,
    observer: Observer | None = None,
) -> Grasps: ...
@overload
def plan_grasps(
    cloud: Sequence[CloudLike],
    hand: HandLike,
    spec: ContactSpec | None = None,
    starts: Count = 1000,
    seed: Seed = 0,
    *,
    workers: Annotated[int, Range(0, 1024)] = 0,
    fingers: Fingers | None = None,
    task: GraspTask | None = None,
    promise: Promised | None = None,
    reachable: Reachable | None = None,
    arm: Arm | None = None,
    keep: Where | None = None,
    avoid: Where | None = None,
    resist: Resist | None = None,
    mode: Mode = "joint",
    ranking: Ranking | None = None,
    time_budget: Budget | None = None,
    shape: ShapeGP | None = None,
    observer: Observer | None = None,
) -> list[Grasps]: ...
@checked
@single_threaded
def plan_grasps(
    cloud: SeenLike | Sequence[CloudLike],
    hand: HandLike,
    spec: ContactSpec | None = None,
    starts: Count = 1000,
    seed: Seed = 0,
    *,
    workers: Annotated[int, Range(0, 1024)] = 0,
    fingers: Fingers | None = None,
    task: GraspTask | None = None,
    promise: Promised | None = None,
    reachable: Reachable | None = None,
    arm: Arm | None = None,
    keep: Where | None = None,
    avoid: Where | None = None,
    resist: Resist | None = None,
    mode: Mode = "joint",
    ranking: Ranking | None = None,
    time_budget: Budget | None = None,
    shape: ShapeGP | None = None,
    observer: Observer | None = None,
) -> Grasps | list[Grasps]:
    """Plan grasps of a hand on the object of a partial point cloud or scene; return them, best
    first.

    >>> from torchgrasp import load_object
    >>> grasps = plan_grasps(load_object("cylinder"), "barrett", ContactSpec(table=0.0), starts=8)
    >>> grasps.joints.shape[1]
    4

    Args:
        cloud: points that a camera saw [m], in any frame; the grasps are in this frame.
            It is a `PointCloud`, a `Scene` with a target, a `GraspObject`, or an array or tensor
              (n, 3). It may also be a cloud of Open3D or trimesh, or a file for `read_cloud` or
              `read_scene`.
            Missing normals and viewpoint are estimated; `cloud_from_array` adds known ones.
            A sequence of clouds gives a list of `Grasps`. The grasps of a cloud that cannot be
              planned on are empty, and `meta["refused"]` says why. An unreadable cloud raises.
        hand: from `load_hand`, or its name or folder; it is moved to the device of the cloud.
        spec: constraints; None means `ContactSpec()`, in mode "paper" `ContactSpec.paper()`.
        starts: number of random initial guesses of the contact planner.
        seed: random seed; on the CPU the same seed gives bitwise the same grasps.
        workers: number of processes for a sequence of clouds; 0 means this process. If the clouds
            are on a GPU, it plans them at once, and the processes only estimate the shapes.
        fingers: the fingers that grasp, as in `load_hand`; None means the fingers of `hand`. "auto"
            tries the sets of fingers in the hand's file, and takes the most likely to succeed.
            `torchgrasp.hand.hand_of` loads the hand of the result.
        task: what grasps must do; success is predicted for it. None means `GraspTask()`.
        promise: share of the executable grasps that must hold, in [0.5, 0.99]. Less sure grasps get
            the status `NO_PROMISE`. `meta["promise"]` says how many trials support the promise
            (`torchgrasp.success.promise`). None means no promise.
        reachable: function of hand poses `obj_from_hand` (k, 4, 4) [m] in the frame of the cloud.
            It returns a mask (k,) of the poses that an arm reaches. None means all of them.
        arm: the arm that carries the hand, from `load_arm`; it must follow the straight approach
            and the lift of each grasp. Without a table z points up. None means no arm.
        keep: where all contacts lie: a `Region`, or a function of points (n, 3) [m] that returns
            their signed distances (n,) [m], negative inside. None means anywhere.
        avoid: where no contact lies, given as `keep`.
        resist: loads that contacts must resist: "lift", "pour", "push", a tuple of several, or
            `TaskWrenches`. Each force must lie in its planned friction cone, and the hand must be
            strong enough for it. `Grasps.certificate` has the proof; grasps that resist less have
            the status `NOT_RESISTED`. None means that nothing is asked for.
        mode: how contacts become grasps. All but "joint" need a learned model and three fingers.
            "joint": the hand starts from random postures near each contact set. If none succeeds,
              the contacts move along the surface with the hand.
            "contact_first": initial postures of the learned model are refined onto fixed contacts.
            "paper": the paper's method (docs/paper.md).
        ranking: what puts a grasp first: the greatest predicted "success", or the least "variance"
            of the surface at its contacts. None means "success", in mode "paper" "variance".
        time_budget: wall time [s] after which no batch of guesses begins; None means no limit.
            `meta["starts"]` is the number of guesses that were planned.
        shape: the object's shape if it is known better than the cloud shows, as after a touch
            (`ShapeGP.update`). None means that it is estimated.
        observer: function that is called after each stage, with its name, a text and its result.

    Returns:
        Grasps: executable ones (all checks passed) first, best first; if none, see `explain_empty`.

    Raises:
        BadArgument: a wrong type or range; a bad file; with `workers`, a hand unlike its files.
        BadArgument: an object of no graspable size; no target; a camera that cannot have seen it.
        BadArgument: a table above most points or a camera, or over 2 m below the top; `keep` off
            the object; an `arm` of another hand; a `promise` with `GraspTask.displaced`.
        BadArgument: several clouds with `shape`, `arm`, `observer`, `reachable`, region or edge.
        MissingExtra, NoWorkers: pebble or numba is not installed, or no worker process can start.

    If cloud, camera and table are moved together, the grasps move with them. In a scene the hand
    keeps clear of the target's neighbours and of space that is probably full. What risk remains
    lowers `Grasps.success`. Guesses are planned in batches; `stream_grasps` yields each at once.
    """
    given: dict[str, Any] = dict(
        hand=as_hand(hand, "hand"),
        spec=spec,
        starts=starts,
        seed=seed,
        fingers=fingers,
        task=task,
        promise=promise,
        reachable=reachable,
        arm=arm,
        keep=keep,
        avoid=avoid,
        resist=resist,
        mode=mode,
        ranking=ranking,
        time_budget=time_budget,
        shape=shape,
        observer=observer,
    )
    if isinstance(cloud, Sequence) and not isinstance(cloud, str):
        return plan_many([as_cloud(one, "cloud") for one in cloud], workers, given)
    if workers:
        raise BadArgument("workers", workers, "0 for a single cloud")
    return plan_request(Request(as_seen(cloud, "cloud"), **given))


@checked
@single_threaded
def stream_grasps(
    cloud: SeenLike,
    hand: HandLike,
    spec: ContactSpec | None = None,
    starts: Count = 1000,
    seed: Seed = 0,
    *,
    fingers: Fingers | None = None,
    task: GraspTask | None = None,
    promise: Promised | None = None,
    reachable: Reachable | None = None,
    arm: Arm | None = None,
    keep: Where | None = None,
    avoid: Where | None = None,
    resist: Resist | None = None,
    mode: Mode = "joint",
    ranking: Ranking | None = None,
    time_budget: Budget | None = None,
    shape: ShapeGP | None = None,
    observer: Observer | None = None,
) -> Iterator[Grasps]:
    """Yield the executable grasps of `plan_grasps` in batches, as soon as they are planned.

    Each batch holds at least one grasp, its best first. Each grasp has force closure, has passed
    all checks, and is scored. A later batch may hold a better grasp. All batches together, ranked,
    are the executable grasps of `plan_grasps` with the same arguments. The work stops when the
    caller stops iterating. With a `mode` other than "joint", and with "auto" fingers, there is one
    batch.

    Args:
        cloud: one cloud or scene, as in `plan_grasps`.
        hand: the hand, as in `plan_grasps`.
        spec: the constraints on contacts, as in `plan_grasps`.
        starts: number of random initial guesses, as in `plan_grasps`.
        seed: random seed.
        fingers, task, promise, reachable, arm, keep, avoid, resist: as in `plan_grasps`.
        mode, ranking, time_budget, shape, observer: as in `plan_grasps`.

    Raises `BadArgument` for a wrong argument, and `HandFileError` for a bad hand, both at the call.
    Errors that depend on the points, such as a wrong size, are raised at the first iteration.

    >>> from torchgrasp import load_hand, load_object
    >>> first = next(stream_grasps(load_object("cylinder").view, load_hand("barrett"), starts=12))
    >>> bool((first.status == 0).all())
    True
    """
    request = Request(
        as_seen(cloud, "cloud"),
        as_hand(hand, "hand"),
        spec,
        starts,
        seed,
        fingers=fingers,
        task=task,
        promise=promise,
        reachable=reachable,
        arm=arm,
        keep=keep,
        avoid=avoid,
        resist=resist,
        mode=mode,
        ranking=ranking,
        time_budget=time_budget,
        shape=shape,
        observer=observer,
    )
    return stream_request(request)
