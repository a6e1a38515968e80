"""`torchgrasp cloud`: check a cloud, or render one from a mesh."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from torchgrasp.cli.common import check_seed, naming, read_view
from torchgrasp.cloud import diagnose_cloud, format_report, look_at, partial_view, save_cloud
from torchgrasp.mesh import read_mesh


def check(
    cloud: Annotated[Positional[Path], arg(metavar="FILE")], /, viewpoint: tuple[float, float, float] | None = None
) -> int:
    """Report on a point cloud, with advice for a better one.

    Args:
        cloud: point cloud of one object in metres, z up (.ply, .pcd, .npy, .npz, .xyz).
        viewpoint: position of the camera in the frame of the cloud; by default the file's, else it is estimated.
    """
    with naming(points="FILE", normals="FILE"):
        print(format_report(diagnose_cloud(read_view("FILE", cloud, viewpoint))))
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
