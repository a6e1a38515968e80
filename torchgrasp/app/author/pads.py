"""Guesses of fingertip pads: their contact points and normals.

A URDF does not define pads. The guessed pad faces the direction in which the finger's last joint
bends. This is the side with most of the joint's range. For a symmetric range it is the side towards
the other fingertips.
"""

import dataclasses
import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.errors import BadArgument
from torchgrasp.hand.hand_toml import Pad
from torchgrasp.hand.kinematics import chain_from_urdf, map_directions, map_points, pose_in_carrier
from torchgrasp.hand.urdf import Joint, Link, LinkShape, Triple, Urdf, pose_of


@dataclasses.dataclass(frozen=True)
class PadNumbers:
    """Numbers by which pads, the parts that touch objects, are guessed from the motion and the
    surface of fingertips.
    """

    # share of the random postures in which fingers count as meeting: those with the nearest tips
    near_share: float = 0.1
    # distance of the middle of a joint's range from zero, as a share of the range; beyond it the
    # pad is on the side with most of the range
    one_sided: float = 0.1
    # angle [rad] by which the contact of a round tip is turned from its motion to the finger's end
    tilt: float = math.radians(30)
    short_arm: float = 1e-3  # least distance of a tip from the axis of a joint that moves it [m]
    # greatest distance [m] of a surface point from a ray or plane on which it counts
    beside: float = 0.003
    end: float = 0.015  # length of a finger's end, half of whose thickness is the ball's radius [m]
    radii: tuple[float, float] = (0.003, 0.013)  # least and greatest radius of a ball [m]
    radius_digits: int = 4  # number of decimals to which the radius [m] of a ball is rounded
    place_digits: int = 6  # number of decimals to which the centre [m] of a ball is rounded
    digits: int = 12  # number of decimals to which all numbers of a pad are rounded


@dataclasses.dataclass(frozen=True)
class FacingNumbers:
    """Bounds within which the pads of fingers count as facing each other."""

    # greatest angle [degrees] between a pad's normal and the direction to the centroid of the
    # contacts
    angle: float = 45.0
    nearest: float = 0.015  # least distance of a contact from this centroid [m]
    farthest: float = 0.08  # greatest distance of a contact from this centroid [m]
    # least distance [m] that is used as a divisor, so that nothing is divided by 0
    least: float = 1e-9


PADS = PadNumbers()
FACING = FacingNumbers()
Vector = Float[np.ndarray, "3"]
Points = Float[np.ndarray, "_ 3"]  # points [m], of any count in each use


class Guess(NamedTuple):
    """A guess of the fingertip pads of a hand, the parts of the fingertips that touch objects.

    Attributes:
        pads: the pad of each fingertip, in the frame of the fingertip's link.
        outward: unit vector (3,) from the last joint to the tip of each finger, in the same frame.
        approach: unit direction (3,) out of the palm, in the frame of the URDF's root.
    """

    pads: tuple[Pad, ...]
    outward: tuple[Vector, ...]
    approach: Triple


