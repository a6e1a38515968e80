"""The uncertain surface along the lines of three fingers, and where a finger meets a surface drawn from it.

A finger comes along the planned normal n of its contact x and stops at x + t n where the distance d turns negative;
where it does so more than once, at the place nearest to x, since before the others free space was planned on. The
normal there is along the slope w. Both are drawn from the joint posterior of all three lines at a ladder of t, are
linear in t between its rungs, and deviate from their mean beyond it as at its ends; the mean of d, which alone says
where the finger stops on the estimated surface, is followed at a finer and longer ladder.

Two choices make the deviations real ones. All covariances are taken times `std_factor`^2, which is the posterior of
the same process with that much less amplitude and noise: real surfaces deviate that much less than sqrt(variance),
the paper's measure of doubt. And the deviation of the slope from its mean, the gradient of the posterior mean, is that
over a fingertip's width. A sample of the thin plate is rough: the gradient at its points turns by 25 degrees where the
errors of true normals are 10, and no finger would feel that. Over 24 mm the factor that was found for distances, 0.62,
holds for normals as well: on 16 views of scanned objects 68 % of the errors of a normal's components lie within 0.58
(hidden side, median of the views) and 0.67 (seen side) of their sqrt(variance).
"""

import dataclasses
import functools

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Batch, check_tensor
from torchgrasp.errors import BadArgument
from torchgrasp.linalg import unit
from torchgrasp.plan.certify import UNIT_TOLERANCE
from torchgrasp.plan.wrench import tangents
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.joint_posterior import distance_covariance, symmetric_root
from torchgrasp.values import Contacts

FOOTPRINT = 0.012
"""Half the width [m] over which a fingertip feels the slope of the surface."""

NODES = (4.0, 1.5, 0.0, -1.5, -4.0)
"""Rungs of a ladder in standard deviations of the surface at its contact: on 80 cases the probability of closure is
0.004 greater than with 49 of them, at most by 0.02; with three it is off by up to 0.07."""

STEPS = (12.0, 9.0, 6.5, 4.0, 3.375, 2.75, 2.125, 1.5, 1.125, 0.75, 0.375, 0.0)
"""Outer half of the finer ladder, which holds all rungs."""

SETS = 32
"""Triples whose joint posterior is made at a time."""


@dataclasses.dataclass(frozen=True)
class SurfaceSamples(Batch):
    """The Gaussian of (d, w) on the lines x + t n of three fingers, from outside in; all is normalised.

    Args:
        points: planned contacts x.
        normals: outward unit normals n.
        deviation: the standard deviation of d at the contact, in which the ladders are measured.
        distance: mean of d at the finer ladder.
        slope: mean of w at the rungs.
        root: of the covariance of the deviations of (d, w) at the rungs, line by line, rung by rung; symmetric.
    """

    points: Float[Tensor, "b 3 3"]
    normals: Float[Tensor, "b 3 3"]
    deviation: Float[Tensor, "b 3"]
    distance: Float[Tensor, "b 3 23"]
    slope: Float[Tensor, "b 3 5 3"]
    root: Float[Tensor, "b 60 60"]

    @property
    def steps(self) -> Float[Tensor, "b 3 23"]:
        """Return t at the finer ladder."""
        return self.deviation[..., None] * finer_grid().to(self.deviation)


def finer_grid() -> Float[Tensor, "23"]:
    """Return the finer ladder in standard deviations, from outside in."""
    return torch.tensor([*STEPS, *(-step for step in reversed(STEPS[:-1]))], dtype=torch.float64)


@functools.cache
def refinement() -> Float[Tensor, "23 5"]:
    """Return the weights of the deviations at the rungs for those at each step of the finer ladder.

    >>> refinement()[[0, 3, 7, 9]].tolist()
    [[1.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0, 0.0], [0.0, 0.5, 0.5, 0.0, 0.0]]
    """
    return interpolation(finer_grid(), torch.tensor(NODES, dtype=torch.float64))


def interpolation(at: Float[Tensor, "*b"], nodes: Float[Tensor, "k"]) -> Float[Tensor, "*b k"]:
    """Return the weights of falling rungs in the value at each place: linear between them, constant beyond."""
    held = torch.minimum(torch.maximum(at, nodes[-1]), nodes[0])[..., None]
    gaps = nodes[:-1] - nodes[1:]
    share = ((nodes[:-1] - held) / gaps).clamp(0, 1)  # how far each gap has been passed
    return torch.cat([torch.ones_like(held), share], -1) - torch.cat([share, torch.zeros_like(held)], -1)


def well_inside(shape: ShapeGP, contacts: Contacts) -> Bool[Tensor, "b"]:
    """Tell which triples are at least a footprint inside the domain of the shape, where closure has a probability."""
    radius = torch.linalg.vector_norm(shape.normalise(contacts.points.detach().double().to(shape.device)), dim=-1)
    return (radius + FOOTPRINT / shape.scale <= shape.domain_radius).all(-1)


