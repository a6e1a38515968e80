"""How a grasp carries a load: the forces that it needs, and the load's lever arm. Also the strength
of the fingers.
"""

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.contacts.balance import (
    forces_near,
    grasp_map,
    least_friction_forces,
)
from torchgrasp.contacts.form_closure import cone_edges, tangents
from torchgrasp.contacts.problem import contact_pairs
from torchgrasp.geometry.frames import apply, inverse, rotate, skew, subsets
from torchgrasp.geometry.linalg import dot, norm, unit
from torchgrasp.hand.hand import Hand
from torchgrasp.values.planning import Contacts, Grasps, IKSeeds


@dataclasses.dataclass(frozen=True)
class LoadNumbers:
    """Parameters of the forces that carry a load: friction cones, and bounds of forces."""

    carrying: float = 2.07
    """Decrease of a lift's log-odds of success, if the force that carries the load grows by the
    factor e.
    """
    torsion: float = 0.01
    """Length [m] that is added to the height of the contacts' triangle. It stands for the torsional
    friction of a contact.
    """
    edges: int = 32
    """Number of edges of the pyramid that approximates a friction cone."""
    least_force: float = 0.3
    """Lower bound [N] of the forces from which the log-odds are computed."""
    most_force: float = 100.0
    """Upper bound [N] of the forces from which the log-odds are computed."""


LOADS = LoadNumbers()


def lever_arm(points: Float[Tensor, "b f 3"], center: Float[Tensor, "*b 3"]) -> Float[Tensor, "b"]:
    """Return the lever arm (no unit) of a load at `center` [m] on each set of f contact `points`
    [m].

    It is d / (h + 10 mm). Here d is the distance of `center` from the line of the longest side of
    the contacts' triangle. About this side the object turns most easily, and h is the triangle's
    height over it. The 10 mm (`LOADS.torsion`) stand for the torsional friction of a contact. For
    more than three contacts, the triangle with the smallest result counts. `center` is one point
    (3,), or one for each of the b sets (b, 3). All points are in one frame.
    """
    if points.shape[1] > 3:
        triples = subsets(points.shape[1], 3, points.device)
        each = center if center.ndim == 1 else center.repeat_interleave(len(triples), 0)
        arms = lever_arm(points[:, triples].flatten(0, 1), each)
        return arms.unflatten(0, (len(points), len(triples))).amin(1)
    sides = points.roll(-1, dims=1) - points
    longest = norm(sides).argmax(1)[:, None, None].expand(-1, 1, 3)
    along = unit(sides.gather(1, longest)[:, 0])
    foot = points.gather(1, longest)[:, 0]
    opposite = points.gather(1, (longest + 2) % 3)[:, 0]
    arm = norm(torch.linalg.cross(along, center - foot))
    height = norm(torch.linalg.cross(along, opposite - foot))
    return arm / (height + LOADS.torsion)


def carrying_force(
    contacts: Contacts,
    forces: Float[Tensor, "b f 3"],
    center: Float[Tensor, "*b 3"],
    frictions: Sequence[float],
    load: Float[Tensor, "3"],
    push: float = 0.0,
) -> Float[Tensor, "m b"]:
    """Return the least factor s on balanced contact forces at which all contacts stick under a
    load.

    The result holds a factor (no unit) for each of m `frictions`, the friction coefficients, and b
    contact sets. `forces` f_0 [N] balance each other without a load. The `load` [N] acts at
    `center` [m], one point (3,) or one for each set (b, 3). A force of the size `push` [N] in any
    direction acts there, too. All vectors are in the frame of the contacts. The wrench of load and
    push is w. Equal springs share it, with the grasp map G:

        f = s f_0 - G^+ w,    y . f >= 0 for all edges y of the cones dual to the friction cones.

    The factor is infinite if the forces do not stick at all, as where no forces balance.
    """
    points = contacts.points.to(forces)
    normals = contacts.normals.to(forces)
    edges = cone_edges(normals, tangents(points, normals), 1.0, edges=LOADS.edges)
    moment = skew(center.to(forces) - points.mean(1))  # maps a force at `center` to its torque
    eye = torch.eye(3).to(forces).expand_as(moment)
    wrench = torch.cat([eye, moment], 1)  # (b, 6, 3): of a force at `center`
    shared = torch.linalg.pinv(grasp_map(points)) @ wrench
    shared = shared.unflatten(1, points.shape[1:])  # (b, f, 3, 3)
    found = list[Tensor]()
    for friction in frictions:
        dual = edges + (1 - friction) * normals[:, :, None]
        across = torch.einsum("bfij,bfei->bfej", shared, dual)
        lacking = across @ load.to(forces) + push * norm(across)
        having = torch.einsum("bfi,bfei->bfe", forces, dual)
        factor = torch.where(having > 0, lacking.clamp_min(0) / having, torch.inf)
        found.append(factor.amax((1, 2)))
    return torch.stack(found)


