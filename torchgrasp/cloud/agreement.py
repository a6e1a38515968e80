"""Checks that the cloud, mesh, contacts and table of one object do not contradict each other."""

import dataclasses
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.neighbours import draw_rows
from torchgrasp.foundation.errors import BadArgument, CloudWarning, NoEffect
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.foundation.told import warn_user
from torchgrasp.geometry.linalg import Points, norm, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.plane_fit import assume_noise
from torchgrasp.geometry.signed_distance import DistanceField
from torchgrasp.values.planning import Grasps, PointCloud


@dataclasses.dataclass(frozen=True)
class AgreementNumbers:
    """Bounds on how far the cloud, mesh, contacts and table of one object may be apart."""

    sunk: float = 0.3
    """Greatest share of a mesh's height that may be below a table, which may be a guess."""
    drawn: int = 300
    """Greatest number of points whose distances from a mesh or a cloud are measured."""
    drawn_of_cloud: int = 500
    """Greatest number of points of a cloud to which the distances of other points are measured."""
    slack: float = 0.01
    """Greatest distance [m] of points from their mesh, in addition to the noise. Points farther
    away count as off the mesh.
    """
    share: float = 0.2
    """Greatest share of points that may be off their mesh."""
    beside: float = 0.0005
    """Greatest median distance [m] of points from their mesh without a warning. The noise and the
    error of the camera's pose are added to it. Views of rendered sensors are nearer to their mesh,
    those of a similar object farther.
    """
    guessed: float = 0.4
    """Greatest share of contacts that may be off their mesh: one of three, on a side that nobody
    saw.
    """
    astray: float = 0.7
    """Greatest share of contacts that may be off their mesh in simulated trials, where some grasps
    may miss.
    """
    levels: int = 8
    """Number of depths behind each point of a cloud at which a region of allowed contacts is
    sought.
    """
    unseen: float = 0.03
    """Greatest distance [m] of contacts from a partial cloud and the space hidden behind it."""
    unseen_share: float = 0.5
    """Greatest share of contacts that may be farther than `unseen` from the cloud and the space
    hidden behind it.
    """
    lowest: float = 0.02
    """Share of the points of an object that may be lower than its foot: outliers."""
    foot: float = 0.015
    """Greatest height [m] of an object's foot above or below its table, in addition to the noise.
    """


AGREEMENT = AgreementNumbers()


def check_agreement(
    name: str,
    points: Points,
    what: str,
    other: "trimesh.Trimesh | PointCloud",
    slack: float,
    share: float,
) -> float:
    """Return the median distance [m] of `points` from `other`. Raise `BadArgument` if too many are
    far from it.

    `points` (n, 3) [m] and `other` are in one frame. The distance from a mesh [m] is that from its
    surface, also for points inside. The distance from a cloud is 0 in the space that its points
    hide from its camera (`distance_behind`). The error is raised if more than the fraction `share`
    of the points is farther than `slack` [m]. At most 300 points (`AGREEMENT.drawn`) are measured.
    In the error's text, `name` is the bad argument, and `what` describes the points.
    """
    points = points.detach().cpu().double()
    points = points[draw_rows(len(points), AGREEMENT.drawn)]
    if isinstance(other, PointCloud):
        distance = distance_behind(points, other)
        surface = "the cloud or behind it"
    else:
        distance = torch.from_numpy(trimesh.proximity.closest_point(other, points.numpy())[1])
        surface = "the mesh's surface"
    far = distance > slack
    if float(far.double().mean()) > share:
        off = float(distance[far].median())
        found = f"{int(far.sum())} of {len(far)} about {1e3 * off:.0f} mm off"
        allowed = f"{what} within {1e3 * slack:.0f} mm of {surface}: one frame, in metres"
        raise BadArgument(name, found, allowed)
    return float(distance.median())


def check_mesh(cloud: PointCloud, mesh: "trimesh.Trimesh", name: str = "mesh") -> None:
    """Raise `BadArgument` if many points of an object's cloud do not lie on the object's mesh.

    At most 20 % of the points (`AGREEMENT.share`) may be off it. A point is off if its distance
    exceeds 10 mm (`AGREEMENT.slack`) plus twice the camera's noise (`noise_of`). The mesh [m] is in
    the frame of the cloud. Errors call it by `name`. A `CloudWarning` is given if the median
    distance exceeds 0.5 mm (`AGREEMENT.beside`), the noise and the cloud's `pose_error` together.
    Then the mesh may be that of a similar object.
    """
    noise = noise_of(cloud)
    slack = AGREEMENT.slack + 2 * noise
    points = cloud.points
    off = check_agreement(name, points, "the cloud's points", mesh, slack, AGREEMENT.share)
    error = 0.0 if cloud.pose_error is None else float(cloud.pose_error.median())
    if off > AGREEMENT.beside + noise + error:
        found = f"half of the cloud's points are over {1e3 * off:.0f} mm off it"
        warn_user(CloudWarning, f"{name}: {found}: is it the mesh of this object, at its place?")


