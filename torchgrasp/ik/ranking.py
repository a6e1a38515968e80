"""Which grasp to try first: a geometric score of candidates, a predicted probability of success of grasps.

`score` chooses among the candidates of a triple, a logistic model orders the executable grasps (docs/closing.md).
`scripts/train.py success` fits it to trials of the Allegro hand; it is not calibrated for other hands.
"""

import dataclasses
import json
import math
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.errors import BadArgument, Status
from torchgrasp.linalg import unit
from torchgrasp.plan.internal_forces import least_friction_forces, tangential_ratio
from torchgrasp.values import Contacts, Grasps

OFFSET, PAD_ANGLE = 0.02, 0.8
"""Offset [m] of the contacts' centre, and angle [rad] between contact direction and pad, that cost a point: choices."""
FEATURES = (
    "log-odds of closure",
    "offset of the contacts' centre over 20 mm",
    "least friction angle of a balance over that of friction",
    "friction angle of forces to the contacts' centre over that of friction",
    "mean angle of the pads",
)
"""What the model of success knows of a grasp, in this order."""
MODEL = Path(__file__).with_name("success.json")
"""Weights and bias of the model, and what they were fitted on."""


def lexical_order(*keys: Tensor) -> Int[Tensor, "g"]:
    """Return the order of rows by the first key, ties by the next.

    >>> lexical_order(torch.tensor([1, 0, 1]), torch.tensor([2.0, 3.0, 1.0]))
    tensor([1, 2, 0])
    """
    order = torch.argsort(keys[-1], stable=True)
    for key in reversed(keys[:-1]):
        order = order[torch.argsort(key[order], stable=True)]
    return order


def rank_in_group(group: Int[Tensor, "g"], *keys: Tensor) -> Int[Tensor, "g"]:
    """Return the rank of each row within its group, by `lexical_order` of the keys.

    >>> rank_in_group(torch.tensor([0, 1, 1, 1]), torch.tensor([1.0, 3.0, 2.0, 0.0]))
    tensor([0, 2, 1, 0])
    """
    order = lexical_order(group, *keys)
    grouped = group[order].contiguous()
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order), device=order.device) - torch.searchsorted(grouped, grouped)
    return rank


def centred_friction(contacts: Contacts) -> Float[Tensor, "g"]:
    """Return the largest tangent between an inward normal and the line to the contacts' centre."""
    inward = unit(contacts.points.mean(1, keepdim=True) - contacts.points)
    cosine = -(inward * contacts.normals).sum(-1)
    sine = torch.linalg.vector_norm(torch.linalg.cross(inward, contacts.normals), dim=-1)
    return (sine / cosine.clamp_min(1e-3)).amax(1)


def score(contacts: Contacts, normal_angle: Float[Tensor, "g 3"], center: Float[Tensor, "3"]) -> Float[Tensor, "g"]:
    """Return scores: central contacts, little friction and central pads are better."""
    offset = torch.linalg.vector_norm(contacts.points.mean(1) - center, dim=-1)
    return -(offset / OFFSET + centred_friction(contacts) + normal_angle.amax(1) / PAD_ANGLE)


def success_features(
    contacts: Contacts,
    closure: Float[Tensor, "g"],
    normal_angle: Float[Tensor, "g 3"],
    center: Float[Tensor, "3"],
    friction: float,
) -> Float[Tensor, "g 5"]:
    """Return `FEATURES` of each grasp at a trial's friction, at which `closure` is the probability of closure."""
    offset = torch.linalg.vector_norm(contacts.points.mean(1) - center, dim=-1) / OFFSET
    least = tangential_ratio(least_friction_forces(contacts.points, contacts.normals), contacts.normals).amax(-1)
    angles = torch.atan(torch.stack([least, centred_friction(contacts)], dim=-1)) / math.atan(friction)
    odds = torch.logit(closure.to(offset), eps=1e-3)  # the resolution of `closure`
    return torch.cat([odds[:, None], offset[:, None], angles, normal_angle.mean(1, keepdim=True)], dim=-1)


def success_log_odds(features: Float[Tensor, "g 5"]) -> Float[Tensor, "g"]:
    """Return the log-odds of success, log p / (1 - p).

    >>> good, bad = torch.tensor([[6.9, 0.3, 0.3, 0.4, 0.5], [-1.0, 1.5, 0.8, 2.0, 0.9]])
    >>> success_log_odds(torch.stack([good, bad])).diff() < 0
    tensor([True])
    """
    model = json.loads(MODEL.read_text("utf-8"))
    return features @ features.new_tensor([model["weights"][name] for name in FEATURES]) + model["bias"]


def rank_by_success(grasps: Grasps, log_odds: Float[Tensor, "k"]) -> Grasps:
    """Return grasps scored by the log-odds of the k executable ones, these first, best first."""
    failed, scores = grasps.status != Status.OK, grasps.score.clone()
    scores[~failed] = log_odds.to(scores)
    return dataclasses.replace(grasps, score=scores)[lexical_order(failed.int(), -scores)]


def rank_by_variance(grasps: Grasps) -> Grasps:
    """Return executable grasps first, the least sum of the contacts' variances first (Sec. 6.5); scores stay.

    Raises:
        BadArgument: contacts without `variance`.
    """
    if grasps.contacts.variance is None:
        raise BadArgument("grasps.contacts.variance", "None", "the variance of the surface at each contact")
    return grasps[lexical_order((grasps.status != Status.OK).int(), grasps.contacts.variance.sum(1))]
