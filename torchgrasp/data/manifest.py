"""Folders of objects: true meshes and views of them.

`manifest.json` holds "objects" by name. An object has "views" by name, each with "T_object_camera"
(4x4). An object's folder has `mesh.ply` and `<view>_noisy.ply` [m], resting at z = 0. All readers
apply the object's "suggested_scale" (default 1), which makes it graspable. Optional are "mass_kg",
the "family" of similar objects, and the "group", such as "solid".

A folder from a stranger may hold anything. A name of an object or a view is one part of a path. No
file outside the folder is read.
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.cloud.diagnose import DIAGNOSIS
from torchgrasp.cloud.read import read_cloud, save_cloud
from torchgrasp.files import Field, format_json, read_json, write_file
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import CloudWarning, DatasetError, NoEffect, TwoBodies
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.foundation.rules import Count, Seed
from torchgrasp.foundation.told import warn_user
from torchgrasp.geometry.mesh import SUFFIXES, read_mesh
from torchgrasp.values.planning import PointCloud

# name of the view that shows an object from all sides, with normals: `full_normals.ply`
WHOLE = "whole"
MOST_SCALE = 1e4
MOST_METRES = 1e4
LEAST_MASS = 1e-6
MOST_MASS = 1e4
"""Largest scale, its inverse being the least, largest coordinate [m] of a camera, and least and
largest mass [kg].
"""
MISNAMED = {"mass": "mass_kg", "scale": "suggested_scale"}
"""Names that others give to entries of an object, which are not read, and our names."""
UNREAD = (".glb", ".gltf", ".dae", ".3mf", ".fbx", ".usd", ".usda", ".usdc", ".usdz", ".step")
"""Endings of meshes that `write_objects` does not read."""
NAME_BYTES = 100  # longest name: file names have 255 bytes
PLAIN = f"a printable name of 1 to {NAME_BYTES} bytes without / \\ : or a dot or space at its ends"
"""What names are allowed, in errors."""
SHOWN_NAMES = 100  # most names that an error message quotes


@dataclasses.dataclass(frozen=True)
class CameraNumbers:
    """Bounds within which `write_objects` draws the camera positions and noise of its views."""

    lowest: float = 25.0
    """Least elevation [deg] of a camera above the horizontal, seen from the object."""
    highest: float = 45.0
    """Greatest elevation [deg] of a camera above the horizontal, seen from the object."""
    distance: float = 0.5
    """Distance [m] of a camera from the object."""
    seeds: int = 2**31
    """Number of random seeds among which the seed of a view's noise is drawn."""


@dataclasses.dataclass(frozen=True)
class StandNumbers:
    """Bounds by which a mesh, oriented as in its file, counts as one that stands or falls over.

    The foot of a mesh is the set of its lowest vertices.
    """

    foot: float = 0.001
    """Greatest height [m] of the vertices of the foot over the lowest one."""
    beside: float = 0.002
    """Least horizontal distance [m] of the centre of mass from the foot at which the mesh falls
    over.
    """
    rocks: float = 0.1
    """Greatest angle [rad] by which a mesh may tilt before it stands: scans may rock a little."""
    directions: int = 360
    """Number of horizontal directions in which the centre of mass is compared with the foot."""


CAMERAS = CameraNumbers()
STAND = StandNumbers()


@dataclasses.dataclass(frozen=True)
class ObjectEntry:
    """The description of an object in the manifest of a folder of objects.

    Attributes:
        views: position (x, y, z) [m] of the camera of each view, by the view's name. Multiply it by
            `scale`, as mesh and clouds.
        scale: scale factor of mesh and clouds ("suggested_scale").
        family: name of a family of similar objects; the object's own name by default.
        group: group of the object, such as "solid", "thin" or "shell"; "" by default.
        mass: mass [kg] of the real object ("mass_kg"), which is not scaled; None if it is unknown.
    """

    views: dict[str, tuple[float, ...]]
    scale: float
    family: str
    group: str
    mass: float | None

    def list_views(self, whole: bool = False, most: int | None = None) -> list[str]:
        """Return the names of the object's views, sorted, and of these at most the first `most`.

        None means all of them. If `whole`, the only name is "whole", that of the view that shows
        all sides.
        """
        return ([WHOLE] if whole else sorted(self.views))[:most]


