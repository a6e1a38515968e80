"""A sphere cover of the hand's links, for penalties against the object and the table.

It is made from the collision shapes of the URDF, which are what the simulator sees. Each shape is cut into cells and
each cell gets a sphere. Spheres stand out of flat faces by at most 4 mm, so that nothing whose radius of curvature is
25 mm or more can reach a face between them; edges of fingers stick out by up to 4 mm, corners of the palm by 9 mm.
"""

import dataclasses
import itertools
import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.base import Value
from torchgrasp.frames import rotation_from_rpy
from torchgrasp.hand.hand_toml import HandSpec
from torchgrasp.hand.urdf import Shape, Urdf

PITCH = 0.015
"""Edge of a finger's cells [m]."""
PALM_PITCH = 0.022
"""Edge of the palm's cells [m]."""
THICK = 0.025
"""A shape thinner than this [m] has one layer of cells across."""
BULGE = 0.004
"""How far a sphere may stand out of a shape's faces [m]; those of fingertips do not."""
SHORT = 0.001
"""How far a sphere may stay short of its cell's corners [m]."""


@dataclasses.dataclass(frozen=True)
class CollisionSpheres(Value):
    """Spheres fixed to links: `center` [m] in the link's frame, `radius` [m].

    `finger` is the grasp-order index of the finger, -1 for the palm and -2 for parked fingers; `touching` marks the
    fingertips that are meant to touch the object.
    """

    link_index: Int[Tensor, " s"]
    center: Float[Tensor, "s 3"]
    radius: Float[Tensor, " s"]
    finger: Int[Tensor, " s"]
    touching: Bool[Tensor, " s"]


def spheres_from_urdf(urdf: Urdf, spec: HandSpec) -> CollisionSpheres:
    """Cover every collision shape of a URDF with spheres, labelled with the finger they belong to."""
    owner = {joint: i for i, f in enumerate(spec.fingers) for joint in f.joints}
    tips = [f.tip_link for f in spec.fingers]
    rows: list[tuple[int, tuple[float, ...], float, int, bool]] = []
    for index, link in enumerate(urdf.links):
        movers = [j.name for j in urdf.joints_above(link.name) if j.kind != "fixed"]
        finger = owner.get(movers[0], -2) if movers else -1  # the nearest joint tells whose link it is
        for shape in link.shapes:
            pitch, touching = PALM_PITCH if finger == -1 else PITCH, link.name in tips
            # where a tip touches is known exactly: its spheres must not touch before
            for center, radius in _spheres(shape, pitch, 0.0 if touching else BULGE):
                rows.append((index, center, radius, finger, touching))
    return CollisionSpheres(
        torch.tensor([r[0] for r in rows], dtype=torch.long),
        torch.tensor([r[1] for r in rows], dtype=torch.float64).reshape(-1, 3),
        torch.tensor([r[2] for r in rows], dtype=torch.float64),
        torch.tensor([r[3] for r in rows], dtype=torch.long),
        torch.tensor([r[4] for r in rows], dtype=torch.bool),
    )


def _spheres(shape: Shape, pitch: float, bulge: float) -> list[tuple[tuple[float, ...], float]]:
    """Cover one shape: a sphere by itself, a box and a cylinder (by its bounding box, corners spared) by cells."""
    if shape.kind == "sphere":
        return [(shape.xyz, shape.size[0])]
    round_shape = shape.kind == "cylinder"
    size = (2 * shape.size[0], 2 * shape.size[0], shape.size[1]) if round_shape else shape.size
    counts = [1 if x == min(size) and x < THICK else max(1, round(x / pitch)) for x in size]
    half = [x / n / 2 for x, n in zip(size, counts, strict=True)]
    thinnest = min((x / 2 for x, n in zip(size, counts, strict=True) if n == 1), default=math.inf)
    radius = min(math.hypot(*half) - SHORT, thinnest + bulge)
    local = []
    for cell in itertools.product(*(range(n) for n in counts)):
        if all(0 < c < n - 1 for c, n in zip(cell, counts, strict=True)):
            continue  # an inner cell: the outer ones meet the object first
        center = [(2 * c + 1 - n) * h for c, n, h in zip(cell, counts, half, strict=True)]
        # spheres are pulled in until they stand out of a face by no more than the bulge
        reach = [max(0.0, s / 2 + bulge - radius) for s in size]
        center = [math.copysign(min(abs(c), r), c) for c, r in zip(center, reach, strict=True)]
        if round_shape:
            rim, out = max(0.0, shape.size[0] + bulge - radius), math.hypot(center[0], center[1])
            if out > rim:
                center[:2] = [center[0] * rim / out, center[1] * rim / out]
        local.append(center)
    turned = torch.tensor(local, dtype=torch.float64) @ rotation_from_rpy(shape.rpy).T
    placed = turned + torch.tensor(shape.xyz, dtype=torch.float64)
    return [((p[0], p[1], p[2]), radius) for p in placed.tolist()]
