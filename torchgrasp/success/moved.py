"""The contacts of a grasp whose object is not quite where the camera saw it."""

import dataclasses
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.contacts.balance import forces_near, internal_forces
from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.geometry.linalg import dot, fibonacci_sphere, matvec, norm
from torchgrasp.geometry.signed_distance import DistanceField
from torchgrasp.hand.hand import Hand
from torchgrasp.values.planning import Contacts, Grasps

Sets = Float[Tensor, "d g f 3"]
"""One vector for each of d displacements, g grasps and f fingertips."""


@dataclasses.dataclass(frozen=True)
class MovedNumbers:
    """Parameters of the displacements of an object, and of the search for the contacts of a
    displaced object.
    """

    count: int = 16
    """Number of displacements of the object that are compared."""
    radius: float = 0.02
    """Length [m] of the greatest displacement, at which the fingers of a closing hand still reach
    the object.
    """
    turn: float = 0.618
    """Step (no unit) of the sequence from which the sizes of the displacements are taken: the
    golden ratio. With it, the displacements fill a ball evenly.
    """
    close: float = 3e-4
    """Distance [m] from the surface below which a fingertip counts as touching."""
    least: float = 2e-4
    """Shortest step [m] of a fingertip in the search for its contact."""
    length: float = 0.12
    """Longest path [m] of a fingertip in the search for its contact."""
    steps: int = 24
    """Greatest number of steps of a fingertip in this search."""
    still: float = 1e-6
    """Length [m] of a fingertip's path below which it has no direction."""
    flat: float = 1e-9
    """Length (no unit) of the gradient of the signed distance below which the gradient has no
    direction.
    """


MOVED = MovedNumbers()


class MovedContacts(NamedTuple):
    """Contact sets of g grasps after each of d displacements of the object.

    Args:
        contacts: the d g contact sets: contact points [m] and outward normals in the object's
            frame, one for each of the f fingertips. The sets are ordered by displacement, then by
            grasp.
        forces: balanced contact forces [N] of these sets, of which the largest normal force is 1 N;
            NaN if there are none. They are in the order and frame of `contacts`.
        touched: mask (d, g) of grasps on the displaced object. It is true where all f fingers
            touch, and can press with balanced forces.
    """

    contacts: Contacts
    forces: Float[Tensor, "dg f 3"]
    touched: Bool[Tensor, "d g"]


def touch_moved(
    hand: Hand, field: DistanceField, grasps: Grasps, forces: Float[Tensor, "g f 3"]
) -> MovedContacts:
    """Return the contacts of g grasps after each of 16 displacements of the object (`MOVED.count`),
    with their forces.

    The displacements are at most 20 mm long (`MOVED.radius`). They fill a ball evenly, in the axes
    of the hand. The contacts are in the frame of the object, as `field`. Each fingertip moves along
    the straight line from its position in the pre-grasp to that in the grasp. It goes on beyond,
    until it touches the surface that `field` gives. The balanced `forces` (g, f, 3) [N] at the f
    planned contacts of each grasp say in which ratios the fingers push.
    """
    count = MOVED.count
    numbers = torch.arange(count, dtype=torch.float64, device="cpu")
    sizes = (numbers * MOVED.turn % 1.0) ** (1 / 3)  # even in the ball
    moved = MOVED.radius * (sizes[:, None] * fibonacci_sphere(count)).to(forces)
    pose = grasps.obj_from_hand.to(forces)
    before = apply(pose, hand.tip_centres(grasps.pregrasp).to(forces))
    path = apply(pose, hand.tip_centres(grasps.joints).to(forces)) - before
    way = path / norm(path, keepdim=True).clamp_min(MOVED.still)
    start = before - rotate(pose, moved[None]).transpose(0, 1)[:, :, None]  # (d, g, f, 3)
    points, normals, found = trace(field, start, way.expand_as(start), hand.tips.radius.to(forces))
    pairs = internal_forces(grasps.contacts.points.to(forces)).flatten(2).mT
    weights = matvec(torch.linalg.pinv(pairs), forces.nan_to_num(0.0).flatten(1))
    points = points.flatten(0, 1)
    normals = normals.flatten(0, 1)
    pressed = forces_near(points, normals, weights.repeat(count, 1))
    push = -dot(pressed, normals).amax(-1)
    touched = found.all(-1) & torch.isfinite(push).view(found.shape[:2])
    return MovedContacts(Contacts(points, normals), pressed / push[:, None, None], touched)


def trace(
    field: DistanceField, start: Sets, way: Sets, radius: Float[Tensor, "f"]
) -> tuple[Sets, Sets, Bool[Tensor, "d g f"]]:
    """Return for each ball that moves on a straight line the surface point [m] that it first
    touches. Return then the normal there, and whether the ball touches.

    The balls belong to d displacements, g grasps and f fingertips. All tensors but `radius` have
    the shape (d, g, f, 3), and the mask (d, g, f). Ball f, of a `radius` [m], starts with its
    centre at `start` [m]. It moves along the unit vector `way`, by at most 120 mm (`MOVED.length`).
    `field` gives the signed distance [m] from the surface; the normals are outward unit vectors. A
    ball that does not touch has the surface point nearest to its end. This is sphere tracing: a
    ball moves on by its distance from the surface.
    """
    travelled = torch.zeros_like(start[..., 0]).flatten(0, 1)
    shape = start.shape[:-1]
    field = field.rows(torch.arange(start.shape[1], device=start.device).repeat(len(start)))
    start = start.flatten(0, 1)
    way = way.flatten(0, 1)
    for _ in range(MOVED.steps):
        gap = field.query(start + travelled[..., None] * way)[0] - radius
        further = travelled + gap.clamp_min(MOVED.least)
        travelled = torch.where(gap < MOVED.close, travelled, further).clamp_max(MOVED.length)
    distance, gradient = field.query(start + travelled[..., None] * way)
    steepness = norm(gradient, keepdim=True)
    normals = gradient / steepness.clamp_min(MOVED.flat)
    points = start + travelled[..., None] * way - distance[..., None] * normals
    touching = distance - radius < MOVED.close
    return points.view(*shape, 3), normals.view(*shape, 3), touching.view(shape)
