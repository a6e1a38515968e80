"""The greatest margin of a balance, Eq. (13), for many grasps at once: a simplex method on a batch.

The programme max s: W phi = 0, sum phi = 1, phi >= s over m wrenches a_k with mean a has, with c_k = m (a - a_k), the
dual max a.v: c_k.v <= 1 in six unknowns, and s = 1/m - a.v. The c_k sum to zero, so that v = 0 is always allowed and
no start has to be sought. At the optimum a = sum lambda_k c_k with lambda >= 0 on six tight rows, and

    phi_k = s + m lambda_k  balances with margin s;      w = v has  w . a_k >= -s  for all k.

The second line proves itself, whoever found it: phi that no margin is needed below s, w that none above s exists.
Where s <= 0, w separates: it is a wrench on whose far side not one of the contacts can push.
"""

import torch
from jaxtyping import Float
from torch import Tensor

PIVOTS = 100
"""Most pivots of one grasp: six reach a vertex, and with 24 wrenches fewer than 30 more the optimum."""

OPTIMAL = 1e-12
"""Multipliers below this are zero: the objective grows no further."""

FIRST = 1e3
"""Added to the gain of what must leave the basis first, far above any multiplier."""

CHUNK = 2048
"""Grasps at a time: their tableaux stay in the cache."""


def solve_closure_lp(wrench: Float[Tensor, "b m 6"]) -> tuple[Float[Tensor, "b m"], Float[Tensor, "b 6"]]:
    """Return for each grasp a balance phi of the greatest margin and a unit wrench that bounds the margin from above.

    Both are candidates: rounding, a degenerate set of wrenches or too few pivots may spoil either, which `certify`
    checks. Where no phi balances at all, w.a_k is the same positive number for all k, and phi is meaningless.

    Args:
        wrench: the primitive wrenches, float64.
    """
    parts = [_solve(w) for w in wrench.split(CHUNK)]
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
    # The first six tight rows are v = 0 itself, which is no bound of the programme: they leave first, either way.
    tight = wrench.new_full((b, 6), -1).long()
    inverse = torch.eye(6, dtype=wrench.dtype, device=wrench.device).repeat(b, 1, 1)
    slack = wrench.new_ones(b, m)
    ray = wrench.new_zeros(b, 6)
    running = torch.ones_like(row, dtype=torch.bool)
    for _ in range(PIVOTS):
        multiplier = (mean[:, None] @ inverse)[:, 0]
        artificial = tight < 0
        # Leave along the edge on which the objective grows fastest; a multiplier of a bound may not be negative.
        gain = torch.where(artificial, multiplier.abs(), -multiplier)
        most, leaving = torch.where(artificial & (gain > OPTIMAL), gain + FIRST, gain).max(1)
        running = running & (most > OPTIMAL)
        if not bool(running.any()):
            break
        ahead = torch.where(artificial & (multiplier > 0), 1.0, -1.0)[row, leaving]
        edge = inverse[row, :, leaving]
        step = ahead[:, None] * edge
        rate = (bounds @ step[:, :, None])[:, :, 0]
        blocking = rate > 1e-11 * torch.linalg.vector_norm(step, dim=1, keepdim=True)
        blocking.scatter_(1, tight.clamp(min=0), blocking.gather(1, tight.clamp(min=0)) & artificial)
        length, entering = torch.where(blocking, slack / rate, torch.inf).min(1)
        free = running & torch.isinf(length)
        ray = torch.where(free[:, None], step, ray)
        running = running & ~free
        length = torch.where(running, length.clamp(min=0.0), 0.0)
        slack = slack - length[:, None] * rate
        normal = bounds[row, entering]
        turn = (normal[:, None] @ inverse)[:, 0]
        pivot = turn[row, leaving]
        turn[row, leaving] -= 1.0
        inverse = torch.where(
            running[:, None, None], inverse - (edge / pivot[:, None])[:, :, None] * turn[:, None], inverse
        )
        tight[row, leaving] = torch.where(running, entering, tight[row, leaving])
    # From the tight rows alone, so that the roundings of the pivots are gone.
    artificial = tight < 0
    index = tight.clamp(min=0)
    unused = torch.eye(6, dtype=wrench.dtype, device=wrench.device)
    basis = torch.where(artificial[:, :, None], unused, bounds.gather(1, index[:, :, None].expand(b, 6, 6)))
    vertex, _ = torch.linalg.solve_ex(basis, (~artificial).to(wrench))
    multiplier, _ = torch.linalg.solve_ex(basis.mT, mean)
    multiplier = torch.where(artificial, 0.0, multiplier)
    margin = 1 / m - multiplier.sum(1)
    phi = margin[:, None].expand(b, m).scatter_add(1, index, m * multiplier)
    witness = torch.where((ray != 0).any(1, keepdim=True), ray, vertex)
    return phi, witness / torch.linalg.vector_norm(witness, dim=1, keepdim=True)
