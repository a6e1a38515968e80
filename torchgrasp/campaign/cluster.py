"""One job of a campaign, and running jobs on a Dask cluster, where a worker that dies loses only
its own job.
"""

import contextlib
import importlib.metadata
import itertools
import json
import os
import threading
import uuid
from collections.abc import Callable, Generator, Iterable
from typing import Any, NamedTuple, TypeVar

import torch

from torchgrasp.data.shards import JobRow, Records, Shard, pack_shard, short
from torchgrasp.evaluation.protocols import Protocol
from torchgrasp.evaluation.views import (
    EvaluationSpec,
    ObjectView,
    choose_rows,
    plan_view,
    plan_views,
    try_grasp,
)
from torchgrasp.foundation.errors import BadArgument, MissingExtra, OutputError, Status
from torchgrasp.foundation.threads import one_thread
from torchgrasp.hand.hand import Hand
from torchgrasp.planner.many import no_grasps
from torchgrasp.values.planning import Grasps

PACKAGES = ("torchgrasp", "torch", "numpy", "scipy", "trimesh", "sapien", "mujoco", "coacd")
"""Packages whose versions may change the results of a campaign."""
Result = TypeVar("Result")
CONNECTING = "30s"  # longest time for the scheduler to answer
# tasks that the scheduler holds at once: ten for each of a thousand workers; a task costs memory
OUTSTANDING = 10_000


def versions() -> dict[str, str]:
    """Return the installed versions of `PACKAGES`; "none" for a package that is not installed."""
    from torchgrasp import __version__

    found: dict[str, str] = dict.fromkeys(PACKAGES, "none")
    found["torchgrasp"] = __version__  # of the source; an installation may be older
    for name in PACKAGES[1:]:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def check_versions(meta: dict[str, str]) -> None:
    """Raise `BadArgument` unless this machine has the software with which the campaign began.

    `meta["versions"]` holds the versions at its start as JSON.
    """
    here = json.dumps(versions())
    if here != meta["versions"]:
        raise BadArgument("workers", f"one with {here}", f"workers with {meta['versions']}")


class OnGpu(NamedTuple):
    """A task for a worker with the resource "GPU", whose result is an argument of other tasks.

    The worker calls `function` with the arguments `task`.
    """

    function: Callable[..., Any]
    task: tuple[Any, ...]


def plan_jobs(meta: dict[str, str], *task: Any) -> list[Grasps | None]:
    """Return the executable grasps of several jobs, None for a job that could not be planned.

    `task` holds the arguments of `plan_views`. Raises `BadArgument` on a machine whose software
    differs from `meta["versions"]`.
    """
    check_versions(meta)
    return plan_views(*task)


def run_job(
    view: ObjectView,
    protocol: Protocol,
    spec: EvaluationSpec,
    meta: dict[str, str],
    plans: object = None,
    place: int = 0,
) -> bytes:
    """Plan and try the grasps of one job, a `view`; return the bytes of a shard file with only this
    job.

    `protocol` is the test of each grasp, and `spec` says which grasps are tried. `meta` holds the
    `versions` of the software with which the campaign began; every machine must have them, and the
    same hand. `plans` is what `plan_jobs` returned, and the job's plan is `plans[place]`. If it is
    no list (None, or the `Status` of a planning that took too long), the job is planned here. A
    faulty object gives a `JobRow` with the reason. Errors that are not the object's fault are
    raised.
    """
    check_versions(meta)
    hand = view.load_hand()
    if hand.source.sha256 != view.hand.sha256:
        found = f"{view.hand.urdf_path} with other files"
        raise BadArgument("hand", found, "the same hand on every machine")
    plan = plans[place] if isinstance(plans, list) else None
    try:
        shard = _work(view, hand, protocol, spec, plan)
    except (MissingExtra, OutputError, MemoryError, OSError):
        raise
    except Exception as error:  # of the library: a week of other jobs shall not end with it
        note = short(f"{type(error).__name__}: {error}")
        row = JobRow(view.object, view.view, Status.BROKEN, note)
        shard = empty_shard(row, hand, protocol.noise.draws)
    return pack_shard(shard, meta)


