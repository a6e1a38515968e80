"""The order of grasps: a geometric score of candidates, and a predicted probability of success.

`score` chooses among the candidates of one contact set. A logistic model of success orders executable grasps;
`scripts/train.py success` fits it to trials of the Allegro and the Barrett hand with three fingertips.
"""

import dataclasses
import functools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.errors import BadArgument, Status
from torchgrasp.geometry.frames import apply, inverse, rotate, skew, subsets
from torchgrasp.geometry.linalg import unit
from torchgrasp.hand.hand import Hand
from torchgrasp.plan.closure import cone_edges, tangents
from torchgrasp.plan.closure_probability import closure_share
from torchgrasp.plan.forces import grasp_map, least_friction_forces, tangential_ratio
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.values import Contacts, Grasps

FEATURES = (
    "log-odds of closure",
    "least friction angle of a balance over that of friction",
    "log of the load's arm over the triangle's height",
    "log of the stiffest finger's lever over 70 mm, at most",
    "log of the strongest finger's force that carries the load, over the load",
)
"""The features of the model of success, in this order."""
LEAST_ARM = 0.1  # added to the load's arm over the triangle's height, so that its logarithm is finite
MODEL = Path(__file__).with_name("success.json")
"""File of the success model: weights, biases, the range that trials or lifts support, and notes on these tests."""


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


def score(contacts: Contacts, normal_angle: Float[Tensor, "g f"], center: Float[Tensor, "3"]) -> Float[Tensor, "g"]:
    """Return the geometric score of each grasp, at most 0; a higher score is better.

    Three things lower it: the contacts' distance from `center` [m], the friction needed, and the angle off the pads.
    """
    offset = torch.linalg.vector_norm(contacts.points.mean(1) - center, dim=-1)
    return -(offset / 0.02 + centred_friction(contacts) + normal_angle.amax(1) / 0.8)


def load_arm(points: Float[Tensor, "b f 3"], center: Float[Tensor, "3"]) -> Float[Tensor, "b"]:
    """Return the distance of `center` [m], where the load acts, from the longest side of the contacts' triangle.

    The distance is divided by the triangle's height over this side, about which the object turns most easily. For more
    than three contacts, the triangle of the smallest ratio counts.
    """
    if points.shape[1] > 3:
        triples = subsets(points.shape[1], 3, points.device)
        return load_arm(points[:, triples].flatten(0, 1), center).unflatten(0, (len(points), len(triples))).amin(1)
    sides = points.roll(-1, dims=1) - points
    longest = torch.linalg.vector_norm(sides, dim=-1).argmax(1)[:, None, None].expand(-1, 1, 3)
    along, foot = unit(sides.gather(1, longest)[:, 0]), points.gather(1, longest)[:, 0]
    opposite = points.gather(1, (longest + 2) % 3)[:, 0]
    arm = torch.linalg.vector_norm(torch.linalg.cross(along, center - foot), dim=-1)
    height = torch.linalg.vector_norm(torch.linalg.cross(along, opposite - foot), dim=-1)
    return arm / (height + 0.01)  # [m], the lever of torsion


def carrying_force(
    contacts: Contacts, forces: Float[Tensor, "b f 3"], center: Float[Tensor, "3"], friction: float,
    load: Float[Tensor, "3"], push: float = 0.0,
) -> Float[Tensor, "b"]:  # fmt: skip
    """Return the least factor s on balanced forces f_0 so that all contacts stick under a load and any push [N].

    Load and push of any direction act at `center`; w is their wrench. Equal springs share it, G being the grasp map:

        f = s f_0 - G^+ w,    y . f >= 0 for all edges y of the cones dual to the friction cones.

    The factor is infinite if the forces do not stick at all, as where no forces balance.
    """
    points, normals = contacts.points.to(forces), contacts.normals.to(forces)
    dual = cone_edges(normals, tangents(points, normals), 1.0, edges=32) + (1 - friction) * normals[:, :, None]
    moment = skew(center.to(forces) - points.mean(1))  # maps a force at `center` to its torque
    eye = torch.eye(3).to(forces).expand_as(moment)
    shared = (torch.linalg.pinv(grasp_map(points)) @ torch.cat([eye, moment], 1)).unflatten(1, points.shape[1:])
    across = torch.einsum("bfij,bfei->bfej", shared, dual)
    lacking = across @ load.to(forces) + push * torch.linalg.vector_norm(across, dim=-1)
    having = torch.einsum("bfi,bfei->bfe", forces, dual)
    return torch.where(having > 0, lacking.clamp_min(0) / having, torch.inf).amax((1, 2))


def finger_levers(hand: Hand, grasps: Grasps) -> Float[Tensor, "g f"]:
    """Return each finger's lever [m]: the norm of its joints' moment arms for a force along the contact's normal.

    If the surface is displaced by e, the force of a finger whose joints have stiffness k changes by k e / lever^2.
    """
    joints = grasps.joints
    hand_from_obj, coupling = inverse(grasps.obj_from_hand.to(joints)), hand.actuated.coupling.to(joints)
    points, normals = apply(hand_from_obj, grasps.contacts.points.to(joints)), grasps.contacts.normals.to(joints)
    arms = torch.einsum("gfih,gfi->gfh", hand.jacobian(joints, points), rotate(hand_from_obj, normals))
    return torch.linalg.vector_norm(arms / torch.linalg.vector_norm(coupling, dim=0), dim=-1)


