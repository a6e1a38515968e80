"""Convex parts of a mesh for the simulator, decomposed once and cached.

Simulators replace a mesh by its convex hull, which would make a jug solid. CoACD cuts the mesh into
convex parts. Its measure of concavity is relative to the size of the mesh. Parts of a wide thing
with thin walls may therefore bulge by several walls. Such a mesh is cut finer.
"""

import dataclasses
import hashlib
import logging
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchgrasp.files import load_tensors, save_tensors
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import MeshError, ModelFileError, OutputError
from torchgrasp.foundation.lazy import spatial, trimesh
from torchgrasp.geometry.mesh import LEAST_VOLUME, check_solid, read_mesh
from torchgrasp.sim.decompose import decompose


@dataclasses.dataclass(frozen=True)
class CutNumbers:
    """Parameters with which CoACD cuts a mesh into convex parts, and bounds on how far these may
    bulge.
    """

    thresholds: tuple[float, ...] = (0.05, 0.02, 0.01)
    """Concavities of a part (no unit), as CoACD defines them, below which it cuts no further. They
    are tried in order, until the parts do not bulge out of the mesh.
    """
    bulge: float = 1e-3
    """Greatest distance [m] of the parts' surface outside the mesh. It equals the default of
    `TrialSpec.overlap`, the depth by which a hand may penetrate the object at the start.
    """
    within: float = 0.95
    """Share of the parts' surface that must be within the distance `bulge` of the mesh."""
    sampled: int = 2000
    """Number of points of the parts' surface whose distance outside the mesh is measured."""


CUT = CutNumbers()
_SEARCH: dict[str, Any] = {"mcts_iterations": 60, "mcts_max_depth": 2, "mcts_nodes": 10}
"""Settings of CoACD's search for cuts, which make it narrower and faster than by default."""
MOST_PARTS = 1000  # most parts that a caller may give
LARGEST_MISFIT = 0.01  # difference [m] of the boxes of a mesh and of its parts
DECIMALS = 6  # decimals to which corners [m] are rounded if their hull would not be closed
_log = logging.getLogger(__name__)


@checked
def convex_parts(
    mesh: "trimesh.Trimesh | Path | str", cache: Path | str | None = None
) -> "list[trimesh.Trimesh]":
    """Return convex parts [m] whose union approximates a closed mesh, in the mesh's frame; a convex
    mesh gives a single part.

    Parts bulge if more than 5 % of their surface lies farther than 1 mm outside the mesh
    (`CUT.bulge`). The mesh is then cut again, finer, at most twice. The parts of the finest cut are
    returned even if they bulge.

    Args:
        mesh: the closed mesh [m], or its file.
        cache: folder in which the parts are kept for later calls. None means
            `$XDG_CACHE_HOME/torchgrasp` or `~/.cache/torchgrasp`. If it cannot be written, a
            warning is logged.

    Raises:
        MeshError: the mesh is missing, open or without volume.
        MeshError: the coarsest cut takes more than 4 GiB of memory, or 60 s of processor time plus
            5 ms a face.
        MissingExtra: the mesh is not convex, and CoACD is not installed.

    >>> import trimesh
    >>> len(convex_parts(trimesh.creation.box((0.1, 0.1, 0.1))))
    1
    """
    mesh = read_mesh(mesh)
    if mesh.is_convex:
        return [hull(mesh.vertices)]
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = home / "torchgrasp" if cache is None else Path(cache)
    path = folder / f"{_fingerprint(mesh)}.safetensors"
    parts = list[trimesh.Trimesh]()
    if path.is_file():
        try:
            parts = _load(path, mesh)
        except (ModelFileError, ValueError):
            _log.warning("%s is damaged and will be made anew", path)
    if not parts:
        parts = [part for body in _bodies(mesh) for part in _cut(body)]
        try:
            _save(parts, path)
        except OutputError as error:
            _log.warning("convex parts are not kept: %s", error)
    return [part for part in parts if part.volume > LEAST_VOLUME]


def _bodies(mesh: "trimesh.Trimesh") -> "list[trimesh.Trimesh]":
    """Return the closed bodies of which a mesh is put together, or the mesh alone if one is a void.

    CoACD would thicken bodies that overlap on all sides, by half a per cent of their length.
    """
    bodies = list(mesh.split(only_watertight=False))
    solid = all(body.is_watertight and body.volume > LEAST_VOLUME for body in bodies)
    return bodies if solid and len(bodies) <= MOST_PARTS else [mesh]


def _cut(mesh: "trimesh.Trimesh") -> "list[trimesh.Trimesh]":
    """Return the parts of the coarsest cut that does not bulge, or else of the finest one.

    Raises the errors of `decompose` for the first cut. If a finer one takes too long, the parts
    before it are returned, and a warning is logged.
    """
    if mesh.is_convex:
        return [hull(mesh.vertices)]
    parts = list[trimesh.Trimesh]()
    for threshold in CUT.thresholds:
        try:
            pieces = decompose(mesh, {"threshold": threshold, **_SEARCH})
        except MeshError as error:
            if not parts:
                raise
            _log.warning(
                "parts bulge by more than %g m, and were not cut finer: %s", CUT.bulge, error
            )
            break
        parts = [trimesh.Trimesh(vertices, faces).convex_hull for vertices, faces in pieces]
        if _bulge(parts, mesh) <= CUT.bulge:
            break
    return parts