def _work(
    view: ObjectView, hand: Hand, protocol: Protocol, spec: EvaluationSpec, plan: Grasps | None
) -> Shard:
    """Plan grasps on the view of a job unless there is a plan, and try the chosen grasps in
    simulation.
    """
    score, cloud, found = plan_view(view, protocol, spec, plan)
    note = short(score.note)
    row = JobRow(view.object, view.view, score.refusal, note, score.family, score.group)
    draws = protocol.noise.draws
    if cloud is None or found is None:
        return empty_shard(row, hand, draws)
    ranks = choose_rows(len(found), spec.grasps, spec.ranks)
    passed = torch.zeros(len(ranks), draws, dtype=torch.bool)
    outcome = torch.zeros(passed.shape, dtype=torch.int64)
    for k, rank in enumerate(ranks):
        for draw in range(draws):
            tried = try_grasp(view, found, protocol, spec, (rank, draw))
            passed[k, draw] = tried.passed
            outcome[k, draw] = int(tried.status)
    row = row._replace(
        executable=len(found),
        points=len(cloud),
        grasps=len(ranks),
        passed=int(passed.sum()),
        meta=found.meta,
    )
    eye = torch.zeros(3) if cloud.viewpoint is None else cloud.viewpoint
    points = cloud.points.double()
    return Shard((row,), Records(points, eye.double()[None], found[ranks], passed, outcome))


def empty_shard(row: JobRow, hand: Hand, draws: int) -> Shard:
    """Return the shard of a job that has neither a cloud nor grasps.

    `row` is its outcome, and `draws` the number of trials of each grasp in the campaign.
    """
    points = torch.zeros(0, 3, dtype=torch.float64)
    eye = torch.zeros(1, 3, dtype=torch.float64)
    tried = torch.zeros(0, draws, dtype=torch.int64)
    return Shard((row,), Records(points, eye, no_grasps(hand), tried.bool(), tried))


def run_on_cluster(
    function: Callable[..., Result], tasks: Iterable[tuple[Any, ...]], address: str, limit: float
) -> Generator[tuple[int, Result | Status], None, None]:
    """Run tasks on a Dask cluster, and yield the index and the result of each as it ends.

    A task holds the arguments of `function`; `address` is that of the scheduler. A task whose
    worker dies is given to another worker; after the deaths that the scheduler allows
    (`distributed.scheduler.allowed-failures`, 3 by default) it gives `Status.WORKER_DIED`. A task
    that takes longer than `limit` [s] ends its worker, and gives `Status.TIMED_OUT`. The scheduler
    holds `OUTSTANDING` tasks at most, which wait until a worker is free. An argument `OnGpu` that
    successive tasks share is computed once. Without Dask, `MissingExtra` is raised; without a
    scheduler at the address, `BadArgument`.
    """
    try:
        from distributed import CancelledError, Client, Event, KilledWorker, as_completed
    except ImportError as error:
        raise MissingExtra("dask", "cluster") from error
    try:
        client = Client(address, timeout=CONNECTING, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:  # of names and of numbers that are no address
        allowed = "the address of a running Dask scheduler, as tcp://10.0.0.1:8786"
        raise BadArgument("workers", f"{address!r} ({error})", allowed) from error
    with client:
        run = uuid.uuid4().hex
        waiting = enumerate(tasks)
        futures = dict[Any, int]()
        # the last task on a GPU, and its future
        ended = as_completed(loop=client.loop)
        plan = (None, None)

        def submit(most: int) -> None:
            nonlocal plan
            for number, task in itertools.islice(waiting, most):
                for new in (x for x in task if isinstance(x, OnGpu) and x != plan[0]):
                    call = _bounded, new.function, limit, f"{run}-plan-{number}", *new.task
                    plan = new, client.submit(*call, pure=False, priority=1, resources={"GPU": 1})
                given = (plan[1] if isinstance(x, OnGpu) else x for x in task)
                call = _bounded, function, limit, f"{run}-{number}", *given
                future = client.submit(*call, pure=False)
                futures[future] = number
                ended.add(future)

        try:
            submit(OUTSTANDING)
            for future in ended:
                number = futures.pop(future)
                try:
                    result = future.result()
                except KilledWorker:  # also of the worker that planned
                    late = Event(f"{run}-{number}", client).is_set()
                    result = Status.TIMED_OUT if late else Status.WORKER_DIED
                except CancelledError as error:
                    found = f"{address!r}, which ended during the work"
                    allowed = "a scheduler that goes on; the same call continues"
                    raise BadArgument("workers", found, allowed) from error
                # a result that was yielded leaves the memory, whatever else holds its future, as
                # the traceback of a worker that died may
                future.release()
                del future
                submit(1)
                yield number, result
        finally:
            client.cancel(list(futures))


def _bounded(
    function: Callable[..., Result], limit: float, name: str, *task: Any
) -> Result | Status:
    """Call a function on one thread of a worker process; end the process if the call takes longer
    than `limit` [s].
    """
    from distributed import Event

    late = Event(name)
    if late.is_set():
        return Status.TIMED_OUT

    def end() -> None:
        try:
            late.set()
        finally:
            os._exit(1)

    clock = threading.Timer(limit, end)
    clock.daemon = True
    clock.start()
    try:
        with one_thread():
            return function(*task)
    finally:
        clock.cancel()
