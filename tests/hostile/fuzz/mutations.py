"""Mutations of good files: bits, bytes, spans, and words that stand where a number, a name or a bracket stood."""

import re

from hypothesis import strategies as st

WORDS = [
    b"", b"0", b"-1", b"1e999", b"-0.0", b"NaN", b"inf", b"1" * 400, b"2147483648", b"18446744073709551616", b"1e-320",
    b"0x10", b"1_0", b"true", b"null", b'""', b'"x"', b"'", b"[]", b"{}", b"[" * 300, b"]", b'{"a":' * 300, b"../../x",
    b"/etc/passwd", b"\x00", b"\xff\xfe", b"\xed\xa0\x80", b"\xd9\xa1", b"\r\n", b"#", b"<!DOCTYPE r [", b"&#0;", b"</",
    b"2", b"0.001", b"-0.5", b"1000", b"<link>" * 80, b"a.b.c", b"f4", b"float8_e4m3fn", b"list",
    b"double", b"x" * 5000,
]  # fmt: skip
"""What stands in a file by mistake or by malice."""
MOST_BYTES = 200_000
"""A mutated file is no longer, so that its size is no reason for the time of its reader."""
WORD = re.compile(rb"[\w.+-]+")

Edit = tuple[str, int, int]


def flip(data: bytearray, at: int, what: int) -> None:
    """Turn one bit."""
    data[at] ^= 1 << (what % 8)


def put(data: bytearray, at: int, what: int) -> None:
    """Replace one byte."""
    data[at] = what % 256


def cut(data: bytearray, at: int, what: int) -> None:
    """Take out a span."""
    del data[at : at + 1 + what]


def end(data: bytearray, at: int, what: int) -> None:
    """Leave out all that follows."""
    del data[at:]


def insert(data: bytearray, at: int, what: int) -> None:
    """Put a word in between."""
    data[at:at] = WORDS[what % len(WORDS)]


def replace(data: bytearray, at: int, what: int) -> None:
    """Put a word in the place of the next one."""
    found = WORD.search(data, at)
    if found:
        data[found.start() : found.end()] = WORDS[what % len(WORDS)]


def copy(data: bytearray, at: int, what: int) -> None:
    """Put a span from elsewhere over this one."""
    start = what * 257 % len(data)
    data[at : at + 8] = data[start : start + 8]


def repeat(data: bytearray, at: int, what: int) -> None:
    """Write a span many times."""
    data[at:at] = data[at : at + 64] * (what % 256)


def number(data: bytearray, at: int, what: int) -> None:
    """Write a huge or negative binary number of 1, 2, 4 or 8 bytes."""
    size = 1 << (what % 4)
    data[at : at + size] = (b"\xff" * size, b"\x7f" + b"\xff" * (size - 1), b"\x00" * size)[what // 4 % 3]


EDITS = {edit.__name__: edit for edit in (flip, put, cut, end, insert, replace, copy, repeat, number)}


def mutated(data: bytes, edits: list[Edit]) -> bytes:
    """Apply edits in their order; a place is a share of the length in units of 2^-16."""
    out = bytearray(data)
    for name, place, what in edits:
        if out:
            EDITS[name](out, place * len(out) >> 16, what)
    return bytes(out[:MOST_BYTES])


def edits() -> st.SearchStrategy[list[Edit]]:
    """Return a strategy of one to three edits; words come most often, since they reach the farthest."""
    kinds = st.sampled_from([*EDITS, "replace", "replace", "replace"])
    return st.lists(st.tuples(kinds, st.integers(0, 2**16 - 1), st.integers(0, 255)), min_size=1, max_size=3)
