"""Tables of points, as text or binary rows, and the meaning of their columns by name."""

import io
import itertools
import re
import string
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from torchgrasp.files.write import Malformed
from torchgrasp.foundation.limits import CLOUD_POINTS, LINE_LETTERS, TEXT_COLUMNS

# letters of wrong names, and of a wrong line, that an error shows
SHOWN_NAMES = 200
SHOWN_LINE = 60
# words that are no names of columns, in comments that may name them
PROSE = {"and", "are", "as", "cm", "in", "mm", "of", "points", "the"}
SIXES = {
    ".xyzn": ["x", "y", "z", "nx", "ny", "nz"],
    ".xyzrgb": ["x", "y", "z", "red", "green", "blue"],
}
"""Names of the six columns in files whose suffix tells them."""


def find_columns(names: Sequence[str], columns: Sequence[np.ndarray]) -> dict[str, Any]:
    """Return the coordinates and normals in a table whose columns have names, as a dictionary.

    Its key `points` has the columns x, y and z as an array (n, 3). `normals` has nx, ny and nz, or
    None if the table has no normals. `other` lists the names of the other columns. Capitals, and
    names such as normal_x, are understood.

    Each of the `columns` is an array (n,) or (n, k), with one entry for each of the n lines. Of k
    numbers in a line, only the first is used. `names` are the names of the columns. Raises
    `Malformed` for a missing column, or for two of one name.
    """
    places = dict[str, int]()
    other = list[str]()
    for i, name in enumerate(names):
        meant = re.fullmatch(r"(?:(n)(?:ormal)?_?)?([xyz])", name.lower())
        axis = "".join(meant.groups("")) if meant else ""
        if axis in places:
            raise Malformed(f"two columns {name}")
        if axis:
            places[axis] = i
        elif name != "_":  # the padding of PCD
            other.append(name)
    axes = ["x", "y", "z"] + ["nx", "ny", "nz"] * (not places.keys() <= {*"xyz"})
    if missing := [axis for axis in axes if axis not in places]:
        raise Malformed(f"columns {' '.join(names)[:SHOWN_NAMES]!r} without {', '.join(missing)}")
    found = np.stack(
        [columns[places[axis]].reshape(len(columns[0]), -1)[:, 0] for axis in axes], -1
    )
    return {
        "points": found[:, :3],
        "normals": found[:, 3:] if len(axes) > 3 else None,
        "other": other,
    }


def read_fields(
    data: bytes, fields: Sequence[tuple[str, int]], count: int, order: str = "", last: bool = True
) -> list[np.ndarray]:
    """Return an array (count, n) for each field of a table with `count` lines, one for each point.

    Little memory is used beyond the arrays themselves.

    Args:
        data: the table, as text or in binary form.
        fields: for each field the NumPy type code of its numbers, such as "f4", and their number n
            in a line.
        count: number of lines.
        order: byte order of binary data, "<" or ">"; "" means that the data are text.
        last: whether the table ends the data; otherwise anything may follow it.

    Raises `Malformed` for too little data, for a word that is no number, or for a `count` above 5
    million (`CLOUD_POINTS`). With `last`, it is also raised for data of a further line, or a wrong
    number of values in the first.
    """
    if not 0 <= count <= CLOUD_POINTS:
        raise Malformed(f"{count} points, not up to {CLOUD_POINTS}")
    sizes = [n for _, n in fields]
    wanted = count * sum(sizes)
    if order:
        dtype = np.dtype(
            [(str(i), order + kind, (n,)) for i, (kind, n) in enumerate(fields)]
        )  # names may be alike
        if (
            not 0
            <= len(data) - count * dtype.itemsize
            < (dtype.itemsize if last else len(data) + 1)
        ):
            raise Malformed(
                f"{len(data)} bytes of points, where the header promises {count * dtype.itemsize}"
            )
        rows = np.frombuffer(data, dtype=dtype, count=count)
        return [rows[str(i)] for i in range(len(fields))]
    first = next(iter(data[:LINE_LETTERS].lstrip().splitlines()), b"").split()
    if last and wanted and len(first) != sum(sizes):
        raise Malformed(
            f"{len(first)} numbers in the first row, where the header promises {sum(sizes)}"
        )
    # NumPy fills what a text lacks with whatever is in memory, so words are counted first.
    words = _count_words(data)
    if words < wanted:
        raise Malformed(f"{words} numbers, fewer than the promised {count} points have")
    if last and words > wanted:
        raise Malformed(f"{words} numbers, more than the promised {count} points have")
    numbers = np.zeros(0)
    if wanted:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore", DeprecationWarning
            )  # at a word that is no number; the count shows it
            numbers = np.fromstring(data, dtype=np.float64, count=wanted, sep=" ")
    if len(numbers) < wanted:
        raise Malformed("a word that is no number")
    return np.split(numbers.reshape(count, sum(sizes)), np.cumsum(sizes)[:-1], axis=1)


def _count_words(data: bytes) -> int:
    """Return the number of words in a text, between which stands any white space of ASCII."""
    letters = np.frombuffer(data, dtype=np.uint8)
    blank = np.isin(letters, np.frombuffer(string.whitespace.encode(), dtype=np.uint8))
    begins = ~blank
    begins[1:] &= blank[:-1]
    return int(begins.sum())


