"""Paths, as `Path` or text: what no file can be called is refused before any work."""

import os
from pathlib import Path

from torchgrasp.checks.tensors import show
from torchgrasp.errors import BadArgument

NAME_BYTES, PATH_BYTES = 255, 4095
"""Longest name of a file and longest path [bytes] of Linux's file systems, which take the longest."""


def check_path(name: str, path: Path | str) -> None:
    """Refuse what no system takes as a path: a NUL, half a Unicode character, names and paths that are too long.

    Raises:
        BadArgument: it is none.

    >>> check_path("out", "results/a")
    >>> check_path("out", "a" * 300)
    Traceback (most recent call last):
    torchgrasp.errors.BadArgument: out: expected a path with names of at most 255, got a name of 300 bytes
    """
    try:
        raw = os.fsencode(path)
    except UnicodeEncodeError as error:
        raise BadArgument(name, f"{show(str(path))}, half a character", "a path in whole ones") from error
    if b"\0" in raw:
        raise BadArgument(name, f"{show(str(path))}, with a NUL", "a path without one")
    if len(raw) > PATH_BYTES:
        raise BadArgument(name, f"a path of {len(raw)} bytes", f"one of at most {PATH_BYTES}")
    longest = max(map(len, map(os.fsencode, Path(path).parts)), default=0)
    if longest > NAME_BYTES:
        raise BadArgument(name, f"a name of {longest} bytes", f"a path with names of at most {NAME_BYTES}")
