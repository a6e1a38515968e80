"""A guess of where a view's camera was, and a test whether a camera can have been at a place."""

import contextlib
import dataclasses
import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.neighbours import draw_rows, nearest
from torchgrasp.foundation.errors import NoSupport
from torchgrasp.foundation.lazy import spatial
from torchgrasp.geometry.linalg import Points, Vector, dot, fibonacci_sphere, norm, unit
from torchgrasp.geometry.support_search import find_supports


@dataclasses.dataclass(frozen=True)
class UnseenNumbers:
    """Bounds beyond which a camera cannot have seen the points of a view from its viewpoint."""

    edge_on: float = 0.15
    """Greatest share of points that the camera sees edge-on."""
    elsewhere: float = 2.0
    """Greatest ratio between this share and the least one of a camera in another direction. Thin
    frames look edge-on from everywhere, so their true camera may exceed `edge_on`.
    """
    directions: int = 64
    """Number of the other directions, which are about 25 degrees apart."""
    behind: float = 0.2
    """Greatest share of points that lie behind others."""
    grazing: float = 0.17
    """Cosine between ray and normal below which a surface is seen edge-on: 80 degrees."""
    neighbours: int = 6
    """Number of nearest points in the image with which a point is compared, itself included."""
    slope: float = 2.0
    """Greatest slope of a surface, its depth divided by its width, that hides nothing."""
    step: float = 0.1
    """Least step of depth behind which points are hidden, as a share of the cloud's radius."""


@dataclasses.dataclass(frozen=True)
class GuessNumbers:
    """Parameters of the search for the unknown camera position of a view.

    The score of a camera position is how well it explains two things. They are the bulge of the
    surface, which is towards the camera, and the density of the points.
    """

    drawn: int = 2000
    """Greatest number of points from which the camera is guessed."""
    half_view: float = 50.0
    """Greatest angle [deg] of the points from z, at which the camera may be in the origin."""
    ahead: float = 0.6
    """Least cosine between z and the direction to the mean of the points. With less, no camera in
    the origin looks along z, and z may be up.
    """
    far: float = 2.0
    """Least distance of a cloud from a camera in the origin, in radii of the cloud."""
    directions: int = 400
    """Number of directions of the camera that are tried; they are about 10 degrees apart."""
    above: float = 0.1
    """Least cosine between the direction of a camera and the vertical, as a camera is above the
    support.
    """
    distance: float = 4.0
    """Distance of a guessed camera from the centre of the cloud, in radii of the cloud."""
    density: float = 3.0
    """Weight of the density in the score; that of the bulge is 1. It gave the fewest wrong cameras.
    """
    rival: float = 0.3
    """Difference from the best score up to which another direction is likely, too."""
    least_angle: float = 15.0
    """Least angle [deg] about the guessed direction within which the camera is likely."""
    sure: float = 1.0
    """Least score of a direction that the points show clearly."""
    better: float = 0.5
    """Greatest difference of a given camera's score from the best score, at which the view may be
    from this camera.
    """
    tangent: float = 0.3
    """Cosine between ray and normal below which a surface counts less for the bulge, as noise turns
    its normals.
    """
    neighbours: int = 13
    """Number of nearest points, the point itself included; the farthest measures the density."""
    least_cosine: float = 0.1
    """Least cosine between ray and normal for the density, which noise would make infinite."""
    least: float = 1e-12
    """Least value of a divisor, and of a number whose logarithm is taken, against infinity."""


UNSEEN = UnseenNumbers()
GUESS = GuessNumbers()


@dataclasses.dataclass(frozen=True)
class Unseen:
    """Shares in [0, 1] of a view's points that a camera can hardly have seen.

    Args:
        edge_on: share of the points that the camera sees edge-on.
        behind: share of the points that are hidden behind others.
        least: least share edge-on of a camera in another direction, at the same distance. It is 0
            where `edge_on` is within its bound.
    """

    edge_on: float = 0.0
    behind: float = 0.0
    least: float = 0.0

    @property
    def excess(self) -> tuple[float, float]:
        """The shares `edge_on` and `behind`, each divided by its bound (`UNSEEN`).

        A number above 1 means that the camera cannot have seen the points.
        """
        edge_on = max(UNSEEN.edge_on, UNSEEN.elsewhere * self.least)
        return self.edge_on / edge_on, self.behind / UNSEEN.behind


