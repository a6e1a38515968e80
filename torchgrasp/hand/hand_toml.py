"""Reader of hand.toml: fingers, pads, coupled and parked joints, pairs of links that can meet."""

import dataclasses
import math
import re
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, NamedTuple

from torchgrasp.base import FINGERTIPS
from torchgrasp.errors import BadArgument, HandFileError
from torchgrasp.hand.safe_xml import read_bounded
from torchgrasp.hand.urdf import Mimic, Triple
from torchgrasp.limits import TOML_BYTES, XML_LETTERS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

SUPPORTED = "three to five different fingers"  # fingers of a grasp, see `FINGERTIPS`

_DOTTED = re.compile(
    r"""(?<![\w"'-])(?:[\w-]+|"[^"\n]*"|'[^'\n]*')(?:[ \t]*\.[ \t]*(?:[\w-]+|"[^"\n]*"|'[^'\n]*')){16}"""
)
"""A key of more than 16 parts: the memory of the TOML reader grows with the square of their number."""


class Pad(NamedTuple):
    """The surface of a tip that touches, in its link's frame [m]: a sphere about `center`, or a point (radius 0)."""

    contact: Triple
    normal: Triple
    center: Triple
    radius: float


class Finger(NamedTuple):
    """A finger with its joints from the palm outward."""

    name: str
    joints: tuple[str, ...]
    tip_link: str
    pad: Pad


Grasping = tuple[Finger, ...]
"""The grasping fingers, three to five, in grasp order."""

Fingers = str | int | tuple[str, ...]
"""The grasping fingers: an option of hand.toml, a number of fingers, or names, also as "index,middle,thumb"."""


class Option(NamedTuple):
    """The fingers that grasp, and the positions [rad] of parked joints."""

    fingers: Grasping
    parked: dict[str, float]


@dataclasses.dataclass(frozen=True)
class HandSpec:
    """The values of a hand.toml, with the grasping `fingers` of `option`."""

    path: Path
    name: str
    urdf: Path
    base_link: str
    approach: Triple
    limit_margin: float
    kp: float
    kd: float
    option: str
    fingers: Grasping
    options: dict[str, Option]
    all_fingers: tuple[Finger, ...]
    parked: dict[str, float]
    coupling: dict[str, Mimic]
    pairs: tuple[tuple[str, str], ...] | None
    data: bytes

    def wrong(self, found: str, allowed: str) -> HandFileError:
        """Make the error for a broken rule."""
        return HandFileError("hand.toml", f"{self.path}: {found}", allowed)


def _is_number(value: Any) -> bool:
    try:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # an integer of more than 308 digits
        return False


def _is_word(value: Any) -> bool:
    return isinstance(value, str) and 0 < len(value) <= XML_LETTERS and value.isprintable()


def _is_texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(x, str) for x in value)


class _Table:
    """A table that knows its name, for errors, and the keys that were read."""

    def __init__(self, path: Path, name: str, table: Any):
        if not isinstance(table, dict):
            raise HandFileError("hand.toml", f"{path}: {name.rstrip('.')} = {str(table)[:80]}", "a table")
        self.path, self.name, self.table, self.read = path, name, table, set[str]()

    def wrong(self, key: str, allowed: str) -> HandFileError:
        value = repr(self.table[key])[:80] if key in self.table else "nothing"
        return HandFileError("hand.toml", f"{self.path}: {self.name}{key} = {value}", allowed)

    def value(self, key: str, right: Callable[[Any], bool], allowed: str) -> Any:
        self.read.add(key)
        if not right(self.table.get(key)):
            raise self.wrong(key, allowed)
        return self.table[key]

    def text(self, key: str) -> str:
        return self.value(key, _is_word, f"a text of 1 to {XML_LETTERS} characters")

    def texts(self, key: str) -> tuple[str, ...]:
        return tuple(self.value(key, _is_texts, "a list of texts"))

    def number(self, key: str, low: float = -math.inf, high: float = math.inf) -> float:
        allowed = f"a finite number in [{low:g}, {high:g}]"
        return float(self.value(key, lambda x: _is_number(x) and low <= x <= high, allowed))

    def triple(self, key: str) -> Triple:
        allowed = "three finite numbers"
        x, y, z = self.value(key, lambda v: isinstance(v, list) and len(v) == 3 and all(map(_is_number, v)), allowed)
        return float(x), float(y), float(z)

    def inner(self, key: str, optional: bool = False) -> "_Table":
        self.read.add(key)
        return _Table(self.path, f"{self.name}{key}.", self.table.get(key, {} if optional else None))

    def tables(self, key: str) -> list["_Table"]:
        self.read.add(key)
        value = self.table.get(key, [])
        if not isinstance(value, list) or len(value) > 1000:
            raise self.wrong(key, "a list of at most 1000 tables")
        return [_Table(self.path, f"{self.name}{key}[{i}].", v) for i, v in enumerate(value)]

    def done(self) -> None:
        """Refuse unknown keys: they are most often misspelt."""
        unknown = sorted(set(self.table) - self.read)
        if unknown:
            raise self.wrong(unknown[0], f"one of {sorted(self.read)}")


