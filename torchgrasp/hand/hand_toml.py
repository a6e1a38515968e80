"""Reader of hand.toml, which describes a hand's fingers, pads, coupled and fixed joints, and
colliding links.
"""

import dataclasses
import functools
import math
import re
import sys
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torchgrasp.files import Field, read_bounded
from torchgrasp.foundation.base import FINGERTIPS
from torchgrasp.foundation.errors import BadArgument, HandFileError
from torchgrasp.foundation.limits import HAND_SHAPE_PAIRS, TOML_BYTES, XML_LETTERS
from torchgrasp.hand.urdf import Mimic, Triple

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

ROUNDING = 1e-6  # largest error of a unit vector, and [m] of a contact on its sphere
MOST_GAIN = 1e6  # greatest gain of a drive
LEAST_GAIN = 1e-6  # least stiffness of a drive
# radius [m] of a fingertip
LEAST_RADIUS = 1e-4
MOST_RADIUS = 0.1
SUPPORTED = "three to five different fingers"  # fingers of a grasp, see `FINGERTIPS`
_PART = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')"""
_DOTTED = re.compile(rf"""(?<![\w"'-]){_PART}(?:[ \t]*\.[ \t]*{_PART}){{16}}""")
"""A key of more than 16 parts: the memory of the TOML reader grows with the square of their number.
"""


class Pad(NamedTuple):
    """The surface of a fingertip that may touch objects: a sphere, or a point (radius 0).

    All is in the frame of the tip's link. `contact` [m] is the pad's contact point, and `normal`
    the outward unit normal there. `center` [m] is the centre of the sphere, and `radius` [m] its
    radius. The center of a point is the contact point.
    """

    contact: Triple
    normal: Triple
    center: Triple
    radius: float


class Finger(NamedTuple):
    """A finger of a hand, as hand.toml describes it."""

    name: str  # name of the finger
    joints: tuple[str, ...]  # names of its joints, from the palm outward
    tip_link: str  # name of the link of its tip
    pad: Pad  # the part of the tip that may touch objects


Grasping = tuple[Finger, ...]  # the grasping fingers, three to five, in grasp order
Fingers = str | int | tuple[str, ...]
"""The grasping fingers: an option of hand.toml, a number of fingers, or names, also as
"index,middle,thumb".
"""


class Option(NamedTuple):
    """A choice of grasping fingers that hand.toml offers under a name (an option)."""

    fingers: Grasping  # the grasping fingers
    # positions [rad or m], by name, of joints that stay fixed while these fingers grasp
    parked: dict[str, float]


@dataclasses.dataclass(frozen=True)
class HandSpec:
    """The content of a hand.toml, with the grasping `fingers` of the chosen `option`.

    Args:
        path: path of the hand.toml.
        name: name of the hand.
        urdf: path of the URDF, in the same folder.
        base_link: name of the URDF's root link, the palm.
        approach: unit vector out of the palm, in the palm's frame.
        limit_margin: taken off both ends of the range of every actuated joint [rad or m].
        kp: stiffness of every drive [N m/rad].
        kd: damping of every drive [N m s/rad].
        option: name of the chosen option, or of the chosen fingers with commas between.
        fingers: the grasping fingers, in grasp order.
        options: all options, by name.
        all_fingers: all fingers of the hand.
        parked: positions [rad or m] of the joints that stay fixed, by name.
        coupling: the coupled joints, by name.
        pairs: names of the pairs of links to test for self-collision; None if the file lists none.
        data: the bytes of the file.
    """

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
        """Return an error for a fault of this hand.toml. The text `found` says what the file has,
        and `allowed` what is expected.
        """
        return HandFileError("hand.toml", f"{self.path}: {found}", allowed)


