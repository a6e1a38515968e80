"""Which of the executable grasps to try first.

The paper ranks by the sum of the contacts' variances. Here candidates for the same contacts are ranked by how near the
contacts' centre is to the object's, how little of the squeeze must be carried by friction, and how centrally the pads
touch (`score`, whose weights are a choice); the executable grasps that come of it by how probably they hold
(`hand.success`, whose weights are a fit).
"""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.errors import Status
from torchgrasp.ik.checks import GraspErrors
from torchgrasp.linalg import unit
from torchgrasp.values import Contacts, Grasps

OFFSET, PAD = 0.02, 0.8
"""Offset of the contacts' centre [m] and pad angle [rad] that each cost one point."""


def centred_friction(contacts: Contacts) -> Float[Tensor, "g"]:
    """Return the friction that suffices when the fingers press towards the contacts' centre.

    It is the largest tangent of the angle between an inward normal and the line to the centre, where such forces meet.
    """
    inward = unit(contacts.points.mean(1, keepdim=True) - contacts.points)
    cosine = -(inward * contacts.normals).sum(-1)
    sine = torch.linalg.vector_norm(torch.linalg.cross(inward, contacts.normals), dim=-1)
    return (sine / cosine.clamp_min(1e-3)).amax(1)


def score(contacts: Contacts, found: GraspErrors, center: Float[Tensor, "3"]) -> Float[Tensor, "g"]:
    """Return the score of each grasp if all are as surely closed; larger is better, and differences of one are large.

    Args:
        contacts: in the order of the fingers.
        found: what `check` measured.
        center: estimated centre of the object [m].
    """
    offset = torch.linalg.vector_norm(contacts.points.mean(1) - center, dim=-1)
    return -(offset / OFFSET + centred_friction(contacts) + found.normal_angle.amax(1) / PAD)


def rank_by_success(grasps: Grasps, odds: Float[Tensor, "k"]) -> Grasps:
    """Return grasps with the log-odds of success as the score of the k executable ones; these first, and best first."""
    good = grasps.status == Status.OK
    scored = grasps.score.clone()
    scored[good] = odds.to(scored)
    order = torch.argsort(scored, descending=True, stable=True)
    order = order[torch.argsort((~good)[order].to(torch.uint8), stable=True)]
    return dataclasses.replace(grasps, score=scored)[order]
