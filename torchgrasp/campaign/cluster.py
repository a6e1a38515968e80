"""Jobs on a Dask cluster; a worker that dies costs its own job alone, which another one takes over."""

import os
import threading
from collections import deque
from collections.abc import Callable, Generator, Sequence
from typing import Any, TypeVar

import torch

from torchgrasp.errors import BadArgument, MissingExtra, Status

Result = TypeVar("Result")

CONNECTING = "30s"
"""Longest time for the scheduler to answer."""


def run_on_cluster(
    function: Callable[..., Result], tasks: Sequence[tuple[Any, ...]], address: str, limit: float
) -> Generator[Result | Status, None, None]:
    """Yield `function(*task)` of each task, in the order of the tasks.

    A task whose worker dies is given to another one; after the deaths that the scheduler allows
    (`distributed.scheduler.allowed-failures`, 3 by default) it gives `Status.WORKER_DIED`. A task that takes longer
    than `limit` [s] ends its worker, which counts as a death. Tasks that nobody works on wait for workers.

    Raises:
        MissingExtra: Dask is not installed.
        BadArgument: no scheduler answers at the address, or it ends.
        Exception: of a task, when its turn comes.
    """
    try:
        from distributed import CancelledError, Client, KilledWorker
    except ImportError as error:
        raise MissingExtra("dask", "cluster") from error
    try:
        client = Client(address, timeout=CONNECTING, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:  # of names and of numbers that are no address
        allowed = "the address of a running Dask scheduler, as tcp://10.0.0.1:8786"
        raise BadArgument("workers", f"{address!r} ({error})", allowed) from error
    with client:
        waiting = deque(client.submit(_bounded, function, limit, *task, pure=False) for task in tasks)
        try:
            while waiting:
                future = waiting.popleft()  # results that were yielded leave the memory
                try:
                    result = future.result()
                except KilledWorker:
                    result = Status.WORKER_DIED
                except CancelledError as error:
                    found = f"{address!r}, which ended during the work"
                    raise BadArgument("workers", found, "a scheduler that goes on; the same call continues") from error
                del future
                yield result
        finally:
            client.cancel(list(waiting))


def _bounded(function: Callable[..., Result], limit: float, *task: Any) -> Result:
    """Call a function on one thread of a worker, which ends if it takes longer: nothing else stops a simulator."""
    clock = threading.Timer(limit, os._exit, [1])
    clock.daemon = True
    clock.start()
    torch.set_num_threads(1)
    try:
        return function(*task)
    finally:
        clock.cancel()