@checked
def read_entry(objects: Path | str, name: str) -> ObjectEntry:
    """Return the description of the object `name` from the manifest of a folder of objects.

    Raises `DatasetError` if the manifest, or the object's entry in it, is missing or malformed.
    """
    return _parse_entry(name, _read_fields(objects, [name])[name])


@checked
def read_entries(
    objects: Path | str, only: Sequence[str] = ()
) -> dict[str, ObjectEntry | DatasetError]:
    """Return the description of each object in a folder of objects, by name, sorted.

    An object whose entry in the manifest is malformed has the `DatasetError` in place of its
    description. `only` are the names of the objects; empty means all. Raises `DatasetError` for a
    missing or malformed manifest, or one that lacks an object of `only`. `NoEffect` warns of a
    "mass" or a "scale", which are not read, where "mass_kg" or "suggested_scale" is missing.
    """
    fields = _read_fields(objects, only)
    found: dict[str, ObjectEntry | DatasetError] = {}
    for name, field in sorted(fields.items()):
        try:
            found[name] = _parse_entry(name, field)
        except DatasetError as error:
            found[name] = error
    for theirs, ours in MISNAMED.items():
        values = [fields[name].value for name in found if not isinstance(found[name], DatasetError)]
        if count := sum(theirs in value and ours not in value for value in values):
            told = f"{theirs!r} of {count} objects is not read: call it {ours!r}"
            warn_user(NoEffect, f"{Path(objects) / 'manifest.json'}: {told}")
    return found


def _parse_entry(name: str, field: Field) -> ObjectEntry:
    """Check an object's entry in the manifest, and return it."""
    _check_name(field, name)
    fields = field.entries("views")
    views = {}
    for view, of_view in fields["views"].entries().items():
        _check_name(of_view, view)
        pose = of_view.entries("T_object_camera")["T_object_camera"]
        rows = [row.numbers(4, -MOST_METRES, MOST_METRES) for row in pose.items(4)]
        if len(rows) != 4 or rows[3] != [0.0, 0.0, 0.0, 1.0]:
            raise pose.wrong("4 rows of 4 numbers, the last of them 0 0 0 1: is it transposed?")
        views[view] = tuple(row[3] for row in rows[:3])
    scale, mass, family, group = (
        fields.get(key) for key in ("suggested_scale", "mass_kg", "family", "group")
    )
    return ObjectEntry(
        views,
        1.0 if scale is None else scale.number(1 / MOST_SCALE, MOST_SCALE),
        name if family is None else family.text(),
        "" if group is None else group.text(),
        None if mass is None or mass.value is None else mass.number(LEAST_MASS, MOST_MASS),
    )


