"""The paper's refinement (Sec. 6.3): COBYLA on the sum of the tip distances, one grasp at a time.

Only the joints are variables: with the pose, here from Eq. (24), as six more, COBYLA stops millimetres away.
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

FIRST_RADIUS, LAST_RADIUS = 0.02, 1e-4
"""Radius of the trust region [rad] at the start, about a degree, and at the end, 0.01 mm at a fingertip."""


def refine_by_cobyla(
    hand: Hand, configuration: Configuration, contacts: Contacts, world: CollisionWorld
) -> Configuration:
    """Return configurations of least tip distances; starting pose and world are not used, as in the paper."""
    from scipy.optimize import minimize

    bounds = list(zip(hand.lower.tolist(), hand.upper.tolist(), strict=True))
    joints, poses = [], []
    for start, points in zip(configuration.joints.double().cpu().numpy(), contacts.points.double(), strict=True):

        def distance(x: np.ndarray, points: Tensor = points) -> float:
            """Return the sum of the tips' distances [mm]."""
            try:
                tips, obj_from_hand = place(hand, torch.from_numpy(x).to(points), points)
            except DegenerateContacts:  # fingertips in a line have no virtual frame
                return math.inf
            return float(torch.linalg.vector_norm(apply(obj_from_hand, tips) - points, dim=-1).sum()) / MILLIMETRE

        options = {"rhobeg": FIRST_RADIUS, "maxiter": 2000}
        solution = minimize(distance, start, method="COBYLA", bounds=bounds, tol=LAST_RADIUS, options=options)
        joints.append(torch.from_numpy(np.clip(solution.x, *np.array(bounds).T)).to(points))
        poses.append(place(hand, joints[-1], points)[1])
    if not joints:
        return configuration
    return Configuration(torch.stack(joints), torch.stack(poses)).to(configuration.joints.dtype)


def place(
    hand: Hand, joints: Float[Tensor, "h"], points: Float[Tensor, "3 3"]
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "4 4"]]:
    """Return the fingertips in the hand's frame [m], and the hand's pose by Eq. (24)."""
    tips = hand.fingertips(joints)[0]
    return tips, virtual_frame(points) @ inverse(virtual_frame(tips))
