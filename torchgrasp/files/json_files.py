"""Reading of JSON and TOML files within limits, field by field, with checks of types and ranges.

An error names the file and the field, such as `objects.cup.views.front`.
"""

import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

from torchgrasp.errors import BadArgument
from torchgrasp.files.write import Refuse, read_bounded
from torchgrasp.limits import JSON_BYTES, JSON_LETTERS, SHOWN_LETTERS


class Field(NamedTuple):
    """A value in a JSON or TOML file, with its path and place in the file; `refuse` makes the error for a bad value."""

    path: Path
    place: str
    value: Any
    refuse: Refuse

    def wrong(self, allowed: str) -> BadArgument:
        """Return the error for a bad value of this field; `allowed` says what is expected."""
        try:
            text = repr(self.value)[: SHOWN_LETTERS + 1]
        except ValueError:  # Python writes no whole number of more than 4300 digits
            text = "a huge number"
        shown = text if len(text) <= SHOWN_LETTERS else f"{text[:SHOWN_LETTERS]}..."
        return self.refuse(f"{self.path}: {self.place or 'the file'} = {shown}", allowed)

    def entries(self, *required: str) -> "dict[str, Field]":
        """Return the fields of a JSON object by name, those that are `required` among them."""
        if not isinstance(self.value, dict):
            raise self.wrong("an object { }")
        if missing := [name for name in required if name not in self.value]:
            raise self.wrong(f"an object with {missing[0]!r}")
        within = f"{self.place}." if self.place else ""
        return {key: Field(self.path, f"{within}{key}", value, self.refuse) for key, value in self.value.items()}

    def items(self, most: int = 1000) -> "list[Field]":
        """Return the fields of a list of at most `most` items."""
        if not isinstance(self.value, list) or len(self.value) > most:
            raise self.wrong(f"a list of at most {most}")
        return [Field(self.path, f"{self.place}[{i}]", x, self.refuse) for i, x in enumerate(self.value)]

    def text(self, most: int = JSON_LETTERS) -> str:
        """Return the value as a text of at most `most` letters."""
        if not isinstance(self.value, str) or len(self.value) > most:
            raise self.wrong(f"a text of at most {most} letters")
        return self.value

    def number(self, low: float = -sys.float_info.max, high: float = sys.float_info.max) -> float:
        """Return the value as a number in [low, high]; by default any finite number."""
        number = self.value
        if isinstance(number, bool) or not isinstance(number, int | float) or not low <= number <= high:
            raise self.wrong("a finite number" if high == sys.float_info.max else f"a number in [{low:g}, {high:g}]")
        return float(number)

    def numbers(self, count: int, low: float = -sys.float_info.max, high: float = sys.float_info.max) -> list[float]:
        """Return the value as a list of `count` numbers in [low, high]."""
        if not isinstance(self.value, list) or len(self.value) != count:
            raise self.wrong(f"{count} numbers")
        return [x.number(low, high) for x in self.items(count)]

    def whole(self, low: int, high: int) -> int:
        """Return the value as a whole number in [low, high]."""
        if isinstance(self.value, bool) or not isinstance(self.value, int) or not low <= self.value <= high:
            raise self.wrong(f"a whole number in [{low}, {high}]")
        return self.value


def read_json(path: Path, refuse: Refuse, allowed: str, most: int = JSON_BYTES) -> Field:
    """Read a JSON file in UTF-8 of at most `most` bytes, without NaN; raise the error of `refuse` for other files."""
    data = read_bounded(path, most, allowed, refuse)
    try:
        value = json.loads(data.decode("utf-8"), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise refuse(f"{path}: {error}", allowed) from error
    return Field(path, "", value, refuse)


def _refuse_constant(name: str) -> float:
    """Raise an error for NaN and Infinity, which Python's reader would accept."""
    raise ValueError(f"{name}, which is no JSON")
