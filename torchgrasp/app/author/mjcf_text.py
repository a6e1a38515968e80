"""The safety gate for MJCF files: it hands bounded XML and its meshes to MuJoCo's compiler.

The gate puts included files in their place, and writes the XML anew from the sections listed below.
Files are opened here alone, below the folder of the MJCF: the compiler gets their bytes.
"""

import functools
import re
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from torchgrasp.files import read_bounded
from torchgrasp.foundation.errors import HandFileError
from torchgrasp.foundation.limits import (
    HAND_MESH_BYTES,
    MESH_BYTES,
    URDF_BYTES,
    XML_DEPTH,
    XML_ELEMENTS,
    XML_LETTERS,
)
from torchgrasp.hand.safe_xml import bounded_tree

SECTIONS = {"compiler", "default", "asset", "worldbody", "contact", "equality", "tendon"}
"""The sections of an MJCF that are read, beside its actuators."""
LEFT_OUT = {
    "compiler": ("LRopt", "lengthrange"),
    "default": ("material", "camera", "light"),
    "asset": ("texture", "material", "hfield", "skin"),
    "mesh": ("plugin",),
    "worldbody": ("camera", "light", "flexcomp"),
    "body": ("camera", "light", "flexcomp"),
    "frame": ("camera", "light", "flexcomp"),
    "geom": ("plugin",),
    "equality": ("flex", "flexvert", "flexstrain"),
    "actuator": ("plugin", "adhesion"),
}
"""Elements that say nothing about a hand, by the element around them."""
REFUSED = {
    "attach": "a file without <attach>: MuJoCo's MjSpec.to_xml() writes the whole model as one",
    "model": "a file without <model>: MuJoCo's MjSpec.to_xml() writes the whole model as one",
    "replicate": "bodies one by one: MuJoCo's mj_saveLastXML writes them",
    "composite": "bodies one by one: MuJoCo's mj_saveLastXML writes them",
}
UNUSED = ("material", "texture", "plugin", "user", "nsample", "delay", "interp", "content_type")
"""Attributes that are taken off every element: they refer to what is left out, or to memory."""
FOLDERS = ("assetdir", "meshdir", "texturedir", "strippath")
"""Attributes of the compiler that say where meshes are; the gate has found them."""
MESHES = (".stl", ".obj", ".msh")
MOST_FILES = 100  # included files
SHOWN = 80  # letters of a wrong text that an error shows
refuse = functools.partial(HandFileError, "mjcf")  # the error of this gate, as a function


class SafeMjcf(NamedTuple):
    """The checked content of an MJCF, a model file of MuJoCo.

    `name` is the name of the model, and `text` the XML with all included files. `meshes` holds the
    bytes of each mesh file, by its name in the text. Of the elements that were taken out,
    `left_out` holds the tags that matter for motion or contact, such as "flexcomp".
    """

    name: str
    text: str
    meshes: dict[str, bytes]
    left_out: tuple[str, ...]


def is_mjcf(path: Path) -> bool:
    """Return whether a file ends in .xml or .mjcf and its first element is <mujoco> or
    <mujocoinclude>.

    It may still be malformed: only `read_mjcf_text` checks that. A file that cannot be read gives
    False.
    """
    if path.suffix.lower() not in (".xml", ".mjcf"):
        return False
    try:
        with path.open("rb") as file:
            begin = file.read(URDF_BYTES)
    except OSError:
        return False
    text = re.sub(rb"<!--.*?-->|<\?.*?\?>", b"", begin, flags=re.DOTALL)
    first = re.search(rb"<\s*([A-Za-z_]+)", text)
    return first is not None and first[1] in (b"mujoco", b"mujocoinclude")


def read_mjcf_text(path: Path, base: Path | None = None) -> SafeMjcf:
    """Return the checked content of an MJCF with its included files and meshes.

    All files must lie below the folder `base`; None means the folder of the MJCF.

    Raises `HandFileError` for files that are missing, outside this folder, malformed or too large.
    Raises it also for <replicate> and <composite>, which make many bodies. The same is raised for
    <attach> and <model>, which read other models.
    """
    left = Counter[str]()
    spot = _Spot(path, (base or path.parent).resolve())
    root = _included(path, spot, [path.resolve()])
    count = sum(1 for _ in root.iter())
    if count > XML_ELEMENTS:
        raise refuse(f"{path} of {count} elements", f"at most {XML_ELEMENTS} elements")
    for section in list(root):
        if section.tag not in SECTIONS and section.tag != "actuator":
            root.remove(section)
            left.update([section.tag] if section.tag == "deformable" else [])
    for element in root.iter():
        _trim(path, element, left)
    meshes = _read_meshes(spot, root)
    for compiler in root.iter("compiler"):
        for key in FOLDERS:
            compiler.attrib.pop(key, None)
    called = root.get("model", "")
    name = called if called and called.isprintable() else path.stem
    text = ET.tostring(root, encoding="unicode")
    return SafeMjcf(name[:XML_LETTERS], text, meshes, tuple(sorted(left)))


class _Spot(NamedTuple):
    """The file that the user named, and the folder of all its files."""

    path: Path
    base: Path


