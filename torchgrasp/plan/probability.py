"""How probable it is that planned contacts are closed on the real surface, of which only a posterior is known.

A finger comes along the planned normal n of its contact x and touches where it meets the real surface. Around x that
is, with a distance d and a slope w drawn from the joint posterior at all three contacts, the plane d + w.(p - x) = 0.
It meets the line at p = x + t n with t = -d / (w.n), and it must look towards the finger: w.n > 0. The outward normal
there is along w + t H n, with the Hessian H of the posterior mean. The draw is closed if the three points with these
normals are, for round cones.

Two choices make the deviations real ones. All covariances are taken times `std_factor`^2, which is the posterior of
the same process with that much less amplitude and noise: real surfaces deviate that much less than sqrt(variance),
the paper's measure of doubt. And the deviation of the slope from its mean, the gradient of the posterior mean, is that
over a fingertip's width. A sample of the thin plate is rough: the gradient at its points turns by 25 degrees where the
errors of true normals are 10, and no finger would feel that. Over 24 mm the factor that was found for distances, 0.62,
holds for normals as well: on 16 views of scanned objects 68 % of the errors of a normal's components lie within 0.58
(hidden side, median of the views) and 0.67 (seen side) of their sqrt(variance).
"""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import Batch, check_tensor
from torchgrasp.errors import BadArgument, IndefiniteCovariance
from torchgrasp.linalg import unit
from torchgrasp.plan.bound import closure_bound
from torchgrasp.plan.certify import UNIT_TOLERANCE
from torchgrasp.plan.wrench import closed_exact, tangents
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.joint import ROUNDING, distance_covariance
from torchgrasp.specs import ContactSpec
from torchgrasp.values import Contacts

FOOTPRINT = 0.012
"""Half the width [m] over which a fingertip feels the slope of the surface."""

CHUNK = 8192
"""Drawn triples that are judged at a time."""

SETS = 128
"""Triples whose joint posterior is made at a time."""


@dataclasses.dataclass(frozen=True)
class ClosureProbability(Batch):
    """The `probability` that each triple is closed, with its `standard_error`, and a proven `lower_bound` of it."""

    probability: Float[Tensor, "b"]
    standard_error: Float[Tensor, "b"]
    lower_bound: Float[Tensor, "b"]


@dataclasses.dataclass(frozen=True)
class TouchedPlanes(Batch):
    """The Gaussian of (d, w) at three contacts x with planned normals n, contact by contact; all is normalised.

    `bends` is H n: how w changes along n.
    """

    points: Float[Tensor, "b 3 3"]
    normals: Float[Tensor, "b 3 3"]
    bends: Float[Tensor, "b 3 3"]
    mean: Float[Tensor, "b 12"]
    covariance: Float[Tensor, "b 12 12"]


def closure_probability(
    shape: ShapeGP, contacts: Contacts, spec: ContactSpec | None = None, n: int = 2500, seed: int = 0
) -> ClosureProbability:
    """Return how probable closure is on the uncertain surface, by Monte Carlo and by a bound from below.

    `spec.max_variance` says which contacts are allowed, the probability which of them to prefer:
    `plan[probability.probability.argsort(descending=True)]` ranks a plan. All rows share the same draws, so that
    their order does not hang on chance alone, and no row depends on those beside it.

    Args:
        shape: the posterior.
        contacts: triples [m] of any planner with outward unit normals, within the domain of the shape.
        spec: its `friction`, that of execution, is the one that counts, not the smaller `planned_friction`.
        n: draws; the standard error is at most 1 / (2 sqrt(n)), 0.01 with 2500. It is that of (k + 1) / (n + 2)
            after k closed draws, and never 0.
        seed: of the draws.

    Raises:
        BadArgument: a wrong argument, or a contact that is not finite or outside the shape's domain.

    >>> from torchgrasp.linalg import unit
    >>> from torchgrasp import PointCloud, fit_shape
    >>> ball = unit(torch.randn(400, 3, generator=torch.Generator().manual_seed(0)))
    >>> corners = torch.tensor([[[1.0, 0, 0], [-0.6, 0.8, 0], [-0.6, -0.8, 0]]])
    >>> contacts = Contacts(0.04 * corners, corners, torch.zeros(1, 3), torch.zeros(1, 3))
    >>> closure_probability(fit_shape(PointCloud(0.04 * ball, ball)), contacts).probability > 0.9
    tensor([True])
    """
    spec = ContactSpec() if spec is None else spec
    if not isinstance(shape, ShapeGP):
        raise BadArgument("shape", type(shape).__name__, "a ShapeGP")
    if not isinstance(spec, ContactSpec):
        raise BadArgument("spec", type(spec).__name__, "a ContactSpec")
    for name, value, least in (("n", n, 1), ("seed", seed, 0)):
        if not isinstance(value, int) or not least <= value < 2**63:
            raise BadArgument(name, value, f"an integer from {least}")
    planes = touched_planes(shape, contacts)
    closed = count_closed(planes, spec.friction, n, seed, float(shape.prior_block()[0, 0]))
    middle = (closed + 1) / (n + 2)
    return ClosureProbability(
        closed / n,
        torch.sqrt(middle * (1 - middle) / n),
        closure_bound(planes.points, planes.normals, planes.bends, planes.mean, planes.covariance, spec.friction),
    )


