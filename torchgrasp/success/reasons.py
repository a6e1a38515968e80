"""What lowers the predicted success of a grasp, in words."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import inverse
from torchgrasp.geometry.linalg import norm
from torchgrasp.geometry.plane import move, upright_frame
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import check_named
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.success.body import EstimatedBody
from torchgrasp.success.features import (
    CAUSES,
    FEATURES,
    GRIP,
    WEAK,
    lost_by_weakness,
    measure_grasps,
    weights_carried,
)
from torchgrasp.success.model import load_success_model
from torchgrasp.success.order import supported_share
from torchgrasp.success.task import Conditions, GraspTask
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.planning import Grasps
from torchgrasp.values.specs import ContactSpec

SENTENCES = {
    "load": (
        "at half the friction the load takes {force needed} of a finger; its centre is "
        "{offset} from the contacts"
    ),
    "moved": (
        "the fingers carry the load at a share {carried if moved} of the places within "
        "20 mm of the object"
    ),
    "surface": "the surface may be {deviation} off at a contact",
    "object": "the object is {height} high and {size} in radius",
    "task": "the task is {mass} at a friction of {friction}",
}
"""What is said of each cause; the names of features stand for their values. "task" is the last."""
MOST = 3
"""Most causes that are told."""
SLACK = 0.02
"""Greatest median distance [m] of the contacts from the surface, which a second view may move."""
ROUNDING = 1e-9
"""A probability up to this counts as 0."""


class Cost(NamedTuple):
    """A cause that lowers the predicted success of a grasp.

    `explain_success` returns such causes.

    Attributes:
        cause: name of the cause:
            "load": large forces that are needed to carry the load.
            "moved": contacts that carry less if the object is not where the camera saw it.
            "surface": the uncertainty of the surface at the contacts.
            "object": the size of the object.
            "task": mass, friction and force of the task.
        log_odds: by how much (no unit) the cause lowers the log-odds of success, compared to grasps
            that held. The log-odds of a probability p are log(p / (1 - p)).
        sentence: explanation of the cause, with its numbers.
    """

    cause: str
    log_odds: float
    sentence: str


@checked
def explain_success(
    grasps: Grasps, hand: Hand, shape: ShapeGP, task: GraspTask | None = None
) -> tuple[Cost, ...]:
    """Return at most three causes that lower the predicted success of the first grasp most, the
    greatest first.

    The log-odds of a probability p are log(p / (1 - p)). Each cause stands for several features,
    the inputs of the success model. Its `log_odds` is by how much the log-odds rise if these
    features take their median over grasps that held. If the fingers can hardly carry the weight of a
    lifted object, the `log_odds` of "load" are greater (`lost_by_weakness`). Causes that do not
    lower the success are left out.

    If trials have not tested all of the task's frictions and masses, "task" is always among the
    causes. Its `log_odds` may then be negative. Its sentence says what share of the frictions and
    masses no trial has tested. If trials have tested none, it says that the success is unknown.

    Args:
        grasps: grasps of `plan_grasps`, of which the first counts.
        hand: the hand of the grasps.
        shape: the estimated shape of the object (`fit_shape`), in the frame of the grasps.
        task: what the grasp must do; None means `GraspTask()`.

    Raises `BadArgument` for no grasps, or grasps of another planner. It is raised for a hand or
    fingers that the grasps do not name. It is also raised for a shape in another frame: its surface
    is more than 20 mm (`SLACK`) from half of the contacts.

    >>> from torchgrasp import fit_shape, load_hand, load_object
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> shape = fit_shape(load_object("jug").view, table=0.0)
    >>> grasp = load_shipped_grasp("jug", "barrett")
    >>> costs = explain_success(grasp, load_hand("barrett"), shape, GraspTask(mass=0.5))
    >>> costs[0].cause, bool(costs[0].log_odds >= costs[-1].log_odds > 0)
    ('task', True)
    """
    if not len(grasps) or "friction" not in grasps.meta:
        raise BadArgument(
            "grasps", f"{len(grasps)} grasps, planned for no friction", "grasps of plan_grasps"
        )
    task = GraspTask() if task is None else task
    check_named(hand, grasps)
    _check_shape(grasps[0], shape)
    stood = stand_upright(grasps[0], hand, shape)
    features = measure_again(*stood, task)
    carried = _find_carried(*stood, task)
    conditions = conditions_of(grasps, task)
    weights = conditions.weights.to(features)
    supported = supported_share(conditions)
    model = load_success_model(features.device)
    known = model.mean_log_odds(features, weights)
    units = {name: unit for names in CAUSES.values() for name, unit in names.items()}
    means = (weights @ features[:, 0]).tolist()
    values = {name: _say(x, units[name]) for name, x in zip(FEATURES, means, strict=True)}
    told = list[Cost]()
    for cause, names in CAUSES.items():
        columns = [FEATURES.index(name) for name in names]
        usual = features.clone()
        usual[..., columns] = model.usual[columns]
        gain = float(model.mean_log_odds(usual, weights) - known)
        sentence = SENTENCES[cause].format_map(values)
        if cause == "load":
            gain += float(lost_by_weakness(carried))
            sentence += _say_carried(float(carried))
        told.append(Cost(cause, gain, sentence))
    lower = [cost for cost in sorted(told, key=lambda cost: -cost.log_odds) if cost.log_odds > 0]
    if supported >= 1 - ROUNDING:
        return tuple(lower[:MOST])
    # the task is told in any case, with what no trial supports of it
    given = told[-1]
    unknown = "no trial supports these frictions and masses, so the success is unknown"
    if supported > 0:
        unknown = f"no trial supports {1 - supported:.0%} of these frictions and masses"
    said = given._replace(sentence=f"{given.sentence}; {unknown}")
    others = [cost for cost in lower if cost.cause != given.cause]
    kept = [*others[: MOST - 1], said]
    return tuple(sorted(kept, key=lambda cost: -cost.log_odds))


def _check_shape(grasp: Grasps, shape: ShapeGP) -> None:
    """Raise `BadArgument` if half of a grasp's contacts are off the surface of a shape [m]."""
    points = grasp.contacts.points[0].double().to(shape.device)
    allowed = "the shape of the grasped object, in the frame of the grasps"
    away = norm(points - shape.center)
    if bool((away > 2 * shape.domain_radius * shape.scale).any()):
        found = f"one whose centre is {float(away.max()):.3g} m from a contact"
        raise BadArgument("shape", found, allowed)
    known = shape.predict(points, covariance=False)
    off = float((known.distance.abs() * shape.scale).median())
    if off > SLACK:
        found = f"one whose surface is {1e3 * off:.0f} mm off the contacts"
        raise BadArgument("shape", found, allowed)