def _included(path: Path, spot: _Spot, open_files: list[Path]) -> ET.Element:
    """Return the XML tree of a file, with the content of included files in its place.

    `open_files` are all files that were read so far.
    """
    root = _parse(path)
    if root.tag not in ("mujoco", "mujocoinclude"):
        raise refuse(f"{path}: <{root.tag}>", "<mujoco> as the root element")
    # MuJoCo takes paths from the folder of the main file
    for parent in list(root.iter()):
        for element in [part for part in parent if part.tag == "include"]:
            name = element.get("file", "")
            file = _inside(spot, PurePosixPath(name), f"include {name[:SHOWN]!r}")
            if file in open_files or len(open_files) > MOST_FILES:
                raise refuse(f"{path}: include {name[:SHOWN]!r} twice", "each included file once")
            open_files.append(file)
            content = _included(file, spot, open_files)
            place = list(parent).index(element)
            parent.remove(element)
            for offset, part in enumerate(content):
                parent.insert(place + offset, part)
    return root


def _parse(path: Path) -> ET.Element:
    """Return the XML tree of a file without declarations."""
    data = read_bounded(path, URDF_BYTES, "an MJCF file", refuse)
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise refuse(f"{path}: a DOCTYPE or ENTITY declaration", "MJCF without declarations")
    try:
        data.decode("utf-8-sig")
        return bounded_tree(data)
    except UnicodeDecodeError as error:
        raise refuse(f"{path}: {error.reason} at byte {error.start}", "UTF-8 text") from error
    except HandFileError as error:
        allowed = f"at most {XML_ELEMENTS} elements, nested at most {XML_DEPTH} deep"
        raise refuse(f"{path}: a larger XML tree", allowed) from error
    except (ET.ParseError, ValueError) as error:
        raise refuse(f"{path}: {error}", "well-formed XML") from error


def _trim(path: Path, element: ET.Element, left: Counter[str]) -> None:
    """Take off what the compiler need not see; raise an error for elements that are refused."""
    for part in list(element):
        tag = str(part.tag)
        if tag in REFUSED:
            raise refuse(f"{path}: <{tag}>", REFUSED[tag])
        if tag in LEFT_OUT.get(str(element.tag), ()):
            element.remove(part)
            left.update([tag] if tag in ("flexcomp", "adhesion", "plugin") else [])
    for key in UNUSED:
        element.attrib.pop(key, None)
    name = element.get("name", "")
    if len(name) > XML_LETTERS or not name.isprintable():
        found = f"{path}: a name of {len(name)} letters: {name[:SHOWN]!r}"
        raise refuse(found, f"names of at most {XML_LETTERS} printable letters")


def _read_meshes(spot: _Spot, root: ET.Element) -> dict[str, bytes]:
    """Return the bytes of all meshes of an MJCF by the names that they then have in its tree."""
    folder = PurePosixPath(".")
    bare = False  # whether the folders in the meshes' own paths do not count
    for compiler in root.iter("compiler"):
        found = compiler.get("meshdir") or compiler.get("assetdir")
        folder = PurePosixPath(found) if found else folder
        bare = compiler.get("strippath", str(bare)).lower() == "true"
    meshes = dict[str, bytes]()
    size = 0
    for mesh in root.iter("mesh"):
        name = mesh.get("file")
        if name is None:
            continue
        called = f"mesh {name[:SHOWN]!r}"
        kind = PurePosixPath(name).suffix.lower()
        if kind not in MESHES:
            found = f"{spot.path}: {called} of another format"
            raise refuse(found, f"a mesh ({', '.join(MESHES)})")
        file = _inside(spot, folder / (PurePosixPath(name).name if bare else name), called)
        data = read_bounded(file, MESH_BYTES, "a mesh", refuse)
        size += len(data)
        if size > HAND_MESH_BYTES:
            found = f"{spot.path} with meshes of more than {HAND_MESH_BYTES} bytes"
            raise refuse(found, "smaller ones")
        mesh.set("name", mesh.get("name") or PurePosixPath(name.replace("\\", "/")).stem)
        mesh.set("file", f"mesh{len(meshes)}{kind}")
        meshes[mesh.attrib["file"]] = data
    return meshes


def _inside(spot: _Spot, name: PurePosixPath, called: str) -> Path:
    """Return the path of a file that an MJCF names, from the folder of the MJCF."""
    path, base = spot
    folder = path.parent.resolve()
    allowed = f"a file below {base}, with slashes (--meshes names another folder)"
    if name.is_absolute() or ":" in str(name) or "\\" in str(name):
        raise refuse(f"{path}: {called}, an absolute path or an address", allowed)
    try:
        file = (folder / name).resolve()
        found = file.is_file()
    # a loop of links, or a name that no system takes
    except (OSError, RuntimeError, ValueError):
        raise refuse(f"{path}: {called}, missing", allowed) from None
    if not file.is_relative_to(base):
        raise refuse(f"{path}: {called}, outside of this folder", allowed)
    if not found:
        raise refuse(f"{path}: {called}, missing", allowed)
    return file
