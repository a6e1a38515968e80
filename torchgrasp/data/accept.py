"""What public functions take in place of a cloud, a scene or a hand. It may be arrays, clouds of
other programs, files, or names.

The decorator `checked` converts it to a value, so that all other functions take values alone.
"""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.read import make_cloud, read_cloud_file
from torchgrasp.data.shipped import GraspObject, find_view
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import arguments_beside
from torchgrasp.foundation.errors import BadArgument, NoEffect
from torchgrasp.foundation.rules import Taken, check_path, show
from torchgrasp.foundation.told import warn_user
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import find_hand, hands_folder, load_hand
from torchgrasp.scene.file import read_scene
from torchgrasp.scene.image import is_scene
from torchgrasp.scene.scene import Scene
from torchgrasp.values.planning import PointCloud

Read = TypeVar("Read")
CLOUD = (
    "a PointCloud, an array (n, 3) in metres (cloud_from_array takes normals and the camera's position, too), "
    "a cloud of Open3D or trimesh, a file, the name of a shipped object, or a GraspObject"
)
SCENE = "a Scene, or a file of save_scene"
HAND = "a Hand, the name of a shipped hand, or the folder of another hand"


@runtime_checkable
class _Open3D(Protocol):
    """A cloud of Open3D: it has `points`, and perhaps `normals`."""

    points: Any


@runtime_checkable
class _Trimesh(Protocol):
    """A cloud of trimesh: it has `vertices`."""

    vertices: Any


def _named(read: Callable[[Any], Read]) -> Callable[[Any, str], Read]:
    """Return a reader whose errors name the argument that it reads."""

    @functools.wraps(read)
    def call(value: Any, name: str) -> Read:
        try:
            if isinstance(value, str | Path):
                check_path(name, value)
            return read(value)
        except BadArgument as error:
            raise type(error)(name, error.found, error.allowed) from error

    return call


@_named
def as_cloud(value: Any) -> PointCloud:
    """Return a `PointCloud` [m], given any value that the library takes for a cloud (`CloudLike`).
    Its frame is that of the value.

    The value may be a cloud, a `GraspObject`, a file, or an array or tensor (n, 3) [m]. It may also
    be a cloud of Open3D or trimesh. The name of a shipped object means its view. An array has no
    viewpoint. `@_named` adds a second argument, the name that errors give to the value. `NoEffect`
    warns of a file's table, which is not part of the cloud, unless the call gives a table, too.
    Raises `BadArgument` for anything else, and `CloudFileError` for a malformed file.
    """
    told = _has_table(arguments_beside())
    if isinstance(value, PointCloud):
        return value
    if isinstance(value, GraspObject):
        return value.view
    if isinstance(value, str | Path):
        file = read_cloud_file(find_view(Path(value)))
        if file.table is not None and not told:
            found = f"its table, {file.table.describe()}, is not part of the cloud"
            warn_user(NoEffect, f"{value}: {found}; give it as the table")
        return file.tell(str(value))
    if isinstance(value, Tensor):
        return PointCloud(value)
    if isinstance(value, np.ndarray):
        return make_cloud("an array", {"columns": value}).cloud
    for surface in ("faces", "triangles"):
        if hasattr(value, surface):
            raise BadArgument(
                "cloud", f"a mesh ({show(value)})", f"points that a camera saw: {CLOUD}"
            )
    points = getattr(value, "points", getattr(value, "vertices", None))
    if points is None or isinstance(value, Value):
        raise BadArgument("cloud", show(value), CLOUD)
    normals = np.asarray(getattr(value, "normals", []))
    arrays = {"points": np.asarray(points), "normals": normals if normals.size else None}
    return make_cloud(f"a {type(value).__name__}", arrays).cloud


def _has_table(arguments: Mapping[str, Any]) -> bool:
    """Return whether arguments of a call name the table: as `table`, in `spec`, or in planned
    `grasps`.
    """
    table = getattr(arguments.get("spec"), "table", arguments.get("table"))
    return table is not None or "grasps" in arguments


@_named
def as_scene(value: Any) -> Scene:
    """Return a `Scene`, given a scene or the path of a file that `save_scene` wrote.

    `@_named` adds a second argument, the name that errors give to the value. Raises `BadArgument`
    for anything else.
    """
    if isinstance(value, str | Path):
        return read_scene(value)
    if not isinstance(value, Scene):
        raise BadArgument("scene", show(value), SCENE)
    return value


@_named
def as_seen(value: Any) -> PointCloud | Scene:
    """Return a `Scene` or a `PointCloud` [m], given any value that the library takes for one.

    A scene, or the path of a file that `save_scene` wrote, gives a scene. Any other value is read
    as a cloud, by `as_cloud`. `@_named` adds a second argument, the name that errors give to the
    value. Raises `BadArgument` for anything that is neither.
    """
    scene = isinstance(value, Scene) or (isinstance(value, str | Path) and is_scene(Path(value)))
    return as_scene(value, "cloud") if scene else as_cloud(value, "cloud")


@_named
def as_hand(value: Any) -> Hand:
    """Return a `Hand`, given a hand, the name of a shipped hand, or the folder of another hand.

    A shipped hand is loaded only once, so that what the planner computes from it is kept for later
    calls. `@_named` adds a second argument, the name that errors give to the value. Raises
    `HandFileError` for a name or folder of no hand, and `BadArgument` for anything else.
    """
    if isinstance(value, Hand):
        return value
    if not isinstance(value, str | Path):
        raise BadArgument("hand", show(value), HAND)
    folder = find_hand(value)
    return _load_shipped(folder.name) if folder.parent == hands_folder() else load_hand(folder)


@functools.cache
def _load_shipped(name: str) -> Hand:
    return load_hand(name)


Given = (
    PointCloud | np.ndarray | Float[Tensor, "n 3"] | Path | str | GraspObject | _Open3D | _Trimesh
)
CloudLike = Annotated[Given, Taken("CloudLike", PointCloud, CLOUD, as_cloud)]
"""A value that `as_cloud` takes as a cloud; its points [m] are in the frame of the results."""
SceneLike = Annotated[Scene | Path | str, Taken("SceneLike", Scene, SCENE, as_scene)]
"""A scene, or the path of a file of `save_scene`."""
SeenLike = Annotated[
    Given | Scene, Taken("SeenLike", PointCloud | Scene, f"{CLOUD}, or a Scene", as_seen)
]
"""A cloud or a scene, or a value that `as_seen` makes one of."""
HandLike = Annotated[Hand | Path | str, Taken("HandLike", Hand, HAND, as_hand)]
"""A hand, or a name or folder for `load_hand`."""
