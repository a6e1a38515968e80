"""Limits under which a file of a stranger is read: seconds of the processor, and memory."""

import contextlib
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

SECONDS, BYTES = 5.0, 2**30
"""What a small file may cost at most."""


class TooSlow(Exception):
    """A reader took more than `SECONDS` of the processor."""


@contextlib.contextmanager
def limited(most: int = BYTES) -> Iterator[None]:
    """Raise `TooSlow` after `SECONDS` of the processor, and `MemoryError` beyond `most` bytes more than there are.

    Only Linux has both limits; elsewhere there are none.
    """
    if sys.platform != "linux":
        yield
        return
    import resource

    def end(*_: object) -> None:
        raise TooSlow

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGVTALRM, end)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + most, before[1]))
    signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        resource.setrlimit(resource.RLIMIT_AS, before)
        signal.signal(signal.SIGVTALRM, handler)