def check_contacts(
    grasps: Grasps,
    mesh: "trimesh.Trimesh",
    slack: float = AGREEMENT.slack,
    share: float = AGREEMENT.guessed,
) -> None:
    """Raise `BadArgument` if too many contacts of grasps are off their object's mesh.

    At most a `share` of the contacts may be farther than `slack` [m] from the mesh. The mesh [m] is
    in the frame of the grasps. A mesh that does not stand on the table of the grasps is refused,
    too (`check_stand`). But 30 % of its height (`AGREEMENT.sunk`) may be below the table, because
    the table may be a guess.
    """
    if not len(grasps):
        return
    points = grasps.contacts.points.reshape(-1, 3)
    check_agreement("mesh", points, "contacts of grasps", mesh, slack, share)
    if grasps.table is None:
        return
    # A table that was guessed from a view may lie above the true foot, but not below it.
    height = grasps.table.height(torch.tensor(mesh.vertices, dtype=torch.float64))
    foot = float(height.min())
    if foot > 0 or -foot > AGREEMENT.sunk * (float(height.max()) - foot):
        check_stand(mesh, grasps.table)


def check_seen(grasps: Grasps, cloud: PointCloud, name: str) -> None:
    """Raise `BadArgument` if many contacts of grasps are far from their object's cloud, and from
    the space hidden behind it.

    At most half of the contacts (`AGREEMENT.unseen_share`) may be more than 30 mm
    (`AGREEMENT.unseen`) from both. The cloud is in the frame of the grasps. Errors call the
    argument `name`.
    """
    if len(grasps):
        points = grasps.contacts.points.reshape(-1, 3)
        limits = {"slack": AGREEMENT.unseen, "share": AGREEMENT.unseen_share}
        check_agreement(name, points, "the contacts", cloud, **limits)


def check_where(name: str, distance: Callable[[Points], Tensor], cloud: PointCloud) -> None:
    """Raise `BadArgument` if the region in which contacts must lie is far from a cloud and the
    space behind it.

    The space behind it is what the cloud's points hide from their camera.

    Contacts must lie in a region with the `name` "keep", and outside a region with another name.
    Far is more than 30 mm (`AGREEMENT.unseen`) from both. For a cloud without a camera the bound
    grows by half the cloud's length, in place of the hidden space.

    The region is given by the function `distance`. It returns the signed distances [m] of points
    [m] from the region, in the frame of the cloud. Errors call the argument `name`.

    A region of another name that is far off raises the warning `NoEffect` instead. So does a region
    "keep" that holds the whole cloud and the space behind it.
    """
    seen, length, ray = _sight(cloud)
    space = seen
    room = AGREEMENT.unseen
    if ray is None:
        room += length / 2
    else:
        depth = torch.linspace(0, length, AGREEMENT.levels, dtype=seen.dtype)[:, None, None]
        space = (seen + depth * ray).reshape(-1, 3)
    signed = distance(space)
    off = float(signed.min())
    if off <= room:
        if name == "keep" and (signed < 0).all():
            everything = "it holds all of the object's points and the space behind them"
            warn_user(NoEffect, f"{name} changes nothing: {everything}; expected a part, in metres")
        return
    found = f"one that is {1e3 * off:.0f} mm off the object's points"
    allowed = "a region on the object: in the frame of the cloud, in metres"
    if name == "keep":
        raise BadArgument(name, found, allowed)
    warn_user(NoEffect, f"{name} changes nothing: {found}; expected {allowed}")


def check_shape(field: DistanceField, cloud: PointCloud) -> None:
    """Raise `BadArgument` if the points of a cloud lie off the surface of its estimated shape.

    Their median distance may be up to 10 mm (`AGREEMENT.slack`) plus twice the camera's noise
    (`noise_of`). The `field` holds the shape's signed distances [m], in the frame of the cloud.
    """
    points = cloud.points[draw_rows(len(cloud), AGREEMENT.drawn)]
    off = float(field.query(points.to(field.nodes))[0].abs().median())
    if off > AGREEMENT.slack + 2 * noise_of(cloud):
        found = f"one whose surface is {1e3 * off:.0f} mm off the cloud's points"
        raise BadArgument("shape", found, "the shape of this object, in the frame of its cloud")


