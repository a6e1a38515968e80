"""The contact sets that the hand tries: planned, checked for force closure, and given initial hand
postures.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.contacts.certify import certify
from torchgrasp.contacts.resist import resist_loads
from torchgrasp.foundation.base import join, lexical_order, rank_in_group
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.rules import Count
from torchgrasp.geometry.linalg import farthest_points
from torchgrasp.ik.attempts import assign, seed_costs
from torchgrasp.ik.seeds import nearest_postures, query_mixture
from torchgrasp.planner.stack import Owner, Stack, by_cloud
from torchgrasp.posture_model.mixture import PAPER_ENERGY
from torchgrasp.success.loads import lever_arm, strength_of
from torchgrasp.values.planning import Certificate, ContactPlan, Contacts, IKSeeds

LIKELY = 2
"""Farthest-point sampling takes n contact sets from the `LIKELY` * n sets with the lowest cost."""
WEAK = 1e6  # cost of contact sets that resist less than the task's loads: above all other costs


class SeededContacts(NamedTuple):
    """Contact sets with force closure, their certificates, initial hand postures (seeds), and
    clouds.

    `load` is the wrench [N, N m] of the task, about the centroid, of which the greatest forces
    resist the least.
    """

    contacts: Contacts
    certificate: Certificate
    seeds: IKSeeds
    owner: Owner
    load: Float[Tensor, "b 6"]

    def select(self, rows: Int[Tensor, "k"]) -> "SeededContacts":
        """Return the contact sets with given indices, with their certificates and initial hand
        postures (seeds).
        """
        number = rows.new_full((len(self.contacts),), -1)
        number[rows] = torch.arange(len(rows), device=rows.device)
        seeds = self.seeds[number[self.seeds.row] >= 0]
        seeds = dataclasses.replace(seeds, row=number[seeds.row])
        contacts = self.contacts[rows]
        certificate = self.certificate[rows]
        return SeededContacts(contacts, certificate, seeds, self.owner[rows], self.load[rows])


def join_seeded(parts: Sequence[SeededContacts]) -> SeededContacts:
    """Return several groups of contact sets as one group, in order."""
    first = 0
    seeds = list[IKSeeds]()
    for part in parts:
        seeds.append(dataclasses.replace(part.seeds, row=part.seeds.row + first))
        first += len(part.contacts)
    contacts = join([x.contacts for x in parts])
    certificate = join([x.certificate for x in parts])
    owner = torch.cat([x.owner for x in parts])
    load = torch.cat([x.load for x in parts])
    return SeededContacts(contacts, certificate, join(seeds), owner, load)


def find_contacts(
    stack: Stack, plan: ContactPlan, owner: Owner, most: int, note: Callable[..., None]
) -> SeededContacts:
    """Choose at most `most` planned contact sets of each cloud, far apart; return the closed ones,
    and hand postures.

    In mode "paper" with ranking "variance" all sets are chosen, the most certain first. `note` is
    called with the results of the stages "plan", "certify" and "query". Sets that not even the
    greatest forces could hold have failed.
    """
    request = stack.first.request
    load = plan.contacts.points.new_zeros(len(plan), 6)
    if stack.loads is not None:
        rows = torch.nonzero(plan.status == Status.OK)[:, 0]
        points = plan.contacts.points[rows]
        normals = plan.contacts.normals[rows]
        full = torch.full_like(points[..., 0], stack.strongest)
        proof = resist_loads(points, normals, full, stack.loads[owner[rows]], stack.first.spec)
        status = plan.status.index_fill(0, rows[~(proof.margin >= 1)], int(Status.NOT_RESISTED))
        plan = dataclasses.replace(plan, status=status)
        load[rows] = proof.load
    note("plan", plan)
    if request.mode == "paper" and request.order == "variance":
        rows = torch.nonzero(plan.status == Status.OK)[:, 0]
        variance = plan.contacts.variance
        assert variance is not None
        rows = rows[torch.argsort(variance[rows].sum(1), stable=True)]
    else:
        rows = _spread(stack, plan, owner, most)
    certificate = certify(plan.contacts[rows], stack.first.spec)
    closed = torch.nonzero(certificate.closed)[:, 0]
    certificate = certificate[closed]
    kept = rows[closed]
    contacts = plan.contacts[kept]
    owner = owner[kept]
    note("certify", certificate, offered=len(rows))
    seeds = find_seeds(stack, contacts, owner)
    note("query", seeds)
    return SeededContacts(contacts, certificate, seeds, owner, load[kept])


def _spread(stack: Stack, plan: ContactPlan, owner: Owner, most: int) -> Int[Tensor, "k"]:
    """Return the indices of at most `most` successful contact sets of each cloud that lie far
    apart.
    """
    if len(stack) == 1:
        return spread_rows(plan, most)
    solved = torch.nonzero(plan.status == Status.OK)[:, 0]
    clouds = by_cloud(owner[solved], len(stack))
    if max(map(len, clouds)) > most:
        plan = plan[solved].to("cpu")
        solved = solved.cpu()
        clouds = [own[spread_rows(plan[own], most)] for own in clouds]
    return solved[torch.cat(clouds).to(solved.device)].to(owner.device)


@checked
def spread_rows(plan: ContactPlan, most: Count) -> Int[Tensor, "k"]:
    """Return the indices of at most `most` successful contact sets of a plan that lie far apart, in
    ascending order.
    """
    rows = torch.nonzero(plan.status == Status.OK)[:, 0]
    if len(rows) <= most:
        return rows
    first = int(plan.quality[rows].argmin())
    return rows[
        farthest_points(sorted_points(plan.contacts[rows]), most, first=first).sort().values
    ]


def find_seeds(stack: Stack, contacts: Contacts, owner: Owner) -> IKSeeds:
    """Return initial hand postures near contacts: in mode "joint" random postures, else those of
    the learned model.
    """
    problem = stack.first
    if problem.mixture is None:
        return nearest_postures(
            stack.library, contacts, stack.world.rows(owner), reachable=problem.reachable
        )
    if problem.request.mode == "paper":
        return query_mixture(
            stack.hand, contacts, problem.mixture, n_seeds=1, max_energy=PAPER_ENERGY
        )
    return query_mixture(stack.hand, contacts, problem.mixture)


class Pool:
    """A store of the contact sets of all batches so far; each set is taken from it at most once."""

    def __init__(self, clouds: int) -> None:
        self.clouds = clouds
        self.parts = list[SeededContacts]()
        self.costs = list[Tensor]()
        self.taken = list[Tensor]()

    def add(self, found: SeededContacts, cost: Float[Tensor, "n"]) -> None:
        """Add contact sets with their costs; the cost is infinite for a set without initial hand
        postures (seeds).
        """
        self.parts.append(found)
        self.costs.append(cost)

    def take(self, most: int) -> SeededContacts:
        """Return at most `most` of each cloud's cheapest contact sets, far from each other and from
        earlier ones.
        """
        found = join_seeded(self.parts)
        points = sorted_points(found.contacts)
        owner = found.owner
        before = torch.cat(self.taken) if self.taken else owner[:0]
        cost = torch.cat(self.costs).index_fill(0, before, torch.inf)
        if self.clouds > 1:
            rows = _choose_of_each(points, cost, owner, before, most, self.clouds)
        else:
            likely = torch.argsort(cost, stable=True)[: LIKELY * most]
            likely = likely[_are_likely(cost[likely], most)]
            rows = (
                likely[farthest_points(points[likely], most, before=points[before])].sort().values
            )
        self.taken.append(rows)
        return found.select(rows)


def _choose_of_each(
    points: Float[Tensor, "n d"],
    cost: Float[Tensor, "n"],
    owner: Owner,
    before: Tensor,
    most: int,
    clouds: int,
) -> Int[Tensor, "k"]:
    """Return for each of several clouds at most `most` of its cheapest contact sets, far from each
    other and `before`.

    Farthest-point sampling runs for all clouds at once, on their device.
    """
    if not len(owner):
        return owner
    table, held = _table(owner, clouds)
    least, order = torch.where(held, cost[table], torch.inf).sort(dim=1, stable=True)
    rows = table.gather(1, order)[:, : LIKELY * most]
    likely = _are_likely(least[:, : LIKELY * most], most)
    x = points[rows]
    nearest = torch.full_like(likely, torch.inf, dtype=x.dtype)
    if len(before):
        earlier, held = _table(owner[before], clouds)
        gaps = (x[:, :, None] - points[before[earlier]][:, None]).square().sum(-1)
        nearest = torch.where(held[:, None], gaps, torch.inf).amin(2)
    picks = list[Tensor]()
    for _ in range(min(most, rows.shape[1])):
        picks.append(
            torch.where(likely, nearest, -1.0).argmax(1, keepdim=True)
        )  # the first of the largest
        one = x.gather(1, picks[-1][..., None].expand(-1, -1, x.shape[2]))
        nearest = torch.minimum(nearest, (x - one).square().sum(-1))
    chosen = rows.gather(1, torch.cat(picks, 1))
    known = torch.arange(chosen.shape[1], device=rows.device) < likely.sum(1, keepdim=True)
    chosen = torch.where(known, chosen, len(owner)).sort(1).values.flatten()
    return chosen[torch.nonzero(chosen < len(owner))[:, 0]]


def _are_likely(cost: Float[Tensor, "*c m"], most: int) -> Bool[Tensor, "*c m"]:
    """Return for sorted costs a mask of sets to choose from: beyond the first `most` only those
    that resist loads.
    """
    return torch.isfinite(cost) & (
        (cost < WEAK) | (torch.arange(cost.shape[-1], device=cost.device) < most)
    )


def _table(owner: Owner, clouds: int) -> tuple[Int[Tensor, "c m"], Bool[Tensor, "c m"]]:
    """Return the indices of the rows of each cloud, in their order, and a mask of the places that
    hold one.
    """
    count = torch.bincount(owner, minlength=clouds)
    table = owner.new_zeros(clouds, int(count.max()))
    table[owner, rank_in_group(owner)] = torch.arange(len(owner), device=owner.device)
    return table, torch.arange(table.shape[1], device=owner.device) < count[:, None]


def contact_costs(stack: Stack, found: SeededContacts) -> tuple[SeededContacts, Float[Tensor, "b"]]:
    """Return one cost per contact set: large if its first two hand postures miss it, or the load
    has a long arm.

    If grasps must resist loads, the seeds in which the fingers resist the most come first, and sets
    without a seed that resists all loads cost more than all other sets.
    """
    contacts, certificate, seeds, owner, load = found
    weak = torch.zeros_like(certificate.margin)
    if stack.loads is not None:
        touched = assign(contacts, seeds)
        strength = strength_of(stack.hand, seeds, touched, stack.strongest)
        arms = touched.points - touched.points.mean(1, keepdim=True)
        load = load[seeds.row, None]
        share = resist_loads(arms, touched.normals, strength, load, stack.first.spec).margin.clamp(
            max=1
        )
        weak = weak.scatter_reduce(0, seeds.row, share, "amax")
        weak = torch.where(weak < 1, WEAK * (2 - weak), 0.0)
        seeds = seeds[lexical_order(seeds.row, -share)]
    first = seeds[rank_in_group(seeds.row) < 2]
    residual = seed_costs(stack.reach(contacts, certificate, owner), first)
    least = torch.full((len(contacts),), torch.inf, dtype=residual.dtype, device=residual.device)
    least = least.scatter_reduce(0, first.row, residual, "amin")
    arm = lever_arm(contacts.points, stack.body.rows(owner).center)
    return found._replace(seeds=seeds), least.clamp_min(1e-3).log() + 0.3 * (arm + 0.1).log() + weak


def sorted_points(contacts: Contacts) -> Float[Tensor, "b d"]:
    """Return each contact set as one vector of 3 f coordinates, with its f contacts sorted by
    height z.
    """
    order = torch.argsort(contacts.points[..., 2], dim=1, stable=True)
    return contacts.points.gather(1, order[..., None].expand(-1, -1, 3)).flatten(1)
