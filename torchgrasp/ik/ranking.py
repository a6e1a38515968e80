"""The order of candidates: a geometric score that chooses among the candidates of one contact set."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.geometry.linalg import unit
from torchgrasp.values import Contacts


def lexical_order(*keys: Tensor) -> Int[Tensor, "g"]:
    """Return the indices that sort rows ascending by the first key; ties are sorted by the next key."""
    order = torch.argsort(keys[-1], stable=True)
    for key in reversed(keys[:-1]):
        order = order[torch.argsort(key[order], stable=True)]
    return order


def rank_in_group(group: Int[Tensor, "g"], *keys: Tensor) -> Int[Tensor, "g"]:
    """Return the rank (from 0) of each row in its group, sorted ascending by the first key, ties by the next key."""
    order = lexical_order(group, *keys)
    grouped = group[order].contiguous()
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order), device=order.device) - torch.searchsorted(grouped, grouped)
    return rank


def centred_friction(contacts: Contacts) -> Float[Tensor, "g"]:
    """Return the friction coefficient that each contact set needs if all forces point to the contacts' centroid."""
    inward = unit(contacts.points.mean(1, keepdim=True) - contacts.points)
    cosine = -(inward * contacts.normals).sum(-1)
    sine = torch.linalg.vector_norm(torch.linalg.cross(inward, contacts.normals), dim=-1)
    return (sine / cosine.clamp_min(1e-3)).amax(1)


def score(contacts: Contacts, normal_angle: Float[Tensor, "g f"], center: Float[Tensor, "*g 3"]) -> Float[Tensor, "g"]:
    """Return the geometric score of each grasp, at most 0; a higher score is better.

    Three things lower it: the contacts' distance from `center` [m], the friction needed, and the angle off the pads.
    """
    offset = torch.linalg.vector_norm(contacts.points.mean(1) - center, dim=-1)
    return -(offset / 0.02 + centred_friction(contacts) + normal_angle.amax(1) / 0.8)
