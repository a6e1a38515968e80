"""The plane that objects stand on, found in points of any frame."""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.checks import check_tensor
from torchgrasp.errors import BadArgument, NoSupport
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.plane import Plane, as_plane

NOISE, NOISE_GROWTH = 0.001, 0.0035
"""Assumed noise [m] of a depth camera, and its growth with the squared distance [1/m]."""
LEAST_SHARE = 0.05  # least share of the points on the plane
MOST_BELOW = 0.06  # greatest number of points below, over the number on the plane: flying pixels at rims are fewer
LEAST_STANDING = 0.001  # least share of the points that stand on the plane, over its own part of the picture
LEAST_WIDTH = 0.04  # least spread [m] of the points on the plane along its narrower side, as a standard deviation
REACH = 0.30
"""Height [m] of objects, above or below a plane: a floor is deeper below a table, and a wall extends farther."""
MOST_TILT = 30.0  # greatest angle [deg] between the normal and `up`
RIVAL = 0.15
"""A second plane with this share of the points of the first, at more than 15 degrees from it, makes both ambiguous."""
SUPPORT = "one plane with objects on it and nothing below it, or a table that is given"  # what a scene must show


def find_table(
    points: Float[Tensor, "n 3"], viewpoint: Float[Tensor, "3"], table: Plane | float | None, up: object
) -> Plane:
    """Return the given plane, or the fitted one, with the camera above it."""
    plane = as_plane(table)
    direction = None if up is None else torch.as_tensor(up).double().cpu()
    if plane is None:
        return fit_support(points, viewpoint, direction)
    if direction is not None and float(unit(direction) @ plane.normal.double()) < 0.5:
        raise BadArgument("up", direction.tolist(), "a direction within 60 degrees of the table's normal")
    if float(plane.height(viewpoint)) <= 0:
        raise BadArgument("table", f"the camera {-float(plane.height(viewpoint)):.3g} m below it", "a table below it")
    return plane


def fit_support(
    points: Float[Tensor, "n 3"],
    viewpoint: Float[Tensor, "3"] | None = None,
    up: Float[Tensor, "3"] | None = None,
    *,
    seed: int = 0,
) -> Plane:
    """Return the plane that the objects in a cloud stand on, whatever the frame.

    Triples of points propose planes. The chosen plane holds the most points, has objects on its upper side and few
    points below. An iterated fit with Tukey's weights refines it; the noise is measured. A rigid motion of all
    arguments moves the plane alike.

    Args:
        points: everything that was seen [m].
        viewpoint: the camera's position [m], on the upper side; None: the side with more points is the upper one.
        up: against gravity, of any length; None: any direction.
        seed: of the draws.

    Raises:
        BadArgument: a wrong shape or type, or points that are not finite.
        NoSupport: no plane holds enough points; objects are on both sides of each; the camera is below; two planes
            could be the table.
    """
    points = check_tensor("points", points, (None, 3)).detach().cpu().double()
    eye = None if viewpoint is None else check_tensor("viewpoint", viewpoint, (3,)).detach().cpu().double()
    sky = None if up is None else unit(check_tensor("up", up, (3,)).detach().cpu().double())
    if len(points) < 50:
        raise NoSupport("table", f"{len(points)} points", SUPPORT)
    generator = torch.Generator().manual_seed(seed)
    points = points[torch.randperm(len(points), generator=generator)[:20_000]]
    centre = points.mean(0)
    points = points - centre  # so that distant origins cost no digits
    eye = None if eye is None else eye - centre
    squared = torch.full((len(points),), 0.7**2, dtype=points.dtype)  # an assumed distance [m]
    noise = NOISE + NOISE_GROWTH * (squared if eye is None else (points - eye).square().sum(-1))
    normals, offsets = _propose(points, noise, sky, generator)
    scored = 2000  # points that score the proposals
    held = _held(points[:scored], noise[:scored], normals, offsets)
    good: list[_Fit] = []
    reasons: list[str] = []
    least = 0.5 * LEAST_SHARE * min(len(points), scored)
    for _ in range(8):
        counts = held.sum(-1)
        i = int(counts.argmax()) if len(counts) else 0
        if not len(counts) or int(counts[i]) < least:
            break
        fit = _turned_up(points, _refine(points, noise, normals[i], float(offsets[i])), eye, sky)
        reason = _objection(points, noise, fit, eye, sky)
        if reason is None:
            good.append(fit)
            least = max(least, 0.5 * RIVAL * int(counts[i]))
        else:
            reasons.append(reason)
        rest = (points[:scored] @ fit.normal - fit.offset).abs() > 3 * noise[:scored]
        held = held & rest & ~held[i]
    if not good:
        raise NoSupport("table", reasons[0] if reasons else "no plane with enough points", SUPPORT)
    first = max(good, key=lambda fit: fit.count)
    rivals = [fit for fit in good if fit.count > RIVAL * first.count and float(fit.normal @ first.normal) < 0.966]
    if rivals:
        raise NoSupport("table", "two planes that could be the table, and no `up` to choose by", SUPPORT)
    return Plane(first.normal, first.offset + float(first.normal @ centre))


@dataclasses.dataclass(frozen=True)
class _Fit:
    """A plane normal . p = offset, the scale of the noise about it, and the number of points on it."""

    normal: Float[Tensor, "3"]
    offset: float
    scale: float
    count: int


