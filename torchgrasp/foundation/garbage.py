"""Python's collector of garbage, and when it need not look."""

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """Return a context in which Python's cyclic garbage collector is off; afterwards it is as it
    was before.

    Imports make many objects, and all of them stay. The collector would look at them again and
    again.
    """
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()
