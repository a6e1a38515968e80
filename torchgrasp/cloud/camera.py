"""A virtual depth camera, exact or with the noise of a real camera."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.cloud.depth import cloud_from_depth
from torchgrasp.cloud.pose import Transform, check_rigid
from torchgrasp.cloud.rays import unproject
from torchgrasp.cloud.sensor import Image, SensorName, SensorNoise, add_noise, find_sensor
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, MeshError
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.foundation.rules import Range, Seed
from torchgrasp.geometry.frames import apply, inverse, rigid, rotate
from torchgrasp.geometry.linalg import norm
from torchgrasp.geometry.mesh import with_true_normals
from torchgrasp.values.planning import PointCloud

# columns, rows and focal length [px] of the default camera
WIDTH = 640
HEIGHT = 480
FOCAL = 616.0
INTRINSICS = torch.tensor(
    [[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]], dtype=torch.float64
)
"""Intrinsics [px] of the default camera."""


@dataclasses.dataclass(frozen=True)
class RenderNumbers:
    """Parameters of the rendering of a mesh and a table by a virtual camera."""

    nearest: float = 1e-3
    """Depth [m] of a mesh's nearest vertex, above which rays are cast only in its bounding box in
    the image. For a nearer mesh they are cast through all pixels.
    """
    margin: float = 1e-2
    """Width [focal lengths] of a margin around this bounding box, against rounding."""
    table: float = 0.6
    """Radius [m] of the table."""


RENDER = RenderNumbers()


@checked
def look_at(
    azimuth: float,
    elevation: Annotated[float, Range(-89.9, 89.9)],
    distance: Annotated[float, Range(0.01, 10.0)] = 0.5,
    target: "Float[Tensor, '3'] | trimesh.Trimesh | None" = None,
) -> Transform:
    """Return the pose `obj_from_camera` (4, 4) [m] of an upright camera that looks at a target.

    The camera's frame has x right, y down and z forward. Pose and target are in the object frame,
    whose z axis points up. The pose has the dtype float64.

    Args:
        azimuth: angle [deg] about z of the direction from the target to the camera: 0 along x, 90
            along y.
        elevation: angle [deg] of the camera above the horizontal, in [-89.9, 89.9].
        distance: distance [m] of the camera from the target, in [0.01, 10].
        target: point (3,) [m] that is in the middle of the image. A mesh means the centre of its
            bounding box, and None the origin.

    Raises `BadArgument` for an elevation or a distance outside its range, and `MeshError` for a
    mesh without faces.

    >>> look_at(0.0, 0.0, 0.5)[:3, 3]
    tensor([0.5000, 0.0000, 0.0000], dtype=torch.float64)
    """
    a = math.radians(azimuth)
    e = math.radians(elevation)
    away = torch.tensor(
        [math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)], dtype=torch.float64
    )
    right = torch.tensor([-math.sin(a), math.cos(a), 0.0], dtype=torch.float64)
    down = torch.linalg.cross(-away, right)
    position = distance * away
    if isinstance(target, Tensor):
        position = target.double() + position
    elif target is not None:
        if not len(target.faces):
            raise MeshError("target", "no faces", "a mesh with a surface")
        position = torch.from_numpy(np.asarray(target.bounds).mean(0)) + position
    return rigid(torch.stack([right, down, -away], -1), position)


@checked
def partial_view(
    mesh: "trimesh.Trimesh",
    camera_pose: Transform,
    n: Annotated[int, Range(4, 1000000)] = 1000,
    noise: bool | SensorName | SensorNoise = True,
    seed: Seed = 0,
) -> PointCloud:
    """Return the points of a mesh that a simulated depth camera sees, at most `n`, in float64.

    Points and `viewpoint` [m] are in the frame of the mesh. There are no normals. The camera has
    640 x 480 pixels.

    By default the noise is that of an active stereo camera. It has noisy and rounded disparities, a
    smooth bias, and flying and missing pixels at rims, where the depth jumps. Pixels are also
    missing at grazing angles.

    Args:
        mesh: surface of the object [m].
        camera_pose: pose `obj_from_camera` (4, 4) [m] of the camera in the frame of the mesh, as
            `look_at` returns it.
        n: number of points, at least 4, drawn at random from the measured pixels. If there are
            fewer pixels, all are returned.
        noise: True for the default noise, False for exact depths, a camera's name ("realsense",
            "kinect_v1", "azure" or "zivid"), or a `SensorNoise`. "realsense_cloud" is a public
            cloud of a RealSense: smoothed, cropped, with holes and a calibration error.
        seed: seed of the noise and of the choice of points.

    Raises:
        BadArgument: `n` is below 4, the camera's name is unknown, or the pose is not rigid.
        BadArgument: the camera is within the mesh's bounding box, as in a mesh in millimetres.
        MeshError: a mesh without faces.
        TooFewPoints: the camera sees fewer than 4 points of the mesh.
        SuspiciousScale: the points extend over less than 5 mm or more than 2 m.

    >>> import trimesh
    >>> box = trimesh.creation.box([0.06, 0.06, 0.1])
    >>> len(partial_view(box, look_at(azimuth=30.0, elevation=30.0, target=box), n=500))
    500
    """
    pose = check_rigid("camera_pose", camera_pose).double()
    _check_outside(mesh, pose)
    depth, cosine = cast_mesh(mesh, pose)
    generator = torch.Generator().manual_seed(seed)
    sensor = find_sensor(noise)
    if sensor is not None:
        depth = add_noise(depth, cosine, generator, sensor)
    cloud = cloud_from_depth(depth, INTRINSICS, camera_pose=pose)
    if sensor is not None:
        cloud = _crop_and_move(cloud, float(mesh.bounds[0, 2]), sensor, generator)
    return cloud.select(torch.randperm(len(cloud), generator=generator)[:n])


def _check_outside(mesh: "trimesh.Trimesh", obj_from_camera: Transform) -> None:
    """Raise `BadArgument` for a camera within the box of a mesh [m], as of one in millimetres."""
    if not len(mesh.faces):
        return  # no box: `cast_mesh` refuses such a mesh
    low, high = torch.from_numpy(np.array(mesh.bounds))
    eye = obj_from_camera[:3, 3].cpu()
    if ((low < eye) & (eye < high)).all():
        found = f"a camera within the mesh's box, which is {float((high - low).max()):.4g} m long"
        raise BadArgument("camera_pose", found, "a camera outside the object, both in metres")


def _crop_and_move(
    cloud: PointCloud, lowest: float, sensor: SensorNoise, generator: torch.Generator
) -> PointCloud:
    """Return a cloud without what was cut away above the `lowest` height [m], where a calibration
    puts it.
    """
    if sensor.crop:
        cloud = cloud.select(cloud.points[:, 2] > lowest + sensor.crop)
    if not sensor.misplaced or cloud.viewpoint is None:
        return cloud
    shift = sensor.misplaced * torch.randn(3, generator=generator, dtype=torch.float64)
    points = cloud.points + shift.to(cloud.points)
    eye = cloud.viewpoint + shift.to(cloud.viewpoint)
    return dataclasses.replace(cloud, points=points, viewpoint=eye)


def cast_mesh(mesh: "trimesh.Trimesh", obj_from_camera: Transform) -> tuple[Image, Image]:
    """Return a mesh's exact depth image [m] in the default camera, and the cosine of the angle of
    incidence.

    Both images are (480, 640), and 0 where a ray misses the mesh. The cosine is the absolute one
    between ray and face normal. The mesh is in metres. The pose (4, 4) [m] leads from the camera's
    frame (x right, y down, z forward) to the mesh's.
    """
    if not len(mesh.faces):
        raise MeshError("mesh", "no faces", "a mesh with a surface")
    mesh = with_true_normals(mesh)
    rays = _rays()
    inside = torch.nonzero(_in_image_box(mesh, obj_from_camera, rays))
    direction = rotate(obj_from_camera, rays[tuple(inside.T)]).numpy()
    origin = obj_from_camera[:3, 3].numpy()
    face = np.asarray(
        mesh.ray.intersects_first(np.broadcast_to(origin, direction.shape), direction)
    )
    hit = face >= 0
    # Embree works in float32: it gives the face, whose plane gives the distance in float64.
    normal = mesh.face_normals[face[hit]]
    corner = mesh.vertices[mesh.faces[face[hit], 0]]
    against = (normal * direction[hit]).sum(-1)
    z = ((corner - origin) * normal).sum(-1) / against
    cosine = np.abs(against) / np.linalg.norm(direction[hit], axis=-1)
    where = inside[torch.from_numpy(hit)]
    images = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.float64)
    images[:, where[:, 0], where[:, 1]] = torch.from_numpy(np.stack([z, cosine]))
    return images[0], images[1]


def _rays() -> Float[Tensor, "h w 3"]:
    """Return the rays (x, y, 1) of the default camera's pixels, in its frame."""
    row = torch.arange(HEIGHT)[:, None]
    return unproject(torch.ones(HEIGHT, WIDTH).double(), INTRINSICS, row, torch.arange(WIDTH))