@checked
def write_objects(
    meshes: Path | str, out: Path | str, views: Count = 3, seed: Seed = 0
) -> list[str]:
    """Make a folder of objects from a folder of mesh files; return the names of the objects.

    Each object is named after its file, without the suffix. Each mesh is translated. Its lowest
    point is then at z = 0, and the centre of its bounding box on the z axis. Each view is a noisy
    cloud of at most 1000 points, rendered from a random direction above (`partial_view`). The
    manifest, `manifest.json`, names all objects and views. It is written last, so a folder with a
    manifest is complete.

    Args:
        meshes: folder of closed meshes (.ply, .stl, .obj, .off), in metres, with z up.
        out: the folder to write.
        views: number of views of each object.
        seed: seed of the camera directions and of the noise.

    Warns of a mesh that is longer than 0.4 m or falls over (`CloudWarning`). Warns also of a mesh
    whose bodies do not touch each other (`TwoBodies`). `NoEffect` warns of meshes of other formats
    or in folders, which are not read.

    Raises:
        DatasetError: there are no meshes, or two meshes of one name, or a name that the readers of
            the folder refuse. An example is one with a space at its end.
        DatasetError: `out` has a manifest with other objects, or with entries besides "views".
        MeshError: a mesh is malformed, open or without volume.
        OutputError: the folder cannot be written.

    >>> import tempfile, trimesh
    >>> folder = Path(tempfile.mkdtemp())
    >>> _ = trimesh.creation.box((0.05, 0.06, 0.12)).export(folder / "carton.stl")
    >>> write_objects(folder, folder / "objects", views=1), list_views(folder / "objects")
    (['carton'], [('carton', 'view0')])
    >>> len(read_view(folder / "objects", "carton", "view0"))
    1000
    """
    files = sorted(path for path in Path(meshes).glob("*") if path.suffix.lower() in SUFFIXES)
    names = [path.stem for path in files]
    if not files or len(set(names)) != len(names):
        found = f"{meshes} with two meshes of one name"
        if not files:
            missing = "without meshes" if Path(meshes).is_dir() else "which is no folder"
            found = f"{meshes}, {missing}"
        allowed = f"a folder of files {', '.join(SUFFIXES)}, each of its own name"
        raise DatasetError("meshes", found, allowed)
    if odd := [path.name for path in files if not _is_plain(path.stem)]:
        raise DatasetError("meshes", f"{meshes} with the file {odd[0][:NAME_BYTES]!r}", PLAIN)
    _check_replaced(Path(out), names)
    written = {Path(out).resolve(), *((Path(out) / name).resolve() for name in names)}
    if left := [path.name for path in sorted(Path(meshes).iterdir()) if _is_left(path, written)]:
        shown = ", ".join(left[:SHOWN_NAMES])
        fix = f"put files {', '.join(SUFFIXES)} into {meshes} itself"
        warn_user(
            NoEffect, f"{len(left)} files or folders with meshes are not read, {shown}: {fix}"
        )
    generator = torch.Generator().manual_seed(seed)
    entries = dict[str, object]()
    for path in files:
        mesh = read_mesh(path)
        _warn_of_object(path.name, mesh)
        poses = _write_object(mesh, Path(out) / path.stem, views, generator)
        entries[path.stem] = {"views": poses}
    write_file(Path(out) / "manifest.json", format_json({"objects": entries}))
    return names


def _check_replaced(out: Path, names: Sequence[str]) -> None:
    """Raise `DatasetError` if the folder `out` has a manifest from which more than views would be
    lost: other objects than `names`, or what a user has added.
    """
    if not (out / "manifest.json").is_file():
        return
    lost = [
        name
        for name, entry in _read_fields(out, ()).items()
        if name not in names or entry.entries().keys() != {"views"}
    ]
    if lost:
        shown = ", ".join(lost[:SHOWN_NAMES])
        found = f"{out} with a manifest whose objects or entries would be lost, {shown}"
        raise DatasetError("out", found, "a new folder, or one that the same meshes made")


def _is_left(path: Path, written: set[Path]) -> bool:
    """Return whether a path holds meshes that are not read: a file of another format, or a folder.

    Folders that are `written` do not count.
    """
    if path.is_dir():
        some = () if path.resolve() in written else path.iterdir()
        return any(file.suffix.lower() in (*SUFFIXES, *UNREAD) for file in some)
    return path.suffix.lower() in UNREAD


def _write_object(
    mesh: "trimesh.Trimesh", folder: Path, views: int, generator: torch.Generator
) -> dict[str, object]:
    """Write the mesh and the views of an object; return the entries of the views by name."""
    low, high = mesh.bounds
    shift = [-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]]
    placed = mesh.copy().apply_translation(shift)
    write_file(folder / "mesh.ply", placed.export(file_type="ply"))
    poses = dict[str, object]()
    for k in range(views):
        first, second = torch.rand(2, generator=generator, dtype=torch.float32).tolist()
        elevation = CAMERAS.lowest + (CAMERAS.highest - CAMERAS.lowest) * second
        camera = look_at(360.0 * first, elevation, CAMERAS.distance, placed)
        noise = int(torch.randint(CAMERAS.seeds, (1,), generator=generator))
        save_cloud(partial_view(placed, camera, seed=noise), folder / f"view{k}_noisy.ply")
        poses[f"view{k}"] = {"T_object_camera": camera.tolist()}
    return poses


