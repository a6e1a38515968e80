"""Spheres that cover the hand's links: clearance from object and table.

Each collision shape is cut into cells, one sphere each. Fingers' edges stick out of them by up to 4 mm, corners of the
palm by 9 mm. No surface with a radius of curvature above 25 mm reaches a face between them.
"""

import dataclasses
import itertools
import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.geometry.frames import rotation_from_rpy
from torchgrasp.hand.hand_toml import HandSpec
from torchgrasp.hand.urdf import Shape, Triple, Urdf

FINGER_CELL = 0.015
"""Edge of a finger's cells [m]; larger ones let the edges stick out farther."""
PALM_CELL = 0.022
"""Edge of the palm's cells [m]; coarser ones let the corners stick out farther."""
SINGLE_LAYER = 0.025
"""A shape thinner than this [m] has one layer of cells across."""
BULGE = 0.004
"""How far a sphere may stand out of a shape's faces [m]; a fingertip's sphere may not."""
INSET = 0.001
"""How far a sphere may stay short of its cell's corners [m]."""


@dataclasses.dataclass(frozen=True)
class CollisionSpheres(Value):
    """Spheres [m] fixed to links. `finger`: index in grasp order, -1 palm, -2 parked; `touching`: fingertips.

    >>> from torchgrasp import load_hand
    >>> spheres = load_hand("barrett").collision_spheres
    >>> len(spheres.radius), float(spheres.radius.max()) < 0.05, int(spheres.touching.sum())
    (117, True, 3)
    """

    link_index: Int[Tensor, " s"]
    center: Float[Tensor, "s 3"]
    radius: Float[Tensor, " s"]
    finger: Int[Tensor, " s"]
    touching: Bool[Tensor, " s"]


def spheres_from_urdf(urdf: Urdf, spec: HandSpec) -> CollisionSpheres:
    """Cover every collision shape of a URDF with spheres."""
    owner = {joint: i for i, f in enumerate(spec.fingers) for joint in f.joints}
    tips = [f.tip_link for f in spec.fingers]
    rows: list[tuple[int, Triple, float, int, bool]] = []
    for index, link in enumerate(urdf.links):
        movers, touching = urdf.movers(link.name), link.name in tips
        finger = owner.get(movers[0].name, -2) if movers else -1
        cell = PALM_CELL if finger == -1 else FINGER_CELL
        for shape in link.shapes:
            # a tip's contact is known exactly: no sphere may touch before it
            centers, radius = _cover(shape, cell, 0.0 if touching else BULGE)
            rows += [(index, center, radius, finger, touching) for center in centers]
    link_index, center, radius, finger, touching = zip(*rows, strict=True)
    center, radius = torch.tensor(center, dtype=torch.float64), torch.tensor(radius, dtype=torch.float64)
    return CollisionSpheres(torch.tensor(link_index), center, radius, torch.tensor(finger), torch.tensor(touching))


def _cover(shape: Shape, cell: float, bulge: float) -> tuple[list[Triple], float]:
    """Return centres and radius of the spheres that cover a shape."""
    if shape.kind == "sphere":
        return [shape.xyz], shape.size[0]
    cylinder = shape.kind == "cylinder"
    # a cylinder is cut as its bounding box
    size = (2 * shape.size[0], 2 * shape.size[0], shape.size[1]) if cylinder else shape.size
    counts = [1 if x == min(size) and x < SINGLE_LAYER else max(1, round(x / cell)) for x in size]
    half = [x / n / 2 for x, n in zip(size, counts, strict=True)]
    thinnest = min((x / 2 for x, n in zip(size, counts, strict=True) if n == 1), default=math.inf)
    radius = min(math.hypot(*half) - INSET, thinnest + bulge)
    centers = []
    for place in itertools.product(*(range(n) for n in counts)):
        if all(0 < c < n - 1 for c, n in zip(place, counts, strict=True)):
            continue  # an inner cell: the outer ones meet the object first
        center = [(2 * c + 1 - n) * h for c, n, h in zip(place, counts, half, strict=True)]
        # a sphere is pulled in until it stands out of a face by no more than the bulge
        reach = [max(0.0, s / 2 + bulge - radius) for s in size]
        center = [math.copysign(min(abs(c), r), c) for c, r in zip(center, reach, strict=True)]
        if cylinder:
            rim, out = max(0.0, shape.size[0] + bulge - radius), math.hypot(center[0], center[1])
            if out > rim:
                center[:2] = [center[0] * rim / out, center[1] * rim / out]
        centers.append(center)
    rotated = torch.tensor(centers, dtype=torch.float64) @ rotation_from_rpy(shape.rpy).T
    placed = rotated + torch.tensor(shape.xyz, dtype=torch.float64)
    return [(x, y, z) for x, y, z in placed.tolist()], radius