def _bulge(parts: "Sequence[trimesh.Trimesh]", mesh: "trimesh.Trimesh") -> float:
    """Return the distance [m] outside a closed mesh within which most of its parts' surface lies.

    It is a quantile (`CUT.within`) over points drawn evenly from the surfaces of the parts.
    """
    shares = np.array([part.area for part in parts])
    counts = np.ceil(CUT.sampled * shares / shares.sum()).astype(int)
    drawn = [
        trimesh.sample.sample_surface(part, count, seed=0)[0]
        for part, count in zip(parts, counts, strict=True)
    ]
    points = np.concatenate(drawn)
    outside = ~mesh.contains(points)
    height = np.zeros(len(points))
    if outside.any():
        height[outside] = trimesh.proximity.closest_point(mesh, points[outside])[1]
    return float(np.quantile(height, CUT.within))


def read_solid(
    mesh: "trimesh.Trimesh | Path | str", parts: "Sequence[trimesh.Trimesh] | None"
) -> "tuple[trimesh.Trimesh, list[trimesh.Trimesh]]":
    """Return (mesh, parts): a closed mesh [m], given or read from its file, and its convex parts.

    The convex parts [m] are the given `parts`, or those of `convex_parts` if `parts` is None.
    Raises `MeshError` for an open mesh, or for given parts that are not convex. Raises it also if
    the parts' bounding box differs by more than 10 mm from that of the mesh.
    """
    mesh = read_mesh(mesh)
    if parts is None:
        return mesh, convex_parts(mesh)
    pieces = check_parts(parts)
    low = np.min([part.bounds[0] for part in pieces], axis=0)
    high = np.max([part.bounds[1] for part in pieces], axis=0)
    off = float(np.abs(np.stack([low, high]) - mesh.bounds).max())
    if off > LARGEST_MISFIT:
        found = f"parts whose box is {1e3 * off:.0f} mm off that of the mesh"
        raise MeshError("parts", found, "parts of the mesh, in its frame, in metres")
    return mesh, pieces


def hull(corners: np.ndarray) -> "trimesh.Trimesh":
    """Return the convex hull of the points `corners` (n, 3) [m] as a mesh.

    The points are rounded to 1e-6 m if the mesh of the hull would otherwise not be closed.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        body = trimesh.convex.convex_hull(corners)
        return (
            body if body.is_watertight else trimesh.convex.convex_hull(np.round(corners, DECIMALS))
        )


def check_parts(parts: "Sequence[trimesh.Trimesh]") -> "list[trimesh.Trimesh]":
    """Check the convex parts [m] that a caller gave for a mesh, and return them as a list.

    Raises `MeshError` if a part is not closed or not convex. Raises it also for no parts at all, or
    for more than 1000.
    """
    if len(parts) > MOST_PARTS:
        raise MeshError("parts", f"{len(parts)} parts", f"at most {MOST_PARTS}")
    for index, part in enumerate(parts):
        check_solid(part, f"part {index}")
        if not part.is_convex:
            raise MeshError("parts", f"part {index}, which is not convex", "convex meshes")
    if not parts:
        raise MeshError("parts", "no part", "at least one convex mesh")
    return list(parts)


def _fingerprint(mesh: "trimesh.Trimesh") -> str:
    """Return the cache's key for a mesh. It is a SHA-256 of the mesh and of the settings with which
    it is cut.
    """
    digest = hashlib.sha256(f"coacd {dataclasses.astuple(CUT)} {sorted(_SEARCH.items())}".encode())
    digest.update(np.ascontiguousarray(mesh.vertices, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(mesh.faces, dtype="<i8").tobytes())
    return digest.hexdigest()


def _save(parts: "list[trimesh.Trimesh]", path: Path) -> None:
    """Write the vertices of all parts to a cache file."""
    vertices = [np.array(part.vertices, dtype=np.float64) for part in parts]
    tensors = {
        "vertices": torch.from_numpy(np.concatenate(vertices)),
        "counts": torch.tensor([len(part) for part in vertices]),
    }
    save_tensors(path, "parts", tensors, {})


def _load(path: Path, mesh: "trimesh.Trimesh") -> "list[trimesh.Trimesh]":
    """Read the parts of a cache file as hulls of their vertices. Raise an error for vertices far
    outside the mesh.
    """
    tensors, _ = load_tensors(path, "parts", {"vertices", "counts"})
    try:
        vertices = tensors["vertices"]
        away = (vertices - torch.tensor(mesh.bounds.mean(0))).abs()
        if bool((away > torch.tensor(mesh.extents)).any()):
            raise RuntimeError("corners far outside the mesh")
        corners = torch.split(vertices, tensors["counts"].tolist())
        return [hull(c.numpy()) for c in corners]
    except (spatial.QhullError, RuntimeError) as error:
        allowed = "corners of bodies with a volume"
        raise ModelFileError("path", f"{path}: {error}", allowed) from error
