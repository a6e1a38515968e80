"""Tasks in worker processes: a worker that hangs or dies loses only its own task."""

import contextlib
import dataclasses
import math
import multiprocessing
import os
import queue
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, TimeoutError
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import reduction, spawn
from typing import Annotated, Any, NamedTuple, TypeVar

import torch

from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import MissingExtra, NoWorkers, Status
from torchgrasp.foundation.rules import Range
from torchgrasp.foundation.threads import one_thread

Result = TypeVar("Result")
Task = tuple[Any, ...]
_starting = threading.Lock()

WALL = 10.0
"""Limit of a task's wall time on a busy machine, over that of its processor time."""
LATE = -int(getattr(signal, "SIGPROF", 0))
"""Exit code of a process that the timer of its processor time ended; 0 where there is none."""


@checked
def run_tasks(
    function: Callable[..., Result],
    tasks: Iterable[Task],
    workers: Annotated[int, Range(0, 1024)] = 1,
    limit: Annotated[float, Range(0.001, math.inf)] = 60.0,
) -> Generator[Result | Status, None, None]:
    """Yield the results of `function(*task)` for all tasks, which run in worker processes, in the
    order of the tasks.

    Each task runs on one thread of a separate process. A task that takes more than `limit` [s] of
    the process's CPU time gives `Status.TIMED_OUT`. CPU time hardly depends on how busy the machine
    is. A task that takes ten times `limit` by the clock also gives `TIMED_OUT`, since it may wait
    for ever. On Windows only the clock counts. A task whose process dies twice gives
    `Status.WORKER_DIED`. The error of a task is raised in place of its result. All workers end when
    the caller stops iterating. Raises `NoWorkers` if no process can start.

    Each worker imports the module of the function. It runs the caller's script only if the function
    is defined there. Tasks must hold no tensors, which processes would share; `pack` replaces them
    by arrays. If `workers`, the number of processes, is 0, the tasks run in this process, without a
    limit on their time.
    """
    return _in_order(_run(function, tasks, workers, limit))


def run_as_they_end(
    function: Callable[..., Result], tasks: Iterable[Task], workers: int, limit: float
) -> Generator[tuple[int, Result | Status], None, None]:
    """Run tasks in worker processes; yield the index and the result of each task as soon as it
    ends.

    The result is that of `function(*task)`. It is `Status.TIMED_OUT` if the task took too long, and
    `Status.WORKER_DIED` if its process died twice. The error of a task is raised in place of its
    result. `workers` is the number of processes; with 0 the tasks run in this process. `limit` [s]
    is the longest CPU time of a task; ten times `limit` is the longest time by the clock.
    """
    with contextlib.closing(_run(function, tasks, workers, limit)) as results:
        for number, ended in results:
            yield number, ended if isinstance(ended, Status) else ended.result()


def _in_order(
    results: Generator[tuple[int, Future[Result] | Status], None, None],
) -> Generator[Result | Status, None, None]:
    early: dict[int, Future[Result] | Status] = {}
    turn = 0
    with contextlib.closing(results):
        for number, ended in results:
            early[number] = ended
            while turn in early:
                ended = early.pop(turn)
                turn += 1
                yield ended if isinstance(ended, Status) else ended.result()


def _run(
    function: Callable[..., Result], tasks: Iterable[Task], workers: int, limit: float
) -> Generator[tuple[int, Future[Result] | Status], None, None]:
    """Run the tasks; yield the index and the result of each when it ends. A broken pool of
    processes is replaced.
    """
    if not workers:
        for number, task in enumerate(tasks):
            future = Future[Result]()
            with one_thread():
                try:
                    future.set_result(function(*task))
                except Exception as error:
                    future.set_exception(error)
            yield number, future
        return
    waiting = deque(enumerate(tasks))
    died = set[int]()
    broken = 0
    worked = False
    while waiting:
        before = len(waiting)
        yield from _run_pool(function, waiting, died, workers, limit)
        broken = broken + 1 if len(waiting) == before else 0
        worked = worked or not broken or bool(died)
        if broken == 2 and not worked:
            raise NoWorkers
        if broken == 2:
            broken = 0
            yield waiting.popleft()[0], Status.WORKER_DIED