def well_inside(shape: ShapeGP, contacts: Contacts) -> Bool[Tensor, "b"]:
    """Tell which triples are at least a footprint inside the domain of the shape, where closure has a probability."""
    radius = torch.linalg.vector_norm(shape.normalise(contacts.points.detach().double().to(shape.device)), dim=-1)
    return (radius + FOOTPRINT / shape.scale <= shape.domain_radius).all(-1)


def touched_planes(shape: ShapeGP, contacts: Contacts) -> TouchedPlanes:
    """Return the posterior of the surface as the fingers meet it, with real deviations.

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
    width = FOOTPRINT / shape.scale
    if not bool(well_inside(shape, contacts).all()):
        raise BadArgument("contacts.points", "a contact at the edge of the domain", "contacts further inside")
    first = tangents(points, normals)
    axes = torch.stack([normals, first, torch.linalg.cross(normals, first)], 2)  # (b, contact, axis, 3)
    asked = points[:, :, None] + torch.cat([torch.zeros_like(axes[:, :, :1]), axes, -axes], 2) * width
    # (d, w) of a contact from d at its seven points: d itself, and differences along three axes.
    weights = points.new_zeros(*points.shape[:2], 4, 7)
    weights[..., 0, 0] = 1.0
    weights[..., 1:, 1:] = torch.cat([axes, -axes], 2).mT / (2 * width)
    spread = points.new_zeros(len(points), 3, 4, 3, 4)
    for rows in torch.arange(len(points), device=points.device).split(SETS):
        values = distance_covariance(shape, asked[rows].flatten(1, 2)).unflatten(2, (3, 7)).unflatten(1, (3, 7))
        spread[rows] = torch.einsum("bimp,bipjq,bjnq->bimjn", weights[rows], values, weights[rows])
    jet = shape.jet(points.flatten(0, 1))
    mean = torch.cat([jet.distance[:, None], jet.gradient], 1).reshape(-1, 12)
    bends = (jet.hessian.reshape(*points.shape, 3) @ normals[..., None])[..., 0]
    return TouchedPlanes(points, normals, bends, mean, shape.std_factor**2 * spread.reshape(-1, 12, 12))


def touch(planes: TouchedPlanes, drawn: Float[Tensor, "b n 12"]) -> tuple[Float[Tensor, "b n 3 3"], ...]:
    """Return where the fingers meet the drawn planes, and the outward normals there; NaN where they look away."""
    value = drawn.unflatten(-1, (3, 4))
    gradient, normals = value[..., 1:], planes.normals[:, None]
    slope = (gradient * normals).sum(-1, keepdim=True)
    slope = torch.where(slope > 0, slope, torch.nan)
    motion = -value[..., :1] / slope
    return planes.points[:, None] + motion * normals, unit(gradient + motion * planes.bends[:, None])


def count_closed(planes: TouchedPlanes, friction: float, n: int, seed: int, prior: float) -> Float[Tensor, "b"]:
    """Draw planes at the contacts and count the draws that are closed."""
    values, vectors = torch.linalg.eigh(planes.covariance)
    if len(values) and not float(values.min()) >= -ROUNDING * prior:
        raise IndefiniteCovariance("the joint covariance", float(values.min()), "contacts within the domain")
    # The symmetric root: no choice of basis among equal eigenvalues changes a draw.
    root = (vectors * torch.where(values > 0, values, 0.0).sqrt()[:, None]) @ vectors.mT
    generator = torch.Generator().manual_seed(seed)
    count = planes.mean.new_zeros(len(planes))
    at_once = min(n, CHUNK)
    for start in range(0, n, at_once):
        standard = torch.randn(min(at_once, n - start), 12, dtype=torch.float64, generator=generator).to(root)
        for rows in torch.arange(len(planes), device=root.device).split(max(CHUNK // len(standard), 1)):
            drawn = planes.mean[rows, None] + standard @ root[rows]
            points, normals = touch(planes[rows], drawn)
            closed = closed_exact(points.flatten(0, 1), normals.flatten(0, 1), friction)
            count[rows] += closed.unflatten(0, drawn.shape[:2]).sum(1)
    return count
