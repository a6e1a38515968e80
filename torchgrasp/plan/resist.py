"""The greatest multiple of a task's wrench that contacts resist, with a proof by linear programming duality.

A contact pushes with at most its strength b_i along the edges of its friction cone. K holds the wrenches of all such
forces; -t is the wrench that balances the load t. The greatest s with -s t in K is the least value of

    sum_i b_i max(0, max_k y.w_ik)    among the twists y with y.t = -1,

so each such y proves that s is no greater. K has too many corners to list, (e + 1)^f. The simplex method maximises -t.y
with p.y <= 1 for some corners p of K; while a corner breaks its bound, the corner that breaks it most joins them.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.plan.closure import BALANCED, GRASPS_PER_CHUNK, Vectors, centre_and_radius, maximise, wrenches
from torchgrasp.specs import ContactSpec


class Resisted(NamedTuple):
    """For each grasp the multiple s of its worst load t, t and y about the contacts' centroid, and forces for -s t."""

    margin: Float[Tensor, "b"]
    load: Float[Tensor, "b 6"]
    twist: Float[Tensor, "b 6"]
    forces: Vectors


def resist_loads(
    points: Vectors, normals: Vectors, strength: Float[Tensor, "b f"], loads: Float[Tensor, "b w 6"], spec: ContactSpec
) -> Resisted:
    """Return how much of the worst of w loads (force, then torque about the origin) contacts resist.

    `strength` is the greatest normal force [N] of each contact; cones are those of `certify`.
    """
    count = loads.shape[1]
    centre, radius = centre_and_radius(points)
    force, torque = loads.split(3, -1)
    about = torch.cat([force, torque - torch.linalg.cross(centre.expand_as(force), force)], -1)
    unit = torch.cat([torch.ones_like(radius), radius], 1).repeat_interleave(3, 1).mT  # of wrenches in Eq. (13)
    edge = strength[..., None, None] * wrenches(points, normals, spec.planned_friction, spec.edges)
    edge = torch.cat([edge, torch.zeros_like(edge[:, :, :1])], 2)  # the last is no push
    goal = (-about / unit).flatten(0, 1)
    rows = torch.arange(len(goal), device=goal.device).split(GRASPS_PER_CHUNK)
    found = [_solve(edge[row // count], goal[row]) for row in rows]
    margin, twist, forces = map(torch.cat, zip(*found, strict=True))
    worst = margin.view(-1, count).argmin(1)
    row = torch.arange(len(points), device=worst.device) * count + worst
    return Resisted(margin[row], about.flatten(0, 1)[row], twist[row] / unit[:, 0], forces[row])


def _solve(edge: Float[Tensor, "r f e 6"], goal: Float[Tensor, "r 6"]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the greatest multiple of each wrench `goal` that forces along the edges make, with twist and forces."""
    _, f, e, _ = edge.shape
    margin, twist, forces = goal.new_zeros(len(goal)), torch.zeros_like(goal), goal.new_zeros(len(goal), f, 3)
    single = torch.arange(f * (e - 1), device=goal.device)
    choice = torch.full((len(single), f), e - 1, device=goal.device)  # the edge along which each contact pushes
    choice[single, single // (e - 1)] = single % (e - 1)
    choice, left = choice.expand(len(goal), -1, -1), torch.arange(len(goal), device=goal.device)
    for _ in range(60):  # far more rounds than five contacts need
        own = edge[left]
        corner = own.gather(2, choice.mT[..., None].expand(-1, -1, -1, 6))
        y, tight, weight = maximise(goal[left], corner.sum(1))
        part = corner.gather(2, tight[:, None, :, None].expand(-1, f, -1, 6))
        made, gauge = (weight[:, None, :, None] * part).sum(2), weight.sum(1)
        exact = ((made.sum(1) - goal[left]).abs().amax(1) <= BALANCED) & (weight.amin(1) >= -BALANCED) & (gauge > 0)
        push, best = (own @ y[:, None, :, None])[..., 0].max(2)
        along = (goal[left] * y).sum(1)
        lower = torch.where(exact, 1 / gauge, 0.0)
        margin[left], twist[left] = lower, y / along[:, None]
        forces[left] = made[..., :3] * lower[:, None, None]
        broken = torch.nonzero(push.sum(1) / along - lower > BALANCED * (1 + lower))[:, 0]
        if not len(broken):
            break
        left, choice = left[broken], torch.cat([choice[broken], best[broken, None]], 1)
    return margin, twist, forces
