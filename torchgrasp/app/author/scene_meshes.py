"""Checks of .dae and .glb meshes, so that trimesh reads plain geometry in bounded memory, and no
other file.
"""

import importlib.util
import json
import xml.etree.ElementTree as ET

from torchgrasp.files import Malformed
from torchgrasp.foundation.errors import BadArgument, MissingExtra
from torchgrasp.foundation.limits import MESH_FACES
from torchgrasp.hand.safe_xml import bounded_tree

MOST_INDICES = 12 * MESH_FACES  # three corners of a face, each of up to four indices
MAGIC = b"glTF"  # with which a .glb file begins
JSON_SIZE = slice(12, 16)  # bytes that hold the size of its JSON
JSON_START = 20
MOST_TEXT = 200  # of a file's own words in an error [characters]
GEOMETRY = ("library_geometries", "library_visual_scenes")  # libraries of a .dae that are read
LOOKS = ("bind_material", "extra", "instance_camera", "instance_light")  # parts that are not


def clean_dae(data: bytes) -> tuple[bytes, float]:
    """Return the bytes of a COLLADA file (.dae) with its geometry alone, and its length unit [m].

    `data` holds the bytes of the file. Its up axis is ignored, as in ROS. Raises `Malformed` for a
    DOCTYPE or ENTITY, for skins, and for <instance_node>, which repeats other nodes. Raises it also
    for more than 6 million indices of corners (`MOST_INDICES`). Raises `MissingExtra` if pycollada
    is not installed.
    """
    if importlib.util.find_spec("collada") is None:
        raise MissingExtra("pycollada", "meshes")
    text = data.decode("utf-8-sig")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise Malformed("a DOCTYPE or ENTITY declaration")
    try:
        root = bounded_tree(text)
    except BadArgument as error:
        raise Malformed(f"{error.found} than {error.allowed}") from error
    space = root.tag.partition("}")[0] + "}"
    for element in root.iter():
        for part in list(element):
            kind = part.tag.removeprefix(space)
            if kind in ("instance_controller", "instance_node"):
                raise Malformed(f"<{kind}>, where plain geometry should be")
            if kind in LOOKS or (kind.startswith("library_") and kind not in GEOMETRY):
                element.remove(part)
    # a small file may name one geometry many times: the instances count
    sizes = {}
    for geometry in root.iter(f"{space}geometry"):
        polygons = geometry.iter(f"{space}p")
        sizes[f"#{geometry.get('id')}"] = sum(len((p.text or "").split()) for p in polygons)
    instances = root.iter(f"{space}instance_geometry")
    used = sum(sizes.get(instance.get("url", ""), 0) for instance in instances)
    if used > MOST_INDICES:
        raise Malformed(f"{used} indices of corners; at most {MOST_INDICES}")
    unit = root.find(f"{space}asset/{space}unit")
    return ET.tostring(root), 1.0 if unit is None else float(unit.get("meter", "1"))


def check_glb(data: bytes) -> None:
    """Raise `Malformed` for a .glb file with skins, compressed geometry, or too many corners.

    `data` holds the bytes of the file. At most 6 million corners (`MOST_INDICES`) are allowed. A
    mesh counts once for each node that uses it. A file without the header of a .glb is refused,
    too.
    """
    if not data.startswith(MAGIC):
        raise Malformed("no header of a .glb file")
    size = int.from_bytes(data[JSON_SIZE], "little")
    scene = json.loads(data[JSON_START : JSON_START + size])
    accessors = scene.get("accessors", [])
    nodes = scene.get("nodes", [])
    packed = [name for name in scene.get("extensionsRequired", []) if "mesh" in name.lower()]
    if packed or scene.get("skins") or any("bufferView" not in accessor for accessor in accessors):
        raise Malformed(f"compressed geometry or skins {' '.join(packed)[:MOST_TEXT]}".strip())
    sizes = []
    for mesh in scene.get("meshes", []):
        # without indices, every position is a corner
        parts = [p.get("indices", p["attributes"]["POSITION"]) for p in mesh["primitives"]]
        sizes.append(sum(accessors[part]["count"] for part in parts))
    # nodes may share a mesh, and parents a node: each use counts
    parents = *scene.get("scenes", []), *nodes
    used = [i for part in parents for i in part.get("nodes", part.get("children", []))]
    count = sum(sizes[nodes[i]["mesh"]] for i in used if "mesh" in nodes[i])
    stored = sum(view["byteLength"] for view in scene.get("bufferViews", []))
    numbers = sum(accessor["count"] for accessor in accessors)
    if max(count, numbers) > MOST_INDICES or stored > len(data):
        raise Malformed(f"{count} corners of {numbers} numbers in {stored} bytes")