def _warn_of_object(name: str, mesh: "trimesh.Trimesh") -> None:
    """Warn of a mesh that is large for a hand, falls over, or has bodies whose boxes lie apart."""
    longest = float(mesh.extents.max())
    if longest > DIAGNOSIS.long:
        fix = 'if it is normalised, scale it, or write "suggested_scale" into the manifest'
        warn_user(CloudWarning, f"{name} is {longest:.2f} m long, too large for a hand: {fix}")
    beside = _beside_foot(mesh)
    if beside > STAND.beside:
        off = f"its mass centre is {1e3 * beside:.0f} mm beside its foot"
        warn_user(CloudWarning, f"{name} falls over as it lies: {off}. Is z up?")
    left = [part.bounds for part in mesh.split(only_watertight=False)]
    joined = left.pop()
    # bodies whose boxes meet are joined, until none is near the first
    while near := [k for k, box in enumerate(left) if _meet(joined, box)]:
        boxes = np.stack([joined, *(left[k] for k in near)])
        joined = np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)])
        left = [box for k, box in enumerate(left) if k not in near]
    if left:
        warn_user(TwoBodies, f"{name} has bodies that lie apart, and counts as one rigid object")


def _beside_foot(mesh: "trimesh.Trimesh") -> float:
    """Return the distance [m] of a mesh's mass centre from its foot, seen from above.

    It is negative over the foot, and 0 if the mesh stands after it rocks a little.
    """
    height = np.asarray(mesh.vertices[:, 2] - mesh.bounds[0, 2])
    flat = np.asarray(mesh.vertices - mesh.center_mass)[:, :2]
    foot = flat[height < STAND.foot]
    turn = np.linspace(0, 2 * np.pi, STAND.directions, endpoint=False)
    away = np.stack([np.cos(turn), np.sin(turn)])  # (2, directions)
    ends = (foot @ away).max(0)
    falls = int(ends.argmin())
    beside = -float(ends[falls])
    # it turns about the end of its foot, until a vertex beyond its mass centre touches the table
    along = flat @ away[:, falls]
    beyond = along > 0
    rocks = np.arctan2(height[beyond], along[beyond] + beside).min(initial=np.inf)
    return min(beside, 0.0) if rocks < STAND.rocks else beside


def _meet(first: np.ndarray, second: np.ndarray) -> bool:
    """Return whether two boxes (2, 3), lower and upper corner, meet."""
    return bool((first[0] <= second[1]).all() and (second[0] <= first[1]).all())


def _check_name(field: Field, name: str) -> None:
    """Raise the field's error for a name that is more than one part of a path. Raise it also for
    one that is not printable.
    """
    if not _is_plain(name):
        raise field.refuse(f"{field.path}: the name {name[:NAME_BYTES]!r}", PLAIN)


def _is_plain(name: str) -> bool:
    """Return whether a name of an object or a view is one part of a path, printable, and not too
    long.
    """
    plain = name.isprintable() and not set(name) & set("/\\:") and name == name.strip(" .")
    return plain and 0 < len(name.encode("utf-8", "surrogatepass")) <= NAME_BYTES


@checked
def list_views(
    objects: Path | str, whole: bool = False, only: Sequence[str] = (), most: Count | None = None
) -> list[tuple[str, str]]:
    """Return the names (object, view) of all views in a folder of objects, sorted.

    Args:
        objects: the folder of objects, as `write_objects` makes it.
        whole: True lists only the view "whole" of each object, a cloud of all its sides. The user
            adds its file, OBJECT/full_normals.ply; `write_objects` does not write it. False lists
            the views that `write_objects` wrote.
        only: names of the objects to list. Empty means all objects.
        most: largest number of views of each object, the first by name. None means all.

    Raises `DatasetError` for a missing manifest, or one that has no objects or lacks one of `only`.
    It is also raised for a malformed entry of an object.

    >>> import tempfile, trimesh
    >>> folder = Path(tempfile.mkdtemp())
    >>> _ = trimesh.creation.box((0.05, 0.06, 0.12)).export(folder / "carton.stl")
    >>> _ = write_objects(folder, folder / "objects", views=1)
    >>> list_views(folder / "objects")
    [('carton', 'view0')]
    """
    entries = {
        name: _parse_entry(name, field)
        for name, field in sorted(_read_fields(objects, only).items())
    }
    return [(name, view) for name, x in entries.items() for view in x.list_views(whole, most)]