def guess_viewpoint(
    points: Points, normals: Points, up: Vector | None = None, assumed: bool = False
) -> tuple[Vector, float]:
    """Return an estimated camera position (3,) [m] of a view, and the angle [deg] of its
    uncertainty.

    The position is in the frame of the points. The camera's direction from their centre is likely
    within the angle of the estimate. 180 degrees means that the points hardly show the direction.

    First the origin is tried. It is returned if the points lie before it along z, and a camera
    there can have seen them. If `up` is known, the points must also lie below the origin. Else the
    direction is searched, among all directions above the support. The best one explains the bulge
    of the surface and the density of the points. The camera is placed along it, 4 radii of the
    cloud away.

    Args:
        points: the points (n, 3) [m].
        normals: their unit normals (n, 3), of either sign.
        up: unit vector (3,) that points away from the support. If the points show a support, its
            normal replaces `up` in the search. None means unknown.
        assumed: whether `up` is only a guess, and so not known.
    """
    points, normals = _draw(points, normals)
    centre, radius = _enclose(points)
    origin = torch.zeros_like(points[0])
    may_be_own = up is None or assumed or float(centre @ up.to(points)) < 0
    if may_be_own and _is_ahead(points, centre, radius) and can_see(points, normals, origin):
        return origin, GUESS.least_angle
    with contextlib.suppress(NoSupport):
        up = find_supports(points, up=up)[0].plane.normal

    directions = fibonacci_sphere(GUESS.directions).to(points)
    if up is not None:
        directions = directions[directions @ up.to(points) > GUESS.above]
    bulge, density = _explain(points, normals, centre + GUESS.distance * radius * directions)
    score = bulge + GUESS.density * density
    best = score.argmax()
    rivals = directions[score > score[best] - GUESS.rival] @ directions[best]
    angle = math.degrees(math.acos(min(float(rivals.min()), 1.0)))
    angle = max(GUESS.least_angle, angle) if score[best] > GUESS.sure else 180.0
    return centre + GUESS.distance * radius * directions[best], angle


