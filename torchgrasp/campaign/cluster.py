"""One job of a campaign, and running jobs on a Dask cluster, where a worker that dies loses only its own job."""

import importlib.metadata
import json
import os
import threading
import uuid
from collections.abc import Callable, Generator, Sequence
from typing import Any, TypeVar

import torch

from torchgrasp.data.shards import JobRow, Records, Shard, pack_shard, short
from torchgrasp.errors import BadArgument, MissingExtra, OutputError, Status
from torchgrasp.evaluation.protocols import Protocol
from torchgrasp.evaluation.views import EvaluationSpec, View, choose_rows, plan_view, try_grasp
from torchgrasp.hand.hand import Hand
from torchgrasp.planner.many import no_grasps

PACKAGES = ("torchgrasp", "torch", "numpy", "scipy", "trimesh", "sapien", "mujoco", "coacd")
"""Packages whose versions may change the results of a campaign."""
Result = TypeVar("Result")
CONNECTING = "30s"  # longest time for the scheduler to answer


def versions() -> dict[str, str]:
    """Return the installed versions of `PACKAGES`; "none" for a package that is not installed."""
    from torchgrasp import __version__

    found = {"torchgrasp": __version__}  # of the source that runs; an installation may be older
    for name in PACKAGES[1:]:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "none"
    return found


def check_versions(meta: dict[str, str]) -> None:
    """Raise `BadArgument` unless this machine has the software of the machine that began the campaign."""
    if (here := json.dumps(versions())) != meta["versions"]:
        raise BadArgument("workers", f"one with {here}", f"workers with {meta['versions']}")


def run_job(view: View, protocol: Protocol, spec: EvaluationSpec, meta: dict[str, str]) -> bytes:
    """Plan and try the grasps of one job; return the bytes of a shard file that holds only this job.

    Every machine must have the same hand and the same software as the machine that began the campaign: `meta` holds the
    `versions` of the software. A faulty object gives a row with the reason. Errors that are not the object's fault are
    raised.
    """
    check_versions(meta)
    hand = view.load_hand()
    if hand.source.sha256 != view.hand.sha256:
        raise BadArgument("hand", f"{view.hand.urdf_path} with other files", "the same hand on every machine")
    try:
        shard = _work(view, hand, protocol, spec)
    except (MissingExtra, OutputError, MemoryError, OSError):
        raise
    except Exception as error:  # of the library: a week of other jobs shall not end with it
        row = JobRow(view.object, view.view, Status.BROKEN, short(f"{type(error).__name__}: {error}"))
        shard = empty_shard(row, hand, protocol.noise.draws)
    return pack_shard(shard, meta)


def _work(view: View, hand: Hand, protocol: Protocol, spec: EvaluationSpec) -> Shard:
    """Plan grasps on the view of a job, and try the chosen grasps in simulation."""
    score, cloud, found = plan_view(view, protocol, spec)
    row = JobRow(view.object, view.view, score.refusal, short(score.note), score.family, score.group)
    if cloud is None or found is None:
        return empty_shard(row, hand, protocol.noise.draws)
    ranks = choose_rows(len(found), spec.grasps, spec.ranks)
    grasps, draws = found[ranks], range(protocol.noise.draws)
    tries = [try_grasp(view, found[rank], protocol, spec, (rank, draw)) for rank in ranks for draw in draws]
    passed = torch.tensor([x.passed for x in tries], dtype=torch.bool).reshape(len(ranks), len(draws))
    outcome = torch.tensor([int(x.status) for x in tries], dtype=torch.int64).reshape(passed.shape)
    eye = torch.zeros(3, dtype=torch.float64) if cloud.viewpoint is None else cloud.viewpoint.double()
    counts = {"executable": len(found), "points": len(cloud), "grasps": len(ranks), "passed": int(passed.sum())}
    row = row._replace(**counts, meta=found.meta)
    return Shard((row,), Records(cloud.points.double(), eye[None], grasps, passed, outcome))


def empty_shard(row: JobRow, hand: Hand, draws: int) -> Shard:
    """Return the data of a job that has neither a cloud nor grasps, as a shard."""
    points, tried = torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, draws, dtype=torch.int64)
    return Shard((row,), Records(points, torch.zeros(1, 3, dtype=torch.float64), no_grasps(hand), tried.bool(), tried))


def run_on_cluster(
    function: Callable[..., Result], tasks: Sequence[tuple[Any, ...]], address: str, limit: float
) -> Generator[tuple[int, Result | Status], None, None]:
    """Run tasks on a Dask cluster; yield the index of each task and its result, in the order in which they end.

    A task whose worker dies is given to another worker; after the deaths that the scheduler allows
    (`distributed.scheduler.allowed-failures`, 3 by default) it gives `Status.WORKER_DIED`. A task that takes longer
    than `limit` [s] ends its worker, and gives `Status.TIMED_OUT`. Tasks wait until a worker is free. Without Dask,
    `MissingExtra` is raised; without a scheduler at the address, `BadArgument`.
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
        names = [f"torchgrasp-late-{run}-{k}" for k in range(len(tasks))]
        shared = _bounded, function, limit
        futures = {client.submit(*shared, names[k], *task, pure=False): k for k, task in enumerate(tasks)}
        try:
            for future in as_completed(list(futures), loop=client.loop):
                number = futures.pop(future)
                late = Event(names[number], client)
                try:
                    result = future.result()
                except KilledWorker:
                    result = Status.TIMED_OUT if late.is_set() else Status.WORKER_DIED
                except CancelledError as error:
                    found = f"{address!r}, which ended during the work"
                    raise BadArgument("workers", found, "a scheduler that goes on; the same call continues") from error
                del future  # results that were yielded leave the memory
                if result is Status.TIMED_OUT:
                    late.clear()
                yield number, result
        finally:
            client.cancel(list(futures))


def _bounded(function: Callable[..., Result], limit: float, name: str, *task: Any) -> Result | Status:
    """Call a function on one thread of a worker process; end the process if the call takes longer than `limit` [s]."""
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
    torch.set_num_threads(1)
    try:
        return function(*task)
    finally:
        clock.cancel()
