"""Calls that use one torch thread: on busy cores several threads mostly wait for each other."""

import contextlib
import functools
import inspect
import threading
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager
from typing import Any, TypeVar

import torch

Function = TypeVar("Function", bound=Callable[..., Any])
_lock = threading.Lock()
_here = threading.local()  # `inside` is True in a thread that is within `one_thread`
_state = {"calls": 0, "before": 1}
"""How many threads are within `one_thread`, and the number of torch's threads before the first of
them.
"""


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Return a context in which torch computes with one thread. Afterwards it has as many threads
    as before.
    """
    if getattr(_here, "inside", False):
        yield
        return
    with _lock:
        if not _state["calls"]:
            _state["before"] = torch.get_num_threads()
        _state["calls"] += 1
    _here.inside = True
    torch.set_num_threads(1)
    try:
        yield
    finally:
        with _lock:
            _state["calls"] -= 1
        _here.inside = False
        torch.set_num_threads(_state["before"])


def single_threaded(function: Function) -> Function:
    """Return a function that calls `function` while torch uses a single thread (`one_thread`).

    If `function` is a generator function, torch uses one thread while each item is computed, but
    not between items.
    """

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        with one_thread():
            result = function(*args, **kwargs)
        return each_within(result, one_thread) if inspect.isgenerator(result) else result

    return call  # pyright: ignore[reportReturnType]


def each_within(
    items: Generator[Any, Any, Any], context: Callable[[], AbstractContextManager[None]]
) -> Iterator[Any]:
    """Yield the items of a generator; each item is computed within a new context, the result of
    `context()`. The context ends before the item is yielded.
    """
    with contextlib.closing(items):
        while True:
            with context():
                try:
                    item = next(items)
                except StopIteration:
                    return
            yield item
