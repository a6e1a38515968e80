"""Exact distances between the collision shapes of a hand's links: the oracle of self-collision
(coal).
"""

import itertools

import coal
import numpy as np
import torch

from torchgrasp import Hand
from torchgrasp.geometry.frames import rotation_from_rpy
from torchgrasp.hand.urdf import read_urdf

LEFT_OUT = frozenset(frozenset(("palm", f"f{k}_med")) for k in (1, 2))
"""Links of the Barrett hand that clear each other by less than their boxes bulge (see its
hand.toml).
"""
MAKE = {"box": coal.Box, "sphere": coal.Sphere, "cylinder": coal.Cylinder}


def exact_clearance(hand: Hand, joints: torch.Tensor) -> np.ndarray:
    """Return the signed least distance [m] of all links without a common joint, listed in hand.toml
    or not.

    Args:
        hand: the hand.
        joints: postures (n, h) [rad].
    """
    urdf = read_urdf(hand.urdf_path)
    untested = LEFT_OUT | {frozenset((j.parent, j.child)) for j in urdf.joints}
    shapes = [
        (link, MAKE[s.kind](*s.size), rotation_from_rpy(s.rpy).numpy(), np.array(s.xyz))
        for link, part in enumerate(urdf.links)
        for s in part.shapes
    ]
    owner = [hand.tree.link_names[link] for link, *_ in shapes]
    pairs = [
        (i, j)
        for i, j in itertools.combinations(range(len(shapes)), 2)
        if owner[i] != owner[j] and frozenset((owner[i], owner[j])) not in untested
    ]
    request = coal.DistanceRequest()
    request.enable_signed_distance = True
    least = np.full(len(joints), np.inf)
    for row, poses in enumerate(hand.link_poses(joints).numpy()):
        frames = [
            (poses[link, :3, :3], poses[link, :3, 3], turn, xyz) for link, _, turn, xyz in shapes
        ]
        places = [coal.Transform3s(r @ turn, r @ xyz + p) for r, p, turn, xyz in frames]
        for i, j in pairs:
            both = shapes[i][1], places[i], shapes[j][1], places[j]
            least[row] = min(least[row], coal.distance(*both, request, coal.DistanceResult()))
    return least