def sample_surfaces(shape: ShapeGP, contacts: Contacts) -> SurfaceSamples:
    """Return the posterior of the surface along the fingers' lines, with real deviations.

    Raises:
        BadArgument: contacts of wrong shape, not finite, within a footprint of the domain's edge, or without unit
            normals.
    """
    for name, value in (("points", contacts.points), ("normals", contacts.normals)):
        check_tensor(f"contacts.{name}", value, (len(contacts), 3, 3))
    points = shape.normalise(contacts.points.detach().double().to(shape.device))
    normals = contacts.normals.detach().double().to(shape.device)
    if bool(((torch.linalg.vector_norm(normals, dim=-1) - 1).abs() > UNIT_TOLERANCE).any()):
        raise BadArgument("contacts.normals", "lengths other than 1", "unit vectors (to 1e-3)")
    if not bool(well_inside(shape, contacts).all()):
        raise BadArgument("contacts.points", "a contact at the edge of the domain", "contacts further inside")
    deviation = shape.std_factor * shape.jet(points.flatten(0, 1)).variance.sqrt().reshape(points.shape[:2])
    nodes = deviation[..., None] * torch.tensor(NODES).to(deviation)
    spread = points.new_empty(len(points), 12 * len(NODES), 12 * len(NODES))
    for rows in torch.arange(len(points), device=points.device).split(SETS):
        spread[rows] = deviations(shape, points[rows], normals[rows], nodes[rows])
    slope = shape.mean_and_gradient((points[:, :, None] + nodes[..., None] * normals[:, :, None]).reshape(-1, 3))[1]
    steps = deviation[..., None] * finer_grid().to(deviation)
    distance = shape.mean((points[:, :, None] + steps[..., None] * normals[:, :, None]).reshape(-1, 3))
    prior = float(shape.prior_block()[0, 0])
    root = symmetric_root(shape.std_factor**2 * spread, prior, "contacts within the domain")
    return SurfaceSamples(
        points, normals, deviation, distance.reshape(steps.shape), slope.reshape(*nodes.shape, 3), root
    )


def deviations(
    shape: ShapeGP, points: Float[Tensor, "b 3 3"], normals: Float[Tensor, "b 3 3"], nodes: Float[Tensor, "b 3 5"]
) -> Float[Tensor, "b 60 60"]:
    """Return the posterior covariance of (d, w) at the rungs: d itself, w from d a footprint away along three axes.

    The posterior is one within the domain only: outside, deviations are those at its edge.
    """
    width = FOOTPRINT / shape.scale
    along = (points * normals).sum(-1)
    chord = (along**2 + (shape.domain_radius - width) ** 2 - (points**2).sum(-1)).sqrt()  # half of it
    nodes = torch.maximum(torch.minimum(nodes, (chord - along)[..., None]), -(chord + along)[..., None])
    first = tangents(points, normals)
    axes = torch.stack([normals, first, torch.linalg.cross(normals, first)], 2)  # (b, line, axis, 3)
    around = torch.cat([torch.zeros_like(axes[:, :, :1]), axes, -axes], 2) * width
    ladder = points[:, :, None] + nodes[..., None] * normals[:, :, None]
    asked = ladder[:, :, :, None] + around[:, :, None]  # (b, line, rung, 7, 3)
    weights = points.new_zeros(*points.shape[:2], 4, 7)
    weights[..., 0, 0] = 1.0
    weights[..., 1:, 1:] = torch.cat([axes, -axes], 2).mT / (2 * width)
    values = distance_covariance(shape, asked.flatten(1, 3)).unflatten(2, (3, -1, 7)).unflatten(1, (3, -1, 7))
    half = torch.einsum("bimp,bikpjlq->bikmjlq", weights, values)
    return torch.einsum("bikmjlq,bjnq->bikmjln", half, weights).flatten(4).flatten(1, 3)


def first_contact(
    lines: SurfaceSamples, drawn: Float[Tensor, "b n 60"]
) -> tuple[Float[Tensor, "b n 3 3"], Float[Tensor, "b n 3 3"]]:
    """Return where the fingers stop for drawn deviations, and the outward normals there.

    Rows are NaN where a finger meets none along its ladder.
    """
    deviation = drawn.unflatten(-1, (3, len(NODES), 4))
    distance = lines.distance[:, None] + deviation[..., 0] @ refinement().to(drawn).T
    crosses = (distance[..., :-1] > 0) & (distance[..., 1:] <= 0)
    steps = finer_grid().to(drawn)
    far = torch.where(crosses, steps[:-1].abs(), torch.inf)
    nearest, before = far.min(-1, keepdim=True)
    high, low = distance.gather(-1, before), distance.gather(-1, before + 1)
    step = torch.lerp(steps[before], steps[before + 1], high / (high - low))
    step = torch.where(torch.isinf(nearest), torch.nan, step)
    weights = interpolation(step, torch.tensor(NODES).to(step))  # (b, n, 3, 1, k)
    slope = lines.slope[:, None] + deviation[..., 1:]
    motion = step * lines.deviation[:, None, :, None]
    return lines.points[:, None] + motion * lines.normals[:, None], unit((weights @ slope)[..., 0, :])
