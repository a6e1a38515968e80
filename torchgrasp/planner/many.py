"""Plans of many clouds: one after another, on processes, or all at once on an accelerator."""

import contextlib
import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import torch

from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, GraspError, MissingExtra, Status, one_line
from torchgrasp.foundation.jobs import pack, run_tasks, unpack
from torchgrasp.hand.hand import Hand, HandSource
from torchgrasp.hand.load import check_as_loaded, load_hand
from torchgrasp.planner.objects import Objects, join_objects, pose_request, settle_hand
from torchgrasp.planner.planner import plan_objects
from torchgrasp.planner.request import Request
from torchgrasp.planner.run import finish, plan_request, relax
from torchgrasp.values.planning import Certificate, Contacts, Grasps, PointCloud

Result = TypeVar("Result")


@dataclasses.dataclass(frozen=True)
class ManyNumbers:
    """Bounds on plans of many clouds at once."""

    stack: int = 128
    """Number of clouds that a device plans at once. With more, it would wait longer for their
    shapes.
    """
    patience: float = 3600.0
    """Time [s] after which a worker process gives up a cloud."""


MANY = ManyNumbers()


def plan_many(clouds: Sequence[PointCloud], workers: int, given: dict[str, Any]) -> list[Grasps]:
    """Return the planned grasps of each cloud, on the cloud's device; a bad cloud does not affect
    the others.

    A bad cloud has no grasps, and `meta["refused"]` says why. `workers` is the number of processes,
    0 for none. `given` holds the other arguments of `Request`, common to all clouds. A worker
    process gives up a cloud after an hour. Where an accelerator plans clouds at once, the worker
    processes estimate the shapes. Raises `BadArgument` for arguments that only one cloud can have.
    They are shape, observer, reachable, arm, regions, and a table with an edge.
    """
    for name in ("shape", "observer", "reachable", "arm", "keep", "avoid"):
        if given.get(name) is not None:
            raise BadArgument(name, "one for many clouds", "None for many clouds")
    if given["spec"] is not None and given["spec"].region is not None:
        raise BadArgument(
            "spec", "a region for many clouds", "one without a region for many clouds"
        )
    table = None if given["spec"] is None else given["spec"].plane
    if table is not None and table.edge is not None:
        # objects that are planned at once share their constraints
        raise BadArgument(
            "spec", "a table with an edge for many clouds", "one without an edge for many clouds"
        )
    requests = [Request(cloud, **given) for cloud in clouds]
    hands = [request.hands for request in requests]  # wrong fingers are refused
    devices = {cloud.points.device for cloud in clouds}
    together = len(devices) == 1 and devices != {torch.device("cpu")} and len(hands[0]) == 1
    if together and requests[0].mode == "joint":
        planned = plan_stacks(requests, estimate_shapes(requests, workers), next(iter(devices)))
    else:
        planned = _each(plan_request, requests, workers)
    return [grasps.to(cloud.points.device) for cloud, grasps in zip(clouds, planned, strict=True)]


def plan_stacks(
    requests: Sequence[Request], prepared: Iterator[Objects | Grasps], device: torch.device
) -> Iterator[Grasps]:
    """Yield the grasps of each request; the `device` plans up to 128 objects at once.

    The number is `MANY.stack`. The requests differ in their clouds alone. `prepared` yields the
    object of each request, with its shape and initial guesses. For a bad cloud it yields an empty
    set of grasps, which is passed on. The next objects are prepared while the device plans.
    """
    most = MANY.stack
    deadline = requests[0].deadline() if requests else math.inf
    stack = _take(prepared, most)
    with ThreadPoolExecutor(1) as beside:
        for first in range(0, len(requests), most):
            ahead = beside.submit(_take, prepared, most) if first + most < len(requests) else None
            yield from _plan_stack(requests[first : first + most], stack, device, deadline)
            stack = [] if ahead is None else ahead.result()


@checked
def _take(prepared: Iterator[Objects | Grasps], count: int) -> list[Objects | Grasps]:
    """Return the next `count` objects of an iterator.

    In any thread the library does not check its own calls.
    """
    return list(itertools.islice(prepared, count))


