"""`torchgrasp cloud`: check a cloud, or render one from a mesh."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from torchgrasp.cli.common import check_seed, naming
from torchgrasp.cloud import diagnose_cloud, format_report, look_at, partial_view, read_cloud, save_cloud
from torchgrasp.errors import BadArgument
from torchgrasp.mesh import read_mesh


def check(
    cloud: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")],
    /,
    viewpoint: tuple[float, float, float] | None = None,
) -> int:
    """Report what a point cloud is like, and what would improve it.

    Args:
        cloud: point cloud of one object in metres, z up (.ply, .pcd, .npy, .npz, .xyz).
        viewpoint: position of the camera in the frame of the cloud; by default the file's, else it is estimated.
    """
    with naming("FILE", "path", "points", "normals"), naming("--viewpoint", "viewpoint"):
        report = diagnose_cloud(read_cloud(cloud, viewpoint))
    print(format_report(report))
    return 0


@dataclasses.dataclass(frozen=True)
class CameraPosition:
    """Where the camera is, seen from the centre of the mesh.

    Args:
        azimuth: direction of the camera, from x towards y, in degrees.
        elevation: of the camera above the horizontal, in degrees.
        distance: from the centre of the mesh to the camera, in metres.
    """

    azimuth: float = 30.0
    elevation: float = 30.0
    distance: float = 0.5


def render(
    mesh: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MESH")],
    /,
    out: Path,
    camera: Annotated[CameraPosition, tyro.conf.arg(name="")] = CameraPosition(),
    points: int = 1000,
    no_noise: bool = False,
    seed: int = 0,
) -> int:
    """Write the point cloud that a depth camera sees of a mesh.

    Args:
        mesh: closed mesh of an object in metres, z up (.ply, .obj, .stl, ...).
        out: point cloud to write (.npz or .ply), with the viewpoint.
        camera: where the camera is.
        points: number of points; fewer if fewer pixels see the object.
        no_noise: an exact camera, not an active stereo camera.
        seed: of the noise and of the choice of points.
    """
    check_seed(seed)
    if out.suffix.lower() not in (".npz", ".ply"):
        raise BadArgument("--out", out, "a file ending in .npz or .ply")
    with naming("MESH", "mesh"):
        solid = read_mesh(mesh)
    options = [naming(f"--{name}", name) for name in ("azimuth", "elevation", "distance")]
    with (
        options[0],
        options[1],
        options[2],
        naming("--points", "n"),
        naming("MESH", "points", "depth", "mesh", "target"),
    ):
        pose = look_at(camera.azimuth, camera.elevation, camera.distance, solid)
        cloud = partial_view(solid, pose, points, not no_noise, seed)
    with naming("--out", "path"):
        save_cloud(cloud, out)
    print(f"{len(cloud)} points, {out}")
    return 0