def guess_pads(
    urdf: Urdf,
    frames: Float[Tensor, "3 4 _ n"],
    tips: Sequence[str],
    surfaces: Mapping[str, Points],
) -> Guess:
    """Return guessed pads of the fingertips, and the direction out of the palm.

    A pad is the part of a fingertip that touches objects. `frames` (3, 4, l, n) are poses [m] of l
    links in n random postures. They are in the frame of the URDF's root. The links are the
    fingertips, which `tips` names, and last the palm. `surfaces` holds points (k, 3) [m] on each
    link, by its name, in its frame.
    """
    links = {x.name: i for i, x in enumerate(urdf.links)}
    cores = [_core(urdf, urdf.links[links[tip]], surfaces) for tip in tips]
    tip_frames = frames[:, :, :-1]
    centres = map_points(tip_frames, torch.tensor(np.stack(cores)))  # 3 f n
    middle = centres[:, :3].mean(1, keepdim=True)
    spread = torch.linalg.vector_norm(centres[:, :3] - middle, dim=0).sum(0)
    count = max(1, int(PADS.near_share * len(spread)))
    near = spread.topk(count, largest=False).indices
    # the mean way from each tip to the middle, in the tip's frame: (f, 3)
    ways = tip_frames[:, :3] * (middle - centres)[:, None]
    inward = ways[..., near].sum(0).mean(-1).T.numpy()
    pads = []
    ends = []
    for tip, core, closing in zip(tips, cores, inward, strict=True):
        joint, motion, outward = _motion(urdf, tip, core)
        middle_of_range = (joint.lower + joint.upper) / 2
        one_sided = abs(middle_of_range) > PADS.one_sided * (joint.upper - joint.lower)
        bending = math.copysign(1.0, middle_of_range if one_sided else motion @ closing)
        link = urdf.links[links[tip]]
        way = bending * motion
        ends.append(outward)
        if is_primitive(link):
            pads.append(_pad(link.shapes[0], core, way, outward))
        else:
            pads.append(_ball(surfaces[tip], way, outward))
    points = surfaces.get(palm_of(urdf, tips), np.zeros((1, 3)))
    palm_middle = torch.tensor((points.min(0) + points.max(0))[None] / 2)
    palm_centre = map_points(frames[:, :, -1:, :1], palm_middle)
    # out of the palm, along the nearest axis, towards where the fingers meet
    out = (middle[:, 0, near].mean(1) - palm_centre[:, 0, 0]).numpy()
    axis = int(np.abs(out).argmax())
    return Guess(tuple(pads), tuple(ends), _triple(np.sign(out[axis]) * np.eye(3)[axis]))


def palm_of(urdf: Urdf, tips: Sequence[str]) -> str:
    """Return the name of the link from which most of the fingers start.

    `tips` are the names of the fingertip links.
    """
    bases = Counter(urdf.movers(tip)[-1].parent for tip in tips)
    return max(bases, key=lambda name: bases[name])


def order_by_facing(frames: Float[Tensor, "3 4 f n"], pads: Sequence[Pad]) -> list[int]:
    """Return the indices of f fingertips, those first whose pads best face each other.

    First come the three whose pads face each other in the largest share of n random postures. Each
    further tip is that with which this share stays largest. Pads face each other if all normals
    point to the centroid of the contacts within 45 degrees (`FACING`). The contacts must be 15 to
    80 mm from this centroid.

    `frames` are poses (3 x 4) [m] of the tips, in the frame of the URDF's root. `pads` are in the
    frames of the tips.
    """
    contacts = torch.tensor([pad.contact for pad in pads], dtype=torch.float64)
    normals = torch.tensor([pad.normal for pad in pads], dtype=torch.float64)
    points = map_points(frames, contacts)
    directions = map_directions(frames, normals)

    def share(tips: tuple[int, ...]) -> float:
        """Return the fraction of postures in which the pads of these tips all face the centroid of
        their contacts.
        """
        inward = points[:, tips].mean(1, keepdim=True) - points[:, tips]
        length = torch.linalg.vector_norm(inward, dim=0)
        cosine = (directions[:, tips] * inward).sum(0) / length.clamp_min(FACING.least)
        apart = (length > FACING.nearest) & (length < FACING.farthest)
        facing = cosine > math.cos(math.radians(FACING.angle))
        return float((facing & apart).all(0).double().mean())

    order = max(itertools.combinations(range(len(pads)), 3), key=share)
    while len(order) < len(pads):
        others = [k for k in range(len(pads)) if k not in order]
        order = max(((*order, k) for k in others), key=share)
    return list(order)


def is_primitive(link: Link) -> bool:
    """Return whether a link has a single collision shape, a box, cylinder or sphere."""
    return len(link.shapes) == 1 and link.shapes[0].kind != "mesh"