def read_hand_toml(path: Path | str, fingers: Fingers = "default") -> HandSpec:
    """Read and check a hand.toml; return its content, with the chosen grasping `fingers`.

    `fingers` are the name of an option of hand.toml, a number of fingers, or names of fingers. A
    number takes the first option with as many. Raises `HandFileError` for a missing or malformed
    file, and `BadArgument` for fingers that the hand lacks.
    """
    path = Path(path)
    refuse = functools.partial(HandFileError, "hand.toml")
    data = read_bounded(path, TOML_BYTES, "a hand.toml", refuse)
    try:
        text = data.decode("utf-8")
        if _DOTTED.search(text):
            raise ValueError("a key of more than 16 parts")
        top = Field(path, "", tomllib.loads(text), refuse)
    except (ValueError, RecursionError) as error:
        raise refuse(
            f"{path}: {error}", "valid TOML in UTF-8, with keys of at most 16 parts"
        ) from error
    names = ("name", "urdf", "base_link")
    numbers = ("approach", "limit_margin", "actuators")
    table = _entries(
        top, (*names, *numbers, "options"), {"finger": [], "coupling": {}, "self_collision": {}}
    )
    name, file, base_link = (_word(table[key]) for key in names)
    urdf = (path.parent / file).resolve()
    if urdf.parent != path.parent.resolve():
        raise table["urdf"].wrong("a file beside hand.toml")
    approach = _triple(table["approach"])
    margin = table["limit_margin"].number(0.0, 1.0)
    actuators = _entries(table["actuators"], ("kp", "kd"), {})
    kp = actuators["kp"].number(LEAST_GAIN, MOST_GAIN)
    kd = actuators["kd"].number(0.0, MOST_GAIN)
    known = tuple(map(_finger, table["finger"].items()))
    if len({f.name for f in known}) < len(known):
        raise refuse(f"{path}: fingers {[f.name for f in known]}", "different names")
    options = {name: _option(field, known) for name, field in table["options"].entries().items()}
    coupling = _coupling(table["coupling"])
    pairs = _pairs(table["self_collision"])
    option, (chosen, parked) = _choose(options, {f.name: f for f in known}, coupling, fingers)
    return HandSpec(
        path,
        name,
        urdf,
        base_link,
        approach,
        margin,
        kp,
        kd,
        option,
        chosen,
        options,
        known,
        parked,
        coupling,
        pairs,
        data,
    )


def _entries(
    table: Field, required: Sequence[str], optional: Mapping[str, Any]
) -> dict[str, Field]:
    """Return the fields of a table, with defaults for optional keys; refuse unknown keys, which may
    be misspelt.
    """
    fields = table.entries()
    for key in sorted(fields.keys() - {*required, *optional}):
        raise fields[key].wrong(f"one of {sorted([*required, *optional])}")
    place = f"{table.place}." if table.place else ""
    missing = {
        key: table._replace(place=place + key, value=optional.get(key))
        for key in (*required, *optional)
    }
    return missing | fields


def _word(field: Field) -> str:
    """Return the text of a field; refuse a text that is empty, too long or not printable."""
    if not (text := field.text(XML_LETTERS)) or not text.isprintable():
        raise field.wrong(f"a text of 1 to {XML_LETTERS} characters")
    return text


def _texts(field: Field) -> tuple[str, ...]:
    return tuple(x.text() for x in field.items())


def _triple(field: Field) -> Triple:
    x, y, z = field.numbers(3)
    return x, y, z


def _finger(field: Field) -> Finger:
    required = ("name", "joints", "tip_link", "contact", "normal", "tip")
    table = _entries(field, required, {"center": None, "radius": None})
    contact = _triple(table["contact"])
    normal = _triple(table["normal"])
    kind = table["tip"].value
    if kind not in ("sphere", "point"):
        raise table["tip"].wrong("'sphere' or 'point'")
    if abs(math.hypot(*normal) - 1) > ROUNDING:
        raise table["normal"].wrong("a unit vector")
    center = contact
    radius = 0.0
    if kind == "sphere":
        center = _triple(table["center"])
        radius = table["radius"].number(LEAST_RADIUS, MOST_RADIUS)
        on_sphere = [c + radius * n for c, n in zip(center, normal, strict=True)]
        if math.dist(contact, on_sphere) > ROUNDING:
            raise table["contact"].wrong("center + radius * normal")
    pad = Pad(contact, normal, center, radius)
    return Finger(_word(table["name"]), _texts(table["joints"]), _word(table["tip_link"]), pad)


