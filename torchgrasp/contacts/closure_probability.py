"""The probability that a grasp has force closure on the true surface, given the uncertain shape.

Each fingertip approaches along the normal of its contact. Random surfaces are drawn from the
Gaussian process along these lines. They give the points and normals at which the fingertips touch.
"""

import dataclasses
import functools
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.contacts.certify import check_contacts, check_unit
from torchgrasp.contacts.form_closure import Vectors, closed_exact, first_balance, tangents
from torchgrasp.contacts.problem import walls_at
from torchgrasp.foundation.base import Batch, row_numbers
from torchgrasp.foundation.checks import check_tensor, checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import FINITE, Range, Seed, is_known
from torchgrasp.foundation.threads import single_threaded
from torchgrasp.geometry.frames import real
from torchgrasp.geometry.linalg import dot, norm, unit
from torchgrasp.shape.estimate import surface_deviation
from torchgrasp.shape.gp import DOMAIN, ShapeGP
from torchgrasp.shape.posterior import combined_covariance, symmetric_root
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.planning import Contacts
from torchgrasp.values.specs import ContactSpec

# half the width [m] over which a fingertip senses the slope of the surface: the radius of its
# sphere
FOOTPRINT = 0.012
# nodes of a line, in standard deviations of the surface at its contact
NODES = (4.0, 1.5, 0.0, -1.5, -4.0)
LINES = 32  # contact sets whose covariances are computed at a time: they stay in the cache
DRAWS = 8192  # drawn rows that are judged at a time: their tensors take about 20 MB
DRAWS_ON_GPU = 2**18  # the same on a GPU, which fewer leave idle: about 700 MB
FRICTIONS = 9  # frictions that stand for a distribution
OUTER_GRID = (12.0, 9.0, 6.5, 4.0, 3.375, 2.75, 2.125, 1.5, 1.125, 0.75, 0.375, 0.0)
"""Outer half of the grid on a line, in standard deviations of the surface; all nodes are grid
points.
"""


@dataclasses.dataclass(frozen=True)
class LinePosterior(Batch):
    """The joint Gaussian of signed distance d and its gradient w along lines through the contacts.

    The line of a contact x with the normal n holds the points x + t n. Lengths are in normalised
    units; w and `slope` have no unit. `deviation` is the standard deviation of the surface at each
    contact, which is the unit of the positions `grid`. `distance` is the mean of d at these 23
    positions. `slope` is the mean of w at five of them, the nodes. `root` is the symmetric root of
    the covariance of d and w at all nodes (`node_covariance`).
    """

    points: Vectors  # planned contacts x (b, f, 3)
    normals: Vectors  # outward unit normals n (b, f, 3)
    # standard deviation of the surface at each contact; t of nodes and grid points is given in it
    deviation: Float[Tensor, "b f"]
    # mean of d at the grid points of each line, from outside to inside
    distance: Float[Tensor, "b f 23"]
    slope: Float[Tensor, "b f 5 3"]  # mean of w at the five nodes of each line
    # symmetric root of the covariance of the z = 20 f values (d, w), by line, then by node
    root: Float[Tensor, "b z z"]


@functools.cache
def grid() -> Float[Tensor, "23"]:
    """Return the 23 grid positions t on the line x + t n through a contact x along its normal n.

    n points outward. The positions fall from 12 (outside) to -12 (inside), unevenly spaced, in
    standard deviations of the surface at the contact.
    """
    return real([*OUTER_GRID, *(-t for t in reversed(OUTER_GRID[:-1]))])


def interpolation(at: Float[Tensor, "*b"], nodes: Float[Tensor, "k"]) -> Float[Tensor, "*b k"]:
    """Return the weights (no unit) of k nodes for linear interpolation at the positions `at`.

    `nodes` are the positions of the nodes in descending order. Positions beyond the nodes take the
    value of the nearest node.
    """
    held = torch.minimum(torch.maximum(at, nodes[-1]), nodes[0])[..., None]
    gaps = nodes[:-1] - nodes[1:]
    # how far each gap has been passed
    share = ((nodes[:-1] - held) / gaps).clamp(0, 1)
    begun = torch.cat([torch.ones_like(held), share], -1)
    return begun - torch.cat([share, torch.zeros_like(held)], -1)


def well_inside(shape: ShapeGP, contacts: Contacts) -> Bool[Tensor, "b"]:
    """Return a mask of the contact sets that lie well inside the ball in which the shape's
    posterior is valid.

    All contacts [m] of such a set are at least 12 mm (`FOOTPRINT`) from the edge of this ball. They
    are in the frame of the cloud.
    """
    radius = norm(_normalised_points(shape, contacts))
    return (radius + FOOTPRINT / shape.scale <= shape.domain_radius).all(-1)