def _draw(points: Points, normals: Points) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Return some of the points, with their normals."""
    rows = draw_rows(len(points), GUESS.drawn).to(points.device)
    return points[rows], normals[rows]


def is_along_z(points: Points) -> bool:
    """Return whether the points (n, 3) [m] are ahead of a camera in the origin that looks along z.

    They are if the cosine between z and the direction to their mean exceeds 0.6 (`GUESS.ahead`).
    """
    middle = points.mean(0)
    return float(middle[2]) > GUESS.ahead * float(norm(middle))


def is_before_origin(points: Points) -> bool:
    """Return whether all points (n, 3) lie before a camera in the origin that looks along z.

    All must lie within 50 degrees (`GUESS.half_view`) of z. Their centre must be farther away than
    2 radii (`GUESS.far`). The radius is the greatest distance of a point from the centre. The
    points may have any unit.
    """
    return _is_ahead(points, *_enclose(points))


def _is_ahead(points: Points, centre: Vector, radius: Float[Tensor, ""]) -> bool:
    """Return whether points lie before a camera in the origin that looks along z."""
    least = math.cos(math.radians(GUESS.half_view))
    in_front = points[:, 2] > least * norm(points)
    far = norm(centre) > GUESS.far * radius
    return bool(far) and bool(in_front.all())


def can_see(points: Points, normals: Points, viewpoint: Vector) -> bool:
    """Return whether a camera at `viewpoint` (3,) [m] can have seen the points of a view.

    It must see at most 15 % of them edge-on, and at most 20 % behind others (`UNSEEN`). Of a thin
    frame it may see twice the share edge-on that the best other camera sees. In addition, one of
    three conditions must hold. First, the camera's pixels explain how dense the points are. Second,
    no other camera position explains the points much better. Third, the camera looks down on a
    support. `points` are (n, 3) [m]; `normals` (n, 3) are unit vectors of either sign.
    """
    points, normals = _draw(points, normals)
    if max(share_unseen(points, normals, viewpoint).excess) > 1:
        return False
    centre, radius = _enclose(points)
    others = centre + GUESS.distance * radius * fibonacci_sphere(GUESS.directions).to(points)
    bulge, density = _explain(points, normals, torch.cat([viewpoint[None], others]))
    score = bulge + GUESS.density * density
    if density[0] > 0 or score[0] > score.max() - GUESS.better:
        return True
    try:
        find_supports(points, viewpoint)
    except NoSupport:
        return False
    return True


def _enclose(points: Points) -> tuple[Vector, Float[Tensor, ""]]:
    """Return the centre of the points' box along their principal axes, and its distance to the
    farthest point.
    """
    # Principal axes do not depend on the frame.
    axes = torch.linalg.svd(points - points.mean(0), full_matrices=False).Vh
    along = points @ axes.T
    centre = (along.amax(0) + along.amin(0)) / 2 @ axes
    return centre, norm(points - centre).max()


def _explain(
    points: Points, normals: Points, viewpoints: Float[Tensor, "k 3"]
) -> tuple[Float[Tensor, "k"], Float[Tensor, "k"]]:
    """Return two scores of each camera position, at most 1. They say how well it explains a view's
    bulge and point density.

    Visible surfaces bulge towards the camera. A pixel covers an area that grows with the squared
    distance, over the cosine between ray and normal.
    """
    away = viewpoints - points[:, None]  # (n, k, 3)
    distance = norm(away).clamp_min(GUESS.least)
    cosine = dot(away, normals[:, None]) / distance  # (n, k)
    bulge = (normals * (points - _enclose(points)[0])).sum(-1)
    towards = (bulge[:, None] * torch.tanh(cosine / GUESS.tangent)).sum(0)
    bulging = towards / bulge.abs().sum().clamp_min(GUESS.least)

    # The logarithm of the density, up to a constant, against that of the camera's pixels.
    spacing = nearest(points, GUESS.neighbours)[0][:, -1].clamp_min(GUESS.least)
    density = -2 * torch.log(spacing)
    density = density - density.median()
    steep = cosine.abs().clamp_min(GUESS.least_cosine)
    error = density[:, None] - torch.log(steep) + 2 * torch.log(distance)
    error = (error - error.median(0).values).abs().mean(0)  # (k,)
    return bulging, 1 - error / density.abs().mean().clamp_min(GUESS.least)


def share_unseen(points: Points, normals: Points, viewpoint: Vector) -> Unseen:
    """Return the share of points that a camera sees edge-on, and the share hidden behind others.

    A point is seen edge-on if its ray is at more than 80 degrees to the normal (`UNSEEN.grazing`).
    The second share is 1 if a point lies behind the camera at `viewpoint` (3,) [m]. `points` are
    (n, 3) [m]; `normals` (n, 3) are unit vectors of either sign.
    """
    points, normals, viewpoint = (x.cpu() for x in (points, normals, viewpoint))
    middle = (points.amax(0) + points.amin(0)) / 2
    edge_on = float(_share_edge_on(points, normals, viewpoint[None]))
    least = 0.0
    if edge_on > UNSEEN.edge_on:
        directions = fibonacci_sphere(UNSEEN.directions).to(points)
        others = middle + norm(viewpoint - middle) * directions
        least = float(_share_edge_on(points, normals, others).min())
    return Unseen(edge_on, _share_behind(points, viewpoint, middle), least)


def _share_edge_on(
    points: Points, normals: Points, viewpoints: Float[Tensor, "k 3"]
) -> Float[Tensor, "k"]:
    """Return the share of points that each of k cameras sees edge-on."""
    ray = unit(points[:, None] - viewpoints)  # (n, k, 3)
    return (dot(ray, normals[:, None]).abs() < UNSEEN.grazing).to(points).mean(0)


def _share_behind(points: Points, viewpoint: Vector, middle: Vector) -> float:
    """Return the share of points that are hidden behind others. It is 1 if a point is behind the
    camera.
    """
    forward = middle - viewpoint
    if not forward.any() or ((points - viewpoint) @ forward <= 0).any():
        return 1.0  # within the cloud, or beside it
    axes = torch.linalg.svd(unit(forward)[None]).Vh  # forward, or backward, and two axes across
    local = (points - viewpoint) @ axes.T
    depth = local[:, 0].abs()
    pixels = (local[:, 1:] / depth[:, None]).numpy()
    apart, index = spatial.KDTree(pixels).query(pixels, k=min(UNSEEN.neighbours, len(pixels)))

    # A point lies behind a neighbour if it is deeper by more than a slope explains.
    step = (depth[:, None] - depth[torch.from_numpy(index)]).abs()
    step = step - UNSEEN.slope * torch.from_numpy(apart).to(depth) * depth[:, None]
    radius = norm(points - middle).max()
    return float((step.amax(1) > UNSEEN.step * radius).double().mean())
