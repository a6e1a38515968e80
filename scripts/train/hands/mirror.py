"""The mirror image of a hand: a left hand's files from the right one's, or back."""

import re
from collections.abc import Callable
from typing import NamedTuple


class Mirror(NamedTuple):
    """How a left hand differs from the mirror image of the right one.

    `axis` is the coordinate (0, 1, 2) that changes its sign, in every link. `kept` are joints that the maker turns
    about the same axis on both sides: there positive is not the mirrored direction.
    """

    names: tuple[str, str]
    axis: int
    kept: frozenset[str] = frozenset()

    def urdf(self, text: str) -> str:
        """Return the mirrored URDF."""
        joint, lines = "", []
        for line in text.splitlines():
            named = re.search(r'<joint name="([^"]+)"', line)
            joint = named[1] if named else joint
            if "<axis" in line:
                line = self._attribute(line, "xyz", self._vector if joint in self.kept else self._turn)
            elif "<limit" in line and joint in self.kept:
                low, high = (_value(line, key) for key in ("lower", "upper"))
                line = _set(_set(line, "lower", _negative(high)), "upper", _negative(low))
            elif "<origin" in line:
                line = self._attribute(self._attribute(line, "xyz", self._vector), "rpy", self._turn)
            elif "<inertia " in line:
                for key in ("ixy", "ixz", "iyz"):
                    if "xyz"[self.axis] in key[1:]:
                        line = _set(line, key, _negative(_value(line, key)))
            lines.append(line)
        return self._renamed("\n".join([*lines, ""]))

    def toml(self, text: str) -> str:
        """Return the mirrored hand.toml."""
        lines = []
        for line in text.splitlines():
            found = re.match(r"(approach|contact|normal|center) = \[(.*?)\]", line)
            if found:
                words = self._vector(found[2].split(", "))
                line = f"{found[1]} = [{', '.join(words)}]{line[found.end() :]}"
            parked = re.findall(r'"?(\w+)"? = (-?[0-9.]+)', line) if line.startswith("parked") else []
            if any(float(value) for joint, value in parked if joint in self.kept):
                raise SystemExit(f"{self.names[1]}: a kept joint that is parked off zero")
            lines.append(line)
        return self._renamed("\n".join([*lines, ""]))

    def _renamed(self, text: str) -> str:
        """Return a text with the names of hand and joints, and the other side's word and direction in comments."""
        right, left = self.names
        text = text.replace(f'name="{right}"', f'name="{left}"', 1).replace(f'name = "{right}"', f'name = "{left}"', 1)
        text = text.replace("right hand", "left hand", 1)
        sign, letter = "+-", "xyz"[self.axis]
        return re.sub(rf"([+-]){letter} to the index", lambda m: f"{sign[m[1] == '+']}{letter} to the index", text)

    def _attribute(self, line: str, key: str, change: Callable[[list[str]], list[str]]) -> str:
        """Return a line with one attribute changed, if it has it."""
        found = re.search(rf'\b{key}="([^"]*)"', line)
        return _set(line, key, " ".join(change(found[1].split()))) if found else line

    def _vector(self, words: list[str]) -> list[str]:
        """Mirror a vector: one coordinate changes its sign."""
        return [_negative(w) if i == self.axis else w for i, w in enumerate(words)]

    def _turn(self, words: list[str]) -> list[str]:
        """Mirror an axis of rotation, or three angles: the other two coordinates change their signs."""
        return [w if i == self.axis else _negative(w) for i, w in enumerate(words)]


def _negative(word: str) -> str:
    """Return the digits of the negative number."""
    if not float(word):
        return word
    return word[1:] if word.startswith("-") else f"-{word}"


def _value(line: str, key: str) -> str:
    """Return an attribute."""
    found = re.search(rf'\b{key}="([^"]*)"', line)
    if found is None:
        raise SystemExit(f"no {key} in {line!r}")
    return found[1]


def _set(line: str, key: str, value: str) -> str:
    """Return a line with another attribute."""
    return re.sub(rf'\b{key}="[^"]*"', f'{key}="{value}"', line)
