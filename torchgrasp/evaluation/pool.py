"""Tasks on worker processes that may hang, crash or be killed: each failure costs its own task and no other.

A simulator is C++ code that no exception stops, so every task runs in a process of its own kind: started afresh
(spawn), on one thread of torch, ended when its parent ends.
"""

import itertools
import multiprocessing
import os
import threading
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import TimeoutError
from typing import TYPE_CHECKING, Any, TypeVar

import torch

from torchgrasp.errors import BadArgument, MissingExtra, Status

if TYPE_CHECKING:
    from pebble import ProcessFuture, ProcessPool

Result = TypeVar("Result")


def run_tasks(
    function: Callable[..., Result], tasks: Iterable[tuple[Any, ...]], workers: int = 1, limit: float = 60.0
) -> Generator[Result | Status, None, None]:
    """Yield `function(*task)` for each task, in the order of the tasks whatever the number of workers.

    A task that is not done in time gives `Status.TIMED_OUT` and its process is killed; one whose process dies twice
    gives `Status.WORKER_DIED`. Another process takes the place, and the other tasks never know. All workers end when
    the caller stops listening: by an error, an interrupt, or `close()`.

    Args:
        function: of a module, so that a worker can import it.
        tasks: arguments of each call: paths, numbers, arrays and values of them, but no tensors, which processes would
            share instead of copy.
        workers: processes; 0: this one, without a limit of time, for what is known to end.
        limit: seconds of wall time that a task may take.

    Raises:
        BadArgument: workers below 0, or a limit that is not positive.
        MissingExtra: pebble is not installed.
        Exception: whatever a task raised, when its turn comes.

    >>> list(run_tasks(pow, [(2, 3), (3, 2)], workers=0))
    [8, 9]
    """
    if workers < 0:
        raise BadArgument("workers", workers, "at least 0")
    if not limit > 0:
        raise BadArgument("limit", limit, "a positive number of seconds")
    return _results(function, tasks, workers, limit)  # lazy, where a bad argument is named at once


def _results(
    function: Callable[..., Result], tasks: Iterable[tuple[Any, ...]], workers: int, limit: float
) -> Generator[Result | Status, None, None]:
    """Yield the results, of this process or of workers."""
    if not workers:
        yield from itertools.starmap(function, tasks)
        return
    try:
        from pebble import ProcessPool
    except ImportError as error:
        raise MissingExtra("pebble", "sim") from error
    # The function goes along so that its module is imported before the first task's time begins to run.
    pool = ProcessPool(workers, initializer=_begin, initargs=[function], context=multiprocessing.get_context("spawn"))
    try:
        futures = [(task, pool.schedule(function, task, timeout=limit)) for task in tasks]
        for task, future in futures:
            yield _result(pool, function, task, future, limit)
    finally:
        pool.stop()
        pool.join()


def _result(
    pool: "ProcessPool",
    function: Callable[..., Result],
    task: tuple[Any, ...],
    future: "ProcessFuture[Result]",
    limit: float,
) -> Result | Status:
    """Wait for a task; one whose process died gets another, since a machine short of memory kills the innocent too."""
    from pebble import ProcessExpired

    for attempt in (future, None):
        try:
            return (attempt or pool.schedule(function, task, timeout=limit)).result()
        except TimeoutError:
            return Status.TIMED_OUT
        except ProcessExpired:
            continue
    return Status.WORKER_DIED


def _begin(function: Callable[..., Any]) -> None:
    """Prepare a worker: one thread, and no life without the parent."""
    torch.set_num_threads(1)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        """End when the parent has ended, however it did."""
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