def _normalised_points(shape: ShapeGP, contacts: Contacts) -> Vectors:
    """Return contact points in the normalised units of a shape, on its device."""
    return shape.normalise(contacts.points.double().to(shape.device))


def line_posterior(shape: ShapeGP, contacts: Contacts) -> LinePosterior:
    """Return the joint Gaussian of signed distance and gradient on the normal line of each contact.

    The contacts [m] are in the frame of the cloud, the result is in normalised units of the shape.
    Raises `BadArgument` for sets of other than 3 to 5 contacts, and normals not of length 1. It is
    also raised for a contact outside the domain, or within 12 mm (`FOOTPRINT`) of its edge. The
    domain is the ball in which the posterior is valid. It is raised for normals that point inward.
    """
    f = check_contacts(contacts).fingertips
    for name, value in (("points", contacts.points), ("normals", contacts.normals)):
        check_tensor(f"contacts.{name}", value, (len(contacts), f, 3))
    points = _normalised_points(shape, contacts)
    normals = check_unit(contacts.normals.double().to(shape.device))
    inside = well_inside(shape, contacts)
    if is_known(inside) and not bool(inside.all()):
        raise BadArgument(
            "contacts.points", "a contact at the edge of the domain", "contacts further inside"
        )
    (wall, own), *others = walls_at(shape, points)
    deviation, distance, slope, covariance = _along_lines(wall, shape.std_factor, points, normals)
    covariance = covariance * _on_same(own)  # errors of different walls are independent
    for wall, own in others:  # a finger meets the wall of its contact
        parts = _along_lines(wall, shape.std_factor, points, normals)
        deviation = torch.where(own, parts[0], deviation)
        distance = torch.where(own[..., None], parts[1], distance)
        slope = torch.where(own[..., None, None], parts[2], slope)
        covariance = covariance + parts[3] * _on_same(own)
    _check_outward(normals, slope[:, :, NODES.index(0.0)])
    prior = float(shape.prior_block()[0, 0])
    root = symmetric_root(shape.std_factor**2 * covariance, prior, "contacts within the domain")
    return LinePosterior(points, normals, deviation, distance, slope, root)


def _check_outward(normals: Vectors, slope: Vectors) -> None:
    """Raise `BadArgument` if the normals of the contacts point into the shape, as other libraries
    have them.

    `slope` is the mean gradient of the signed distance at the contacts. Single normals may do so,
    as those of poor contacts.
    """
    cosines = dot(normals, unit(slope)).detach()
    if is_known(cosines) and len(cosines) and float(cosines.mean()) < DOMAIN.inward:
        found = "normals that point into the shape"
        raise BadArgument("contacts.normals", found, "outward normals, so perhaps -normals")


def _on_same(own: Bool[Tensor, "b f"]) -> Bool[Tensor, "b z z"]:
    """Return a mask of the covariance entries of two contacts on the same wall; `own` marks the
    wall's contacts.
    """
    own = own.repeat_interleave(4 * len(NODES), 1)
    return own[:, :, None] & own[:, None]


def _along_lines(
    shape: ShapeGP, factor: float, points: Vectors, normals: Vectors
) -> tuple[
    Float[Tensor, "b f"], Float[Tensor, "b f 23"], Float[Tensor, "b f 5 3"], Float[Tensor, "b z z"]
]:
    """Return, on lines along the normals: standard deviations, mean distances, mean gradients and
    covariances.
    """
    x = points.flatten(0, 1)
    _, gradient = shape.mean_and_gradient(x)
    deviation = surface_deviation(shape.variance(x), gradient)
    deviation = factor * deviation.reshape(points.shape[:2])
    nodes = deviation[..., None] * torch.tensor(NODES, dtype=torch.float32, device="cpu").to(
        deviation
    )
    covariance = torch.cat(
        [
            node_covariance(shape, points[rows], normals[rows], nodes[rows])
            for rows in row_numbers(points).split(LINES)
        ]
    )
    _, slope = shape.mean_and_gradient(_on_lines(points, normals, nodes).reshape(-1, 3))
    t = deviation[..., None] * grid().to(deviation)
    distance = shape.mean(_on_lines(points, normals, t).reshape(-1, 3))
    slope = slope.reshape(*nodes.shape, 3)
    return deviation, distance.reshape(t.shape), slope, covariance


