"""`torchgrasp cloud`: check, cut and thin a cloud, make one or a scene of a depth image, or render one from meshes."""

from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from tyro.conf import Positional, arg

from torchgrasp.app.cli.common import AS_IT_IS, ViewOptions, check_seed, naming, print_notes, read_view, table_plane
from torchgrasp.base import check_whole
from torchgrasp.checks import check_tensor
from torchgrasp.cloud import (
    cloud_from_depth,
    cut_object,
    diagnose_cloud,
    format_report,
    look_at,
    partial_view,
    remove_outliers,
    save_cloud,
    voxel_downsample,
)
from torchgrasp.cloud.depth import read_image, read_pose
from torchgrasp.cloud.neighbours import draw_rows
from torchgrasp.cloud.prepare import prepare_cloud
from torchgrasp.data import write_objects
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.mesh import read_mesh
from torchgrasp.geometry.plane import as_plane
from torchgrasp.scene import Scene, save_scene
from torchgrasp.shape.completion.silhouette import silhouettes
from torchgrasp.values import PointCloud

IMAGE_OPTIONS = {
    "depth": "DEPTH", "points": "DEPTH", "intrinsics": "--intrinsics", "mask": "--mask", "camera_pose": "--camera-pose",
    "path": "--out",
}  # fmt: skip
"""Names on the command line of what is read beside a depth image, and written."""
MOST_JUDGED = 20_000
"""Points of a cloud, drawn at random, of which it is asked whether one camera sees them: more are no more certain."""


def check(
    cloud: Annotated[Positional[Path], arg(metavar="FILE")],
    /,
    view: Annotated[ViewOptions, arg(name="")] = AS_IT_IS,
    table: tuple[float, ...] | None = None,
    no_table: bool = False,
) -> int:
    """Report on a point cloud, with advice for a better one. The exit code is 1 if `torchgrasp grasp` refuses it.

    Args:
        cloud: point cloud of one object (.ply, .pcd, .npy, .npz, .xyz, .txt, .csv).
        view: how the file is meant.
        table: height of the table along the vertical, or four numbers nx ny nz d of the plane n . p = d, in metres; by
            default the table is at the lowest point of the cloud that is no outlier.
        no_table: there is no table.
    """
    file = read_view("FILE", cloud, view, whole=True)
    plane = as_plane(table_plane(file.cloud, view, table, no_table))
    up = view.vertical if view.up is not None or plane is None else plane.normal
    with naming(points="FILE", normals="FILE"):
        report = diagnose_cloud(file.cloud, up, plane if table is not None else None, stands=not no_table)
    print(format_report(report))
    for note in file.notes:
        print(f"{'note':12}{note}")
    refused = any(advice.refused for advice in report.advice)
    error = None if refused else _no_view(file.cloud)
    if error is not None:
        print(f"{'refused':12}{error.found}: {error.allowed}")
    return int(refused or error is not None)


def _no_view(cloud: PointCloud) -> BadArgument | None:
    """Return what the fit of a shape would say of a cloud that no camera sees at once; None: nothing."""
    some = cloud.select(draw_rows(len(cloud), MOST_JUDGED))
    try:
        seen = prepare_cloud(some, torch.Generator().manual_seed(0))
        if seen.viewpoint is not None:
            silhouettes(seen.cloud)
    except BadArgument as error:
        return error
    return None


def cut(
    cloud: Annotated[Positional[Path], arg(metavar="CLOUD")],
    /,
    out: Path,
    view: Annotated[ViewOptions, arg(name="")] = AS_IT_IS,
    point: tuple[float, float, float] | None = None,
    box: tuple[float, float, float, float, float, float] | None = None,
    gap: float = 0.02,
) -> int:
    """Write the points of one thing of a scene, without the plane that it stands on.

    Args:
        cloud: point cloud of a scene of any size (.ply, .pcd, .npy, .npz, .xyz, .txt, .csv).
        out: point cloud to write (.npz or .ply), in metres.
        view: how the file is meant.
        point: a point on or near the thing; all farther than 0.5 m away is left out. By default the largest thing.
        box: two corners of a box; all outside is left out first.
        gap: least distance between two things [m].
    """
    if not 0.001 <= gap <= 1.0:
        raise BadArgument("--gap", gap, "a number of metres in [0.001, 1]")
    file = read_view("CLOUD", cloud, view, whole=True)
    near = None if point is None else check_tensor("--point", torch.tensor(point, dtype=torch.float64), (3,))
    corners = None if box is None else check_tensor("--box", torch.tensor(box, dtype=torch.float64), (6,)).reshape(2, 3)
    up = view.vertical
    with naming(cloud="CLOUD", points="CLOUD", path="--out"):
        thing, plane = cut_object(
            file.cloud, torch.tensor([0.0, 0, 1]).double() if up is None else up, near, corners, gap
        )
        save_cloud(thing, out)
    print_notes(file.notes, ())
    if plane is None:
        print("note    no plane was found under the thing")
    else:
        x, y, z = plane.normal.tolist()
        print(f"plane   --table {x:.5f} {y:.5f} {z:.5f} {plane.offset:.5f}")
    print(f"{len(thing)} of {len(file.cloud)} points, {out}")
    return 0


