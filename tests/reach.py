"""Contacts that known postures touch, and distance fields of meshes: what tests of inverse kinematics start from."""

import numpy as np
import torch
import trimesh
from torch import Tensor

from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.geometry.signed_distance import SignedDistanceField, field_from_surface
from torchgrasp.hand.hand import Hand
from torchgrasp.values import Contacts


def touched_contacts(hand: Hand, joints: Tensor, obj_from_hand: Tensor | None = None) -> Contacts:
    """Contacts that postures touch with the middle of their pads, in the hand's frame or at poses of the hand."""
    points, normals = hand.fingertips(joints)
    if obj_from_hand is not None:
        points, normals = apply(obj_from_hand, points), rotate(obj_from_hand, normals)
    return Contacts(points, -normals)


def field_of_mesh(mesh: trimesh.Trimesh, margin: float = 0.08) -> SignedDistanceField:
    """The distance field of a mesh [m]."""
    vertices, faces = torch.tensor(np.asarray(mesh.vertices)), torch.tensor(np.asarray(mesh.faces))
    return field_from_surface(vertices, faces, margin=margin)