def _on_lines(
    points: Vectors, normals: Vectors, t: Float[Tensor, "b f n"]
) -> Float[Tensor, "b f n 3"]:
    """Return the points x + t n of the lines through the contacts x along their normals n."""
    return points[:, :, None] + t[..., None] * normals[:, :, None]


def node_covariance(
    shape: ShapeGP, points: Vectors, normals: Vectors, nodes: Float[Tensor, "b f 5"]
) -> Float[Tensor, "b z z"]:
    """Return the posterior covariance of signed distance d and gradient w at all nodes of the
    lines.

    The z = 20 f values of a contact set are ordered by line, then by node. Each node has four: d,
    then the parts of w along the normal and two tangents. `points` and `normals` (b, f, 3) are
    normalised contacts and outward unit normals. `nodes` are normalised positions on the lines.
    Nodes outside the ball in which the shape is known are moved to its edge. The gradient is a
    difference quotient over a fingertip's width.
    """
    width = FOOTPRINT / shape.scale
    along = dot(points, normals)
    inner = (shape.domain_radius - width) ** 2
    half_chord = (along**2 + inner - (points**2).sum(-1)).sqrt()
    nodes = torch.minimum(nodes, (half_chord - along)[..., None])
    nodes = torch.maximum(nodes, -(half_chord + along)[..., None])
    first = tangents(points, normals)
    second = torch.linalg.cross(normals, first)
    axes = torch.stack([normals, first, second], 2)  # (b, line, axis, 3)
    both = torch.cat([axes, -axes], 2)
    around = torch.cat([torch.zeros_like(axes[:, :, :1]), both], 2) * width
    places = _on_lines(points, normals, nodes)
    queries = places[:, :, :, None] + around[:, :, None]  # (b, line, node, 7, 3)
    # of the seven values around a node: its own distance, and a difference along each axis
    weights = points.new_zeros(*points.shape[:2], 4, 7)
    weights[..., 0, 0] = 1.0
    weights[..., 1:, 1:] = both.mT / (2 * width)
    weights = weights.repeat_interleave(len(NODES), 1)
    return combined_covariance(shape, queries.flatten(1, 2), weights)


TouchPoints = Float[Tensor, "b n f 3"]
"""One vector for each of b contact sets, n random surfaces and f fingertips."""


def first_contact(
    lines: LinePosterior, drawn: Float[Tensor, "b n z"]
) -> tuple[TouchPoints, TouchPoints]:
    """Return points (normalised) and outward unit normals at which fingertips touch n random
    surfaces.

    Both have the shape (b, n, f, 3), and are NaN where a line meets no surface. `drawn` holds the
    deviations of the random surfaces from the mean. They are z = 20 f values (d, w) at the nodes of
    the lines.
    """
    deviation = drawn.unflatten(-1, (lines.points.shape[1], len(NODES), 4))
    t = grid().to(drawn)
    nodes = torch.tensor(NODES, dtype=torch.float32, device="cpu").to(drawn)
    between = deviation[..., 0] @ interpolation(t, nodes).T
    distance = lines.distance[:, None] + between  # (b, n, f, 23)
    crosses = (distance[..., :-1] > 0) & (distance[..., 1:] <= 0)
    far = torch.where(crosses, t[:-1].abs(), torch.inf)
    nearest, before = far.min(-1, keepdim=True)
    high = distance.gather(-1, before)
    low = distance.gather(-1, before + 1)
    # a line that meets no surface adds nothing to derivatives, so it is computed as if it did
    missed = torch.isinf(nearest)
    passed = torch.where(missed, 0.0, high / torch.where(missed, 1.0, high - low))
    stop = torch.lerp(t[before], t[before + 1], passed)
    weights = interpolation(stop, nodes)  # (b, n, f, 1, k)
    slope = lines.slope[:, None] + deviation[..., 1:]
    motion = stop * lines.deviation[:, None, :, None]
    points = lines.points[:, None] + motion * lines.normals[:, None]
    normals = unit((weights @ slope)[..., 0, :])
    return torch.where(missed, torch.nan, points), torch.where(missed, torch.nan, normals)


@checked
@dataclasses.dataclass(frozen=True)
class ClosureProbability(Batch):
    """The probability that each of b contact sets has force closure on the true surface: it then
    resists any load.

    `closure_probability` returns it.

    Attributes:
        probability: share (b,) of random surfaces on which the set has force closure, in [0, 1].
            For a distribution of the friction it is the mean over 9 frictions.
        standard_error: standard error (b,) of the probability. If k of n surfaces give force
            closure, it is that of a share (k + 1) / (n + 2). So it is never 0.

    >>> ClosureProbability(torch.tensor([0.97]), torch.tensor([0.01])).probability
    tensor([0.9700])
    """

    probability: Float[Tensor, "b"]
    standard_error: Float[Tensor, "b"]


