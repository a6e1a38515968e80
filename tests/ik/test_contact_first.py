"""Seeds of the learned model become checked grasps on fixed contacts, best first."""

import dataclasses

import pytest
import torch
import trimesh

from tests.make import field_of_mesh
from torchgrasp.errors import BadArgument, Status
from torchgrasp.geometry.frames import apply
from torchgrasp.hand.load import load_hand
from torchgrasp.ik.attempts import solve_contact_first
from torchgrasp.ik.candidates import GraspProblem
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.seeds import query_mixture
from torchgrasp.posture_model.mixture import load_mixture
from torchgrasp.values import Certificate, Contacts


def test_grasps_are_checked_and_ranked():
    """Contacts on a ball within the Barrett hand's reach: the executable grasps come first, best first."""
    hand = load_hand("barrett")
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.035)
    turn = torch.linspace(0, 1.5, 6, dtype=torch.float64)
    flat = torch.full((6, 3), 0.001, dtype=torch.float64)
    angle = turn[:, None] + torch.tensor([0.0, 2.1, 4.2], dtype=torch.float64)
    normals = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)
    contacts = Contacts(0.035 * normals, normals, std_m=flat)
    ones = torch.ones(6, dtype=torch.float64)
    certificate = Certificate(torch.arange(6, dtype=torch.float64), ones, ones, ones > 0, ones[:, None].expand(6, 6))
    world, center = CollisionWorld(field_of_mesh(mesh)), torch.zeros(3, dtype=torch.float64)
    problem = GraspProblem(hand, contacts, certificate, world, center)
    seeds = query_mixture(hand, contacts, load_mixture("barrett"))
    grasps = solve_contact_first(problem, seeds)
    good = grasps.status == Status.OK
    assert good.sum() >= 3
    assert not (good[1:] & ~good[:-1]).any()
    for part in (grasps[good], grasps[~good]):
        assert (part.score.diff() <= 0).all()
    row = certificate.margin.tolist().index(float(grasps.certificate.margin[0]))
    torch.testing.assert_close(grasps.contacts.points[0], contacts.points[row, grasps.permutation[0]])
    tips = apply(grasps.obj_from_hand, hand.tip_centres(grasps.joints))[good]
    gap = torch.linalg.vector_norm(tips, dim=-1) - 0.035 - hand.tips.radius
    assert float(gap.abs().max()) < 2.1e-3
    assert len(solve_contact_first(problem, seeds[:0])) == 0
    with pytest.raises(BadArgument, match="std_m"):
        dataclasses.replace(problem, contacts=dataclasses.replace(contacts, std_m=None))
