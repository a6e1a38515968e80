"""The safety gate for URDF files: it lets through bounded XML without declarations, with known
elements and finite numbers.

The gate writes the XML anew from the elements listed below, so that other readers see nothing else.
It opens no other file.
"""

import math
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

from torchgrasp.foundation.errors import HandFileError
from torchgrasp.foundation.limits import XML_DEPTH, XML_ELEMENTS, XML_LETTERS

IGNORED = {"material", "transmission", "gazebo", "ros2_control", "mujoco", "sensor"}
"""Elements of a robot, besides links and joints, that are left out."""
NUMBER = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")
"""A decimal number; Python also reads 1_0, digits outside ASCII, and nan."""
SIZES = {
    "box": ("size",),
    "sphere": ("radius",),
    "cylinder": ("radius", "length"),
    "mesh": ("scale",),
}
"""The collision shapes of a URDF, and the attributes that hold the sizes of each."""
PARTS = {
    "robot": ("link", "joint"),
    "link": ("inertial", "collision"),
    "inertial": ("origin", "mass", "inertia"),
    "collision": ("origin", "geometry"),
    "geometry": tuple(SIZES),
    "joint": ("origin", "parent", "child", "axis", "limit", "mimic"),
}
"""The elements that are read, by the element around them. `<visual>` is left out, with its mesh."""
REQUIRED = {
    "inertial": ("mass", "inertia"),
    "collision": ("geometry",),
    "joint": ("parent", "child"),
}
"""Elements that an element must have."""
SHOWN = 80  # letters of a wrong text that an error shows
SHOWN_WORD = 20  # letters of a wrong name
FULL_TURN = 6.3  # angle [rad] above which an angle is probably in degrees
DEGREES = "(in degrees? 90 is 1.57 rad)"
NO_XACRO = "a URDF without xacro (xacro FILE > hand.urdf)"
WORDS = {
    **{"link": ("name",), "joint": ("name", "type"), "mesh": ("filename",)},
    **{"parent": ("link",), "child": ("link",), "mimic": ("joint",)},
}
"""Attributes that are names; all are required."""
NUMBERS: dict[str, dict[str, tuple[int, str | None]]] = {
    "origin": {"xyz": (3, "0 0 0"), "rpy": (3, "0 0 0")},
    "mass": {"value": (1, None)},
    "inertia": {key: (1, None) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")},
    "box": {"size": (3, None)},
    "cylinder": {"radius": (1, None), "length": (1, None)},
    "sphere": {"radius": (1, None)},
    "mesh": {"scale": (3, "1 1 1")},
    "axis": {"xyz": (3, None)},
    "limit": {"lower": (1, ""), "upper": (1, ""), "effort": (1, "0"), "velocity": (1, "0")},
    "mimic": {"multiplier": (1, "1"), "offset": (1, "0")},
}
"""Attributes that are numbers: their count and default. None marks a required one, "" one that may
be omitted.
"""


class BoundedBuilder(ET.TreeBuilder):
    """An XML tree builder that rejects more than 50,000 elements, or elements nested more than 64
    deep.
    """

    def __init__(self) -> None:
        super().__init__()
        self.depth = self.count = 0

    def start(self, tag: Any, attrs: Any) -> Any:
        """Count the start of an element; raise `HandFileError` for too many elements or too deep
        nesting.
        """
        self.depth = self.depth + 1
        self.count = self.count + 1
        if self.depth > XML_DEPTH or self.count > XML_ELEMENTS:
            allowed = f"at most {XML_ELEMENTS} elements, nested at most {XML_DEPTH} deep"
            raise HandFileError("urdf", "a larger XML tree", allowed)
        return super().start(tag, attrs)

    def end(self, tag: Any) -> Any:
        """Count the end of an element."""
        self.depth -= 1
        return super().end(tag)


def bounded_tree(data: bytes | str) -> ET.Element:
    """Return the element tree of an XML text.

    Raises `HandFileError` for more than 50,000 elements, or a nesting more than 64 deep. Raises
    `ParseError` or `ValueError` for another fault.
    """
    return ET.fromstring(data, ET.XMLParser(target=BoundedBuilder()))


def parse_urdf(path: Path, data: bytes, visual: bool = False) -> ET.Element:
    """Return the XML tree of a URDF, reduced to links and joints with checked numbers.

    `data` are the bytes of the file; `path` is only named in errors. With `visual`, the <visual> of
    a link without <collision> becomes its <collision>. Known elements of other kinds (`IGNORED`),
    such as <transmission>, are left out. Raises `HandFileError` for malformed XML, for unknown
    elements, and for numbers that are missing or not finite.
    """
    # also within comments: a declaration may be hidden by a processing instruction that looks like
    # a comment
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise HandFileError(
            "urdf", f"{path}: a DOCTYPE or ENTITY declaration", "a URDF without declarations"
        )
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise HandFileError(
            "urdf", f"{path}: {error.reason} at byte {error.start}", "UTF-8 text"
        ) from error
    declared = re.match(r"""\s*<\?xml[^>]*encoding\s*=\s*["']([^"']*)""", text)
    if "\0" in text or (
        declared and declared.group(1).lower() not in ("utf-8", "us-ascii", "ascii")
    ):
        raise HandFileError("urdf", f"{path} in another encoding", "UTF-8 text")
    try:
        robot = bounded_tree(data)
    except (ET.ParseError, ValueError) as error:
        if isinstance(error, HandFileError):
            raise
        raise HandFileError(
            "urdf", f"{path}: {error}", NO_XACRO if "xacro:" in text else "well-formed XML"
        ) from error
    if robot.tag != "robot":
        raise HandFileError("urdf", f"{path}: <{robot.tag}>", "<robot> as the root element")
    for element in robot:
        if (
            element.tag not in {"link", "joint"} | IGNORED and "xacro}" not in element.tag
        ):  # named below
            raise HandFileError(
                "urdf", f"{path}: <{element.tag}>", f"<link>, <joint> or one of {sorted(IGNORED)}"
            )
    for link in _seen_only(robot) if visual else ():
        for part in link.findall("visual"):
            part.tag = "collision"
    clean = _clean(path, "", robot)
    clean.set("name", robot.get("name") or "hand")
    return clean


def seen_links(data: bytes) -> tuple[str, ...]:
    """Return the names of the links of a URDF that have a <visual> but no <collision>.

    `data` are the bytes of a URDF that `parse_urdf` has accepted.
    """
    robot = bounded_tree(data)
    return tuple(link.get("name", "") for link in _seen_only(robot))


def soft_limits(data: bytes) -> dict[str, tuple[float, float]]:
    """Return the soft limits (lower, upper) [rad or m] of joints by the joint's name, from their
    elements <safety_controller>.

    A joint without this element, or without both limits in it, is left out. `data` are the bytes of
    a URDF that `parse_urdf` has accepted.
    """
    robot = bounded_tree(data)
    found = {}
    for joint in robot.findall("joint"):
        safety = joint.find("safety_controller")
        if safety is None:
            continue
        texts = [safety.get(f"soft_{end}_limit", "") for end in ("lower", "upper")]
        if all(NUMBER.fullmatch(text) for text in texts):
            low, high = map(float, texts)
            found[joint.get("name", "")] = (low, high)
    return found


def _seen_only(robot: ET.Element) -> list[ET.Element]:
    """Return the links of a robot with a <visual> but no <collision>."""
    links = robot.findall("link")
    return [x for x in links if x.find("visual") is not None and x.find("collision") is None]


def _clean(path: Path, parent: str, element: ET.Element) -> ET.Element:
    """Return a copy of an element with its known parts; raise `HandFileError` for missing parts or
    bad numbers.
    """
    tag = str(element.tag)
    name = (element.get("name") or "")[:XML_LETTERS]
    where = "" if tag == "robot" else f"{parent} {tag} {name}".strip()
    place = f"{path}: {where}"
    _refuse_xacro(place, element)
    clean = ET.Element(tag)
    for key in WORDS.get(tag, ()):
        clean.set(key, _read_word(place, key, element.get(key, "")))
    for key, (count, default) in NUMBERS.get(tag, {}).items():
        text = element.get(key, default)
        numbers = _read_numbers(place, key, text, count, tag == "mesh")
        if numbers:
            clean.set(key, numbers)
        elif text != "" or key in element.attrib:
            allowed = f"{count} finite numbers" if count > 1 else "a finite number"
            found = f"{place} {key} {(text or 'nothing')[:SHOWN]!r}"
            raise HandFileError("urdf", found, allowed)
    if tag == "geometry" and (len(element) != 1 or element[0].tag not in SIZES):
        shape = f"<{element[0].tag}>" if len(element) == 1 else "without one shape"
        raise HandFileError("urdf", f"{place} {shape}", "box, cylinder or sphere")
    for need in REQUIRED.get(tag, ()):
        if element.find(need) is None:
            allowed = f"a <{need}> in every <{tag}>"
            raise HandFileError("urdf", f"{place} without <{need}>", allowed)
    kept = PARTS.get(tag, ())
    clean.extend([_clean(path, where, part) for part in element if part.tag in kept])
    return clean


def _refuse_xacro(place: str, element: ET.Element) -> None:
    """Raise `HandFileError` if an element holds what only xacro reads."""
    tag = str(element.tag)
    texts = [element.get(key, "") for key in (*WORDS.get(tag, ()), *NUMBERS.get(tag, {}))]
    unread = [text for text in texts if "${" in text or "$(" in text]
    parts = [str(part.tag) for part in element if "xacro}" in str(part.tag)]
    unread += [f"xacro:{part.rpartition('}')[2]}" for part in parts]
    if unread:
        raise HandFileError("urdf", f"{place} {unread[0][:SHOWN]!r}", NO_XACRO)


def _read_word(place: str, key: str, word: str) -> str:
    """Return a word, such as a name; raise `HandFileError` if it is missing, too long or not
    printable.
    """
    if 0 < len(word) <= XML_LETTERS and word.isprintable():
        return word
    found = f"of {len(word)} letters: {word[:SHOWN_WORD]!r}" if word else "without one"
    allowed = f"a {key} of 1 to {XML_LETTERS} printable letters"
    raise HandFileError("urdf", f"{place}: a {key} {found}", allowed)


def _read_numbers(place: str, key: str, text: str | None, count: int, mesh: bool) -> str:
    """Return `count` finite numbers in one text, without a negative zero; empty for another text.

    Raises `HandFileError` for angles in degrees.
    """
    words = (text or "").split()
    if mesh and len(words) == 1:
        words = 3 * words  # one scale for all axes
    finite = all(NUMBER.fullmatch(word) and math.isfinite(float(word)) for word in words)
    if len(words) != count or not finite:
        return ""
    if key == "rpy" and any(abs(float(word)) > FULL_TURN for word in words):
        raise HandFileError("urdf", f"{place} rpy {text!r}", f"radians {DEGREES}")
    return " ".join("0" if float(word) == 0 else word for word in words)
