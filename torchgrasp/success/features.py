"""The features of a grasp from which its success in a task is predicted: physical quantities in SI
units.
"""

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.contacts.balance import least_friction_forces
from torchgrasp.contacts.resist import multiple_carried
from torchgrasp.foundation.base import spread
from torchgrasp.geometry.linalg import across, norm, unit
from torchgrasp.hand.hand import Hand
from torchgrasp.shape.batch import ShapeBatch
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.success.body import EstimatedBody
from torchgrasp.success.loads import carrying_force, greatest_force, strength_of
from torchgrasp.success.moved import touch_moved
from torchgrasp.success.task import Conditions, GraspTask
from torchgrasp.values.planning import Contacts, Grasps
from torchgrasp.values.specs import GRAVITY, ContactSpec

CAUSES: dict[str, dict[str, str]] = {
    "load": {"force needed": "N", "force to spare": "1", "offset": "m"},
    "moved": {
        "force to spare if moved": "1",
        "force to spare if moved and slippery": "1",
        "carried if moved": "1",
    },
    "surface": {"deviation": "m", "tilt": "rad"},
    "object": {"size": "m", "height": "m", "breadth": "m"},
    "task": {
        "friction": "1",
        "mass": "kg",
        "force": "N",
        "lifted": "1",
        "displaced": "1",
        "open loop": "1",
    },
}
"""The features of a grasp with their units, by the cause of failure that they describe.

* "load": the normal force of the strongest finger that the load needs; the logarithm of the
  fingers' strength over it. Last is the distance of the contacts' centroid from the object's
  centre.
* "moved": two such logarithms, and whether the force is enough, as means over displacements of the
  object (`touch_moved`).
* "surface": the greatest standard deviations of the surface and of its normal at a contact.
* "object": `size`, `height` and `breadth` of `EstimatedBody`.
* "task": the friction coefficient; the mass; the normal force of the strongest finger. This force
  is 0 if the hand presses as the load needs. Then 1 if true, else 0: the object is lifted; it may
  be displaced; the hand closes in open loop.
"""
# All features, in the order of the columns.
FEATURES = tuple(name for names in CAUSES.values() for name in names)
GRIP = 15.0  # greatest force [N] that a hand which grips as the load asks for may need


@dataclasses.dataclass(frozen=True)
class FeatureNumbers:
    """Loads and bounds of forces in the features of the success model."""

    slippery: float = 0.5
    """Factor on the friction coefficient, for the features of a slippery object."""
    pull: float = 10.0
    """Acceleration [m/s2] that a pull gives the object, for the features of pulls."""
    least_force: float = 1e-3
    """Lower bound [N] of forces, so that their logarithms are finite."""
    most_force: float = 1e3
    """Upper bound [N] of forces; it also stands for a load that no force can carry."""
    most_spare: float = 2.0
    """Greatest absolute value of a force to spare in a mean. A force to spare is the logarithm of a
    ratio of forces.
    """


MEASURES = FeatureNumbers()


@dataclasses.dataclass(frozen=True)
class WeakNumbers:
    """By how much the log-odds of a lift fall where the fingers are weak. The numbers are from a
    logistic regression on the model's log-odds and this, in trials of authored bodies.
    """

    enough: float = 2.5
    """Multiple of the weight that the fingers can carry, above which nothing is lost."""
    least: float = 0.3
    """Lower bound of this multiple, so that its logarithm is finite."""
    slope: float = 1.4
    """Decrease of the log-odds, divided by that of the logarithm of this multiple."""


WEAK = WeakNumbers()


def measure_grasps(
    hand: Hand,
    body: EstimatedBody,
    grasps: Grasps,
    conditions: Conditions,
    task: GraspTask,
    lifted: bool,
) -> Float[Tensor, "c g k"]:
    """Return the k features that predict the success of g grasps in a task, for each of c
    conditions.

    The k features are in the order of the tuple `FEATURES`, which names them. The dict `CAUSES`
    gives their units, and its text their meaning.

    Args:
        hand: the hand of the grasps.
        body: the estimated object, one for all grasps, or one for each, in an upright frame.
        grasps: the g grasps, in the same frame.
        conditions: c pairs of a friction coefficient and a mass [kg]. The mass of the `task` has
            no effect.
        task: how the hand presses and closes, and whether the object may be displaced.
        lifted: whether the object is lifted; otherwise it is pulled.

    Two features are named "force needed" and "force to spare". The second is the logarithm of a
    ratio: the fingers' strength divided by the force needed. Both, and the features named
    "slippery", are computed with half the friction coefficient.
    """
    contacts = grasps.contacts
    g = len(grasps)
    center = body.center
    points = contacts.points.to(center)
    normals = contacts.normals.to(center)
    forces = least_friction_forces(points, normals, strongest=1.0)
    pressing = task.pressing(lifted)
    greatest = greatest_force(hand, grasps, forces).to(points).nan_to_num(0.0)
    strength = torch.minimum(greatest, greatest.new_tensor(pressing or GRIP))
    frictions = conditions.frictions[0].tolist()
    masses = conditions.masses[0].tolist()
    slipping = [MEASURES.slippery * friction for friction in frictions]
    needed = _force_for(contacts, forces, center, slipping, masses, lifted)
    moved = touch_moved(hand, body.field, grasps, forces)
    everywhere = center if center.ndim == 1 else center.repeat(len(moved.touched), 1)
    both = [*frictions, *slipping]
    there = _force_for(moved.contacts, moved.forces, everywhere, both, masses, lifted)
    there = there.unflatten(2, moved.touched.shape).where(moved.touched, MEASURES.most_force)
    strength = strength.clamp_min(MEASURES.least_force)
    logs = torch.log(strength / there).clamp(-MEASURES.most_spare, MEASURES.most_spare)
    spare, slippery = logs.split(len(frictions))  # (n, m, d, g)
    found: dict[str, Tensor | float] = {
        "force needed": needed,
        "force to spare": torch.log(strength / needed),
        "offset": norm(points.mean(1) - center),
        "force to spare if moved": spare.mean(2),
        "force to spare if moved and slippery": slippery.mean(2),
        "carried if moved": (spare > 0).to(points).mean(2),
        "deviation": contacts.require_std().to(points).amax(1),
        "tilt": _normal_deviation(body.shape, points).amax(1),
        "size": body.size,
        "height": body.height,
        "breadth": body.breadth,
        "friction": points.new_tensor(frictions)[:, None, None],
        "mass": points.new_tensor(masses)[:, None],
        "force": pressing,
        "lifted": float(lifted),
        "displaced": float(task.displaced),
        "open loop": float(task.closing == "open_loop"),
    }
    assert tuple(found) == FEATURES
    size = len(frictions), len(masses), g
    columns = [
        x.to(points).expand(size) if isinstance(x, Tensor) else points.new_full(size, x)
        for x in found.values()
    ]
    return torch.stack(columns, -1).flatten(0, 1)