def read_hand_toml(path: Path | str, fingers: Fingers = "default") -> HandSpec:
    """Read and check a hand.toml; raise `HandFileError`, or `BadArgument` for fingers that it does not have."""
    path = Path(path)
    data = read_bounded("hand.toml", path, "a hand.toml", TOML_BYTES)
    try:
        text = data.decode("utf-8")
        if _DOTTED.search(text):
            raise HandFileError("hand.toml", f"{path}: a key of more than 16 parts", "keys of at most 16 parts")
        top = _Table(path, "", tomllib.loads(text))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise HandFileError("hand.toml", f"{path}: {error}", "valid TOML in UTF-8") from error
    name, base_link, approach = top.text("name"), top.text("base_link"), top.triple("approach")
    urdf = (path.parent / top.text("urdf")).resolve()
    if urdf.parent != path.parent.resolve():
        raise top.wrong("urdf", "a file beside hand.toml")
    margin, actuators = top.number("limit_margin", 0.0, 1.0), top.inner("actuators")
    kp, kd = actuators.number("kp", 1e-6, 1e6), actuators.number("kd", 0.0, 1e6)
    actuators.done()
    known = tuple(_finger(t) for t in top.tables("finger"))
    if len({f.name for f in known}) < len(known):
        raise HandFileError("hand.toml", f"{path}: fingers {[f.name for f in known]}", "different names")
    options, coupling, pairs = _options(top, known), _coupling(top), _pairs(top)
    top.done()
    option, (chosen, parked) = _choose(options, {f.name: f for f in known}, coupling, fingers)
    return HandSpec(
        path, name, urdf, base_link, approach, margin, kp, kd, option, chosen, options, known, parked, coupling, pairs,
        data,
    )  # fmt: skip


def _finger(table: _Table) -> Finger:
    kind = table.text("tip")
    if kind not in ("sphere", "point"):
        raise table.wrong("tip", "'sphere' or 'point'")
    contact, normal = table.triple("contact"), table.triple("normal")
    if abs(math.dist(normal, (0, 0, 0)) - 1) > 1e-6:
        raise table.wrong("normal", "a unit vector")
    center, radius = contact, 0.0
    if kind == "sphere":
        center, radius = table.triple("center"), table.number("radius", 1e-4, 0.1)
        if math.dist(contact, tuple(c + radius * n for c, n in zip(center, normal, strict=True))) > 1e-6:
            raise table.wrong("contact", "center + radius * normal")
    pad = Pad(contact, normal, center, radius)
    finger = Finger(table.text("name"), table.texts("joints"), table.text("tip_link"), pad)
    table.done()
    return finger


def _options(top: _Table, known: tuple[Finger, ...]) -> dict[str, Option]:
    """Read the grasping fingers and the parked joints of every option."""
    table, by_name, options = top.inner("options"), {f.name: f for f in known}, dict[str, Option]()
    for name in table.table:
        option = table.inner(name)
        names = option.texts("fingers")
        if not _is_graspable(names, by_name):
            raise option.wrong("fingers", f"{SUPPORTED} of {sorted(by_name)}")
        park = option.inner("parked", optional=True)
        options[name] = Option(tuple(by_name[x] for x in names), {joint: park.number(joint) for joint in park.table})
        option.done()
    return options


def _is_graspable(names: tuple[str, ...], known: Collection[str]) -> bool:
    """Return whether fingers are known, different, and of a supported number."""
    return FINGERTIPS[0] <= len(names) <= FINGERTIPS[1] and len(set(names)) == len(names) and set(names) <= set(known)


def _choose(
    options: dict[str, Option], known: dict[str, Finger], coupling: dict[str, Mimic], wanted: Fingers
) -> tuple[str, Option]:
    """Return the wanted fingers and the name of their option; for fingers without an option it is their names.

    Joints that no option parks stay at zero, or at the limit next to zero.
    """
    declared = f"one of the options {sorted(options)}, their number of fingers, or {SUPPORTED} of {sorted(known)}"
    if isinstance(wanted, str) and wanted in options:
        return wanted, options[wanted]
    names = tuple(wanted.split(",")) if isinstance(wanted, str) else wanted
    for name, option in options.items():
        if str(len(option.fingers)) == str(wanted) or tuple(f.name for f in option.fingers) == names:
            return name, option
    if not isinstance(names, tuple) or not _is_graspable(names, known):
        raise BadArgument("fingers", repr(wanted), declared)
    fingers = tuple(known[name] for name in names)
    grasping = {joint for finger in fingers for joint in finger.joints}
    moving = grasping | {coupling[joint].source for joint in grasping if joint in coupling} | set(coupling)
    parked = {joint: value for option in reversed(options.values()) for joint, value in option.parked.items()}
    return ",".join(names), Option(fingers, {joint: value for joint, value in parked.items() if joint not in moving})


def _coupling(top: _Table) -> dict[str, Mimic]:
    """Read the coupled joints."""
    table, coupling = top.inner("coupling", optional=True), dict[str, Mimic]()
    for joint in table.table:
        row = table.inner(joint)
        coupling[joint] = Mimic(row.text("source"), row.number("ratio"), row.number("offset"))
        row.done()
    for joint, mimic in coupling.items():
        if mimic.source in coupling:
            raise table.wrong(joint, "a source that is not coupled itself")
    return coupling


def _pairs(top: _Table) -> tuple[tuple[str, str], ...] | None:
    """Read the pairs of links to test for self-collision."""
    table, pairs = top.inner("self_collision", optional=True), None
    if "pairs" in table.table:

        def right(rows: Any) -> bool:
            return isinstance(rows, list) and all(_is_texts(r) and len(r) == 2 and r[0] != r[1] for r in rows)

        pairs = tuple((a, b) for a, b in table.value("pairs", right, "a list of pairs of different links"))
    table.done()
    return pairs