def _propose(
    points: Float[Tensor, "n 3"], noise: Float[Tensor, "n"], sky: Float[Tensor, "3"] | None, generator: torch.Generator
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m"]]:
    """Return unit normals and offsets of planes through triples of points."""
    a, b, c = points[torch.randint(len(points), (3, 4000), generator=generator)]
    normal = torch.linalg.cross(b - a, c - a)
    double_area = torch.linalg.vector_norm(normal, dim=-1)
    longest = torch.stack([(b - a).norm(dim=-1), (c - a).norm(dim=-1), (c - b).norm(dim=-1)]).amax(0)
    wide = double_area / longest.clamp_min(1e-12) > 10 * noise.median()  # a lower triangle's normal is noise
    normal = normal[wide] / double_area[wide, None]
    offset = (normal * a[wide]).sum(-1)
    if sky is not None:
        upright = (normal @ sky).abs() > torch.cos(torch.deg2rad(torch.tensor(MOST_TILT + 5.0)))
        normal, offset = normal[upright], offset[upright]
    return normal, offset


def _held(
    points: Float[Tensor, "n 3"], noise: Float[Tensor, "n"], normals: Float[Tensor, "m 3"], offsets: Float[Tensor, "m"]
) -> Bool[Tensor, "m n"]:
    """Return which points are within twice the noise of each plane."""
    held = torch.empty(len(normals), len(points), dtype=torch.bool)
    for rows in torch.arange(len(normals)).split(500):
        held[rows] = (normals[rows] @ points.T - offsets[rows, None]).abs_() < 2 * noise
    return held


def _refine(points: Float[Tensor, "n 3"], noise: Float[Tensor, "n"], normal: Float[Tensor, "3"], offset: float) -> _Fit:
    """Return the plane of weighted least squares with Tukey's weights, which change smoothly with the points."""
    scale = 1.0
    for _ in range(30):
        ratio = (points @ normal - offset) / noise
        core = ratio.abs() < 4 * scale
        scale = min(max(float(1.4826 * ratio[core].abs().median()), 0.2), 2.0) if bool(core.any()) else scale
        weight = (1 - (ratio / (4.685 * scale)).square()).clamp_min(0).square() / noise.square()
        weight = weight / weight.sum()
        mean = weight @ points
        offset_points = points - mean
        spread = offset_points.T @ (weight[:, None] * offset_points)
        turned = torch.linalg.eigh(spread).eigenvectors[:, 0]
        turned = turned if float(turned @ normal) > 0 else -turned
        moved = float(mean @ turned)
        change = float((turned - normal).abs().max()) + abs(moved - offset)
        normal, offset = turned, moved
        if change < 1e-12:
            break
    on = ((points @ normal - offset).abs() / noise) < 3 * scale
    return _Fit(normal, offset, scale, int(on.sum()))


def _turned_up(
    points: Float[Tensor, "n 3"], fit: _Fit, eye: Float[Tensor, "3"] | None, sky: Float[Tensor, "3"] | None
) -> _Fit:
    """Return the plane with its normal along `up`, else towards the camera, else towards the side with more points."""
    if sky is not None:
        side = float(fit.normal @ sky)
    elif eye is not None:
        side = float(fit.normal @ eye) - fit.offset
    else:
        side = float((points @ fit.normal - fit.offset).clamp(-REACH, REACH).sum())
    return fit if side >= 0 else dataclasses.replace(fit, normal=-fit.normal, offset=-fit.offset)


def _objection(
    points: Float[Tensor, "n 3"],
    noise: Float[Tensor, "n"],
    fit: _Fit,
    eye: Float[Tensor, "3"] | None,
    sky: Float[Tensor, "3"] | None,
) -> str | None:
    """Return why a plane is no support, or None."""
    n, height = len(points), points @ fit.normal - fit.offset
    tolerance = 4 * fit.scale * noise + 0.001
    share = fit.count / n
    if share < LEAST_SHARE:
        return f"no plane with more than {share:.1%} of the points"
    if fit.scale > 0.9:  # points of no plane spread farther than the assumed noise
        return "no flat plane"
    if sky is not None and float(fit.normal @ sky) < float(torch.cos(torch.deg2rad(torch.tensor(MOST_TILT)))):
        return f"no plane within {MOST_TILT:g} degrees of level"
    on = height.abs() < tolerance
    width = float(torch.linalg.svdvals(points[on] - points[on].mean(0))[1]) / int(on.sum()) ** 0.5
    if width < LEAST_WIDTH:
        return f"a flat face about {3.5 * width:.2f} m wide"
    if eye is not None and float(unit(eye - points[on].mean(0)) @ fit.normal) < math.sin(math.radians(5.0)):
        return "a plane that the camera does not see from above"
    below = int(((height < -tolerance) & (height > -REACH)).sum())
    if below > MOST_BELOW * fit.count:
        return f"a plane with {share:.0%} of the points, but {below / n:.0%} of them below it"
    above = (height > tolerance) & (height < REACH)
    low, over = height[above] < 0.06, _over(points[above], points[on], fit.normal)
    # Low points of an object are over the plane's own part of the picture. A pan's rim is not over its floor.
    if int(over.sum()) < LEAST_STANDING * n or int((over & low).sum()) < 0.05 * int(low.sum()):
        return f"a plane with {share:.0%} of the points and nothing that stands on it"
    return None


def _over(points: Float[Tensor, "n 3"], ground: Float[Tensor, "m 3"], normal: Float[Tensor, "3"]) -> Bool[Tensor, "n"]:
    """Return which points are over the convex hull of the ground, shrunk by a twentieth."""
    from scipy.spatial import ConvexHull

    side = ground[0] - ground.mean(0)
    x = unit(side - (side @ normal) * normal)
    axes = torch.stack([x, torch.linalg.cross(normal, x)], -1)
    flat = (ground - ground.mean(0)) @ axes
    hull = torch.from_numpy(ConvexHull(flat.numpy()).equations)
    inside = ((points - ground.mean(0)) @ axes / 0.95) @ hull[:, :2].T + hull[:, 2]
    return (inside < 0).all(-1)
