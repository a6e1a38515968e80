"""Who is at work on a file or folder: its process holds a lock, which the system frees when the process ends."""

import contextlib
import errno
import os
from collections.abc import Iterator

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None


def own(handle: int) -> bool:
    """Lock what was just made, for as long as the handle is open.

    False if another process took it for abandoned in between: it is being removed.
    """
    if fcntl is None:
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:  # some network folders know no locks; there nothing is ever taken for abandoned
        return error.errno not in (errno.EACCES, errno.EAGAIN)
    return os.fstat(handle).st_nlink > 0


@contextlib.contextmanager
def abandoned(path: str) -> Iterator[bool]:
    """Tell whether nobody is at work on a path of ours, and keep it so within the context."""
    handle = None
    try:
        if fcntl is not None and os.lstat(path).st_uid == os.getuid():
            handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        free = handle is not None
    except OSError:  # it is locked, gone, or a link
        free = False
    try:
        yield free
    finally:
        if handle is not None:
            os.close(handle)