@checked
@single_threaded
def closure_probability(
    shape: ShapeGP,
    contacts: Annotated[Contacts, FINITE],
    spec: ContactSpec | None = None,
    n: Annotated[int, Range(1, 10**8)] = 2500,
    seed: Seed = 0,
) -> ClosureProbability:
    """Return the probability that each contact set has force closure on the uncertain surface, by
    Monte Carlo.

    A fingertip moves along the normal of its contact until it meets a random surface of the
    Gaussian process. Of several places where the normal enters it, the nearest to the contact
    counts. If it meets none within 12 standard deviations of the contact, the set has no force
    closure on this surface. All contact sets use the same random numbers, and no result depends on
    another set.

    Args:
        shape: the uncertain shape, from `fit_shape`.
        contacts: sets of 3 to 5 contacts (b, f, 3) [m] with outward unit normals, in the frame of
            the shape's cloud. They must lie in the shape's domain, the ball in which its posterior
            is valid. Their distance from its edge must be at least 12 mm (`FOOTPRINT`).
        spec: its `friction` is used, the coefficient of friction at execution; `planned_friction`
            is not used. For a distribution the result is the mean over 9 frictions (`FRICTIONS`).
            None means `ContactSpec()`.
        n: number of random surfaces. The standard error is at most 1 / (2 sqrt(n)).
        seed: random seed.

    Raises `BadArgument` for a contact that is not finite, or is outside the shape's domain or at
    its edge. It is also raised for a wrong argument, such as normals that on average point inward.

    >>> from torchgrasp import fit_shape, load_object
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> contacts = load_shipped_grasp("jug", "barrett").contacts
    >>> closure_probability(fit_shape(load_object("jug").view), contacts).probability > 0.5
    tensor([True])
    """
    spec = ContactSpec() if spec is None else spec
    lines = line_posterior(shape, contacts)
    frictions, weights = Distribution.of(spec.friction).nodes(FRICTIONS)
    shares = torch.stack([closed_share(lines, x, n, seed) for x in frictions.tolist()])
    share = weights.to(shares) @ shares
    middle = (n * share + 1) / (n + 2)
    return ClosureProbability(share, torch.sqrt(middle * (1 - middle) / n))


def drawn_contacts(lines: LinePosterior, n: int, seed: int) -> tuple[TouchPoints, TouchPoints]:
    """Return points (normalised) and outward unit normals at which fingertips touch n random
    surfaces.

    `lines` is the Gaussian of the surface along the normal lines of b sets of f contacts. The
    surfaces are drawn from it with a `seed`. Both results have the shape (b, n, f, 3). They are NaN
    where a line meets no surface.
    """
    # the draws are the same for all that torch.vmap maps over
    with torch._C._DisableFuncTorch():
        generator = torch.Generator("cpu").manual_seed(seed)
        size = n, lines.root.shape[-1]
        standard = torch.randn(size, dtype=torch.float64, generator=generator, device="cpu")
    return first_contact(lines, standard.to(lines.root.device) @ lines.root)


def closed_share(lines: LinePosterior, friction: float, n: int, seed: int) -> Float[Tensor, "b"]:
    """Return the share of n random surfaces, drawn on `lines`, on which each contact set has force
    closure.

    `friction` is the coefficient of friction, and `seed` that of the random surfaces.
    """
    generator = torch.Generator().manual_seed(seed)
    count = lines.points.new_zeros(len(lines))
    guess = None
    if lines.points.shape[1] > 3:
        guess = first_balance(lines.points, lines.normals, friction)
    at_once = min(n, DRAWS)
    judged = DRAWS if count.device.type == "cpu" else DRAWS_ON_GPU
    for start in range(0, n, at_once):
        size = min(at_once, n - start), lines.root.shape[-1]
        standard = torch.randn(size, dtype=torch.float64, generator=generator, device="cpu")
        parts = row_numbers(count).split(max(judged // len(standard), 1))
        for rows in parts:
            drawn = standard.to(count) @ lines.root[rows]
            points, normals = first_contact(lines[rows], drawn)
            balance = None if guess is None else guess[rows].repeat_interleave(len(standard), 0)
            closed = closed_exact(points.flatten(0, 1), normals.flatten(0, 1), friction, balance)
            count[rows] += closed.unflatten(0, points.shape[:2]).sum(1)
    return count / n
