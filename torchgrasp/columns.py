"""Tables as plain text: columns that line up on a terminal."""

from collections.abc import Collection, Sequence


def format_columns(rows: Sequence[Sequence[str]], left: Collection[int] = ()) -> str:
    """Return rows as lines with columns as wide as need be, flush right except those in `left`.

    >>> print(format_columns([("object", "held"), ("tin", "4")], left={0}))
    object  held
    tin        4
    """
    longest = [max(map(len, column)) for column in zip(*rows, strict=True)]
    widths = [-width if k in left else width for k, width in enumerate(longest)]
    return "\n".join(format_line(row, widths) for row in rows)


def format_line(cells: Sequence[object], widths: Sequence[int]) -> str:
    """Return one line of a table, for rows that come one by one; a column of negative width is flush left.

    >>> format_line(("tin", 4), (-6, 3))
    'tin       4'
    """
    columns = zip(cells, widths, strict=True)
    return "  ".join(f"{cell!s:{'<' if w < 0 else '>'}{abs(w)}}" for cell, w in columns).rstrip()