def estimate_shapes(
    requests: Sequence[Request], workers: int
) -> Generator[Objects | Grasps, None, None]:
    """Yield the object of each request on the CPU, or an empty set of grasps for a bad cloud.

    Each object has its estimated shape and initial guesses (`pose_request`). The metadata of the
    empty set say why the cloud is bad. `workers` is the number of processes, 0 for none.
    """
    return _each(
        _prepare, [dataclasses.replace(x, cloud=x.cloud.to("cpu")) for x in requests], workers
    )


def _plan_stack(
    requests: Sequence[Request],
    prepared: Sequence[Objects | Grasps],
    device: torch.device,
    deadline: float,
) -> Iterator[Grasps]:
    """Yield the grasps of posed objects that are planned at once on a device."""
    hand = settle_hand(requests[0].hands[0], torch.device("cpu"))
    # a process gave back objects without the hand's caches
    ready = [
        x if isinstance(x, Grasps) else dataclasses.replace(x, hand=hand, request=request)
        for x, request in zip(prepared, requests, strict=True)
    ]
    posed = [x for x in ready if isinstance(x, Objects)]
    batches: Iterator[tuple[Grasps, ...]] = iter(())
    if posed:
        batches = zip(*plan_objects(join_objects(posed, device), deadline), strict=True)
    for x in ready:
        if isinstance(x, Grasps):
            yield x
        else:
            planned = relax(x, iter(next(batches)), deadline)
            yield finish(x.request, [x.give_back(grasps) for grasps in planned])


def _prepare(request: Request) -> Objects:
    """Estimate the shape of a request's object, and draw initial guesses."""
    objects = pose_request(request, settle_hand(request.hands[0], torch.device("cpu")))
    # objects that another process plans need no caches
    bare = dataclasses.replace(request.hand)
    return dataclasses.replace(objects, hand=bare, request=dataclasses.replace(request, hand=bare))


def _or_refuse(function: Callable[[Request], Result], request: Request) -> Result | Grasps:
    """Return a function of a request. If its cloud is bad, return an empty set of grasps with the
    reason in `meta`.
    """
    try:
        return function(request)
    except MissingExtra:
        raise
    except GraspError as error:
        return _refused(request.hand, one_line(error))


def _refused(hand: Hand, reason: str) -> Grasps:
    """Return an empty set of grasps, whose `meta` gives the reason why planning was refused."""
    return dataclasses.replace(no_grasps(hand), meta={"hand": hand.name, "refused": reason})


def no_grasps(hand: Hand) -> Grasps:
    """Return a `Grasps` that holds no grasp of the hand.

    Its empty tensors have axes of the hand's joints and fingers.
    """
    f = len(hand.tips)

    def none(*shape: int) -> torch.Tensor:
        return torch.zeros(0, *shape, dtype=torch.float64, device="cpu")

    contacts = Contacts(none(f, 3), none(f, 3), none(f), none(f))
    certificate = Certificate(none(), none(), none(), none().bool(), none(6))
    return Grasps(
        none(hand.dof),
        none(hand.dof),
        none(3),
        none(4, 4),
        contacts,
        none(f).long(),
        none(f),
        none(),
        none(f),
        certificate,
        none(),
        none().long(),
        known=none().bool(),
        interval=none(2),
    )


def _each(
    function: Callable[[Request], Result], requests: Sequence[Request], workers: int
) -> Generator[Result | Grasps, None, None]:
    """Yield a function's results for requests with the same hand, in worker processes if there are
    any.
    """
    call = functools.partial(_or_refuse, function)
    if not workers or not requests:
        yield from map(call, requests)
        return
    hand = requests[0].hand
    check_as_loaded(hand)  # each process reads the files
    # without the caches
    source = HandSource(hand.source.option, hand.source.urdf_path, hand.source.sha256)
    tasks = ((call, source, pack(dict(vars(request), hand=None))) for request in requests)
    with contextlib.closing(run_tasks(_call, tasks, workers, MANY.patience)) as results:
        for found in results:
            yield _refused(hand, found.sentence) if isinstance(found, Status) else unpack(found)


def _call(function: Callable[[Request], Any], source: HandSource, packed: dict[str, Any]) -> Any:
    """Call a function of a request in a worker process, which loads the hand itself."""
    hand = load_hand(source.urdf_path.parent, source.option)
    return pack(function(Request(**dict(unpack(packed), hand=hand))))