def _ball(points: Points, motion: Vector, outward: Vector) -> Pad:
    """Return a spherical pad at a finger's end: part of a ball that touches the finger's surface
    from inside.
    """
    axes = np.stack([motion, outward, np.cross(motion, outward)], 1)
    local = points @ axes
    end = local[:, 1].max()
    near = local[local[:, 1] > end - PADS.end]
    half = np.ptp(near[:, [0, 2]], axis=0).min() / 2
    radius = round(float(np.clip(half, *PADS.radii)), PADS.radius_digits)
    # the middle of the finger where the ball's centre will lie
    ring = local[np.abs(local[:, 1] - (end - radius)) < PADS.beside]
    low = ring.min(0)
    high = ring.max(0)
    core = axes @ [(low[0] + high[0]) / 2, end - radius, (low[2] + high[2]) / 2]
    normal = _tilted(motion, outward)
    # the ball moves along the normal until it touches the surface from inside
    along = (points - core) @ normal
    off = np.linalg.norm(points - core - along[:, None] * normal, axis=1)
    depth = float(along[off < PADS.beside].max(initial=radius))
    center = _triple(np.round(core + (depth - radius) * normal, PADS.place_digits))
    normal = np.array(_triple(normal / np.linalg.norm(normal)))
    return Pad(_triple(center + radius * normal), _triple(normal), center, radius)


def _motion(urdf: Urdf, tip: str, core: Vector) -> tuple[Joint, Vector, Vector]:
    """Return the last joint that moves a tip. Return also, in the tip's frame, its motion and the
    direction from joint to tip.
    """
    tip_from_above = np.eye(4)
    for joint in urdf.joints_above(tip):
        if joint.kind != "fixed":
            axis = tip_from_above[:3, :3] @ np.array(joint.axis)
            arm = core - tip_from_above[:3, 3]
            motion = axis if joint.kind == "prismatic" else np.cross(axis, arm)
            length = float(np.linalg.norm(motion))
            if length > PADS.short_arm:
                arm = arm - (arm @ axis) * axis
                reach = max(float(np.linalg.norm(arm)), PADS.short_arm)
                return joint, motion / length, arm / reach
        tip_from_above = tip_from_above @ np.linalg.inv(pose_of(joint))
    raise BadArgument("tips", tip, "links that a joint moves")


def _core(urdf: Urdf, link: Link, surfaces: Mapping[str, Points]) -> Vector:
    """Return a point near the far end of a tip, in its frame. It lies half the tip's thickness
    before the end of a simple shape.
    """
    if not is_primitive(link):
        points = surfaces[link.name]
        pose = pose_in_carrier(chain_from_urdf(urdf), link.name)[1].numpy()
        reach = np.linalg.norm(points @ pose[:, :3].T + pose[:, 3], axis=1)
        return points[reach > reach.max() - PADS.beside].mean(0)
    shape = link.shapes[0]
    center = np.array(shape.xyz)
    half = np.array(shape.half)
    rotation = pose_of(shape)[:3, :3]
    long = int(half.argmax())
    inset = half[long] - np.delete(half, long).min()
    return center + math.copysign(inset, rotation[:, long] @ center) * rotation[:, long]


def _pad(shape: LinkShape, core: Vector, motion: Vector, outward: Vector) -> Pad:
    """Return the pad of a tip that is one simple shape, on the side of its motion. On a sphere it
    is nearer to its end.
    """
    if shape.kind == "sphere":
        normal = _tilted(motion, outward)
        radius = shape.size[0]
        center = np.array(shape.xyz)
        normal = normal / np.linalg.norm(normal)
        return Pad(_triple(center + radius * normal), _triple(normal), _triple(center), radius)
    rotation = pose_of(shape)[:3, :3]
    half = np.array(shape.half)
    side = rotation.T @ motion
    side[int(half.argmax())] = 0.0  # the pad is beside the tip, not at its end
    if shape.kind == "box":
        face = int(np.abs(side).argmax())
        side = np.sign(side[face]) * np.eye(3)[face]
        depth = half[face]
    else:
        side = side / np.linalg.norm(side)
        depth = shape.size[0]
    contact = core + depth * (rotation @ side)
    return Pad(_triple(contact), _triple(rotation @ side), _triple(contact), 0.0)


def _tilted(motion: Vector, outward: Vector) -> Vector:
    """Return the normal of a round pad, between the tip's motion and the finger's end."""
    return math.cos(PADS.tilt) * motion + math.sin(PADS.tilt) * outward


def _triple(x: Vector) -> Triple:
    """Return an array as three rounded numbers."""
    a, b, c = (round(float(v), PADS.digits) + 0.0 for v in x)
    return a, b, c
