"""Safe parsing of a URDF's XML: bounded, without declarations, without meshes outside the folder."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

from torchgrasp.errors import HandFileError

MAX_DEPTH = 64
"""Deepest nesting of elements; a URDF needs six."""
MAX_ELEMENTS = 50_000
"""Most elements: about 100 for each of 512 links."""
MAX_MESH = 50 * 1024 * 1024
"""Largest mesh that a URDF may name [bytes]."""
IGNORED = {"material", "transmission", "gazebo"}
"""Elements of a robot, besides links and joints, that a hand can do without."""


def read_bounded(source: str, path: Path, wanted: str, most: int) -> bytes:
    """Read a file of at most `most` bytes; `source` and `wanted` describe it in the error."""
    if not path.is_file():
        raise HandFileError(source, f"{path}, which is no file", wanted)
    if path.stat().st_size > most:
        raise HandFileError(source, f"{path}: {path.stat().st_size} bytes", f"at most {most} bytes")
    return path.read_bytes()


class _BoundedBuilder(ET.TreeBuilder):
    """A tree builder that refuses too deep or too many elements."""

    def __init__(self) -> None:
        super().__init__()
        self.depth = self.count = 0

    def start(self, tag: Any, attrs: Any) -> Any:
        self.depth, self.count = self.depth + 1, self.count + 1
        if self.depth > MAX_DEPTH or self.count > MAX_ELEMENTS:
            raise HandFileError("urdf", "a too large XML tree", f"depth {MAX_DEPTH}, {MAX_ELEMENTS} elements at most")
        return super().start(tag, attrs)

    def end(self, tag: Any) -> Any:
        self.depth -= 1
        return super().end(tag)


def parse_urdf(path: Path, data: bytes) -> ET.Element:
    """Parse a URDF's bytes; refuse XML that reaches other files or explodes, unknown elements, meshes elsewhere."""
    # anywhere, comments included: what looks like a comment may be hidden in a processing instruction
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise HandFileError("urdf", f"{path}: a DOCTYPE or ENTITY declaration", "no declarations")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise HandFileError("urdf", f"{path}: {error.reason} at byte {error.start}", "UTF-8 text") from error
    declared = re.match(r"""\s*<\?xml[^>]*encoding\s*=\s*["']([^"']*)""", text)
    if "\0" in text or (declared and declared.group(1).lower() not in ("utf-8", "us-ascii", "ascii")):
        raise HandFileError("urdf", f"{path}: another encoding", "UTF-8 text")
    try:
        robot = ET.fromstring(data, ET.XMLParser(target=_BoundedBuilder()))
    except (ET.ParseError, ValueError) as error:
        if isinstance(error, HandFileError):
            raise
        raise HandFileError("urdf", f"{path}: {error}", "well-formed XML") from error
    if robot.tag != "robot":
        raise HandFileError("urdf", f"{path}: <{robot.tag}>", "<robot>")
    for element in robot:
        if element.tag not in {"link", "joint"} | IGNORED:
            raise HandFileError("urdf", f"{path}: <{element.tag}>", f"<link>, <joint> or one of {sorted(IGNORED)}")
    for mesh in robot.iter("mesh"):
        _check_mesh_name(path, mesh.get("filename", ""))
    return robot


def _check_mesh_name(path: Path, name: str) -> None:
    """Refuse a mesh outside the hand's folder or not a regular file, without opening it."""
    allowed = "a relative .stl or .obj of at most 50 MiB inside the hand's folder"
    refusal = HandFileError("urdf", f"{path}: mesh {name[:80]!r}", allowed)
    if not 0 < len(name) <= 255 or ":" in name or "\\" in name or Path(name).suffix.lower() not in (".stl", ".obj"):
        raise refusal
    mesh = path.parent.resolve() / name
    try:
        inside = mesh.resolve().is_relative_to(path.parent.resolve())
    except (OSError, RuntimeError):  # a loop of symbolic links, a name that the file system does not take
        inside = False
    if not inside or (mesh.exists() and not (mesh.is_file() and mesh.stat().st_size <= MAX_MESH)):
        raise refusal
