"""The probability that planned contacts are closed on the real surface.

Fingers come along the planned normals and stop on a surface drawn from the posterior (`line_posterior`). The draw
counts if the touched points are closed for round cones.
"""

import dataclasses
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Batch
from torchgrasp.checks import FINITE, Range, Seed, checked
from torchgrasp.plan.line_posterior import LinePosterior, first_contact, line_posterior, well_inside
from torchgrasp.plan.round_cones import closed_exact, first_balance
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.specs import ContactSpec
from torchgrasp.threads import single_threaded
from torchgrasp.values import Contacts

DRAWS_PER_CHUNK = 8192
"""Drawn rows that are judged at a time: their tensors take about 20 MB."""
GPU_DRAWS = 2**18
"""The same on a GPU, which fewer leave idle: about 700 MB (`scripts/bench.py gpu`)."""


@checked
@dataclasses.dataclass(frozen=True)
class ClosureProbability(Batch):
    """The `probability` that the contacts of each row are closed, with its `standard_error`.

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
    """Return how probable closure is on the uncertain surface, by Monte Carlo.

    All rows share the draws, and no row depends on another.

    Args:
        shape: the posterior.
        contacts: three to five a row [m], of any planner, with outward unit normals, inside the domain of the shape. A
            finger that meets no surface within 12 standard deviations of its contact does not close.
        spec: its `friction` counts, that of execution, not `planned_friction`.
        n: number of draws. The standard error is at most 1 / (2 sqrt(n)): 0.01 for 2500. It is that of
            (k + 1) / (n + 2) for k closed draws, and so never 0.
        seed: of the draws.

    Raises:
        BadArgument: a wrong argument, or a contact that is not finite or outside the shape's domain.

    >>> from torchgrasp.geometry.linalg import unit
    >>> from torchgrasp import PointCloud, fit_shape
    >>> ball = unit(torch.randn(400, 3, generator=torch.Generator().manual_seed(0)))
    >>> corners = torch.tensor([[[1.0, 0, 0], [-0.6, 0.8, 0], [-0.6, -0.8, 0]]])
    >>> contacts = Contacts(0.04 * corners, corners)
    >>> closure_probability(fit_shape(PointCloud(0.04 * ball, ball)), contacts).probability > 0.9
    tensor([True])
    """
    spec = ContactSpec() if spec is None else spec
    share = closed_share(line_posterior(shape, contacts), spec.friction, n, seed)
    middle = (n * share + 1) / (n + 2)
    return ClosureProbability(share, torch.sqrt(middle * (1 - middle) / n))


def closure_share(shape: ShapeGP, contacts: Contacts, friction: float, n: int, seed: int) -> Float[Tensor, "b"]:
    """Return the share of n draws that are closed; 0 at the edge of the domain."""
    inside = well_inside(shape, contacts)
    share = contacts.points.new_zeros(len(contacts))
    share[inside] = closed_share(line_posterior(shape, contacts[inside]), friction, n, seed).to(share)
    return share


def closed_share(lines: LinePosterior, friction: float, n: int, seed: int) -> Float[Tensor, "b"]:
    """Return the share of n drawn surfaces on which the fingers' contacts are closed."""
    generator = torch.Generator().manual_seed(seed)
    count = lines.points.new_zeros(len(lines))
    guess = None if lines.points.shape[1] == 3 else first_balance(lines.points, lines.normals, friction)
    at_once, judged = min(n, DRAWS_PER_CHUNK), DRAWS_PER_CHUNK if count.device.type == "cpu" else GPU_DRAWS
    for start in range(0, n, at_once):
        standard = torch.randn(min(at_once, n - start), lines.root.shape[-1], dtype=torch.float64, generator=generator)
        for rows in torch.arange(len(lines), device=count.device).split(max(judged // len(standard), 1)):
            points, normals = first_contact(lines[rows], standard.to(count) @ lines.root[rows])
            balance = None if guess is None else guess[rows].repeat_interleave(len(standard), 0)
            closed = closed_exact(points.flatten(0, 1), normals.flatten(0, 1), friction, balance)
            count[rows] += closed.unflatten(0, points.shape[:2]).sum(1)
    return count / n