@checked
def read_view(objects: Path | str, name: str, view: str, camera: bool = True) -> PointCloud:
    """Return the noisy point cloud [m] of a view, with the camera's position as `viewpoint`.

    The cloud is in the frame of `read_object_mesh`. Its numbers are those of the file times the
    object's scale in the manifest (1 by default). It has no normals, except for the view "whole".

    Args:
        objects: the folder of objects, as `write_objects` makes it.
        name: name of the object.
        view: name of the view, from `list_views`. "whole" means all sides, with normals and no
            `viewpoint`. The user adds its file, OBJECT/full_normals.ply; `write_objects` does not
            write it.
        camera: whether the cloud has a `viewpoint`.

    Raises `DatasetError` if there is no manifest, or if it has no valid entry of the object or the
    view. Raises `CloudFileError` for a missing or malformed file of the cloud.

    >>> import tempfile, trimesh
    >>> folder = Path(tempfile.mkdtemp())
    >>> _ = trimesh.creation.box((0.05, 0.06, 0.12)).export(folder / "carton.stl")
    >>> _ = write_objects(folder, folder / "objects", views=1)
    >>> len(read_view(folder / "objects", "carton", "view0"))
    1000
    """
    entry = read_entry(objects, name)
    if view == WHOLE:
        cloud = read_cloud(_file(objects, name, "full_normals.ply"))
        return PointCloud(cloud.points * entry.scale, cloud.normals)
    if view not in entry.views:
        found = f"{objects}: view {view!r} of {name!r}"
        raise DatasetError("objects", found, f"one of {sorted(entry.views)}")
    cloud = read_cloud(_file(objects, name, f"{view}_noisy.ply"))
    viewpoint = torch.tensor(entry.views[view], dtype=torch.float64)
    return PointCloud(cloud.points * entry.scale, None, viewpoint * entry.scale if camera else None)


@checked
def read_object_mesh(objects: Path | str, name: str) -> "trimesh.Trimesh":
    """Return the true, closed mesh [m] of an object, in the frame of the object's views.

    Its numbers are those of the file times the object's scale in the manifest (1 by default).

    Args:
        objects: the folder of objects, as `write_objects` makes it.
        name: name of the object.

    Raises `DatasetError` if there is no manifest, or if it has no valid entry of the object. Raises
    `MeshError` for a mesh that is missing, malformed, open or without volume.

    >>> import tempfile, trimesh
    >>> folder = Path(tempfile.mkdtemp())
    >>> _ = trimesh.creation.box((0.05, 0.06, 0.12)).export(folder / "carton.stl")
    >>> _ = write_objects(folder, folder / "objects", views=1)
    >>> round(float(read_object_mesh(folder / "objects", "carton").volume), 6)
    0.00036
    """
    scale = read_entry(objects, name).scale
    return read_mesh(_file(objects, name, "mesh.ply")).apply_scale(scale)


def _file(objects: Path | str, name: str, file: str) -> Path:
    """Return the path of an object's file; raise `DatasetError` if it is a link to a file outside
    the folder.
    """
    path = Path(objects) / name / file
    folder = Path(objects).resolve()
    if not path.resolve().is_relative_to(folder):
        found = f"{path}, which is {path.resolve()}"
        raise DatasetError("objects", found, f"files within {folder}")
    return path


def _read_fields(objects: Path | str, only: Sequence[str]) -> dict[str, Field]:
    """Return the unchecked manifest entries, by name, of the objects in `only`; an empty `only`
    selects all.
    """
    refuse = functools.partial(DatasetError, "objects")
    path = Path(objects) / "manifest.json"
    allowed = (
        "a folder with a manifest.json in UTF-8 (`torchgrasp cloud views` makes one from meshes)"
    )
    top = read_json(path, refuse, allowed).entries()
    entries = top["objects"].entries() if "objects" in top else {}
    missing = sorted(set(only) - set(entries))
    if missing or not entries:
        found = f"{path} with {sorted(entries)[:SHOWN_NAMES]}"
        wanted = "objects" if not only else f"the objects asked for, {missing[:SHOWN_NAMES]} too"
        raise refuse(found, f"a manifest with {wanted}")
    return {name: entries[name] for name in entries if not only or name in only}
