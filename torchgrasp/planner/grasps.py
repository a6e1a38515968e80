"""The planner's entry points: from a point cloud or a scene to ranked grasps, all at once or batch by batch."""

import dataclasses
import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, overload

import numpy as np
import torch
from typing_extensions import Unpack

from torchgrasp.base import count_status
from torchgrasp.checks import Count, Range, Seed, checked
from torchgrasp.errors import BadArgument, GraspError, MissingExtra, Status
from torchgrasp.files import temporary_folder
from torchgrasp.hand.hand import Hand, HandSource
from torchgrasp.hand.load import load_hand
from torchgrasp.jobs import run_tasks
from torchgrasp.planner.batches import describe, plan_hand, rank_together
from torchgrasp.planner.problem import Problem
from torchgrasp.planner.request import Budget, PlanOptions, Request
from torchgrasp.scene.scene import Scene
from torchgrasp.specs import ContactSpec
from torchgrasp.threads import single_threaded
from torchgrasp.values import Certificate, Contacts, Grasps, PointCloud, load_grasps

BEST = 20  # best grasps of a set of fingers by which the set is judged: the number that an evaluation tries of a view


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
@single_threaded
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
    neighbours and of space that is probably full. The remaining risk of collision lowers `Grasps.success`.

    Grasps are planned in batches, each larger than the one before. `stream_grasps` yields each batch when it ends.

    Args:
        cloud: points that a camera saw [m]; missing normals and viewpoint are estimated. Or a `Scene` with a target. A
            sequence of clouds gives a list of results. A bad cloud gives no grasps, and `meta["refused"]` holds the
            reason.
        hand: from `load_hand`; it is moved to the device of the cloud.
        spec: the constraints on contacts; by default `ContactSpec()`, in mode "paper" `ContactSpec.paper()`.
        starts: number of random initial guesses of the contact planner.
        seed: random seed; on the CPU the same seed gives bitwise the same grasps.
        time_budget: wall time [s] after which no batch begins; `meta["starts"]` is the number of planned guesses.
        workers: number of processes for a sequence of clouds; 0 means this process.
        fingers: the fingers that grasp, as in `load_hand`; by default those of `hand`. "auto" chooses, of the sets that
            the hand declares, the one with the greatest expected success. `hand_of` loads the hand of the result.
        mode: see `Mode`; all modes but "joint" need the hand's learned model, and three fingers.
        ranking: criterion by which grasps are ordered, see `Ranking`; by default "success", in mode "paper" "variance".
        task: what the grasps must do, for which their success is predicted; by default `GraspTask()`.
        promise: share of the returned grasps that must hold, or None; less sure grasps get the status `NO_PROMISE`.
            `meta["promise"]` says which trials chose the bound (`torchgrasp.success.promise`).
        shape: the object's shape if it is known better than the cloud shows, as after a touch (`ShapeGP.update`).
        observer: function that is called after each stage with the stage's name, a line of text and its result.
        reachable: function that returns as booleans (k,) which hand poses `obj_from_hand` (k, 4, 4) an arm reaches, in
            the frame of the cloud; by default all poses are reachable.

    Returns:
        Grasps: executable grasps (`Status.OK`) first, best first. `explain_empty` explains an empty result.

    Raises:
        BadArgument: an argument of the wrong type or range; a cloud of an object that is not of graspable size; a scene
            without a target; `shape`, `observer` or `reachable` beside several clouds.
        MissingExtra: pebble is not installed, for workers.

    >>> from torchgrasp import load_hand, load_object
    >>> view = load_object("cylinder").view
    >>> grasps = plan_grasps(view, load_hand("barrett"), starts=20)
    >>> grasps.joints.shape[1]
    4
    """
    given = {"hand": hand, "spec": spec, "starts": starts, "seed": seed, "time_budget": time_budget, **options}
    if isinstance(cloud, Sequence):
        return _plan_many(cloud, workers, given)
    if workers:
        raise BadArgument("workers", workers, "0 for a single cloud")
    return _plan(Request(cloud, **given))


@checked
@single_threaded
def stream_grasps(
    cloud: PointCloud | Scene,
    hand: Hand,
    spec: ContactSpec | None = None,
    starts: Count = 1000,
    seed: Seed = 0,
    **options: Unpack[PlanOptions],
) -> Iterator[Grasps]:
    """Yield the executable grasps of each batch of `plan_grasps` when the batch ends, best first.

    Each grasp has force closure, has passed all checks, and is scored. All batches together, ranked, are the executable
    grasps of `plan_grasps` with the same arguments. The work stops when the caller stops iterating. In modes other than
    "joint", and with "auto" fingers, there is one batch.

    Args:
        cloud: this and all other arguments: see `plan_grasps`.

    Returns:
        An iterator over `Grasps` of at least one grasp each. A later batch may have a better best grasp.

    Raises:
        BadArgument: as `plan_grasps`; for a wrong cloud it is raised at the first iteration.

    >>> from torchgrasp import load_hand, load_object
    >>> first = next(stream_grasps(load_object("cylinder").view, load_hand("barrett"), starts=40))
    >>> bool((first.status == 0).all())
    True
    """
    return _stream(Request(cloud, hand, spec, starts, seed, **options))


def _plan(request: Request) -> Grasps:
    """Plan all batches; return their executable grasps, best first, and then the failed grasps."""
    return _finish(request, list(_plan_batches(request)))


def _stream(request: Request) -> Iterator[Grasps]:
    """Plan in batches; yield the executable grasps of each batch that has any, the best grasp first."""
    batches = list[Grasps]()
    for grasps in _plan_batches(request):
        batches.append(grasps)
        good = grasps[grasps.status == Status.OK]
        if len(good):
            yield good
    _finish(request, batches)


def _finish(request: Request, batches: list[Grasps]) -> Grasps:
    """Rank the grasps of all batches together, report them to the observer, and return them."""
    grasps = rank_together(batches, request.order)
    request.observer("refine", f"{len(grasps)} refined: {describe(count_status(grasps.status))}", grasps)
    return grasps


def _plan_batches(request: Request) -> Iterator[Grasps]:
    """Yield the grasps of each batch in the frame of the request; several sets of fingers give a single batch."""
    deadline = math.inf if request.time_budget is None else time.monotonic() + request.time_budget
    hands = request.hands
    problem = Problem.of(request, hands[0])
    if len(hands) == 1:
        for grasps in plan_hand(problem, deadline):
            yield problem.give_back(grasps)
    else:
        yield _plan_sets(problem, hands, deadline)


def _plan_sets(problem: Problem, hands: tuple[Hand, ...], deadline: float) -> Grasps:
    """Return the grasps of the set of fingers whose expected success is greatest.

    All sets share the remaining time. The observer is called with "fingers" after each set, then with the stages of the
    best set.
    """
    best, observer = None, problem.request.observer
    for left, hand in zip(range(len(hands), 0, -1), hands, strict=True):
        stages = list[tuple[str, str, Any]]()
        problem = problem.for_hand(hand, lambda *stage: stages.append(stage))  # noqa: B023 called at once
        now = time.monotonic()
        batches = list(plan_hand(problem, now + (deadline - now) / left))
        grasps = problem.give_back(rank_together(batches, problem.request.order))
        expected, count = expected_success(grasps), int((grasps.status == Status.OK).sum())
        observer("fingers", f"{', '.join(hand.finger_names)}: {count} executable, {expected:.0%} expected", grasps)
        if best is None or expected > best[0]:
            best = expected, grasps, stages
    assert best is not None
    for stage in best[2]:
        observer(*stage)
    return best[1]


def expected_success(grasps: Grasps, best: int = BEST) -> float:
    """Return the mean predicted success of the `best` best executable grasps; 0 for each grasp that is missing."""
    likely = torch.where(grasps.status == Status.OK, torch.sigmoid(grasps.score), 0.0)
    return float(likely.sort(descending=True).values[:best].sum()) / best


def _plan_many(clouds: Sequence[PointCloud], workers: int, given: dict[str, Any]) -> list[Grasps]:
    """Plan for each cloud on its device; a bad cloud does not affect the others.

    `given` holds the other arguments of `Request`, common to all clouds. A worker process gives up a cloud after an
    hour.
    """
    for name in ("shape", "observer", "reachable"):
        if given.get(name) is not None:
            raise BadArgument(name, "one for many clouds", "None for many clouds")
    for cloud in clouds:
        _ = Request(cloud, **given).hands  # wrong fingers are refused
    if not workers:
        planned = [_plan_or_refuse(Request(cloud, **given)) for cloud in clouds]
    else:
        hand = given["hand"].source
        source = HandSource(hand.option, hand.urdf_path, hand.sha256)
        rest = {name: _with_arrays(value) for name, value in given.items() if name != "hand"}
        with temporary_folder() as folder:
            files = [folder / f"{k}.safetensors" for k in range(len(clouds))]
            sent = [(_with_arrays(cloud), str(cloud.points.device)) for cloud in clouds]
            tasks = [(*cloud, source, rest, file) for cloud, file in zip(sent, files, strict=True)]
            planned = [
                load_grasps(file) if end is None else _refused(given["hand"], end.sentence)
                for file, end in zip(files, run_tasks(_plan_to_file, tasks, workers, 3600.0), strict=True)
            ]
    return [grasps.to(cloud.points.device) for cloud, grasps in zip(clouds, planned, strict=True)]


def _plan_or_refuse(request: Request) -> Grasps:
    """Return the grasps of a request; if its cloud is bad, return an empty set with the reason in `meta`."""
    try:
        return _plan(request)
    except MissingExtra:
        raise
    except GraspError as error:
        return _refused(request.hand, " ".join(str(error).split()))


def _refused(hand: Hand, reason: str) -> Grasps:
    """Return an empty set of grasps, whose `meta` gives the reason why planning was refused."""
    return dataclasses.replace(no_grasps(hand), meta={"hand": hand.name, "refused": reason})


def no_grasps(hand: Hand) -> Grasps:
    """Return an empty set of grasps that has the joints and fingers of a hand."""
    f = len(hand.tips)

    def none(*shape: int) -> torch.Tensor:
        return torch.zeros(0, *shape, dtype=torch.float64, device="cpu")

    contacts = Contacts(none(f, 3), none(f, 3), none(f), none(f))
    certificate = Certificate(none(), none(), none(), none().bool(), none(6))
    return Grasps(
        none(hand.dof), none(hand.dof), none(3), none(4, 4), contacts, none(f).long(), none(f), none(), none(f),
        certificate, none(), none().long(), known=none().bool(), interval=none(2),
    )  # fmt: skip


def _plan_to_file(cloud: Any, device: str, hand: HandSource, rest: dict[str, Any], file: Path) -> None:
    """Plan for one cloud in a worker process, and save the grasps to a file."""
    points = _with_tensors(cloud).to(torch.device(device))
    given = {name: _with_tensors(value) for name, value in rest.items()}
    _plan_or_refuse(Request(points, load_hand(hand.urdf_path.parent, hand.option), **given)).save(file)


def _with_arrays(value: Any) -> Any:
    """Return a dataclass as a pair of its class and its fields, with tensors as NumPy arrays, for another process."""
    if isinstance(value, torch.Tensor):
        return value.detach().cpu().numpy()
    if dataclasses.is_dataclass(value):
        return type(value), {f.name: _with_arrays(getattr(value, f.name)) for f in dataclasses.fields(value)}
    return value


def _with_tensors(sent: Any) -> Any:
    """Return the value that `_with_arrays` packed, with tensors in place of the arrays."""
    if isinstance(sent, np.ndarray):
        return torch.from_numpy(sent)
    if isinstance(sent, tuple) and isinstance(sent[0], type):
        return sent[0](**{name: _with_tensors(field) for name, field in sent[1].items()})
    return sent
