"""Tasks on worker processes: a simulator that hangs or dies costs its own task alone."""

import collections
import contextlib
import math
import multiprocessing
import os
import threading
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import TimeoutError
from concurrent.futures.process import BrokenProcessPool
from typing import Annotated, Any, TypeVar

import torch

from torchgrasp.border import Range, checked
from torchgrasp.errors import MissingExtra, Status

Result = TypeVar("Result")

JOIN_TIME = 10.0
"""Longest time [s] for stopped workers to end: they are killed, which takes milliseconds."""


@checked
def run_tasks(
    function: Callable[..., Result],
    tasks: Iterable[tuple[Any, ...]],
    workers: Annotated[int, Range(0, 1024)] = 1,
    limit: Annotated[float, Range(0.001, math.inf)] = 60.0,
) -> Generator[Result | Status, None, None]:
    """Yield `function(*task)` for each task, in the order of the tasks.

    A task runs on one thread, a worker is a fresh process. A late task gives `Status.TIMED_OUT`, a task whose process
    dies twice `Status.WORKER_DIED`. All workers end when the caller stops listening.

    Args:
        function: of a module, so that a worker can import it.
        tasks: arguments of the calls: paths, numbers, arrays and values of them, but no tensors, which would be shared.
        workers: processes; 0: this one, without a limit of time.
        limit: wall time of a task [s].

    Raises:
        BadArgument: workers outside [0, 1024], or a limit below 1 ms.
        MissingExtra: pebble is not installed.
        Exception: of a task, when its turn comes.

    >>> list(run_tasks(pow, [(2, 3), (3, 2)], workers=0))
    [8, 9]
    """
    return _run(function, tasks, workers, limit) if workers else _run_here(function, tasks)


def _run_here(function: Callable[..., Result], tasks: Iterable[tuple[Any, ...]]) -> Generator[Result, None, None]:
    """Yield the results of this process, which has its threads again in between."""
    for task in tasks:
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            result = function(*task)
        finally:
            torch.set_num_threads(threads)
        yield result


def _run(
    function: Callable[..., Result], tasks: Iterable[tuple[Any, ...]], workers: int, limit: float
) -> Generator[Result | Status, None, None]:
    """Yield the results of workers; where all of them die before they take a task, others take their place."""
    waiting, lost = collections.deque(tasks), 0
    while waiting:
        before = len(waiting)
        for result in _run_pool(function, waiting, workers, limit):
            waiting.popleft()
            lost = 0
            yield result
        lost += len(waiting) == before
        if lost == 2:
            waiting.popleft()
            lost = 0
            yield Status.WORKER_DIED


def _run_pool(
    function: Callable[..., Result], tasks: Iterable[tuple[Any, ...]], workers: int, limit: float
) -> Generator[Result | Status, None, None]:
    """Yield the results of one pool of workers until all tasks are done, or the pool is broken."""
    try:
        from pebble import ProcessExpired, ProcessPool
    except ImportError as error:
        raise MissingExtra("pebble", "sim") from error
    # The function goes along so that its module is imported before the first task's time begins to run.
    pool = ProcessPool(workers, initializer=_begin, initargs=[function], context=multiprocessing.get_context("spawn"))
    try:
        try:
            waiting = collections.deque((task, pool.schedule(function, task, timeout=limit)) for task in tasks)
        except RuntimeError:  # it broke meanwhile
            return
        while waiting:
            task, first = waiting.popleft()  # results that were yielded leave the memory
            try:
                try:
                    result = first.result()
                except ProcessExpired:  # a machine short of memory kills the innocent too: once more
                    try:
                        second = pool.schedule(function, task, timeout=limit)
                    except RuntimeError:
                        return
                    result = second.result()
            except TimeoutError:
                result = Status.TIMED_OUT
            except ProcessExpired:
                result = Status.WORKER_DIED
            except BrokenProcessPool:
                return
            yield result
    finally:
        pool.stop()
        with contextlib.suppress(TimeoutError):  # a signal can leave pebble's threads waiting for each other
            pool.join(JOIN_TIME)


def _begin(function: Callable[..., Any]) -> None:
    """Prepare a worker: one thread, and an end with the parent."""
    torch.set_num_threads(1)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
