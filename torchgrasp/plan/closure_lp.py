"""The greatest margin of a balance, Eq. (13), for many grasps at once: a simplex method on a batch.

Over m wrenches a_k with mean a, the programme is max s: W phi = 0, sum phi = 1, phi >= s. With c_k = m (a - a_k) its
dual is max a.v: c_k.v <= 1, in six unknowns, and s = 1/m - a.v. v = 0 is feasible, so no start has to be found. At the
optimum a = sum lambda_k c_k with lambda >= 0 on six tight rows. Then

    phi_k = s + m lambda_k  balances with margin s;      w = v has  w . a_k >= -s  for all k.

phi proves that the margin is at least s, w that it is at most s. Where s <= 0, no contact can push against w.
"""

import torch
from jaxtyping import Float
from torch import Tensor

PIVOTS = 100
"""Most pivots of one grasp: six reach a vertex, and with 24 wrenches fewer than 30 more reach the optimum."""
OPTIMAL = 1e-12
"""Multipliers below this are zero: the objective grows no further."""
ARTIFICIAL_GAIN = 1e3
"""Added to the gain of the artificial rows, far above any multiplier: they leave first."""
BLOCKING = 1e-11
"""A bound approached more slowly than this, for each unit of the step, is parallel to it."""
GRASPS_PER_CHUNK = 2048
"""Grasps at a time: their tableaux stay in the cache."""


def solve_closure_lp(wrench: Float[Tensor, "b m 6"]) -> tuple[Float[Tensor, "b m"], Float[Tensor, "b 6"]]:
    """Return the balance phi of the greatest margin of each grasp, and the unit witness of the margin.

    Rounding, degenerate wrenches or too few pivots may spoil either, so `certify` checks them. Where nothing balances,
    the witness opposes all wrenches alike, and phi is meaningless.

    Args:
        wrench: the primitive wrenches, float64.
    """
    parts = [_solve(w) for w in wrench.split(GRASPS_PER_CHUNK)]
    if not parts:
        return wrench.new_zeros(wrench.shape[:2]), wrench.new_zeros(len(wrench), 6)
    phi, witness = (torch.cat(part) for part in zip(*parts, strict=True))
    return phi, witness


def _solve(wrench: Float[Tensor, "b m 6"]) -> tuple[Float[Tensor, "b m"], Float[Tensor, "b 6"]]:
    """Pivot all grasps until the last one is at its optimum."""
    b, m, _ = wrench.shape
    row = torch.arange(b, device=wrench.device)
    mean = wrench.mean(1)
    bounds = m * (mean[:, None] - wrench)
    # The first six tight rows are artificial, v = 0 itself: they leave first, in either direction.
    tight = wrench.new_full((b, 6), -1).long()
    inverse = torch.eye(6, dtype=wrench.dtype, device=wrench.device).repeat(b, 1, 1)
    slack = wrench.new_ones(b, m)
    ray = wrench.new_zeros(b, 6)
    running = torch.ones_like(row, dtype=torch.bool)
    for _ in range(PIVOTS):
        multiplier = (mean[:, None] @ inverse)[:, 0]
        artificial = tight < 0
        # Leave along the edge on which the objective grows fastest; the multiplier of a bound may not be negative.
        gain = torch.where(artificial, multiplier.abs(), -multiplier)
        most, leaving = torch.where(artificial & (gain > OPTIMAL), gain + ARTIFICIAL_GAIN, gain).max(1)
        running = running & (most > OPTIMAL)
        if not bool(running.any()):
            break
        sign = torch.where(artificial & (multiplier > 0), 1.0, -1.0)[row, leaving]
        edge = inverse[row, :, leaving]
        step = sign[:, None] * edge
        rate = (bounds @ step[:, :, None])[:, :, 0]
        blocking = rate > BLOCKING * torch.linalg.vector_norm(step, dim=1, keepdim=True)
        blocking.scatter_(1, tight.clamp(min=0), blocking.gather(1, tight.clamp(min=0)) & artificial)
        length, entering = torch.where(blocking, slack / rate, torch.inf).min(1)
        unbounded = running & torch.isinf(length)
        ray = torch.where(unbounded[:, None], step, ray)
        running = running & ~unbounded
        length = torch.where(running, length.clamp(min=0.0), 0.0)
        slack = slack - length[:, None] * rate
        normal = bounds[row, entering]
        change = (normal[:, None] @ inverse)[:, 0]
        pivot = change[row, leaving]
        change[row, leaving] -= 1.0
        updated = inverse - (edge / pivot[:, None])[:, :, None] * change[:, None]
        inverse = torch.where(running[:, None, None], updated, inverse)
        tight[row, leaving] = torch.where(running, entering, tight[row, leaving])
    # From the tight rows alone, so that the roundings of the pivots are gone.
    artificial = tight < 0
    index = tight.clamp(min=0)
    identity = torch.eye(6, dtype=wrench.dtype, device=wrench.device)
    basis = torch.where(artificial[:, :, None], identity, bounds.gather(1, index[:, :, None].expand(b, 6, 6)))
    vertex, _ = torch.linalg.solve_ex(basis, (~artificial).to(wrench))
    multiplier, _ = torch.linalg.solve_ex(basis.mT, mean)
    multiplier = torch.where(artificial, 0.0, multiplier)
    margin = 1 / m - multiplier.sum(1)
    phi = margin[:, None].expand(b, m).scatter_add(1, index, m * multiplier)
    witness = torch.where((ray != 0).any(1, keepdim=True), ray, vertex)
    return phi, witness / torch.linalg.vector_norm(witness, dim=1, keepdim=True)