def _option(field: Field, known: tuple[Finger, ...]) -> Option:
    table = _entries(field, ("fingers",), {"parked": {}})
    by_name = {f.name: f for f in known}
    names = _texts(table["fingers"])
    if not _is_graspable(names, by_name):
        raise table["fingers"].wrong(f"{SUPPORTED} of {sorted(by_name)}")
    parked = {joint: position.number() for joint, position in table["parked"].entries().items()}
    return Option(tuple(by_name[x] for x in names), parked)


def _is_graspable(names: tuple[str, ...], known: Collection[str]) -> bool:
    """Return whether finger names are known, different, and of a supported number."""
    return (
        FINGERTIPS[0] <= len(names) <= FINGERTIPS[1]
        and len(set(names)) == len(names)
        and set(names) <= set(known)
    )


def _choose(
    options: dict[str, Option],
    known: dict[str, Finger],
    coupling: dict[str, Mimic],
    wanted: Fingers,
) -> tuple[str, Option]:
    """Return name and content of the option of hand.toml that has the `wanted` fingers.

    `options` are the file's options, `known` its fingers, and `coupling` its coupled joints, each
    by name. If no option has these fingers, a new one is made; its name lists them. Raises
    `BadArgument` for an unknown option or finger, or an impossible number of fingers.
    """
    declared = (
        f"one of the options {sorted(options)}, their number of fingers, or {SUPPORTED} "
        f"of {sorted(known)}"
    )
    if isinstance(wanted, str) and wanted in options:
        return wanted, options[wanted]
    names = tuple(wanted.split(",")) if isinstance(wanted, str) else wanted
    for name, option in options.items():
        if (
            str(len(option.fingers)) == str(wanted)
            or tuple(f.name for f in option.fingers) == names
        ):
            return name, option
    if not isinstance(names, tuple) or not _is_graspable(names, known):
        raise BadArgument("fingers", repr(wanted), declared)
    fingers = tuple(known[name] for name in names)
    grasping = {joint for finger in fingers for joint in finger.joints}
    moving = grasping | leading(coupling, grasping) | set(coupling)
    parked = {
        joint: value
        for option in reversed(options.values())
        for joint, value in option.parked.items()
    }
    return ",".join(names), Option(
        fingers, {joint: value for joint, value in parked.items() if joint not in moving}
    )


def _coupling(field: Field) -> dict[str, Mimic]:
    coupling = dict[str, Mimic]()
    joints = field.entries()
    for joint, row in joints.items():
        if "sources" in row.entries():
            table = _entries(row, ("sources", "offset"), {})
            ratios = table["sources"].entries()
            terms = [(source, ratio.number()) for source, ratio in ratios.items()]
            if not terms:
                raise table["sources"].wrong("at least one source with its ratio")
            coupling[joint] = Mimic(*terms[0], table["offset"].number(), tuple(terms[1:]))
            continue
        table = _entries(row, ("source", "ratio", "offset"), {})
        coupling[joint] = Mimic(
            _word(table["source"]), table["ratio"].number(), table["offset"].number()
        )
    for joint in coupling:
        if leading(coupling, [joint]) & set(coupling):
            raise joints[joint].wrong("a source that is not coupled itself")
    return coupling


def leading(coupling: Mapping[str, Mimic], joints: Collection[str]) -> set[str]:
    """Return the names of the joints that are followed by coupled joints among `joints`.

    `joints` holds names of joints. `coupling` tells by name which joints follow others, and how.
    """
    return {name for joint in joints if joint in coupling for name, _ in coupling[joint].terms}


def _pairs(field: Field) -> tuple[tuple[str, str], ...] | None:
    """Return the pairs of links to test for self-collision, or None if hand.toml lists none."""
    pairs = _entries(field, (), {"pairs": None})["pairs"]
    if pairs.value is None:
        return None
    found = tuple((row, _texts(row)) for row in pairs.items(HAND_SHAPE_PAIRS))
    for row, names in found:
        if len(names) != 2 or names[0] == names[1]:
            raise row.wrong("a pair of different links")
    return tuple((one, two) for _, (one, two) in found)