def success_features(
    hand: Hand, shape: ShapeGP, grasps: Grasps, center: Float[Tensor, "3"], friction: float, seed: int = 0,
    weight: tuple[float, float, float] = (0.0, 0.0, -1.0),
) -> Float[Tensor, "g k"]:  # fmt: skip
    """Return the success model's inputs `FEATURES` for each grasp; `center` [m] is the estimated centre of mass.

    `weight` is the direction of gravity; a zero vector means that it is unknown.
    """
    contacts = grasps.contacts
    points, normals = contacts.points.to(shape.x), contacts.normals.to(shape.x)
    center = center.to(points)
    closure = torch.logit(closure_share(shape, contacts, friction, 600, seed).to(points), eps=1e-3)
    forces = least_friction_forces(points, normals, strongest=1.0)
    least = torch.atan(tangential_ratio(forces, normals).amax(-1)).nan_to_num(math.pi / 2)  # NaN: no balance
    arm = torch.log(load_arm(points, center) + LEAST_ARM)
    least_lever = finger_levers(hand, grasps).amin(1).to(points)
    free, straight = 0.07, 0.01  # [m] more lever is no better; keeps the logarithm of a straight finger finite
    lever = torch.log((least_lever.clamp_max(free) + straight) / (free + straight))
    carried = _log_carried(contacts, forces, center, friction, weight).to(points)
    return torch.stack([closure, least / math.atan(friction), arm, lever, carried], dim=-1)


def _log_carried(
    contacts: Contacts, forces: Float[Tensor, "g f 3"], center: Float[Tensor, "3"], friction: float,
    weight: Sequence[float],
) -> Float[Tensor, "g"]:  # fmt: skip
    """Return the last of the `FEATURES`: the log of the force that carries the load at half of the friction."""
    push = 0.0 if any(weight) else 1.0
    carried = carrying_force(contacts, forces, center, 0.5 * friction, center.new_tensor(weight), push)
    return torch.log(carried.clamp(0.3, 100.0))


def log_odds_about(
    grasps: Grasps, centers: Float[Tensor, "c 3"], friction: float, weight: Sequence[float]
) -> Float[Tensor, "g c"]:
    """Return the log-odds of success of grasps for other centres of mass [m] than the first, for which they are ranked.

    Only the force that carries the load depends on the centre.
    """
    points, normals = grasps.contacts.points.to(centers), grasps.contacts.normals.to(centers)
    forces = least_friction_forces(points, normals, strongest=1.0)
    carried = [_log_carried(grasps.contacts, forces, center, friction, weight) for center in centers]
    change = torch.stack(carried, -1) - carried[0][:, None]
    return grasps.score.to(centers)[:, None] + _read_model()["weights"][FEATURES[-1]] * change


@functools.cache
def _read_model() -> dict[str, Any]:
    return json.loads(MODEL.read_text("utf-8"))


def success_log_odds(features: Float[Tensor, "g k"], hand: str) -> Float[Tensor, "g"]:
    """Return the predicted log-odds of success of each grasp; a hand without trials gets the lowest bias of all."""
    model = _read_model()
    bias = model["bias"].get(hand, min(model["bias"].values()))
    return features @ features.new_tensor([model["weights"][name] for name in FEATURES]) + bias


def is_known(shape: ShapeGP, grasps: Grasps, friction: float) -> Bool[Tensor, "g"]:
    """Return a mask of the grasps whose predicted success is supported by trials or lifts of similar grasps.

    Friction, object size and the surface's standard deviation at the contacts must be in the range that was tried.
    """
    tried = _read_model()["range"]
    alike = friction >= tried["least_friction"] and tried["half_size"][0] <= shape.scale <= largest_known()
    return alike & (grasps.contacts.require_std().amax(1) <= tried["most_deviation"])


def largest_known() -> float:
    """Return the largest half size [m] (from centre to surface) of objects for which success is predicted."""
    return _read_model()["range"]["half_size"][1]


def rank_by_success(grasps: Grasps, log_odds: Float[Tensor, "k"]) -> Grasps:
    """Set the scores of the k executable grasps to their log-odds of success, and return all grasps, best first."""
    failed, scores = grasps.status != Status.OK, grasps.score.clone()
    scores[~failed] = log_odds.to(scores)
    return by_success(dataclasses.replace(grasps, score=scores))


def by_success(grasps: Grasps) -> Grasps:
    """Sort grasps, each group by falling score: executable with a supported prediction, other executable, failed."""
    late = 2 * (grasps.status != Status.OK).int()
    late = late if grasps.known is None else late + (~grasps.known & (late == 0)).int()
    return grasps[lexical_order(late, -grasps.score)]


def rank_by_variance(grasps: Grasps) -> Grasps:
    """Sort grasps: executable grasps first, then by increasing sum of the surface variances at contacts (Sec. 6.5)."""
    if grasps.contacts.variance is None:
        raise BadArgument("grasps.contacts.variance", "None", "the variance of the surface at each contact")
    return grasps[lexical_order((grasps.status != Status.OK).int(), grasps.contacts.variance.sum(1))]