def check_foot(cloud: PointCloud, table: Plane) -> None:
    """Raise `BadArgument` for a table that lies above the lowest points of its object.

    It may be up to 15 mm (`AGREEMENT.foot`) plus twice the camera's noise (`noise_of`) above them.
    The lowest 2 % of the points (`AGREEMENT.lowest`) do not count. The table is in the frame of the
    cloud.
    """
    height = table.height(cloud.points.double().cpu())
    foot = float(height.quantile(AGREEMENT.lowest))
    if -foot > AGREEMENT.foot + 2 * noise_of(cloud):
        found = f"one {-1e3 * foot:.0f} mm above the object's foot"
        allowed = f"a table under the object's points, at least {-1e3 * foot:.0f} mm lower"
        raise BadArgument("table", found, allowed)


def warn_of_low_table(cloud: PointCloud, table: Plane) -> None:
    """Warn (`NoEffect`) if the gap between a table and the points above it is larger than the
    diagonal of the points' bounding box.

    The object then counts as in the air, as without a table: what the points hide is assumed to
    reach no farther than this diagonal. The table is in the frame of the cloud.
    """
    points = cloud.points.double().cpu()
    foot = float(table.height(points).quantile(AGREEMENT.lowest))
    if foot > float(norm(points.amax(0) - points.amin(0))):
        found = f"it is {1e3 * foot:.0f} mm below the object's points, more than their extent"
        fix = "expected the table's height in metres, or None (--no-table) for an object in the air"
        warn_user(NoEffect, f"table changes nothing: {found}; {fix}")


def check_stand(mesh: "trimesh.Trimesh", table: Plane, name: str = "mesh") -> None:
    """Raise `BadArgument` if the mesh of an object floats above its table or sinks into it.

    Its lowest vertex may be up to 15 mm (`AGREEMENT.foot`) above or below the table. The mesh [m]
    is in the frame of the table. Errors call it by `name`.
    """
    foot = float(table.height(torch.tensor(mesh.vertices, dtype=torch.float64)).min())
    if abs(foot) > AGREEMENT.foot:
        side = "above" if foot > 0 else "below"
        found = f"one whose foot is {1e3 * abs(foot):.0f} mm {side} the table"
        raise BadArgument(name, found, "a mesh that stands on the table, in the frame of both")


def noise_of(cloud: PointCloud) -> float:
    """Return the assumed standard deviation [m] of the depth noise of a cloud's camera.

    It is the median over the points. The assumed noise grows with the squared distance from the
    camera. An unknown camera counts as 0.7 m away.
    """
    eye = None if cloud.viewpoint is None else cloud.viewpoint.double().cpu().reshape(-1, 3).mean(0)
    return float(assume_noise(cloud.points.double().cpu(), eye).median())


def _sight(cloud: PointCloud) -> tuple[Points, float, Points | None]:
    """Return some points [m] of a cloud, how long they are [m], and the unit vectors along which
    its cameras saw them. The vectors are None without a camera.
    """
    rows = draw_rows(len(cloud), AGREEMENT.drawn_of_cloud)
    seen = cloud.points[rows].double().cpu()
    length = float(norm(seen.amax(0) - seen.amin(0)))
    if cloud.viewpoint is None:
        return seen, length, None
    eye = cloud.viewpoint.double().cpu()
    return seen, length, unit(seen - (eye if eye.ndim == 1 else eye[rows]))


def distance_behind(points: Points, cloud: PointCloud) -> Float[Tensor, "n"]:
    """Return each point's distance (n,) [m] from a cloud and the space hidden behind it, 0 inside.

    The hidden space reaches as far behind each point of the cloud as the cloud is long. Without a
    camera it reaches half this length in all directions. `points` (n, 3) [m] are in the frame of
    the cloud.
    """
    seen, length, ray = _sight(cloud)
    away = points[:, None] - seen  # (n, m, 3)
    # Without a camera, the space around the cloud counts as hidden.
    if ray is None:
        return (norm(away).amin(1) - length / 2).clamp_min(0)
    behind = (away * ray).sum(-1, keepdim=True).clamp(0, length)
    return norm(away - behind * ray).amin(1)
