"""A grasp as one GLB file, for slides and 3D viewers. The links of the hand and the object are
coloured parts.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from torchgrasp.app.report.canvas import OBJECT, color_std, rgb
from torchgrasp.app.report.raster import FULL
from torchgrasp.app.report.solids import link_poses, solids_by_link
from torchgrasp.app.report.stills import mesh_arrays
from torchgrasp.cloud.agreement import check_contacts
from torchgrasp.control.reference import check_single
from torchgrasp.files import write_file
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.lazy import spatial, trimesh
from torchgrasp.geometry.frames import to_array
from torchgrasp.hand.hand import Hand
from torchgrasp.shape.surface import Surface
from torchgrasp.values.planning import Grasps


@dataclasses.dataclass(frozen=True)
class SrgbCurve:
    """The curve from sRGB colours to linear light, as IEC 61966-2-1 defines it."""

    dark: float = 0.04045  # greatest sRGB value of the straight part of the curve
    slope: float = 12.92  # divisor of the values of the straight part
    # a larger value v becomes ((v + offset) / (1 + offset)) ** gamma
    offset: float = 0.055
    gamma: float = 2.4  # exponent of the curved part


SRGB = SrgbCurve()
ROUGHNESS = 0.6  # of all parts, from 0, a mirror, to 1: that of matt plastic


@checked
def write_glb(
    path: Path | str, hand: Hand, grasp: Grasps, body: "Surface | trimesh.Trimesh"
) -> Path:
    """Write a hand at a single grasp, with the object, as one GLB file, atomically; return the
    path.

    The file is binary glTF 2.0, in metres, with y up. Up is the normal of the grasp's table;
    without a table it is the z axis of the grasp's frame. The nodes are "object" and the hand's
    links by name. Each finger has its own colour.

    Args:
        path: the file to write.
        hand: the hand of the grasp.
        grasp: a single grasp.
        body: the object's mesh [m] in the frame of the grasp, that of the planned cloud. Or its
            estimated surface. The surface is coloured by its standard deviation.

    Raises:
        BadArgument: there is not exactly one grasp, or its joints are of another hand.
        BadArgument: the grasp does not touch the mesh, or the mesh floats above the grasp's table
            or sinks far into it. An estimated surface is not checked.
        OutputError: the file cannot be written.

    >>> import tempfile
    >>> from torchgrasp import load_hand, load_object
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> jug, grasp = load_object("jug"), load_shipped_grasp("jug", "barrett")
    >>> file = write_glb(Path(tempfile.mkdtemp(), "jug.glb"), load_hand("barrett"), grasp, jug.mesh)
    >>> sorted(trimesh.load_scene(file).geometry)[:3]
    ['f1_dist', 'f1_med', 'f1_prox']
    """
    check_single(grasp)
    if not isinstance(body, Surface):
        check_contacts(grasp, body)
    up = np.array([0.0, 0.0, 1.0]) if grasp.table is None else to_array(grasp.table.normal)
    turn = spatial.transform.Rotation.align_vectors([[0.0, 1.0, 0.0]], [up])[0]
    y_up = np.eye(4)
    y_up[:3, :3] = turn.as_matrix()
    scene = trimesh.Scene()
    scene.add_geometry(_solid(body), geom_name="object", node_name="object", transform=y_up)
    joints = hand.expand_joints(grasp.joints.double())
    names = hand.tree.joint_names
    poses = link_poses(hand, joints, names, grasp.obj_from_hand)[0].cpu().numpy()
    for name, solid in solids_by_link(hand).items():
        shape = trimesh.Trimesh(
            solid.vertices,
            solid.faces,
            vertex_normals=solid.normals,
            visual=_paint(solid.color),
            process=False,
        )
        pose = y_up @ poses[solid.link]
        scene.add_geometry(shape, geom_name=name, node_name=name, transform=pose)
    data = scene.export(file_type="glb", include_normals=True, tree_postprocessor=_soften)
    assert isinstance(data, bytes)
    return write_file(path, data)


def _solid(body: "Surface | trimesh.Trimesh") -> "trimesh.Trimesh":
    """Return the object as a mesh: in one colour, or an estimated surface by its standard
    deviation.
    """
    if not isinstance(body, Surface):
        return trimesh.Trimesh(body.vertices, body.faces, visual=_paint(OBJECT), process=False)
    colors, _ = color_std(body)
    vertices, faces, normals = mesh_arrays(body)
    return trimesh.Trimesh(
        vertices,
        faces,
        vertex_normals=normals,
        vertex_colors=np.uint8(FULL * _linear(colors)),
        process=False,
    )


def _paint(color: str) -> Any:
    """Return a material of a colour, as trimesh keeps it."""
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    opaque = [*_linear(np.array(rgb(color))), 1.0]
    return TextureVisuals(material=PBRMaterial(baseColorFactor=opaque))


def _linear(colors: np.ndarray) -> np.ndarray:
    """Return sRGB colours in [0, 1] as linear light, which glTF stores."""
    curve = ((colors + SRGB.offset) / (1 + SRGB.offset)) ** SRGB.gamma
    return np.where(colors <= SRGB.dark, colors / SRGB.slope, curve)


def _soften(tree: dict[str, Any]) -> None:
    """Make every part of a glTF tree matt plastic: by default a part is a mirror of metal."""
    matt = {"metallicFactor": 0.0, "roughnessFactor": ROUGHNESS}
    materials = tree.setdefault("materials", [])
    for material in materials:
        material["pbrMetallicRoughness"].update(matt)
    for mesh in tree["meshes"]:
        for part in mesh["primitives"]:
            # a part with a colour at each vertex has no material yet
            if "material" not in part:
                part["material"] = len(materials)
                materials.append({"pbrMetallicRoughness": dict(matt)})
