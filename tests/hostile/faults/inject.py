"""A forked child runs a command, and at its n-th call that changes the disk something happens to
it.
"""

import contextlib
import io
import json
import os
import signal
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from torchgrasp.app import cli

CALLS = ("mkdir", "open", "write", "fsync", "chmod", "replace", "unlink", "rmdir")
"""The calls of `os` that change a disk, and that the library's writing goes through."""

Happening = Callable[[str, tuple[Any, ...]], None]
"""What happens before a call: its name and arguments are given."""


class Ended(NamedTuple):
    """How a child ended: exit code, negative for a signal; its calls; what it said on stderr."""

    code: int
    calls: list[str]
    said: str


def kill(name: str, given: tuple[Any, ...]) -> None:
    """Die as by kill -9, in the middle of the call if it writes."""
    if name == "write":
        REAL["write"](given[0], bytes(given[1])[: len(given[1]) // 2])
    os.kill(os.getpid(), signal.SIGKILL)


def fail(code: int) -> Happening:
    """Refuse the call as the system would; of a write on a full disk half succeeds."""

    def happen(name: str, given: tuple[Any, ...]) -> None:
        if name == "write":
            REAL["write"](given[0], bytes(given[1])[: len(given[1]) // 2])
        raise OSError(code, os.strerror(code))

    return happen


def send(sign: int) -> Happening:
    return lambda name, given: os.kill(os.getpid(), sign)


UNCAUGHT = 70
"""Exit code of a child whose command raised."""

REAL = {name: getattr(os, name) for name in CALLS}


def run(words: list[str], happen: Happening | None = None, at: int = -1) -> Ended:
    """Run a command in a child; `happen` comes before its call number `at`. Its clocks stand still."""
    ours, theirs = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(ours)
        signal.signal(
            signal.SIGINT, signal.default_int_handler
        )  # a shell's background processes ignore it
        calls: list[str] = []
        _watch(calls, happen, at)
        time.perf_counter = time.process_time = lambda: 0.0
        said = io.StringIO()
        code = UNCAUGHT
        with (
            contextlib.suppress(Exception),
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(said),
        ):
            sys.argv[1:] = words
            try:
                cli.run_and_exit()
            except SystemExit as ended:
                code = ended.code
        _send_all(theirs, json.dumps([code, calls, said.getvalue()]).encode())
        os._exit(0)
    os.close(theirs)
    with os.fdopen(ours, "rb") as pipe:
        told = pipe.read()
    _, status = os.waitpid(child, 0)
    return Ended(*json.loads(told)) if told else Ended(os.waitstatus_to_exitcode(status), [], "")


def _watch(calls: list[str], happen: Happening | None, at: int) -> None:
    """Replace the calls by ones that are noted first."""

    def note(name: str, given: tuple[Any, ...]) -> None:
        calls.append(name)
        if happen is not None and len(calls) == at + 1:
            happen(name, given)

    def watched(name: str) -> Callable[..., Any]:
        def call(*given: Any, **named: Any) -> Any:
            if name != "open" or given[1] & (os.O_WRONLY | os.O_RDWR):
                note(name, given)
            return REAL[name](*given, **named)

        return call

    def opened(file: Any, mode: str = "r", *given: Any, **named: Any) -> Any:
        if "r" not in mode:
            note("open", (file, mode))
        return open(file, mode, *given, **named)

    for name in CALLS:
        setattr(os, name, watched(name))
    io.open = opened  # of pathlib


def _send_all(pipe: int, data: bytes) -> None:
    """Write all of it: a pipe takes 64 KiB at once."""
    while data:
        data = data[REAL["write"](pipe, data) :]
