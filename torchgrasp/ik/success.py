"""How probable it is that a planned grasp holds: a small model, calibrated on simulated trials.

A trial is DexGraspBench's test by pulling (`trials.protocol`): the hand closes and presses with 7 N, and the object
must withstand its own weight from six sides. Every grasp is put to five: closed open loop, and as the library itself
closes, under uncertainty, each at the friction that was planned for and at half of it; and under uncertainty with the
hand up to 5 mm and 5 degrees beside its plan. The probability is the share of such trials, at the friction that is
asked for, in which a grasp like this one holds: which closing it is counts for less than the features do.

The model is logistic in five numbers that a planner knows without the true object; friction counts by the angles
over its own alone. `scripts/make_success.py` fits it, on grasps of all ranks, and shows how well it is calibrated on
objects that it was not fitted on. The trials are those of the Allegro hand: the grasps of another are ranked by it,
but nothing says that its probabilities hold for them.
"""

import functools
import json
import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.ik.ranking import centred_friction
from torchgrasp.plan.internal_forces import least_friction_forces, tangential_ratio
from torchgrasp.values import Contacts

FEATURES = (
    "log-odds of closure",
    "offset of the contacts' centre over 20 mm",
    "least friction angle of a balance over that of friction",
    "friction angle of forces to the contacts' centre over that of friction",
    "mean angle of the pads",
)
"""What the model knows of a grasp, in this order."""

OFFSET = 0.02
"""Offset of the contacts' centre from the object's that counts as one [m]."""

LEAST = 1e-3
"""Probabilities of closure within this of 0 and 1 count as that."""

MODEL = Path(__file__).with_name("success.json")
"""Weights and bias, and what they were fitted on."""


def success_features(
    contacts: Contacts,
    closure: Float[Tensor, "g"],
    normal_angle: Float[Tensor, "g 3"],
    center: Float[Tensor, "3"],
    friction: float,
) -> Float[Tensor, "g 5"]:
    """Return `FEATURES` of each grasp.

    A hand that balances its forces needs the least friction (`least_friction_forces`); one whose fingers push towards each
    other as they are needs more. Where nothing balances the angle needed is a right one.

    Args:
        contacts: in the order of the fingers [m].
        closure: probability of closure at this friction (`closure_share`), which says how sure the surface is.
        normal_angle: between contact direction and pad [rad].
        center: estimated centre of the object [m].
        friction: of the trial, positive.
    """
    offset = torch.linalg.vector_norm(contacts.points.mean(1) - center, dim=-1) / OFFSET
    least = tangential_ratio(least_friction_forces(contacts.points, contacts.normals), contacts.normals).amax(-1)
    angles = torch.atan(torch.stack([least, centred_friction(contacts)], dim=-1)) / math.atan(friction)
    odds = torch.logit(closure.to(offset), eps=LEAST)
    return torch.cat([odds[:, None], offset[:, None], angles, normal_angle.mean(1, keepdim=True)], dim=-1)


def success_odds(features: Float[Tensor, "g 5"]) -> Float[Tensor, "g"]:
    """Return the log-odds of success of each grasp: log p / (1 - p).

    >>> good, bad = torch.tensor([[6.9, 0.3, 0.3, 0.4, 0.5], [-1.0, 1.5, 0.8, 2.0, 0.9]])
    >>> success_odds(torch.stack([good, bad])).diff() < 0
    tensor([True])
    """
    weights, bias = read_model()
    return features @ features.new_tensor(weights) + bias


@functools.cache
def read_model() -> tuple[tuple[float, ...], float]:
    """Return the weights of `FEATURES` and the bias."""
    model = json.loads(MODEL.read_text("utf-8"))
    return tuple(model["weights"][name] for name in FEATURES), model["bias"]
