"""The paper's refinement: COBYLA on the sum of the tip distances, one grasp at a time (Sec. 6.3).

The hand's pose follows from the joints by Eq. (24), the virtual frame of its fingertips on that of the contacts: the
joints are the only variables. With the six numbers of the pose beside them SciPy's COBYLA stops millimetres away.
Neither contact directions nor collisions enter: they are checked afterwards.
"""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.errors import DegenerateContacts
from torchgrasp.frames import apply, inverse, virtual_frame
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.clearance import MILLIMETRE, CollisionWorld
from torchgrasp.ik.configuration import Configuration
from torchgrasp.values import Contacts

FIRST, LAST, MOST = 0.02, 1e-4, 2000
"""Radius of the trust region [rad] at the start and at the end, and the most evaluations."""


def refine_by_cobyla(posture: Configuration, hand: Hand, contacts: Contacts, world: CollisionWorld) -> Configuration:
    """Return postures whose pads' contact points are as near to their contacts as COBYLA brings them.

    Args:
        posture: starting pose and joints, g rows; of the pose only the joints are used, Eq. (24) gives another.
        hand: whose fingers, in grasp order, take the contacts in theirs.
        contacts: g rows; finger i takes contact i.
        surroundings: not used, as in the paper.
    """
    from scipy.optimize import minimize

    bounds = list(zip(hand.lower.tolist(), hand.upper.tolist(), strict=True))
    joints, poses = [], []
    for start, points in zip(posture.joints.double().cpu().numpy(), contacts.points.double(), strict=True):

        def distance(x: np.ndarray, points: Tensor = points) -> float:
            """Return the sum of the tips' distances [mm]."""
            try:
                tips, placed = place(hand, torch.from_numpy(x).to(points), points)
            except DegenerateContacts:  # fingertips in a line have no virtual frame
                return math.inf
            return float(torch.linalg.vector_norm(apply(placed, tips) - points, dim=-1).sum()) / MILLIMETRE

        options = {"rhobeg": FIRST, "maxiter": MOST}
        found = minimize(distance, start, method="COBYLA", bounds=bounds, tol=LAST, options=options)
        best = torch.from_numpy(np.clip(found.x, *np.array(bounds).T)).to(points)
        joints.append(best)
        poses.append(place(hand, best, points)[1])
    if not joints:
        return posture
    return Configuration(torch.stack(joints), torch.stack(poses)).to(posture.joints.dtype)


def place(
    hand: Hand, joints: Float[Tensor, "h"], points: Float[Tensor, "3 3"]
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "4 4"]]:
    """Return the fingertips in the hand's frame [m], and the hand's pose by Eq. (24)."""
    tips = hand.fingertips(joints)[0]
    return tips, virtual_frame(points) @ inverse(virtual_frame(tips))
