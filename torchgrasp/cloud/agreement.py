"""Checks that the views, mesh, contacts and table of one object do not contradict each other."""

import dataclasses
import itertools
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.cloud.neighbours import draw_rows, nearest
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import spatial, trimesh
from torchgrasp.geometry.linalg import Points, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.plane_fit import assume_noise
from torchgrasp.values.planning import Grasps, PointCloud


@dataclasses.dataclass(frozen=True)
class AgreementNumbers:
    """Bounds on how far the cloud, mesh, contacts and table of one object may be apart."""

    sunk: float = 0.3
    """Greatest share of a mesh's height below a table that may have been guessed from a view."""
    drawn: int = 300
    """Most points whose distances are measured."""
    drawn_of_cloud: int = 500
    """Most points of a cloud to which these distances are measured."""
    slack: float = 0.01
    """Greatest distance [m] of points from their mesh, beside the noise."""
    share: float = 0.2
    """Greatest share of points that may be farther from their mesh."""
    guessed: float = 0.4
    """Greatest share of contacts that may be farther from their mesh: one of three, on a side that
    nobody saw.
    """
    unseen: float = 0.03
    """Greatest distance [m] of contacts from a cloud, which is partial, and the space behind it."""
    unseen_share: float = 0.5
    """Greatest share of contacts that may be farther from such a cloud."""
    lowest: float = 0.02
    """Share of the points of an object that may be lower than its foot: outliers."""
    foot: float = 0.015
    """Greatest height [m] of a foot above or below its table, beside the noise."""


@dataclasses.dataclass(frozen=True)
class ViewNumbers:
    """Bounds on how far the views of one object may be apart."""

    drawn: int = 400
    """Most points of a view that are compared with another view."""
    surface: int = 5000
    """Most points of the surface that they are compared with."""
    neighbours: int = 9
    """Nearest points, the point itself included, that give the spacing of a view's rays."""
    reach: float = 1.5
    """A ray meets a surface if the nearest ray of the surface is so many spacings away."""
    least: int = 20
    """Fewest compared points that count: fewer are a rim that flies."""
    seen: float = 0.9
    """Quantile of the heights before a surface: flying pixels are above it."""
    near: float = 0.75
    """Quantile of the distances without a camera, where the wrong neighbours are above it."""
    same: float = 0.8
    """Least cosine of two normals of one surface."""
    refused: float = 3.0
    """Greatest distance of two views, over their noise."""
    meet: float = 0.05
    """Share of a view's points that lies on the other view, or behind it."""
    gap: float = 0.03
    """Greatest distance [m] of these points from there."""


AGREEMENT = AgreementNumbers()
VIEWS = ViewNumbers()


def check_agreement(
    name: str,
    points: Points,
    what: str,
    other: "trimesh.Trimesh | PointCloud",
    slack: float,
    share: float,
) -> None:
    """Raise `BadArgument` if points lie off a mesh, or off a cloud and the space hidden behind it.

    At most the fraction `share` of the `points` (n, 3) [m] may be farther than `slack` [m] from
    `other`, the mesh [m] or the cloud. Errors call the argument `name`, and its points `what`.
    """
    points = points.detach().cpu().double()
    points = points[draw_rows(len(points), AGREEMENT.drawn)]
    if isinstance(other, PointCloud):
        distance = _distance_behind(points, other)
        surface = "the cloud or behind it"
    else:
        from trimesh.proximity import closest_point

        distance = torch.from_numpy(closest_point(other, points.numpy())[1])
        surface = "the mesh's surface"
    far = distance > slack
    if float(far.double().mean()) > share:
        off = float(distance[far].median())
        found = f"{int(far.sum())} of {len(far)} about {1e3 * off:.0f} mm off"
        allowed = f"{what} within {1e3 * slack:.0f} mm of {surface}: one frame, in metres"
        raise BadArgument(name, found, allowed)


@dataclasses.dataclass(frozen=True)
class Disagreement:
    """How far two views, by their places in a list, are apart, and the noise of their cameras."""

    views: tuple[int, int]
    distance: float
    noise: float
    """Distance and noise [m]."""


