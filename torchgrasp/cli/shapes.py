"""`torchgrasp shape`: the estimated surface as a mesh."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from torchgrasp.cli.common import check_seed, check_table, naming, table_height
from torchgrasp.cloud.io.read import read_cloud
from torchgrasp.export import check_surface_path, largest_std, save_surface
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.surface import extract_surface


def surface(
    cloud: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CLOUD")],
    /,
    out: Path,
    viewpoint: tuple[float, float, float] | None = None,
    table: float | None = None,
    no_table: bool = False,
    support: Literal["camera", "paper"] = "camera",
    resolution: int = 64,
    seed: int = 0,
) -> int:
    """Write the estimated surface of an object, coloured by its standard deviation.

    Args:
        cloud: point cloud of one object in metres, z up (.ply, .pcd, .npy, .npz, .xyz).
        out: mesh to write: .ply, with the standard deviation of each vertex as "std_m" in metres, or .glb.
        viewpoint: position of the camera in the frame of the cloud; by default the file's, else it is estimated.
        table: height of the table [m]; by default the lowest point of the cloud.
        no_table: there is no table.
        support: what is observed of the hidden side: outline, symmetry and free space, or the paper's points.
        resolution: cells along the diameter of the surface's domain, 8 to 256.
        seed: of every random draw.
    """
    check_seed(seed)
    check_table(table, no_table)
    with naming("--out", "path"):
        check_surface_path(out)
    with naming("CLOUD", "path", "points", "normals"), naming("--viewpoint", "viewpoint"):
        points = read_cloud(cloud, viewpoint)
        with naming("--table", "table"):
            shape = fit_shape(points, support=support, seed=seed, table=table_height(points, table, no_table))
    with naming("--resolution", "resolution"):
        mesh = extract_surface(shape, resolution)
    with naming("--out", "path"):
        save_surface(mesh, out)
    middle = float(mesh.std_m.median())
    print(f"{len(mesh.vertices)} vertices, {len(mesh.faces)} faces, {out}")
    print(f"standard deviation: median {1e3 * middle:.1f} mm, {1e3 * largest_std(mesh):.1f} mm where it is yellow")
    return 0