def depth(
    depth: Annotated[Positional[Path], arg(metavar="DEPTH")],
    /,
    intrinsics: tuple[float, float, float, float],
    out: Path,
    mask: Path | None = None,
    camera_pose: Path | None = None,
) -> int:
    """Write the point cloud of a depth image, with the camera as viewpoint.

    Args:
        depth: image along the optical axis (.png of 16 bit, .npy, or .npz with an array "depth"): integers are
            millimetres, floats metres; 0 and NaN are not measured.
        intrinsics: fx fy cx cy in pixels, of the image's own resolution.
        out: point cloud to write (.npz or .ply), in metres.
        mask: image of the depth's size that is not 0 at the object (.png, .npy, or .npz with an array "mask").
        camera_pose: file with frame_from_camera, 4 x 4 (.npy, or .txt); by default the cloud is in the camera's frame.
    """
    with naming(**IMAGE_OPTIONS):
        image, inside, pose = read_images(depth, mask, camera_pose)
        cloud = cloud_from_depth(image, intrinsics, inside, pose)
        save_cloud(cloud, out)
    frame = "the camera's frame: give its vertical with --up" if pose is None else "the frame of the pose"
    print(f"{len(cloud)} points in {frame}, {out}")
    return 0


def read_images(
    depth: Path, mask: Path | None, camera_pose: Path | None
) -> tuple[np.ndarray, np.ndarray | None, torch.Tensor | None]:
    """Return a depth image, its mask and the pose of its camera, as far as they are given."""
    inside = None if mask is None else read_image("mask", mask)
    return read_image("depth", depth), inside, None if camera_pose is None else read_pose("camera_pose", camera_pose)


def scene(
    depth: Annotated[Positional[Path], arg(metavar="DEPTH")],
    /,
    intrinsics: tuple[float, float, float, float],
    out: Path,
    mask: Path | None = None,
    camera_pose: Path | None = None,
) -> int:
    """Write the scene of a depth image: the table and the things on it, for `torchgrasp grasp`.

    Args:
        depth: image as for `cloud depth`.
        intrinsics: fx fy cx cy in pixels, of the image's own resolution.
        out: scene to write (.npz).
        mask: image of the depth's size that is not 0 at the object to be grasped; by default every thing is found.
        camera_pose: file with frame_from_camera, 4 x 4 (.npy, or .txt); by default results are in the camera's frame.
    """
    with naming(**IMAGE_OPTIONS):
        image, inside, pose = read_images(depth, mask, camera_pose)
        seen = Scene.from_depth(image, intrinsics, pose, mask=inside)
        save_scene(seen, out)
    for label in seen.things:
        print(f"thing {label}: {int(seen.rows_of(label).sum())} points{' (the target)' * (label == seen.target)}")
    table = "unknown" if seen.table is None else seen.table.describe()
    print("\n".join([f"table: {table}", *(f"advice: {sentence}" for sentence in seen.advice), str(out)]))
    return 0


def thin(
    cloud: Annotated[Positional[Path], arg(metavar="CLOUD")],
    /,
    out: Path,
    voxel: float = 0.002,
    view: Annotated[ViewOptions, arg(name="")] = AS_IT_IS,
) -> int:
    """Write one point a voxel, without the outliers, such as flying pixels.

    Args:
        cloud: point cloud (.ply, .pcd, .npy, .npz, .xyz, .txt, .csv).
        out: point cloud to write (.npz or .ply), in metres.
        voxel: side of a voxel in metres.
        view: how the file is meant.
    """
    file = read_view("CLOUD", cloud, view, whole=True)
    with naming(voxel="--voxel", points="CLOUD", path="--out"):
        some = voxel_downsample(file.cloud, voxel)
        less = remove_outliers(some)
        save_cloud(less, out)
    print_notes(file.notes, ())
    print(f"{len(less)} of {len(file.cloud)} points, {len(some) - len(less)} outliers removed, {out}")
    return 0


def render(
    mesh: Annotated[Positional[Path], arg(metavar="MESH")],
    /,
    out: Path,
    azimuth: float = 30.0,
    elevation: float = 30.0,
    distance: float = 0.5,
    points: int = 1000,
    no_noise: bool = False,
    seed: int = 0,
) -> int:
    """Write the point cloud that a depth camera sees of a mesh.

    Args:
        mesh: closed mesh of an object in metres, z up (.ply, .obj, .stl, ...).
        out: point cloud to write (.npz or .ply), with the viewpoint.
        azimuth: direction of the camera from the mesh, from x towards y, in degrees.
        elevation: of the camera above the horizontal, in degrees.
        distance: from the centre of the mesh to the camera, in metres.
        points: number of points; fewer if fewer pixels see the object.
        no_noise: an exact camera, not an active stereo camera.
        seed: of the noise and of the choice of points.
    """
    check_seed(seed)
    angles = {name: f"--{name}" for name in ("azimuth", "elevation", "distance")}
    with naming(**angles, n="--points", points="MESH", depth="MESH", mesh="MESH"):
        solid = read_mesh(mesh)
        cloud = partial_view(solid, look_at(azimuth, elevation, distance, solid), points, not no_noise, seed)
    with naming(path="--out"):
        save_cloud(cloud, out)
    print(f"{len(cloud)} points, {out}")
    return 0


def views(
    meshes: Annotated[Positional[Path], arg(metavar="MESHES")], /, out: Path, views: int = 3, seed: int = 0
) -> int:
    """Make a folder of objects from a folder of meshes: each is seen by a noisy depth camera, as trials need it.

    Args:
        meshes: folder of closed meshes in metres, z up (.ply, .stl, .obj, .off).
        out: folder to write: manifest.json, and for each object mesh.ply and its views.
        views: of each object, from random sides.
        seed: of the cameras and of their noise.
    """
    check_seed(seed)
    check_whole("--views", views, 1, 1000)
    with naming(meshes="MESHES", mesh="MESHES", path="--out"):
        names = write_objects(meshes, out, views, seed)
    print(f"{len(names)} objects with {views} view{'s' * (views != 1)} each: {out}")
    return 0