def parse_text(data: bytes, suffix: str) -> dict[str, Any]:
    """Return the points, and normals if any, in the n lines of a text, as a dictionary.

    If a first line names the columns, the keys are `points` (n, 3), `normals` (n, 3) or None, and
    `other`, names of other columns. Without names there must be three or six columns. The only key
    is then `columns`, an array (n, 3) or (n, 6). A first line of one number counts the lines.

    `data` is the content of the file. In files with the `suffix` .xyzi or .pts an intensity may
    follow x, y and z, and then a colour. In .xyzrgb a colour follows. Raises `Malformed` for a text
    that is no such table.
    """
    names, table = _read_text(data)
    rows, width = table.shape
    if len(names) == 1 and names[0].isdecimal():
        if int(names[0]) != rows:
            raise Malformed(f"{rows} rows, where the first line promises {names[0]}")
        names = []
    if not names and suffix in SIXES and width == len(SIXES[suffix]):
        names = SIXES[suffix]
    if not names and suffix in (".xyzi", ".pts") and width in (4, 7):
        names = ["x", "y", "z", "intensity", "red", "green", "blue"][:width]
    if len(names or [0] * width) != width or (not names and width not in (3, 6)):
        named = (
            f"the names {' '.join(names)[:SHOWN_NAMES]!r}: one word for each column, as in x y z nx ny nz"
            if names
            else "no line of names above, such as x y z nx ny nz"
        )
        raise Malformed(f"{width} columns with {named}")
    return find_columns(names, list(table.T)) if names else {"columns": table}


def read_lines(data: bytes) -> Float[np.ndarray, "rows columns"]:
    """Return the numbers of a text as an array with one row for each line.

    `data` is the content of the file. Blanks, commas or semicolons separate the numbers. `#` or
    `//` starts a comment. A first line of words is left out. Raises `Malformed` for a text that is
    no such table of numbers.
    """
    return _read_text(data)[1]


def _read_text(data: bytes) -> tuple[list[str], Float[np.ndarray, "rows columns"]]:
    """Return two things: the words of a first line that names the columns or counts the lines, and
    the numbers.
    """
    comment: str = ""
    shown: str = ""
    number = rows = width = 0

    def lines() -> Iterator[str]:
        nonlocal comment, shown, number, rows
        stream = io.TextIOWrapper(io.BytesIO(data), encoding="utf-8-sig")
        while shown := stream.readline(LINE_LETTERS + 1):
            number += 1
            if len(shown) > LINE_LETTERS:
                raise Malformed(f"a line of more than {LINE_LETTERS} characters")
            if number > 2 * CLOUD_POINTS:
                raise Malformed(f"more than {2 * CLOUD_POINTS} lines")
            line, _, said = shown.replace("//", "#").partition("#")
            comment = comment if rows or not said else said
            if line.isspace() or not line:
                continue
            rows += 1
            if rows > CLOUD_POINTS:
                raise Malformed(f"more than {CLOUD_POINTS} lines of numbers")
            if rows <= 2:  # the other lines have as many numbers, or are refused
                _check_line(line.strip())
            yield line.replace(",", " ").replace(";", " ").replace('"', " ")

    every = lines()
    names = list[str]()
    try:
        some = [next(every, "")]
        if some[0].strip().isdecimal():  # a count of the rows, if the next line has more numbers
            some.append(next(every, ""))
        width = len(some[-1].split())
        if width > 1 and some[0].split() == [str(i) for i in range(width)]:
            # the numbers of columns without names, if the next line has fractions
            some.append(next(every, ""))
            if "." in some[1] and len(some[1].split()) == width:
                del some[0]
        if (
            not re.search(r"(?i)(?:^|\s)[-+.]*(?:\d|(?:nan|inf)\b)", some[0])
            or len(some[0].split()) < width
        ):
            names = some.pop(0).split()
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore", UserWarning
            )  # of a file without numbers, which is refused below
            table = np.loadtxt(itertools.chain(filter(None, some), every), ndmin=2)
    except Malformed:
        raise
    except UnicodeDecodeError as error:
        raise Malformed("text of another encoding than UTF-8") from error
    except ValueError as error:
        raise Malformed(
            f"line {number}, {shown.strip()[:SHOWN_LINE]!r}, where {width} numbers should be"
        ) from error
    if not table.size:
        raise Malformed("no numbers")
    # Also a comment may name the columns, above a count of the rows or without one.
    unnamed = not names or names == [str(len(table))]
    return (unnamed and _names_in(comment, width)) or names, table


def _names_in(comment: str, width: int) -> list[str]:
    """Return the names of `width` columns in a comment; [] if it names none.

    Three columns are x, y and z, whatever else is said, as in "x y z in mm". Raises `Malformed` for
    a sentence above more columns, whose words would be taken for names.
    """
    words = comment.replace(",", " ").split()
    if words and words[0].endswith(":"):  # as in "columns: x y z"
        del words[0]
    lower = [*map(str.lower, words)]
    if not {"x", "y", "z"} <= {*lower}:
        return []
    if width == 3 and len(words) > 3 and "x y z" in " ".join(lower):
        return []
    if said := [word for word in words if word.lower() in PROSE]:
        wanted = "names alone, one for each column"
        raise Malformed(
            f"a comment {comment.strip()[:SHOWN_NAMES]!r} with {said[0]!r}, not {wanted}"
        )
    return words


def _check_line(line: str) -> None:
    """Raise `Malformed` for a line of too many numbers, with decimal commas, as in 0,03;0,1, or
    with an empty cell.
    """
    if len(re.split(r"[\s,;]+", line)) > TEXT_COLUMNS:
        raise Malformed(f"more than {TEXT_COLUMNS} numbers in a line")
    mixed = re.search(r"\d,\d", line) and re.search(r'[;"]|[^\s,]\s+[^\s,]', line)
    if mixed or re.search(r"(?:^|,)-?0\d", line):
        raise Malformed(f"decimal commas: {line[:SHOWN_LINE]!r}")
    if re.search(r"[,;]\s*[,;]", line):
        raise Malformed(f"an empty cell: {line[:SHOWN_LINE]!r}")
