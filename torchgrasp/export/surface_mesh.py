"""The estimated surface as a mesh file for other programs, coloured by its standard deviation."""

from pathlib import Path

import numpy as np

from torchgrasp.checks import checked
from torchgrasp.errors import BadArgument
from torchgrasp.files import write_file
from torchgrasp.shape.surface import Surface


@checked
def save_surface(surface: Surface, path: Path | str) -> Path:
    """Write a surface as `.ply`, with `std_m` [m] of each vertex, or `.glb`. Yellow marks `largest_std`, violet 0.

    Raises:
        BadArgument: another suffix.
        OutputError: the file cannot be written.

    >>> import tempfile
    >>> from torchgrasp import fit_shape, load_object
    >>> from torchgrasp.shape import extract_surface
    >>> surface = extract_surface(fit_shape(load_object("jug").view), 24)
    >>> save_surface(surface, Path(tempfile.mkdtemp(), "jug.ply")).stat().st_size > 10_000
    True
    """
    import matplotlib
    import trimesh

    path = check_surface_path(path)
    std = surface.std_m.detach().cpu().double().numpy()
    shares = np.clip(std / largest_std(surface), 0.0, 1.0)
    colors = (255 * matplotlib.colormaps["viridis"](shares) + 0.5).astype(np.uint8)  # as in the report
    mesh = trimesh.Trimesh(
        vertices=surface.vertices.detach().cpu().double().numpy(),
        faces=surface.faces.cpu().numpy(),
        vertex_normals=surface.normals.detach().cpu().double().numpy(),
        vertex_colors=colors,
        process=False,
    )
    if path.suffix.lower() == ".ply":
        mesh.vertex_attributes["std_m"] = std.astype(np.float32)
    content = mesh.export(file_type=path.suffix.lower()[1:])
    assert isinstance(content, bytes)
    return write_file(path, content)


@checked
def largest_std(surface: Surface) -> float:
    """Return the upper end [m] of the colour scale: the 99 % quantile over the vertices, at least 1 um.

    >>> from torchgrasp import fit_shape, load_object
    >>> from torchgrasp.shape import extract_surface
    >>> surface = extract_surface(fit_shape(load_object("jug").view), 24)
    >>> 0.001 < largest_std(surface) < 0.05
    True
    """
    return max(float(surface.std_m.double().quantile(0.99)), 1e-6)


@checked
def check_surface_path(path: Path | str) -> Path:
    """Return the path if `save_surface` can write its format; raise `BadArgument` for another suffix.

    >>> check_surface_path("a.glb").suffix
    '.glb'
    """
    path = Path(path)
    if path.suffix.lower() not in (".ply", ".glb"):
        raise BadArgument("path", path, "a file ending in .ply or .glb")
    return path
