"""Tasks on a Dask cluster, where a worker that dies loses only its own task."""

import itertools
import os
import threading
import uuid
from collections.abc import Callable, Generator, Iterable
from typing import Any, NamedTuple, TypeVar

from torchgrasp.foundation.errors import BadArgument, MissingExtra, Status
from torchgrasp.foundation.threads import one_thread

Result = TypeVar("Result")
CONNECTING = "30s"  # longest time for the scheduler to answer
# tasks that the scheduler holds at once: ten for each of a thousand workers; a task costs memory
OUTSTANDING = 10_000


class OnGpu(NamedTuple):
    """A task for a Dask worker with the resource "GPU": it calls `function` with the arguments
    `task`.

    `run_on_cluster` takes it as an argument of other tasks, which get its result in its place.
    """

    function: Callable[..., Any]
    task: tuple[Any, ...]


def run_on_cluster(
    function: Callable[..., Result], tasks: Iterable[tuple[Any, ...]], address: str, limit: float
) -> Generator[tuple[int, Result | Status], None, None]:
    """Call `function` for each of `tasks` on a Dask cluster, and yield (index, result) of each task
    as it ends.

    A task holds the arguments of a call, and its index counts `tasks` from 0. The result is that of
    `function`, or a `Status` if the worker dies or the call takes too long. An error of `function`
    is raised here. `address` is that of the scheduler.

    A task whose worker dies is given to another worker. After too many such deaths the task gives
    `Status.WORKER_DIED`. The scheduler's setting `distributed.scheduler.allowed-failures`, 3 by
    default, is their number. A task that takes longer than `limit` [s] ends its worker, and gives
    `Status.TIMED_OUT`. At most 10 000 tasks (`OUTSTANDING`) are given to the scheduler at once;
    they wait there for a free worker. An argument `OnGpu` that successive tasks share is computed
    once.

    Raises `MissingExtra` without Dask, and `BadArgument` without a scheduler at the address.
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
                # a result that was yielded leaves the memory; the traceback of a worker that died
                # may hold its future
                future.release()
                del future
                submit(1)
                yield number, result
        finally:
            client.cancel(list(futures))


def _bounded(
    function: Callable[..., Result], limit: float, name: str, *task: Any
) -> Result | Status:
    """Call a function on one thread of a worker process. End the process if the call takes longer
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
