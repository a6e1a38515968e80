"""Whether contacts satisfy the problem, however they were found."""

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchgrasp.errors import Status
from torchgrasp.geometry.frames import degenerate
from torchgrasp.plan.closure_lp import solve_closure_lp
from torchgrasp.plan.flatness import normal_variation
from torchgrasp.plan.problem import ContactProblem, Shape, triple_jet
from torchgrasp.plan.wrench import BALANCED, MIN_MARGIN, MIN_RANK_RATIO, Vectors, rank_ratio, wrenches
from torchgrasp.shape.values import surface_deviation
from torchgrasp.specs import ContactSpec
from torchgrasp.values import ContactPlan, Contacts

ON_SURFACE = 1e-6
"""Largest |f_d| of a contact on the surface, normalised: 0.1 um on a hand-sized object, far above rounding."""


def check_feasibility(shape: Shape, spec: ContactSpec, points: Vectors) -> ContactPlan:
    """Evaluate contacts at normalised `points` against every constraint."""
    jet = triple_jet(shape, points)
    normals, metres = jet.normals, shape.metres(points)
    wrench = wrenches(points, normals, spec.planned_friction, spec.edges)
    finite = torch.isfinite(wrench).flatten(1).all(1)
    wrench = torch.where(finite[:, None, None, None], wrench, 0.0)
    flat = wrench.flatten(1, 2)
    coefficients, _ = solve_closure_lp(flat)
    residual = (coefficients[:, None] @ flat)[:, 0].abs().amax(-1)
    closed = finite & (residual <= BALANCED) & (coefficients.amin(-1) >= MIN_MARGIN)
    closed &= rank_ratio(wrench) >= MIN_RANK_RATIO  # 0 / 0 of a row that is not finite is False

    problem = ContactProblem.of(shape, spec)
    apart = torch.linalg.vector_norm(problem.sides(points, normals), dim=-1).amin(-1) * shape.scale
    room = problem.room(points, normals)
    good = {
        Status.OUT_OF_DOMAIN: (torch.linalg.vector_norm(points, dim=-1) <= shape.domain_radius).all(-1),
        Status.OFF_SURFACE: (jet.distance.abs() <= ON_SURFACE).all(-1),
        Status.TOO_UNCERTAIN: ((jet.variance >= 0) & (jet.variance < spec.max_variance)).all(-1),
        Status.BELOW_TABLE: (room >= 0).all(-1),
        Status.TOO_CLOSE: apart >= spec.least_separation,
        Status.DEGENERATE: ~degenerate(points),
    }
    if spec.flatness is not None:
        # A ring costs eight evaluations a contact, so it is measured only where nothing has failed before.
        rows = torch.nonzero(torch.stack(list(good.values())).all(0))[:, 0]
        flat_rows = normal_variation(shape, points[rows], normals[rows], spec.ring_radius).amax(-1) <= spec.flatness
        good[Status.NOT_FLAT] = torch.ones_like(closed).index_put((rows,), flat_rows)
    good[Status.NOT_CLOSED] = closed
    std_m = shape.std_factor * shape.scale * surface_deviation(jet.variance, jet.gradient)
    return ContactPlan(
        Contacts(metres, normals, jet.variance, std_m),
        coefficients.unflatten(1, wrench.shape[1:3]),
        torch.linalg.vector_norm(points.mean(1), dim=-1) * shape.scale,
        first_violation(good),
    )


def first_violation(good: dict[Status, Bool[Tensor, "b"]]) -> Int[Tensor, "b"]:
    """Return the first status whose condition a row does not meet, in the dictionary's order; else OK."""
    met = torch.stack(list(good.values()))
    codes = torch.tensor([*good, Status.OK], device=met.device)
    return codes[torch.where(met.all(0), len(good), (~met).to(torch.uint8).argmax(0))]