def weight_about(
    points: Float[Tensor, "g f 3"], center: Float[Tensor, "*g 3"], mass: float
) -> Float[Tensor, "g 6"]:
    """Return the weight of a mass [kg] about the centroid of each contact set: force [N], then
    torque [N m].

    The contact `points` (g, f, 3) [m] and the centre of mass `center` [m] are in an upright frame.
    The centre is one for all g contact sets, or one for each.
    """
    arm = center - points.mean(1)
    force = torch.zeros_like(arm)
    force[:, 2] = -GRAVITY * mass
    return torch.cat([force, torch.linalg.cross(arm, force)], -1)


def weights_carried(
    hand: Hand,
    grasps: Grasps,
    center: Float[Tensor, "*g 3"],
    mass: float,
    spec: ContactSpec,
    most: float,
) -> Float[Tensor, "g"]:
    """Return the greatest multiple of the weight of a mass that the fingers of g grasps can carry.

    Contact forces balance the weight, within the friction cones. No force may exceed `most`, or
    what the torques of the drives allow. Linear programming finds the multiple.

    Args:
        hand: the hand of the grasps.
        grasps: the grasps, in an upright frame.
        center: centre of mass (3,) [m] for all grasps, or one for each (g, 3).
        mass: the lifted mass [kg].
        spec: its `planned_friction` and `edges` define the friction cones.
        most: greatest normal force [N] of a finger in the task.
    """
    contacts = grasps.contacts
    strength = strength_of(hand, grasps, contacts, most)
    weight = weight_about(contacts.points, center.to(contacts.points), mass)
    return multiple_carried(contacts, strength, weight, spec)


def lost_by_weakness(carried: Float[Tensor, "*g"]) -> Float[Tensor, "*g"]:
    """Return by how much the log-odds of a lift fall if the fingers carry at most some multiple of
    the weight, `carried`.

    It is 1.4 log(2.5 / `carried`), but 0 above 2.5, with the numbers of `WEAK`.
    """
    return WEAK.slope * (WEAK.enough / carried.clamp(WEAK.least, WEAK.enough)).log()


def _force_for(
    contacts: Contacts,
    forces: Float[Tensor, "g f 3"],
    center: Float[Tensor, "*b 3"],
    frictions: Sequence[float],
    masses: Sequence[float],
    lifted: bool,
) -> Float[Tensor, "n m g"]:
    """Return the force [N] of the strongest finger at which no contact slides under the load. There
    is one for each of n friction coefficients, m masses [kg] and g grasps.

    The load is the weight of the mass if the object is `lifted`, and otherwise a pull in any
    direction.
    """
    weight = GRAVITY * masses[0] if lifted else 0.0
    pull = 0.0 if lifted else MEASURES.pull * masses[0]
    load = center.new_tensor([0.0, 0.0, -weight])
    force = carrying_force(contacts, forces, center, frictions, load, pull)
    # the force is proportional to the mass
    ratios = force.new_tensor(masses)[:, None] / masses[0]
    force = torch.where(ratios == 1, force[:, None], ratios * force[:, None])
    return force.clamp(MEASURES.least_force, MEASURES.most_force)  # infinite: no force does


def _normal_deviation(
    shape: ShapeGP | ShapeBatch, points: Float[Tensor, "g f 3"]
) -> Float[Tensor, "g f"]:
    """Return the standard deviation [rad] of the surface's normal at each contact, about the axis
    for which it is largest.
    """
    mean, covariance = shape.estimate(shape.normalise(points).flatten(0, 1))
    normal = unit(mean[:, 1:])
    slope = norm(mean[:, 1:])
    tangents = torch.stack(across(normal), -1)
    tangential = tangents.mT @ covariance[:, 1:, 1:] @ tangents
    # the larger eigenvalue of each matrix (2, 2)
    one, other = tangential.diagonal(dim1=1, dim2=2).unbind(1)
    variance = (one + other) / 2 + torch.hypot((one - other) / 2, tangential[:, 0, 1])
    largest = variance.clamp_min(0).sqrt()
    largest, slope = (x.view(points.shape[:2]) for x in (largest, slope))
    return spread(shape.std_factor, largest) * largest / slope
