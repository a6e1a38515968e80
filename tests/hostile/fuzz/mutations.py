"""Mutations of good files: bits, bytes, spans and words; and the limits under which the mutated
files are read.
"""

import contextlib
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

from hypothesis import strategies as st

WORDS = [
    b"",
    b"0",
    b"-1",
    b"1e999",
    b"-0.0",
    b"NaN",
    b"inf",
    b"1" * 400,
    b"2147483648",
    b"18446744073709551616",
    b"1e-320",
    b"0x10",
    b"1_0",
    b"true",
    b"null",
    b'""',
    b'"x"',
    b"'",
    b"[]",
    b"{}",
    b"[" * 300,
    b"]",
    b'{"a":' * 300,
    b"../../x",
    b"/etc/passwd",
    b"\x00",
    b"\xff\xfe",
    b"\xed\xa0\x80",
    b"\xd9\xa1",
    b"\r\n",
    b"#",
    b"<!DOCTYPE r [",
    b"&#0;",
    b"</",
    b"2",
    b"0.001",
    b"-0.5",
    b"1000",
    b"<link>" * 80,
    b"a.b.c",
    b"f4",
    b"float8_e4m3fn",
    b"list",
    b"double",
    b"x" * 5000,
]
"""What stands in a file by mistake or by malice."""
MOST_BYTES = 200_000
"""A mutated file is no longer, so that its size is no reason for the time of its reader."""
WORD = re.compile(rb"[\w.+-]+")

Edit = tuple[str, int, int]


def flip(data: bytearray, at: int, what: int) -> None:
    data[at] ^= 1 << (what % 8)


def put(data: bytearray, at: int, what: int) -> None:
    data[at] = what % 256


def cut(data: bytearray, at: int, what: int) -> None:
    del data[at : at + 1 + what]


def end(data: bytearray, at: int, what: int) -> None:
    del data[at:]


def insert(data: bytearray, at: int, what: int) -> None:
    data[at:at] = WORDS[what % len(WORDS)]


def replace(data: bytearray, at: int, what: int) -> None:
    found = WORD.search(data, at)
    if found:
        data[found.start() : found.end()] = WORDS[what % len(WORDS)]


def copy(data: bytearray, at: int, what: int) -> None:
    start = what * 257 % len(data)
    data[at : at + 8] = data[start : start + 8]


def repeat(data: bytearray, at: int, what: int) -> None:
    data[at:at] = data[at : at + 64] * (what % 256)


def number(data: bytearray, at: int, what: int) -> None:
    """Write a huge or negative binary number of 1, 2, 4 or 8 bytes."""
    size = 1 << (what % 4)
    data[at : at + size] = (b"\xff" * size, b"\x7f" + b"\xff" * (size - 1), b"\x00" * size)[
        what // 4 % 3
    ]


EDITS = {
    edit.__name__: edit for edit in (flip, put, cut, end, insert, replace, copy, repeat, number)
}


def mutated(data: bytes, edits: list[Edit]) -> bytes:
    """Apply edits in their order; a place is a share of the length in units of 2^-16."""
    out = bytearray(data)
    for name, place, what in edits:
        if out:
            EDITS[name](out, place * len(out) >> 16, what)
    return bytes(out[:MOST_BYTES])


def edits() -> st.SearchStrategy[list[Edit]]:
    """Return a strategy of one to three edits; words come most often, since they reach the
    farthest.
    """
    kinds = st.sampled_from([*EDITS, "replace", "replace", "replace"])
    return st.lists(
        st.tuples(kinds, st.integers(0, 2**16 - 1), st.integers(0, 255)), min_size=1, max_size=3
    )


SECONDS = 5.0
BYTES = 2**30
"""What a small file may cost at most."""


class TooSlow(Exception):
    """A reader took more than `SECONDS` of the processor."""


@contextlib.contextmanager
def limited(most: int = BYTES) -> Iterator[None]:
    """Raise `TooSlow` after `SECONDS` of the processor, and `MemoryError` beyond `most` bytes more
    than there are.

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
