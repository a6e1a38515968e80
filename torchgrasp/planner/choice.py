"""Which contacts the hand tries first: those that a posture nearly fits, near the object's centre, far apart."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import join
from torchgrasp.geometry.linalg import farthest_points
from torchgrasp.values import Certificate, Contacts, IKSeeds

LIKELY = 2
"""Rows of the least cost of which the farthest apart are tried, for each that is tried. With 1 three in a hundred more
are executable, but the best 20 lie 16 mm apart in place of 18 (27 without costs)."""


class Offer(NamedTuple):
    """Closed contacts, their certificates, and seeds of the hand on them."""

    contacts: Contacts
    certificate: Certificate
    seeds: IKSeeds

    def select(self, rows: Int[Tensor, "k"]) -> "Offer":
        """Return some of the contacts, with their seeds."""
        number = rows.new_full((len(self.contacts),), -1)
        number[rows] = torch.arange(len(rows), device=rows.device)
        seeds = self.seeds[number[self.seeds.row] >= 0]
        return Offer(self.contacts[rows], self.certificate[rows], dataclasses.replace(seeds, row=number[seeds.row]))


def join_offers(offers: Sequence[Offer]) -> Offer:
    """Return the contacts of all offers, one after the other."""
    first, seeds = 0, list[IKSeeds]()
    for offer in offers:
        seeds.append(dataclasses.replace(offer.seeds, row=offer.seeds.row + first))
        first += len(offer.contacts)
    return Offer(join([x.contacts for x in offers]), join([x.certificate for x in offers]), join(seeds))


class Untried:
    """The offers of all waves so far; each row of contacts is taken once."""

    def __init__(self) -> None:
        self.offers = list[Offer]()
        self.costs = list[Tensor]()
        self.taken = list[Tensor]()

    def add(self, offer: Offer, cost: Float[Tensor, "n"]) -> None:
        """Add an offer with the costs of trying its rows, infinite where there is no seed."""
        self.offers.append(offer)
        self.costs.append(cost)

    def take(self, most: int) -> Offer:
        """Return at most so many of the rows that cost least, far from each other and from those taken before."""
        offer = join_offers(self.offers)
        points = sorted_points(offer.contacts)
        before = torch.cat(self.taken) if self.taken else points.new_zeros(0, dtype=torch.long)
        cost = torch.cat(self.costs).index_fill(0, before, torch.inf)
        likely = torch.argsort(cost, stable=True)[: min(LIKELY * most, int(torch.isfinite(cost).sum()))]
        rows = likely[farthest_points(points[likely], most, before=points[before])].sort().values
        self.taken.append(rows)
        return offer.select(rows)


def sorted_points(contacts: Contacts) -> Float[Tensor, "b d"]:
    """Return the contacts' coordinates, the lowest contact first: in another order they are the same."""
    order = torch.argsort(contacts.points[..., 2], dim=1, stable=True)
    return contacts.points.gather(1, order[..., None].expand(-1, -1, 3)).flatten(1)
