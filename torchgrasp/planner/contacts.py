"""The contact sets that the hand tries: planned, checked for force closure, and given initial hand postures."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import join
from torchgrasp.checks import Count, checked
from torchgrasp.errors import Status
from torchgrasp.geometry.linalg import farthest_points
from torchgrasp.ik.attempts import seed_costs
from torchgrasp.ik.ranking import rank_in_group
from torchgrasp.ik.seeds import nearest_postures, query_mixture
from torchgrasp.plan.certify import certify
from torchgrasp.planner.problem import Problem
from torchgrasp.posture_model.mixture import PAPER_ENERGY
from torchgrasp.success.loads import load_arm
from torchgrasp.values import Certificate, ContactPlan, Contacts, IKSeeds

LIKELY = 2
"""Farthest-point sampling takes n contact sets from the `LIKELY` * n sets with the lowest cost."""


class SeededContacts(NamedTuple):
    """Contact sets with force closure, their certificates, and initial hand postures (seeds) for each set."""

    contacts: Contacts
    certificate: Certificate
    seeds: IKSeeds

    def select(self, rows: Int[Tensor, "k"]) -> "SeededContacts":
        """Return the contact sets with given indices, with their certificates and initial hand postures (seeds)."""
        number = rows.new_full((len(self.contacts),), -1)
        number[rows] = torch.arange(len(rows), device=rows.device)
        seeds = self.seeds[number[self.seeds.row] >= 0]
        seeds = dataclasses.replace(seeds, row=number[seeds.row])
        return SeededContacts(self.contacts[rows], self.certificate[rows], seeds)


def join_seeded(parts: Sequence[SeededContacts]) -> SeededContacts:
    """Return several groups of contact sets as one group, in order."""
    first, seeds = 0, list[IKSeeds]()
    for part in parts:
        seeds.append(dataclasses.replace(part.seeds, row=part.seeds.row + first))
        first += len(part.contacts)
    return SeededContacts(join([x.contacts for x in parts]), join([x.certificate for x in parts]), join(seeds))


def find_contacts(problem: Problem, plan: ContactPlan, most: int, note: Callable[..., None]) -> SeededContacts:
    """Choose at most `most` planned contact sets, far apart; return those with force closure, and hand postures.

    In mode "paper" with ranking "variance" all sets are chosen, the most certain first. `note` is called with the
    results of the stages "plan", "certify" and "query".
    """
    request = problem.request
    note("plan", plan)
    if request.mode == "paper" and request.order == "variance":
        rows, variance = torch.nonzero(plan.status == Status.OK)[:, 0], plan.contacts.variance
        assert variance is not None
        rows = rows[torch.argsort(variance[rows].sum(1), stable=True)]
    else:
        rows = spread_rows(plan, most)
    contacts = plan.contacts[rows]
    certificate = certify(contacts, problem.spec)
    contacts, certificate = contacts[certificate.closed], certificate[certificate.closed]
    note("certify", certificate, offered=len(rows))
    seeds = find_seeds(problem, contacts)
    note("query", seeds)
    return SeededContacts(contacts, certificate, seeds)


@checked
def spread_rows(plan: ContactPlan, most: Count) -> Int[Tensor, "k"]:
    """Return the indices of at most `most` successful contact sets of a plan that lie far apart, in ascending order."""
    rows = torch.nonzero(plan.status == Status.OK)[:, 0]
    if len(rows) <= most:
        return rows
    first = int(plan.quality[rows].argmin())
    return rows[farthest_points(sorted_points(plan.contacts[rows]), most, first=first).sort().values]


def find_seeds(problem: Problem, contacts: Contacts) -> IKSeeds:
    """Return initial hand postures near contacts: in mode "joint" random postures, else those of the learned model."""
    if problem.mixture is None:
        return nearest_postures(problem.library, contacts, problem.world, reachable=problem.reachable)
    if problem.request.mode == "paper":
        return query_mixture(problem.hand, contacts, problem.mixture, n_seeds=1, max_energy=PAPER_ENERGY)
    return query_mixture(problem.hand, contacts, problem.mixture)


class Pool:
    """A store of the contact sets of all batches so far; each set is taken from it at most once."""

    def __init__(self) -> None:
        self.parts, self.costs, self.taken = list[SeededContacts](), list[Tensor](), list[Tensor]()

    def add(self, found: SeededContacts, cost: Float[Tensor, "n"]) -> None:
        """Add contact sets with their costs; the cost is infinite for a set without initial hand postures (seeds)."""
        self.parts.append(found)
        self.costs.append(cost)

    def take(self, most: int) -> SeededContacts:
        """Return at most `most` of the cheapest contact sets, far from each other and from those taken before."""
        found = join_seeded(self.parts)
        points = sorted_points(found.contacts)
        before = torch.cat(self.taken) if self.taken else points.new_zeros(0, dtype=torch.long)
        cost = torch.cat(self.costs).index_fill(0, before, torch.inf)
        likely = torch.argsort(cost, stable=True)[: min(LIKELY * most, int(torch.isfinite(cost).sum()))]
        rows = likely[farthest_points(points[likely], most, before=points[before])].sort().values
        self.taken.append(rows)
        return found.select(rows)


def contact_costs(problem: Problem, found: SeededContacts) -> Float[Tensor, "b"]:
    """Return one cost per contact set: large if its first two hand postures miss it, or the load has a long arm."""
    contacts, certificate, seeds = found
    first = seeds[rank_in_group(seeds.row) < 2]
    residual = seed_costs(problem.reach(contacts, certificate), first)
    least = torch.full((len(contacts),), torch.inf, dtype=residual.dtype, device=residual.device)
    least = least.scatter_reduce(0, first.row, residual, "amin")
    return least.clamp_min(1e-3).log() + 0.3 * (load_arm(contacts.points, problem.center) + 0.1).log()


def sorted_points(contacts: Contacts) -> Float[Tensor, "b d"]:
    """Return each contact set as one vector of 3 f coordinates, with its f contacts sorted by height z."""
    order = torch.argsort(contacts.points[..., 2], dim=1, stable=True)
    return contacts.points.gather(1, order[..., None].expand(-1, -1, 3)).flatten(1)
