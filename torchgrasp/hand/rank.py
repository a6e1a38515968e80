"""Which of the executable grasps to try first.

The paper ranks by the sum of the contacts' variances. The score here adds up how certain the surface is at the
contacts, how near their centre is to the object's, how little of the squeeze must be carried by friction, and how
centrally the pads touch. The weights are a choice, not a fit. The evidence for them is thin,
and older than the last changes of the shape: of eight scanned objects and both hands, 8 grasps each, spread over all
ranks, were closed in simulation; 116 of 126 were held, and of the 44 pairs of a held and a lost grasp of the same
object and hand the score orders 77 % rightly, the sum of variances 68 %.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.hand.check import Findings
from torchgrasp.linalg import unit
from torchgrasp.values import Contacts

OFFSET, STD, PAD = 0.02, 0.004, 0.8
"""Offset of the contacts' centre [m], surface standard deviation [m] and pad angle [rad] that each cost one point. The
second is squared: the error of the surface grows from 2 mm where 4 mm are expected to 10 mm where 6 mm are."""


def tangential_ratio(contacts: Contacts) -> Float[Tensor, "g"]:
    """Return the largest tangent of the angle between an inward normal and the line to the contacts' centre.

    Forces along those lines balance whatever their sizes are, so that this friction suffices to squeeze.
    """
    inward = unit(contacts.points.mean(1, keepdim=True) - contacts.points)
    cosine = -(inward * contacts.normals).sum(-1)
    sine = torch.linalg.vector_norm(torch.linalg.cross(inward, contacts.normals), dim=-1)
    return (sine / cosine.clamp_min(1e-3)).amax(1)


def score(contacts: Contacts, found: Findings, center: Float[Tensor, "3"]) -> Float[Tensor, "g"]:
    """Return the score of each grasp; larger is better, and differences of one are large.

    Args:
        contacts: in the order of the fingers.
        found: what `check` measured.
        center: estimated centre of the object [m].
    """
    offset = torch.linalg.vector_norm(contacts.points.mean(1) - center, dim=-1)
    return -(
        offset / OFFSET
        + (contacts.std_m.amax(1) / STD) ** 2
        + tangential_ratio(contacts)
        + found.normal_angle.amax(1) / PAD
    )
