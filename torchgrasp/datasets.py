"""Folders of objects: true meshes and views of them.

`manifest.json` holds "objects" by name. An object has "views" by name, each with "T_object_camera" (4x4). Its folder
has `mesh.ply` and `<view>_noisy.ply` [m], resting at z = 0. All readers apply the object's "suggested_scale"
(default 1), at which a hand can grasp it. Optional are "mass_kg", the "family" of look-alikes that it belongs to, and
its "group", such as "solid".
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from torchgrasp.cloud.io.read import read_cloud
from torchgrasp.errors import BadArgument
from torchgrasp.mesh import read_mesh
from torchgrasp.values import PointCloud

if TYPE_CHECKING:
    import trimesh

WHOLE = "whole"
"""Name of the view that shows an object from all sides, with normals: `full_normals.ply`."""


def list_views(
    objects: Path, whole: bool = False, only: Sequence[str] = (), most: int | None = None
) -> list[tuple[str, str]]:
    """Return sorted pairs of object and view, at most so many of an object; None: all.

    `only` selects objects; with `whole` each has one view, `WHOLE`.

    Raises:
        BadArgument: no manifest, or none of the objects in it.
    """
    entries = _read_manifest(objects, only)
    return [(name, view) for name in entries for view in ([WHOLE] if whole else sorted(entries[name]["views"]))[:most]]


def read_view(objects: Path, name: str, view: str, camera: bool = True) -> PointCloud:
    """Return a noisy view without normals, with its viewpoint if `camera`."""
    entry, folder = _read_manifest(objects, [name])[name], Path(objects) / name
    if view == WHOLE:
        cloud = read_cloud(folder / "full_normals.ply")
        return PointCloud(cloud.points * _scale(entry), cloud.normals)
    cloud = read_cloud(folder / f"{view}_noisy.ply")
    viewpoint = torch.tensor(entry["views"][view]["T_object_camera"], dtype=torch.float64)[:3, 3]
    return PointCloud(cloud.points * _scale(entry), None, viewpoint * _scale(entry) if camera else None)


def read_object_mesh(objects: Path, name: str) -> "trimesh.Trimesh":
    """Return the true mesh of an object; raises as `read_mesh`."""
    return read_mesh(Path(objects) / name / "mesh.ply").apply_scale(_scale(_read_manifest(objects, [name])[name]))


def read_family(objects: Path, name: str) -> str:
    """Return the family of look-alikes of an object: its own name if the manifest has none."""
    return str(_read_manifest(objects, [name])[name].get("family", name))


def read_group(objects: Path, name: str) -> str:
    """Return the group of an object, such as "solid", "thin" or "shell": "" if the manifest has none."""
    return str(_read_manifest(objects, [name])[name].get("group", ""))


def read_mass(objects: Path, name: str) -> float | None:
    """Return the mass [kg] of an object, of the real one whatever its scale; None: the manifest has none."""
    mass = _read_manifest(objects, [name])[name].get("mass_kg")
    return None if mass is None else float(mass)


def _scale(entry: dict[str, Any]) -> float:
    """Return the factor of an object's mesh and clouds."""
    return float(entry.get("suggested_scale", 1.0))


def _read_manifest(objects: Path, only: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the entries of the objects asked for, sorted; all of them if `only` is empty."""
    manifest = Path(objects) / "manifest.json"
    if not manifest.is_file():
        raise BadArgument("objects", str(objects), "a folder with a manifest.json")
    entries = json.loads(manifest.read_text()).get("objects", {})
    chosen = {name: entries[name] for name in sorted(entries) if not only or name in only}
    if not chosen:
        raise BadArgument("objects", f"{manifest} with {sorted(entries)}", "a manifest with the objects asked for")
    return chosen