def conditions_of(grasps: Grasps, task: GraspTask) -> Conditions:
    """Return the pairs of friction and mass for which the success of `grasps` in a `task` is
    predicted.

    The masses are those of the `task`. The friction is in the metadata of the grasps, as the text
    of a `Distribution`.
    """
    return Conditions.of(Distribution.parse(grasps.meta["friction"]), task.mass)


def measure_again(
    hand: Hand, body: EstimatedBody, grasps: Grasps, task: GraspTask
) -> Float[Tensor, "c g k"]:
    """Return the k features of g planned grasps for any task, under each of its c conditions.

    A condition is a pair of a friction and a mass. The features are in the order of the tuple
    `FEATURES`. The first three arguments are what `stand_upright` returns: body and grasps in an
    upright frame. The metadata of the grasps name the table and the friction.
    """
    conditions = conditions_of(grasps, task)
    return measure_grasps(hand, body, grasps, conditions, task, task.lifts(grasps.table))


def _find_carried(
    hand: Hand, body: EstimatedBody, grasp: Grasps, task: GraspTask
) -> Float[Tensor, ""]:
    """Return the greatest multiple of the weight that the fingers of an upright grasp can carry.

    It is infinite if the task does not lift.
    """
    lifts = task.lifts(grasp.table)
    if not lifts:
        return torch.tensor(torch.inf)
    spec = ContactSpec(Distribution.parse(grasp.meta["friction"]), friction_margin=1.0)
    mass = Distribution.of(task.mass).mean
    most = task.pressing(lifts) or GRIP
    return weights_carried(hand, grasp, body.center, mass, spec, most)[0]


def _say_carried(multiple: float) -> str:
    """Return the end of a sentence on the load, which says how many times the weight the fingers
    can carry. It is empty if that is enough.
    """
    if multiple < 1:
        return "; no forces of the fingers carry the weight"
    if multiple < WEAK.enough:
        return f"; the fingers carry at most {multiple:.1f} times the weight"
    return ""


def stand_upright(grasps: Grasps, hand: Hand, shape: ShapeGP) -> tuple[Hand, EstimatedBody, Grasps]:
    """Return the hand, the estimated object and the grasps, the last two turned to an upright
    frame, with z up.

    The `shape` of the object is in the frame of the grasps. Up is the normal of the grasps' table,
    or without a table the direction to the camera. The hand is moved to the device of the
    grasps. All is in float64: float32 is too coarse to prove that forces carry a load.
    """
    frame = inverse(upright_frame(shape.cloud.points, shape.cloud.viewpoint, grasps.table))
    grasps = grasps.to(torch.float64)
    hand = hand.to(grasps.joints.device, torch.float64)
    return hand, EstimatedBody.of(shape.moved(frame)), move(grasps, frame)


def _say(value: float, unit: str) -> str:
    """Return a number with its unit as text: millimetres and degrees for metres and radians."""
    scales = {"m": (1000.0, " mm"), "rad": (math.degrees(1.0), " degrees"), "1": (1.0, "")}
    factor, shown = scales.get(unit, (1.0, f" {unit}"))
    number = value * factor
    return f"{number:.2g}{shown}" if abs(number) < 10 else f"{number:.0f}{shown}"