def _in_image_box(
    mesh: "trimesh.Trimesh", obj_from_camera: Transform, rays: Float[Tensor, "h w 3"]
) -> Bool[Tensor, "h w"]:
    """Return a mask of the camera rays (x, y, 1) that pass through the bounding box of the mesh in
    the image.
    """
    vertices = torch.from_numpy(np.array(mesh.vertices, dtype=np.float64))
    u, v, depth = apply(inverse(obj_from_camera), vertices).unbind(-1)
    if float(depth.min()) <= RENDER.nearest:
        return torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    seen = torch.stack([u, v], -1) / depth[:, None]
    low = seen.amin(0) - RENDER.margin
    high = seen.amax(0) + RENDER.margin
    return ((rays[..., :2] >= low) & (rays[..., :2] <= high)).all(-1)


def render_depth(
    meshes: "Sequence[trimesh.Trimesh]",
    camera_pose: Transform,
    *,
    table: float | None = 0.0,
    noise: bool | SensorName | SensorNoise = True,
    seed: int = 0,
) -> tuple[Image, Int[Tensor, "h w"]]:
    """Return a depth image [m] of meshes on a table, as the default camera measures it, and labels.

    Both images are (480, 640). Depth is 0 where nothing was measured. A pixel's true label is 0 for
    the table or nothing, k for mesh k - 1. The meshes [m] and the pose obj_from_camera (4, 4) [m]
    are in one frame. The table is a disc of radius 0.6 m about the origin at the height `table`
    [m]; None means no table. `noise` is True for the default noise, False for exact depths, the
    name of a camera, or a `SensorNoise`. `seed` draws the noise.
    """
    pose = check_rigid("camera_pose", camera_pose).double()
    depth = torch.full((HEIGHT, WIDTH), torch.inf, dtype=torch.float64)
    cosine = torch.zeros_like(depth)
    labels = torch.zeros(HEIGHT, WIDTH, dtype=torch.int64)
    layers = [(0, *_cast_table(table, pose))] if table is not None else []
    layers += [(k + 1, *cast_mesh(mesh, pose)) for k, mesh in enumerate(meshes)]
    for label, z, against in layers:
        nearer = (z > 0) & (z < depth)
        depth = torch.where(nearer, z, depth)
        cosine = torch.where(nearer, against, cosine)
        labels[nearer] = label
    depth = torch.where(torch.isfinite(depth), depth, 0.0)
    if (sensor := find_sensor(noise)) is not None:
        depth = add_noise(depth, cosine, torch.Generator().manual_seed(seed), sensor)
    return depth, labels


def _cast_table(height: float, obj_from_camera: Transform) -> tuple[Image, Image]:
    """Return the table's depth image [m], and |cosine| between ray and normal; both are 0 where a
    ray misses.
    """
    direction = rotate(obj_from_camera, _rays())
    origin = obj_from_camera[:3, 3]
    depth = (height - origin[2]) / direction[..., 2]
    where = origin[:2] + depth[..., None] * direction[..., :2]
    met = (depth > 0) & (norm(where) < RENDER.table)
    cosine = direction[..., 2].abs() / norm(direction)
    return torch.where(met, depth, 0.0), torch.where(met, cosine, 0.0)
