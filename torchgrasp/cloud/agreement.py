"""Checks that the cloud, mesh, contacts and table of one object do not contradict each other."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.neighbours import draw_rows
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.geometry.linalg import Points, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.plane_fit import assume_noise
from torchgrasp.values.planning import PointCloud


def check_agreement(
    name: str,
    points: Points,
    what: str,
    other: "trimesh.Trimesh | PointCloud",
    slack: float,
    share: float,
) -> None:
    """Raise `BadArgument` if points lie off a mesh, or off a cloud and the space hidden behind the
    cloud.

    At most the fraction `share` of the points may be farther than `slack` [m] from `other`, the
    mesh or the cloud.
    """
    points = points.detach().cpu().double()
    points = points[draw_rows(len(points), 300)]
    if isinstance(other, PointCloud):
        distance = _distance_behind(points, other)
        surface = "the cloud or behind it"
    else:
        from trimesh.proximity import closest_point

        distance = torch.from_numpy(closest_point(other, points.numpy())[1])
        surface = "the mesh's surface"
    far = distance > slack
    if float(far.double().mean()) > share:
        found = (
            f"{int(far.sum())} of {len(far)} about {1e3 * float(distance[far].median()):.0f} mm off"
        )
        raise BadArgument(
            name, found, f"{what} within {1e3 * slack:.0f} mm of {surface}: one frame, in metres"
        )


def check_mesh(cloud: PointCloud, mesh: "trimesh.Trimesh", name: str = "mesh") -> None:
    """Raise `BadArgument` if many points of an object's cloud do not lie on the object's mesh."""
    check_agreement(name, cloud.points, "the cloud's points", mesh, 0.01 + 2 * _noise(cloud), 0.2)


def check_foot(cloud: PointCloud, table: Plane) -> None:
    """Raise `BadArgument` for a table that lies above the lowest points of its object."""
    foot = float(table.height(cloud.points.double().cpu()).quantile(0.02))
    if -foot > 0.015 + 2 * _noise(cloud):
        found = f"one {-1e3 * foot:.0f} mm above the object's foot"
        raise BadArgument(
            "table",
            found,
            f"a table under the object's points, at least {-1e3 * foot:.0f} mm lower",
        )


def check_stand(mesh: "trimesh.Trimesh", table: Plane, name: str = "mesh") -> None:
    """Raise `BadArgument` if an object's mesh does not stand on the table, but floats above it or
    sinks into it.
    """
    foot = float(table.height(torch.tensor(mesh.vertices, dtype=torch.float64)).min())
    if abs(foot) > 0.015:
        found = f"one whose foot is {1e3 * abs(foot):.0f} mm {'above' if foot > 0 else 'below'} the table"
        raise BadArgument(name, found, "a mesh that stands on the table, in the frame of both")


def _noise(cloud: PointCloud) -> float:
    """Return the depth noise [m] that is assumed for a cloud's camera, as the median over the
    points.
    """
    eye = None if cloud.viewpoint is None else cloud.viewpoint.double().cpu().reshape(-1, 3).mean(0)
    return float(assume_noise(cloud.points.double().cpu(), eye).median())


def _distance_behind(points: Float[Tensor, "n 3"], cloud: PointCloud) -> Float[Tensor, "n"]:
    """Return each point's distance [m] from a cloud and the space hidden behind it, as deep as the
    cloud is long.
    """
    rows = draw_rows(len(cloud), 500)
    seen = cloud.points[rows].double().cpu()
    length = float(torch.linalg.vector_norm(seen.amax(0) - seen.amin(0)))
    away = points[:, None] - seen
    if cloud.viewpoint is None:  # the space around the cloud counts as hidden
        return (torch.linalg.vector_norm(away, dim=-1).amin(1) - length / 2).clamp_min(0)
    eye = cloud.viewpoint.double().cpu()
    ray = unit(seen - (eye if eye.ndim == 1 else eye[rows]))
    behind = (away * ray).sum(-1, keepdim=True).clamp(0, length)
    return torch.linalg.vector_norm(away - behind * ray, dim=-1).amin(1)
