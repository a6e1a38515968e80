"""From a partial point cloud, or a thing of a scene, to ranked grasps: all at once, or wave by wave."""

from collections.abc import Iterator, Sequence
from typing import Annotated, overload

from typing_extensions import Unpack

from torchgrasp.checks import Count, Range, Seed, checked
from torchgrasp.errors import BadArgument
from torchgrasp.hand.hand import Hand
from torchgrasp.planner.chain import plan_request, stream_request
from torchgrasp.planner.many import plan_many
from torchgrasp.planner.task import Budget, PlanOptions, Request
from torchgrasp.scene.scene import Scene
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Grasps, PointCloud


@overload
def plan_grasps(
    cloud: PointCloud | Scene,
    hand: Hand,
    spec: ContactSpec | None = None,
    starts: Count = 1000,
    seed: Seed = 0,
    *,
    time_budget: Budget | None = None,
    **options: Unpack[PlanOptions],
) -> Grasps: ...


@overload
def plan_grasps(
    cloud: Sequence[PointCloud],
    hand: Hand,
    spec: ContactSpec | None = None,
    starts: Count = 1000,
    seed: Seed = 0,
    *,
    time_budget: Budget | None = None,
    workers: Annotated[int, Range(0, 1024)] = 0,
    **options: Unpack[PlanOptions],
) -> list[Grasps]: ...


@checked
def plan_grasps(
    cloud: PointCloud | Scene | Sequence[PointCloud],
    hand: Hand,
    spec: ContactSpec | None = None,
    starts: Count = 1000,
    seed: Seed = 0,
    *,
    time_budget: Budget | None = None,
    workers: Annotated[int, Range(0, 1024)] = 0,
    **options: Unpack[PlanOptions],
) -> Grasps | list[Grasps]:
    """Plan grasps of a hand on the object of a partial point cloud, or on the target of a scene.

    The result does not depend on the frame of cloud, camera and table. In a scene the hand keeps clear of the target's
    neighbours and of space that may be full. The rest of that risk lowers `Grasps.success`.

    The starts are planned and tried in waves, each larger than the one before; `stream_grasps` yields them one by one.

    Args:
        cloud: what the camera saw [m]; missing normals and viewpoint are estimated. A `Scene` has a target. A sequence
            of clouds gives a list of results, see `plan_many`.
        hand: from `load_hand`; it follows the shape, which is where the cloud is, to its device.
        spec: the constraints on contacts, of which each finger gets one; None: `ContactSpec()`, in mode "paper"
            `ContactSpec.paper()`.
        starts: random starts of the contact planner.
        seed: of every random draw; on the CPU the same seed gives bitwise the same grasps.
        time_budget: seconds of wall time; the wave that ends after them is the last, so the result depends on the
            machine. `meta` counts the starts that were planned. None: all.
        workers: processes for a sequence of clouds; 0: this one.
        fingers: which grasp, as in `load_hand`; None: those of the hand. "auto": of the sets that the hand declares,
            the one whose best grasps are likeliest to succeed. The result names them; `hand_of` loads their hand.
        mode: see `Mode`. All but "joint" need the hand's learned model, and three fingers.
        ranking: see `Ranking`; None: "success", in mode "paper" "variance".
        shape: the object's shape if more is known than the cloud shows, as after a touch (`ShapeGP.update`).
        observer: called after each stage, see `Observer`.
        reachable: tells which poses `obj_from_hand` (k, 4, 4) an arm can reach, in the given frame; None: all.

    Returns:
        Grasps, those with `Status.OK` first, best first. There may be none: `explain_empty` tells why.

    Raises:
        BadArgument: an argument of the wrong type or range; a cloud that no object of graspable size gives; a scene
            without a target.

    >>> from torchgrasp import load_hand, load_object
    >>> view = load_object("cylinder").view
    >>> grasps = plan_grasps(view, load_hand("barrett"), starts=20)
    >>> grasps.joints.shape[1]
    4
    """
    given = {"hand": hand, "spec": spec, "starts": starts, "seed": seed, "time_budget": time_budget, **options}
    if isinstance(cloud, Sequence):
        return plan_many(cloud, workers, given)
    if workers:
        raise BadArgument("workers", workers, "0 beside a single cloud")
    return plan_request(Request(cloud, **given))


@checked
def stream_grasps(
    cloud: PointCloud | Scene,
    hand: Hand,
    spec: ContactSpec | None = None,
    starts: Count = 1000,
    seed: Seed = 0,
    **options: Unpack[PlanOptions],
) -> Iterator[Grasps]:
    """Yield executable grasps as soon as they are there: of each wave of `plan_grasps`, best first.

    Each is certified, checked and scored; none is withdrawn. All together, ranked, they are the executable ones of
    `plan_grasps` with the same arguments. Whoever stops listening stops the work. In other modes than "joint", and with
    "auto" fingers, there is one wave.

    Args:
        cloud: this and all others: see `plan_grasps`.

    Returns:
        An iterator over `Grasps` of at least one row each. A later wave may have a better best one.

    Raises:
        BadArgument: as `plan_grasps`; a wrong cloud when the first grasps are asked for.

    >>> from torchgrasp import load_hand, load_object
    >>> first = next(stream_grasps(load_object("cylinder").view, load_hand("barrett"), starts=40))
    >>> bool((first.status == 0).all())
    True
    """
    return stream_request(Request(cloud, hand, spec, starts, seed, **options))
