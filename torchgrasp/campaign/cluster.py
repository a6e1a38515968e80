"""Jobs on a Dask cluster; a worker that dies costs its own job alone, which another one takes over."""

import os
import threading
import uuid
from collections.abc import Callable, Generator, Sequence
from typing import Any, TypeVar

import torch

from torchgrasp.errors import BadArgument, MissingExtra, Status

Result = TypeVar("Result")

CONNECTING = "30s"  # longest time for the scheduler to answer


def run_on_cluster(
    function: Callable[..., Result], tasks: Sequence[tuple[Any, ...]], address: str, limit: float
) -> Generator[tuple[int, Result | Status], None, None]:
    """Yield the number of each task and `function(*task)`, in the order in which they end.

    A task whose worker dies is given to another one; after the deaths that the scheduler allows
    (`distributed.scheduler.allowed-failures`, 3 by default) it gives `Status.WORKER_DIED`. A task that takes longer
    than `limit` [s] ends its worker, and gives `Status.TIMED_OUT`. Tasks that nobody works on wait for workers.

    Raises:
        MissingExtra: Dask is not installed.
        BadArgument: no scheduler answers at the address, or it ends.
        Exception: of a task, when it ends.
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
        futures = {
            client.submit(_bounded, function, limit, names[k], *task, pure=False): k for k, task in enumerate(tasks)
        }
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
    """Call a function on one thread of a worker, which ends if it takes longer: nothing else stops a simulator.

    An event on the scheduler tells the worker that is given the task next that it was late before.
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
    torch.set_num_threads(1)
    try:
        return function(*task)
    finally:
        clock.cancel()
