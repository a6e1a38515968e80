"""Numbers from text. A list of its words would need ten times the memory."""

import io
import warnings
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

MAX_POINTS = 5_000_000
"""Most points that are read: more than the largest depth images have."""
MAX_LINES = 2 * MAX_POINTS
"""Most lines of a text, empty ones and comments too: they take as long to read."""
MAX_COLUMNS = 16
"""Most numbers of a point: position, normal, colour and a few more."""
MAX_LINE = 4096
"""Longest line [characters]: 16 numbers of 256 characters."""


def read_table(data: bytes, rows: int, columns: int) -> Float[np.ndarray, "rows columns"]:
    r"""Return the first rows of a table separated by white space.

    Raises:
        ValueError: too many rows or columns; too few numbers; a word that is no number.

    >>> read_table(b"1 2\n3 4\n5 6", 2, 2).tolist()
    [[1.0, 2.0], [3.0, 4.0]]
    """
    if not (0 <= rows <= MAX_POINTS and 1 <= columns <= MAX_COLUMNS):
        raise ValueError(f"{rows} points of {columns} numbers, not up to {MAX_POINTS} of {MAX_COLUMNS}")
    wanted = rows * columns
    if 2 * wanted > len(data) + 1:  # a number is a digit and a space at least
        raise ValueError(f"fewer numbers than {rows} points have")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # at a word that is no number; the count tells
        numbers = np.fromstring(data, dtype=np.float64, count=wanted, sep=" ") if wanted else np.zeros(0)
    if len(numbers) < wanted:
        raise ValueError(f"fewer numbers than {rows} points have, or a word that is none")
    return numbers.reshape(rows, columns)


def read_lines(data: bytes) -> Float[np.ndarray, "rows columns"]:
    r"""Return lines of numbers, separated by blanks, commas or semicolons.

    `#` starts a comment. A first line that begins with the words x y z names the columns.

    Raises:
        ValueError: no numbers; lines of different length; a line or file that is too long or too wide.

    >>> read_lines(b"# x y z\n1, 2, 3\n").tolist()
    [[1.0, 2.0, 3.0]]
    """

    def lines() -> Iterator[str]:
        stream = io.TextIOWrapper(io.BytesIO(data), encoding="ascii")
        all_lines = count = 0
        while line := stream.readline(MAX_LINE + 1):
            all_lines += 1
            if len(line) > MAX_LINE:
                raise ValueError(f"a line of more than {MAX_LINE} characters")
            if all_lines > MAX_LINES:
                raise ValueError(f"more than {MAX_LINES} lines")
            line = line.split("#")[0].replace(",", " ").replace(";", " ")
            if not line.isspace() and line:
                count += 1
                if count == 1 and line.lower().replace('"', "").split()[:3] == ["x", "y", "z"]:
                    continue
                if count > MAX_POINTS:
                    raise ValueError(f"more than {MAX_POINTS} lines of numbers")
                if count <= 2 and len(line.split()) > MAX_COLUMNS:  # the others have as many, or are refused
                    raise ValueError(f"more than {MAX_COLUMNS} numbers in a line")
                yield line

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of a file without numbers, which has its own sentence here
        table = np.loadtxt(lines(), ndmin=2)
    if not table.size:
        raise ValueError("no numbers")
    return table
