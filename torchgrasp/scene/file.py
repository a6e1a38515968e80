"""Reading and writing of scenes as .npz files with depth, labels, camera, tables and target."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from torchgrasp.files import write_file
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.limits import SHOWN_LETTERS
from torchgrasp.foundation.rules import check_suffix
from torchgrasp.geometry.plane import Plane
from torchgrasp.scene.image import read_arrays
from torchgrasp.scene.masks import read_labels, without_masks
from torchgrasp.scene.scene import Scene


@checked
def read_scene(path: Path | str) -> Scene:
    """Read a scene from a .npz file, as `save_scene` writes it, with the checks of
    `Scene.from_depth`.

    The file holds these arrays, of which `depth` and `intrinsics` are needed. Without
    `camera_pose`, `labels` or `table` this argument of `Scene.from_depth` is None.

    * `depth` (h, w): floats in m, or whole numbers in mm.
    * `depth_unit`: metres of one count of the depth, if it is in another unit.
    * `intrinsics`: matrix (3, 3), or (fx, fy, cx, cy) [pixels].
    * `camera_pose` (4, 4): the pose `obj_from_camera` [m].
    * `labels` (h, w): 1, 2, ... for the pixels of the objects, 0 for all others. Or `mask` (h, w),
      not 0 at the target's pixels.
    * `target`: label of the object to be grasped.
    * `table` (4,): numbers (nx, ny, nz, d) of the plane n . p = d [m], with the unit normal n.
    * `others` (k, 4): such numbers of other planes on which objects could stand.
    * `given`: labels that a user made, as in `Scene.given`. The pixels of other labels then stay as
      they are. If it is missing, the user made all labels, or none in a file with `table` and
      `labels`.
    * `bounded`: False for an image rendered from a cloud, whose border is not that of the camera's
      view. If it is missing, it is True.

    Other arrays are not read; `Scene.notes` names them.

    Raises `CloudFileError` for no such file, or for malformed content. Raises `BadArgument` for a
    `target` that is no label of an object, or a normal not of length 1. It is also raised for
    arrays that `Scene.from_depth` refuses. Raises `NoSupport` if no table is found.

    >>> import tempfile
    >>> from torchgrasp import load_scene
    >>> read_scene(save_scene(load_scene(), Path(tempfile.mkdtemp(), "scene.npz"))).things
    (1, 2, 3, 4)
    """
    return scene_of(read_arrays(Path(path)))


def scene_of(
    arrays: dict[str, Any], table: Plane | float | None = None, up: Tensor | None = None
) -> Scene:
    """Return the scene of a file's arrays by name, which `read_arrays` returned.

    `table` and `up` are used only if no table is among the arrays. `table` is a plane, or its
    height [m] along z; None means that it is fitted to the points. `up` is the direction (3,)
    against gravity; None allows any. Raises `BadArgument` for arrays that are no scene, and
    `NoSupport` if no table is found.
    """
    left = dict(arrays)
    own_table, pose, target = (left.pop(name, None) for name in ("table", "camera_pose", "target"))
    others = left.pop("others", np.empty((0, 4)))
    bounded = bool(left.pop("bounded", True))
    unread = left.pop("unread")
    notes = (f"arrays {', '.join(unread)[:SHOWN_LETTERS]} were not read",) if unread else ()
    given = left.pop("given", [] if own_table is not None and "labels" in left else None)
    rows = [] if own_table is None else [own_table, *others]
    plane, *rest = [Plane(torch.tensor(row[:3]), float(row[3])) for row in rows] or [table]
    up = up if own_table is None else None
    scene = Scene.from_depth(
        left.pop("depth"), left.pop("intrinsics"), pose, **left, table=plane, up=up
    )
    if {"given", "labels"} <= arrays.keys():
        scene = _with_found(scene, read_labels(arrays["labels"], scene.image.depth.shape), given)
    own = scene.given if given is None else tuple(label for label in scene.things if label in given)
    image = dataclasses.replace(scene.image, bounded=bounded)
    others = (*rest, *scene.others)
    notes = (*notes, *scene.notes)
    scene = dataclasses.replace(scene, image=image, others=others, given=own, notes=notes)
    return scene if target is None else scene.select(int(target))


def _with_found(scene: Scene, labels: Int[Tensor, "h w"], given: np.ndarray) -> Scene:
    """Return the scene with the saved `labels` of those objects whose labels are not `given`, and
    without notes on their masks. The library found their pixels, and none of them is on the table.
    """
    saved = labels[tuple(scene.pixels.T)]
    found = (saved > 0) & ~torch.isin(saved, torch.from_numpy(given))
    restored = tuple(saved[found].unique().tolist())
    notes = without_masks(scene.notes, restored)
    return dataclasses.replace(scene, labels=torch.where(found, saved, scene.labels), notes=notes)


@checked
def save_scene(scene: Scene, path: Path | str) -> Path:
    """Write a scene as .npz, atomically, for `read_scene`. Return the path.

    The file holds the arrays that `read_scene` lists. It does not hold `notes`. Of several points
    in one pixel, it holds only the nearest.

    Raises `BadArgument` for a path that does not end in .npz, and `OutputError` if the file cannot
    be written.

    >>> import tempfile
    >>> from torchgrasp import load_scene
    >>> read_scene(save_scene(load_scene(), Path(tempfile.mkdtemp(), "scene.npz"))).things
    (1, 2, 3, 4)
    """
    path = Path(path)
    check_suffix("path", path, ".npz")
    labels = scene.pixel_labels.cpu().numpy().astype(np.int32)
    arrays = {
        # a rounded depth could move a pixel beyond a bound, and out of its mask
        "depth": scene.image.depth.cpu().numpy(),
        "intrinsics": scene.image.intrinsics.cpu().numpy(),
        "camera_pose": scene.image.obj_from_camera.cpu().numpy(),
        "labels": labels,
        "given": np.array(scene.given, dtype=np.int64),
        "bounded": np.array(scene.image.bounded),
    }
    if scene.table is not None:
        arrays["table"] = np.array([*scene.table.normal.tolist(), scene.table.offset])
    if scene.others:
        arrays["others"] = np.array(
            [[*plane.normal.tolist(), plane.offset] for plane in scene.others]
        )
    if scene.target is not None:
        arrays["target"] = np.array(scene.target)
    return write_file(path, lambda file: np.savez_compressed(file, **arrays))  # pyright: ignore[reportArgumentType]
