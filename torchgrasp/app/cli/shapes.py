"""`torchgrasp shape`: the estimated surface as a mesh."""

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from torchgrasp.app.cli.common import AS_IT_IS, ViewOptions, check_seed, naming, print_notes, read_view, table_plane
from torchgrasp.export import check_surface_path, largest_std, save_surface
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.surface import extract_surface


def surface(
    cloud: Annotated[Positional[Path], arg(metavar="CLOUD")],
    /,
    out: Path,
    view: Annotated[ViewOptions, arg(name="")] = AS_IT_IS,
    table: tuple[float, ...] | None = None,
    no_table: bool = False,
    support: Literal["camera", "paper"] = "camera",
    resolution: int = 64,
    seed: int = 0,
) -> int:
    """Write the estimated surface of an object, coloured by its standard deviation.

    Args:
        cloud: point cloud of one object (.ply, .pcd, .npy, .npz, .xyz, .txt, .csv).
        out: mesh to write: .ply, with the standard deviation of each vertex as "std_m" in metres, or .glb.
        view: how the file of the cloud is meant.
        table: height of the table along the vertical, or four numbers nx ny nz d of the plane n . p = d, in metres; by
            default the table is at the lowest point of the cloud that is no outlier.
        no_table: there is no table.
        support: what is observed of the hidden side: outline, symmetry and free space, or the paper's points.
        resolution: cells along the diameter of the surface's domain, 8 to 256.
        seed: of every random draw.
    """
    check_seed(seed)
    with naming(path="--out"):
        check_surface_path(out)
    file = read_view("CLOUD", cloud, view)
    with naming(points="CLOUD", normals="CLOUD", table="--table", resolution="--resolution", path="--out"):
        shape = fit_shape(file.cloud, support=support, seed=seed, table=table_plane(file.cloud, view, table, no_table))
        estimate = extract_surface(shape, resolution)
        save_surface(estimate, out)
    print_notes(file.notes, ())
    middle, most = 1e3 * float(estimate.std_m.median()), 1e3 * largest_std(estimate)
    print(f"{len(estimate.vertices)} vertices, {len(estimate.faces)} faces, {out}")
    print(f"standard deviation: median {middle:.1f} mm, {most:.1f} mm where it is yellow")
    return 0