def _run_pool(
    function: Callable[..., Result],
    waiting: deque[tuple[int, Task]],
    died: set[int],
    workers: int,
    limit: float,
) -> Generator[tuple[int, Future[Result] | Status], None, None]:
    """Run `waiting` tasks in one pool until all end or the pool breaks; `died` are tasks whose
    process died once.
    """
    try:
        from pebble import ProcessExpired, ProcessPool
    except ImportError as error:
        raise MissingExtra("pebble", "sim") from error
    # The initializer imports the module of the function before the time of the first task begins.

    # whether only the script has the function
    own = b"__main__" in bytes(reduction.ForkingPickler.dumps(function))
    if _USUAL.get_start_method() == "forkserver":
        _USUAL.set_forkserver_preload(["torchgrasp"])
    pool = ProcessPool(
        min(workers, len(waiting)),
        initializer=_begin,
        initargs=[function, dict(os.environ)],
        context=_USUAL if own else _Apart(),
    )
    ended = queue.SimpleQueue[int]()
    running: dict[int, tuple[Task, Future[Result]]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < 2 * workers:
                number, task = waiting[0]
                try:
                    timed = (limit, function, *task)
                    future = pool.schedule(_call_timed, timed, timeout=WALL * limit)
                except RuntimeError:  # the pool broke
                    return
                running[number] = waiting.popleft()[1], future
                future.add_done_callback(lambda _, number=number: ended.put(number))
            try:
                number = ended.get(timeout=1.0)  # a broken pool may never end some tasks
            except queue.Empty:
                if pool.active:
                    continue
                return
            error = running[number][1].exception()
            if isinstance(error, BrokenProcessPool):
                return
            task, future = running.pop(number)
            late = isinstance(error, ProcessExpired) and error.exitcode == LATE
            if late or isinstance(error, TimeoutError):
                yield number, Status.TIMED_OUT
            elif isinstance(error, ProcessExpired) and number not in died:
                # a machine short of memory may kill any process: try once more, first
                died.add(number)
                waiting.appendleft((number, task))
            elif isinstance(error, ProcessExpired):
                yield number, Status.WORKER_DIED
            else:
                yield number, future
    finally:
        waiting.extendleft(
            (number, task) for number, (task, _) in sorted(running.items(), reverse=True)
        )
        pool.stop()
        # a signal can leave pebble's threads waiting for each other
        with contextlib.suppress(TimeoutError):
            pool.join(10.0)


def _usual_context() -> Any:
    """Return the way in which worker processes start.

    They are copies of a server process that has imported the library. The server has no threads
    that a copy would lack. On Windows each imports the library itself.
    """
    copies = "forkserver" in multiprocessing.get_all_start_methods()
    return multiprocessing.get_context("forkserver" if copies else "spawn")


_USUAL = _usual_context()


class _Process(_USUAL.Process):
    """A process that does not run the caller's script, which would begin the work anew where it has
    no guard.
    """

    def start(self) -> None:
        """Start the process without the path of the caller's script."""
        with _starting:
            known = spawn.get_preparation_data
            spawn.get_preparation_data = lambda name: {
                k: x for k, x in known(name).items() if k[:9] != "init_main"
            }
            try:
                super().start()
            finally:
                spawn.get_preparation_data = known


class _Apart(type(_USUAL)):
    """A way to start processes: each is a `_Process`."""

    Process = _Process


def _begin(function: Callable[..., Any], environment: dict[str, str]) -> None:
    """Prepare a worker process: it uses one torch thread, and it ends when its parent process ends.

    `environment` holds the variables of the parent process; those of the server may be older.
    """
    os.environ.clear()
    os.environ.update(environment)
    torch.set_num_threads(1)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _call_timed(limit: float, function: Callable[..., Result], *task: Any) -> Result:
    """Call a function in a worker process, which ends if the call takes more than `limit` [s] of
    CPU time.
    """
    timed = hasattr(signal, "setitimer") and math.isfinite(limit)
    if timed:
        signal.setitimer(signal.ITIMER_PROF, limit)
    try:
        return function(*task)
    finally:
        if timed:
            signal.setitimer(signal.ITIMER_PROF, 0.0)


class _Packed(NamedTuple):
    """A tensor or a dataclass in a form for another process.

    `kind` is the name of the tensor's device, or the class of the dataclass. `content` is the
    tensor as an array, or the packed attributes of the dataclass, cached ones too.
    """

    kind: type | str
    content: Any


def pack(value: Any, known: dict[int, Any] | None = None) -> Any:
    """Return a value in a form for another process; `unpack` restores it.

    NumPy arrays take the place of tensors, which processes would share. `known` maps the `id` of
    each object that is already packed to its packed form; None means no object. So an object that
    occurs twice is sent once.
    """
    known = {} if known is None else known
    if id(value) in known:
        return known[id(value)]
    if isinstance(value, torch.Tensor):
        packed = known[id(value)] = _Packed(str(value.device), value.detach().cpu().numpy())
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        packed = known[id(value)] = _Packed(type(value), pack(vars(value), known))
    else:
        packed = _map_items(lambda item: pack(item, known), value)
    return packed


def unpack(packed: Any) -> Any:
    """Return the value whose packed form `pack` made, with its tensors on their devices."""
    if not isinstance(packed, _Packed):
        return _map_items(unpack, packed)
    if isinstance(packed.kind, str):
        return torch.from_numpy(packed.content).to(torch.device(packed.kind))
    value = object.__new__(packed.kind)
    vars(value).update(unpack(packed.content))
    return value


def _map_items(function: Callable[[Any], Any], value: Any) -> Any:
    """Return a dictionary, list or tuple with the results of a function of its items; another value
    as it is.
    """
    if isinstance(value, dict):
        return {key: function(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        items = map(function, value)
        return type(value)(*items) if hasattr(value, "_fields") else type(value)(items)
    return value