def greatest_force(
    hand: Hand, grasps: Grasps, forces: Float[Tensor, "g f 3"]
) -> Float[Tensor, "g"]:
    """Return the factor (g,) (no unit) on the `forces` [N] of each grasp at which a drive reaches
    its greatest torque.

    The forces (g, f, 3) act at the f contacts of each grasp, in the frame of the grasps. Forces
    that are NaN give NaN.
    """
    return _most_times(hand, grasps, grasps.contacts, forces)


def squeezing_forces(contacts: Contacts) -> Float[Tensor, "b f 3"]:
    """Return balanced forces [N] with which f fingers squeeze an object at each of b contact sets.

    A short search from equal pulls along all pairs of contacts finds them (`forces_near`). So they
    need little friction at three contacts, and are a rough guess for more. The strongest finger has
    a normal force of 1 N. They are in the frame of the `contacts`, and NaN if the search finds no
    forces that push at every contact.
    """
    points = contacts.points
    pairs = contact_pairs(points.shape[1], points.device).shape[1]
    forces = forces_near(points, contacts.normals, points.new_ones(len(points), pairs))
    push = -dot(forces, contacts.normals)
    return forces / push.amax(1)[:, None, None]


def squeezing_strength(
    hand: Hand,
    held: Grasps | IKSeeds,
    contacts: Contacts,
    forces: Float[Tensor, "g f 3"],
    most: float,
) -> Float[Tensor, "g"]:
    """Return the force (g,) [N] with which each posture of the hand can squeeze its object, at most
    `most` [N].

    It is the normal force of the strongest finger at which a drive reaches its greatest torque.
    `held` gives the postures of the hand in g grasps. `contacts` are their contacts, one for each
    of the f fingers. `forces` (g, f, 3) [N] are the `squeezing_forces` there. The strength is 0
    where the forces are NaN.
    """
    greatest = _most_times(hand, held, contacts, forces)
    return greatest.nan_to_num(0.0).clamp(max=most)


def _most_times(
    hand: Hand, held: Grasps | IKSeeds, contacts: Contacts, forces: Float[Tensor, "g f 3"]
) -> Float[Tensor, "g"]:
    """Return the largest factor on the `forces` [N] at the contacts of each posture at which no
    drive exceeds its greatest torque.
    """
    jacobian, pushes, effort = _levers(hand, held, contacts, forces)
    torque = torch.einsum("gfih,gfi->gh", jacobian, pushes)
    return (effort / torque.abs()).amin(1)


def strength_of(
    hand: Hand, held: Grasps | IKSeeds, contacts: Contacts, most: float
) -> Float[Tensor, "g f"]:
    """Return the greatest normal force [N] that each fingertip alone can press with, at most `most`
    [N].

    The torques of the finger's drives bound the force. `held` gives the postures of the hand in g
    grasps. `contacts` are their contacts, one for each of the f fingers. The force is 0 at a
    contact that is NaN.
    """
    jacobian, pushes, effort = _levers(hand, held, contacts, -contacts.normals)
    torque = torch.einsum("gfih,gfi->gfh", jacobian, pushes)
    alone = (effort / torque.abs()).amin(2)
    return alone.nan_to_num(0.0).clamp(0.0, most)  # a contact that is unknown has no strength


def _levers(
    hand: Hand, held: Grasps | IKSeeds, contacts: Contacts, forces: Float[Tensor, "g f 3"]
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the Jacobians (g, f, 3, h) of the contacts, the forces in the hand's frame, and the
    drives' greatest torques (h,).
    """
    joints = held.joints
    hand_from_obj = inverse(held.obj_from_hand.to(joints))
    jacobian = hand.jacobian(joints, apply(hand_from_obj, contacts.points.to(joints)))
    effort = joints.new_tensor([hand.actuators[name].effort for name in hand.joint_names])
    return jacobian, rotate(hand_from_obj, forces.to(joints)), effort


def log_odds_about(
    grasps: Grasps, centers: Float[Tensor, "c 3"], friction: float, weight: Sequence[float]
) -> Float[Tensor, "g c"]:
    """Return the log-odds of success of g grasps for each of c possible centres of mass.

    `centers` [m] are in the frame of the grasps; the first is the one for which `grasps.score` was
    predicted. Only the force that carries the load depends on the centre. `weight` (3,) is the load
    [N] in this frame, and `friction` the coefficient of friction. As in the features of the success
    model, the load must be carried at half of this friction.
    """
    points = grasps.contacts.points.to(centers)
    normals = grasps.contacts.normals.to(centers)
    forces = least_friction_forces(points, normals, strongest=1.0)
    load = centers.new_tensor(weight)
    carried = [
        carrying_force(grasps.contacts, forces, center, (0.5 * friction,), load)[0]
        for center in centers
    ]
    forces = torch.stack(carried, -1).clamp(LOADS.least_force, LOADS.most_force)  # (g, c)
    logs = torch.log(forces)
    return grasps.score.to(centers)[:, None] - LOADS.carrying * (logs - logs[:, :1])
