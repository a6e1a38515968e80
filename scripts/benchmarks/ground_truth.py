"""Views of objects with their true meshes, and samples of what a view does not show."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
import trimesh
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from torchgrasp.cloud import read_cloud_file
from torchgrasp.data import list_views, read_object_mesh, read_view
from torchgrasp.values.planning import PointCloud

HIDDEN = 0.006
"""Distance [m] from the cloud beyond which the true surface counts as hidden."""
TABLE_FACE = 0.002
DOWNWARD = -0.7
"""Height [m] over the lowest point, and upward part of the normal. Below both, surface is the face
on the table.
"""


def read_views(
    objects: Path, views: Sequence[str] = ()
) -> Iterator[tuple[str, str, PointCloud, trimesh.Trimesh]]:
    """Yield (object, view, noisy cloud, true mesh) of each view in a folder of objects.

    `views` are the names of the views; empty means all. Cloud and mesh [m] are in one frame.
    """
    for name, view in list_views(objects):
        if views and view not in views:
            continue
        yield name, view, read_view(objects, name, view), read_object_mesh(objects, name)


def read_cameras(folder: Path) -> dict[str, dict[str, Float[Tensor, "n 3"]]]:
    """Return the points (n, 3) [m] of real things, by the thing's name, then by camera.

    The folder has files NAME_CAMERA.ply.
    """
    clouds: dict[str, dict[str, Tensor]] = defaultdict(dict)
    for path in sorted(folder.glob("*_*.ply")):
        name, camera = path.stem.rsplit("_", 1)
        clouds[name][camera] = read_cloud_file(path).cloud.points.double()
    return clouds


def sample_hidden(mesh: trimesh.Trimesh, cloud: PointCloud, n: int) -> Float[Tensor, "k 3"]:
    """Draw n points from the surface of a mesh [m], and return those that a cloud does not show.

    They are farther than `HIDDEN` [m] from all points of the cloud. The face on the table is left
    out.
    """
    points, faces = trimesh.sample.sample_surface(mesh, n, seed=0)[:2]
    low = mesh.bounds[0, 2] + TABLE_FACE
    on_table = (points[:, 2] < low) & (mesh.face_normals[faces][:, 2] < DOWNWARD)
    away = KDTree(cloud.points.numpy()).query(points)[0]
    return torch.from_numpy(points[(away > HIDDEN) & ~on_table])
