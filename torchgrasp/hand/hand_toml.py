"""Reading of hand.toml: what a URDF does not say about a grasping hand.

It names the grasping fingers in their order and their pads, the joints that follow others, the posture of the unused
ones, and the links that can meet.
"""

import dataclasses
import math
import sys
from pathlib import Path
from typing import Any, NamedTuple

from torchgrasp.errors import BadArgument, HandFileError
from torchgrasp.hand.safe_xml import read_bounded
from torchgrasp.hand.urdf import Mimic, Triple

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

MAX_BYTES = 1024 * 1024
"""Largest hand.toml; those of the shipped hands have about 5 kB."""


class Pad(NamedTuple):
    """Where a fingertip touches, in the tip link's frame [m].

    `radius` is that of the tip's sphere about `center`; 0: the tip touches in `contact` alone.
    """

    contact: Triple
    normal: Triple
    center: Triple
    radius: float


class Finger(NamedTuple):
    """A finger: its joints from the palm outward, its tip link and its pad."""

    name: str
    joints: tuple[str, ...]
    tip_link: str
    pad: Pad


@dataclasses.dataclass(frozen=True)
class HandSpec:
    """A hand.toml with one of its finger options chosen."""

    path: Path
    name: str
    urdf: Path
    base_link: str
    approach: Triple
    limit_margin: float
    kp: float
    kd: float
    option: str
    fingers: tuple[Finger, Finger, Finger]
    all_fingers: tuple[Finger, ...]
    parked: dict[str, float]
    coupling: dict[str, Mimic]
    pairs: tuple[tuple[str, str], ...] | None
    data: bytes


def _finite(value: Any) -> float | None:
    """Return a number as a float; None for anything that is not a finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:  # an integer of more than 308 digits
        return None


class _Table:
    """A toml table that names itself in every complaint and knows which of its keys were read."""

    def __init__(self, path: Path, name: str, table: Any):
        if not isinstance(table, dict):
            raise HandFileError("hand.toml", f"{path}: {name} is {type(table).__name__}", "a table")
        self.path, self.name, self.table, self.read = path, name, table, set[str]()

    def wrong(self, key: str, allowed: str) -> HandFileError:
        """Make the error for a key."""
        value = repr(self.table[key])[:80] if key in self.table else "nothing"
        return HandFileError("hand.toml", f"{self.path}: {self.name}{key} = {value}", allowed)

    def value(self, key: str, default: Any = None) -> Any:
        """Read a value of any type."""
        self.read.add(key)
        return self.table.get(key, default)

    def text(self, key: str) -> str:
        """Read a word."""
        value = self.value(key)
        if not isinstance(value, str) or not 0 < len(value) <= 200 or not value.isprintable():
            raise self.wrong(key, "a text of 1 to 200 letters")
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        """Read a list of words."""
        value = self.value(key)
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
            raise self.wrong(key, "a list of texts")
        return tuple(value)

    def number(self, key: str, low: float = -math.inf, high: float = math.inf) -> float:
        """Read a finite number in a range."""
        value = _finite(self.value(key))
        if value is None or not low <= value <= high:
            raise self.wrong(key, f"a finite number in [{low:g}, {high:g}]")
        return value

    def triple(self, key: str) -> Triple:
        """Read three finite numbers."""
        value = self.value(key)
        numbers = [_finite(x) for x in value] if isinstance(value, list) and len(value) == 3 else [None]
        if None in numbers:
            raise self.wrong(key, "three finite numbers")
        x, y, z = (v for v in numbers if v is not None)
        return x, y, z

    def inner(self, key: str, optional: bool = False) -> "_Table":
        """Read a table inside."""
        return _Table(self.path, f"{self.name}{key}.", self.value(key, {} if optional else None))

    def tables(self, key: str) -> list["_Table"]:
        """Read a list of tables inside."""
        value = self.value(key, [])
        if not isinstance(value, list) or len(value) > 1000:
            raise self.wrong(key, "a list of at most 1000 tables")
        return [_Table(self.path, f"{self.name}{key}[{i}].", v) for i, v in enumerate(value)]

    def done(self) -> None:
        """Refuse keys that nobody read: they are most often misspelt."""
        unknown = sorted(set(self.table) - self.read)
        if unknown:
            raise self.wrong(unknown[0], f"one of {sorted(self.read)}")


def read_hand_toml(path: Path | str, fingers: str = "default") -> HandSpec:
    """Read and check a hand.toml, choosing one of its options for the three grasping fingers.

    Raises:
        HandFileError: with the file, the key, what was found and what is allowed.
        BadArgument: `fingers` names no option of this hand.
    """
    path = Path(path)
    data = read_bounded("hand.toml", path, "a hand.toml", MAX_BYTES)
    try:
        top = _Table(path, "", tomllib.loads(data.decode("utf-8")))
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
        raise HandFileError("hand.toml", f"{path}: fingers {[f.name for f in known]}", "every name once")
    chosen, parked = _option(top, known, fingers)
    coupling, pairs = _coupling(top), _pairs(top)
    top.done()
    return HandSpec(
        path, name, urdf, base_link, approach, margin, kp, kd, fingers, chosen, known, parked, coupling, pairs, data
    )


def _finger(table: _Table) -> Finger:
    """Read a finger; its normal must be a unit vector, and its contact lie on its sphere."""
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


def _option(
    top: _Table, known: tuple[Finger, ...], name: str
) -> tuple[tuple[Finger, Finger, Finger], dict[str, float]]:
    """Choose the three grasping fingers, in grasp order, and the posture of the joints that do not grasp."""
    options = top.inner("options")
    if name not in options.table:
        raise BadArgument("fingers", repr(name), f"one of {sorted(options.table)}")
    option = options.inner(name)
    names, by_name = option.texts("fingers"), {f.name: f for f in known}
    if len(names) != 3 or len(set(names)) != 3 or not set(names) <= set(by_name):
        raise option.wrong("fingers", f"three different fingers of {sorted(by_name)}")
    park = option.inner("parked", optional=True)
    parked = {joint: park.number(joint) for joint in park.table}
    option.done()
    return (by_name[names[0]], by_name[names[1]], by_name[names[2]]), parked


def _coupling(top: _Table) -> dict[str, Mimic]:
    """Read which joint follows which."""
    table, coupling = top.inner("coupling", optional=True), dict[str, Mimic]()
    for joint in table.table:
        row = table.inner(joint)
        coupling[joint] = Mimic(row.text("source"), row.number("ratio"), row.number("offset"))
        row.done()
    for joint, mimic in coupling.items():
        if mimic.source in coupling:
            raise table.wrong(joint, "a source that follows no other joint")
    return coupling


def _pairs(top: _Table) -> tuple[tuple[str, str], ...] | None:
    """Read the pairs of links that the self-collision test takes; None: the file lists none."""
    table, pairs = top.inner("self_collision", optional=True), None
    if "pairs" in table.table:
        rows = table.value("pairs")
        if not isinstance(rows, list) or not all(
            isinstance(r, list) and len(r) == 2 and all(isinstance(x, str) for x in r) and r[0] != r[1] for r in rows
        ):
            raise table.wrong("pairs", "a list of pairs of different links")
        pairs = tuple((r[0], r[1]) for r in rows)
    table.done()
    return pairs