def check_views(views: Sequence[PointCloud]) -> Disagreement | None:
    """Raise `BadArgument` if two views of one object contradict each other beyond their noise.

    The views [m], with normals, are in one frame, each with at most one camera. Points of a view
    may not stand before a surface that the camera of another saw. Without a camera, surfaces that
    overlap are compared. Views that nowhere meet are refused, too.

    Returns the two views that are farthest apart, over their noise; None if none can be compared.
    """
    worst = None
    pairs = list(itertools.permutations(range(len(views)), 2))
    for first, second in pairs:
        a = views[first]
        b = views[second]
        noise = max(_noise(a), _noise(b))
        distance = _overlap_distance(a, b) if a.viewpoint is None else _height_before(a, b)
        if distance is None:
            continue
        if worst is None or distance / noise > worst.distance / worst.noise:
            worst = Disagreement((first, second), distance, noise)
    if worst is not None and worst.distance > VIEWS.refused * worst.noise:
        _refuse_views(worst.views, worst.distance, VIEWS.refused * worst.noise)
    for first, second in pairs:
        gap = float(
            _distance_behind(_draw_points(views[second]), views[first]).quantile(VIEWS.meet)
        )
        if gap > VIEWS.gap:
            _refuse_views((first, second), gap, VIEWS.gap)
    return worst


def _refuse_views(views: tuple[int, int], distance: float, limit: float) -> None:
    """Raise `BadArgument` for two views with a `distance` [m] above the `limit` [m]."""
    first, second = sorted(views)
    found = f"views {first} and {second} about {1e3 * distance:.1f} mm apart: check their poses"
    allowed = f"views of one object that agree within {1e3 * limit:.1f} mm"
    raise BadArgument("clouds", found, allowed)


def _height_before(a: PointCloud, b: PointCloud) -> float | None:
    """Return how far [m] points of view b stand before the surface that the camera of view a saw.

    None if too few points of b are on rays to that surface.
    """
    assert a.viewpoint is not None
    eye = a.viewpoint.double().cpu()
    surface, normals = _draw_surface(a)
    # the camera saw only what faces it
    facing = ((eye - surface) * normals).sum(-1) > 0
    surface = surface[facing]
    normals = normals[facing]
    points = _draw_points(b)
    if len(surface) < VIEWS.least:
        return None
    rays = unit(surface - eye)
    spacing = float(nearest(rays, VIEWS.neighbours)[0][:, 1:].mean(-1).median())
    apart, row = _find_nearest(rays, unit(points - eye))
    met = apart < VIEWS.reach * spacing
    if int(met.sum()) < VIEWS.least:
        return None
    height = ((points - surface[row]) * normals[row]).sum(-1).clamp_min(0)
    depth = torch.linalg.vector_norm(surface[row] - eye, dim=-1)
    before = torch.linalg.vector_norm(points - eye, dim=-1) < depth
    return float(torch.where(before, height, 0.0)[met].quantile(VIEWS.seen))


def _overlap_distance(a: PointCloud, b: PointCloud) -> float | None:
    """Return the distance [m] of two surfaces where they overlap and face the same way; None if
    they overlap in too few points.
    """
    surface, normals = _draw_surface(a)
    rows = draw_rows(len(b), VIEWS.drawn)
    assert b.normals is not None
    points = b.points[rows].double().cpu()
    spacing = float(nearest(surface, VIEWS.neighbours)[0][:, 1:].mean(-1).median())
    apart, row = _find_nearest(surface, points)
    height = ((points - surface[row]) * normals[row]).sum(-1).abs()
    beside = (apart.square() - height.square()).clamp_min(0).sqrt()
    cosine = (b.normals[rows].double().cpu() * normals[row]).sum(-1)
    overlap = (cosine > VIEWS.same) & (beside < VIEWS.reach * spacing)
    if int(overlap.sum()) < VIEWS.least:
        return None
    return float(height[overlap].quantile(VIEWS.near))


def _draw_points(cloud: PointCloud) -> Points:
    """Return the points [m] of a cloud that are compared with another view, in float64."""
    return cloud.points[draw_rows(len(cloud), VIEWS.drawn)].double().cpu()


def _draw_surface(cloud: PointCloud) -> tuple[Points, Points]:
    """Return some points [m] of a cloud, and their normals, in float64."""
    rows = draw_rows(len(cloud), VIEWS.surface)
    assert cloud.normals is not None
    return cloud.points[rows].double().cpu(), cloud.normals[rows].double().cpu()


def _find_nearest(
    points: Points, asked: Float[Tensor, "m 3"]
) -> tuple[Float[Tensor, "m"], Int[Tensor, "m"]]:
    """Return the distance and the index of the point that is nearest to each asked point."""
    distance, row = spatial.KDTree(points.numpy()).query(asked.numpy())
    return torch.from_numpy(distance), torch.from_numpy(row)


