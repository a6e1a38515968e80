"""Reading of hand.toml: what a URDF does not say about a grasping hand.

Which fingers grasp and in which order, where their pads are, which joints follow others, where the unused ones are
parked, and which links can meet.
"""

import dataclasses
import math
import sys
from pathlib import Path
from typing import Any

from torchgrasp.errors import BadArgument, HandFileError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

MAX_BYTES = 1024 * 1024

Triple = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Finger:
    """A finger: its joints from the palm out, its tip link, and the pad in the tip link's frame [m].

    `radius` is that of the tip's sphere around `center`; 0 for a tip that touches in its contact point alone.
    """

    name: str
    joints: tuple[str, ...]
    tip_link: str
    contact: Triple
    normal: Triple
    center: Triple
    radius: float


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
    coupling: dict[str, tuple[str, float, float]]
    pairs: tuple[tuple[str, str], ...] | None
    data: bytes


def _finite(value: Any) -> float | None:
    """Return a number as a float, or None for what is no finite number."""
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
        found = repr(self.table[key])[:80] if key in self.table else "nothing"
        return HandFileError("hand.toml", f"{self.path}: {self.name}{key} = {found}", allowed)

    def text(self, key: str) -> str:
        """Read a word."""
        self.read.add(key)
        value = self.table.get(key)
        if not isinstance(value, str) or not 0 < len(value) <= 200 or not value.isprintable():
            raise self.wrong(key, "a text of 1 to 200 letters")
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        """Read a list of words."""
        self.read.add(key)
        value = self.table.get(key)
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
            raise self.wrong(key, "a list of texts")
        return tuple(value)

    def number(self, key: str, low: float = -math.inf, high: float = math.inf) -> float:
        """Read a finite number in a range."""
        self.read.add(key)
        value = _finite(self.table.get(key))
        if value is None or not low <= value <= high:
            raise self.wrong(key, f"a finite number in [{low:g}, {high:g}]")
        return value

    def triple(self, key: str) -> Triple:
        """Read three finite numbers."""
        self.read.add(key)
        value = self.table.get(key)
        found = [_finite(x) for x in value] if isinstance(value, list) and len(value) == 3 else [None]
        if None in found:
            raise self.wrong(key, "three finite numbers")
        x, y, z = (v for v in found if v is not None)
        return x, y, z

    def inner(self, key: str, optional: bool = False) -> "_Table":
        """Read a table inside."""
        self.read.add(key)
        return _Table(self.path, f"{self.name}{key}.", self.table.get(key, {} if optional else None))

    def tables(self, key: str) -> list["_Table"]:
        """Read a list of tables inside."""
        self.read.add(key)
        value = self.table.get(key, [])
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
    if not path.is_file():
        raise HandFileError("hand.toml", f"{path}, which is no file", "a hand.toml")
    if path.stat().st_size > MAX_BYTES:
        raise HandFileError("hand.toml", f"{path}: {path.stat().st_size} bytes", f"at most {MAX_BYTES} bytes")
    data = path.read_bytes()
    try:
        top = _Table(path, "", tomllib.loads(data.decode("utf-8")))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise HandFileError("hand.toml", f"{path}: {error}", "valid TOML in UTF-8") from error
    name, base_link, approach = top.text("name"), top.text("base_link"), top.triple("approach")
    urdf = (path.parent / top.text("urdf")).resolve()
    if urdf.parent != path.parent.resolve():
        raise top.wrong("urdf", "a file beside hand.toml")
    margin = top.number("limit_margin", 0.0, 1.0)
    actuators = top.inner("actuators")
    kp, kd = actuators.number("kp", 1e-6, 1e6), actuators.number("kd", 0.0, 1e6)
    actuators.done()
    known = tuple(_finger(t) for t in top.tables("finger"))
    if len({f.name for f in known}) < len(known):
        raise HandFileError("hand.toml", f"{path}: fingers {[f.name for f in known]}", "every name once")
    chosen, parked = _option(top, known, fingers)
    coupling = _coupling(top)
    pairs = _pairs(top)
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
    finger = Finger(table.text("name"), table.texts("joints"), table.text("tip_link"), contact, normal, center, radius)
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


def _coupling(top: _Table) -> dict[str, tuple[str, float, float]]:
    """Read which joint follows which, as joint = ratio * source + offset."""
    table, coupling = top.inner("coupling", optional=True), {}
    for joint in table.table:
        row = table.inner(joint)
        coupling[joint] = (row.text("source"), row.number("ratio"), row.number("offset"))
        row.done()
    for joint, (source, _, _) in coupling.items():
        if source in coupling:
            raise table.wrong(joint, "a source that follows no other joint")
    return coupling


def _pairs(top: _Table) -> tuple[tuple[str, str], ...] | None:
    """Read the pairs of links that the self-collision test takes (none given: all but neighbours)."""
    table, pairs = top.inner("self_collision", optional=True), None
    if "pairs" in table.table:
        table.read.add("pairs")
        rows = table.table["pairs"]
        if not isinstance(rows, list) or not all(
            isinstance(r, list) and len(r) == 2 and all(isinstance(x, str) for x in r) and r[0] != r[1] for r in rows
        ):
            raise table.wrong("pairs", "a list of pairs of different links")
        pairs = tuple((r[0], r[1]) for r in rows)
    table.done()
    return pairs