def check_mesh(cloud: PointCloud, mesh: "trimesh.Trimesh", name: str = "mesh") -> None:
    """Raise `BadArgument` if many points of an object's cloud do not lie on the object's mesh.

    The mesh [m] is in the frame of the cloud. Errors call it by `name`.
    """
    slack = AGREEMENT.slack + 2 * _noise(cloud)
    check_agreement(name, cloud.points, "the cloud's points", mesh, slack, AGREEMENT.share)


def check_contacts(grasps: Grasps, mesh: "trimesh.Trimesh", slack: float = AGREEMENT.slack) -> None:
    """Raise `BadArgument` if many contacts of grasps are farther than `slack` [m] from their
    object's mesh.

    The mesh [m] is in the frame of the grasps. A mesh that floats above the table of the grasps, or
    sinks far into it, is refused, too.
    """
    if not len(grasps):
        return
    points = grasps.contacts.points.reshape(-1, 3)
    check_agreement("mesh", points, "contacts of grasps", mesh, slack, AGREEMENT.guessed)
    if grasps.table is None:
        return
    # A table that was guessed from a view may lie above the true foot, but not below it.
    height = grasps.table.height(torch.tensor(mesh.vertices, dtype=torch.float64))
    foot = float(height.min())
    if foot > 0 or -foot > AGREEMENT.sunk * (float(height.max()) - foot):
        check_stand(mesh, grasps.table)


def check_seen(grasps: Grasps, cloud: PointCloud, name: str) -> None:
    """Raise `BadArgument` if many contacts of grasps lie off the view of their object and the space
    hidden behind it.

    The cloud is in the frame of the grasps. Errors call the argument `name`.
    """
    if len(grasps):
        points = grasps.contacts.points.reshape(-1, 3)
        limits = {"slack": AGREEMENT.unseen, "share": AGREEMENT.unseen_share}
        check_agreement(name, points, "the contacts", cloud, **limits)


def check_foot(cloud: PointCloud, table: Plane) -> None:
    """Raise `BadArgument` for a table that lies above the lowest points of its object.

    The table is in the frame of the cloud.
    """
    height = table.height(cloud.points.double().cpu())
    foot = float(height.quantile(AGREEMENT.lowest))
    if -foot > AGREEMENT.foot + 2 * _noise(cloud):
        found = f"one {-1e3 * foot:.0f} mm above the object's foot"
        allowed = f"a table under the object's points, at least {-1e3 * foot:.0f} mm lower"
        raise BadArgument("table", found, allowed)


def check_stand(mesh: "trimesh.Trimesh", table: Plane, name: str = "mesh") -> None:
    """Raise `BadArgument` if the mesh of an object floats above its table or sinks into it.

    The mesh [m] is in the frame of the table. Errors call it by `name`.
    """
    foot = float(table.height(torch.tensor(mesh.vertices, dtype=torch.float64)).min())
    if abs(foot) > AGREEMENT.foot:
        side = "above" if foot > 0 else "below"
        found = f"one whose foot is {1e3 * abs(foot):.0f} mm {side} the table"
        raise BadArgument(name, found, "a mesh that stands on the table, in the frame of both")


def _noise(cloud: PointCloud) -> float:
    """Return the depth noise [m] that is assumed for a cloud's camera, as the median over the
    points.
    """
    eye = None if cloud.viewpoint is None else cloud.viewpoint.double().cpu().reshape(-1, 3).mean(0)
    return float(assume_noise(cloud.points.double().cpu(), eye).median())


def _distance_behind(points: Points, cloud: PointCloud) -> Float[Tensor, "n"]:
    """Return each point's distance [m] from a cloud and the space hidden behind it, as deep as the
    cloud is long.
    """
    rows = draw_rows(len(cloud), AGREEMENT.drawn_of_cloud)
    seen = cloud.points[rows].double().cpu()
    length = float(torch.linalg.vector_norm(seen.amax(0) - seen.amin(0)))
    away = points[:, None] - seen  # (n, m, 3)
    # Without a camera, the space around the cloud counts as hidden.
    if cloud.viewpoint is None:
        return (torch.linalg.vector_norm(away, dim=-1).amin(1) - length / 2).clamp_min(0)
    eye = cloud.viewpoint.double().cpu()
    ray = unit(seen - (eye if eye.ndim == 1 else eye[rows]))
    behind = (away * ray).sum(-1, keepdim=True).clamp(0, length)
    return torch.linalg.vector_norm(away - behind * ray, dim=-1).amin(1)
