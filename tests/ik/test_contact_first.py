"""Choosing, assigning and ranking of guesses."""

import dataclasses
import math

import pytest
import torch
import trimesh

from torchgrasp.errors import BadArgument, Status
from torchgrasp.frames import apply
from torchgrasp.hand.load import load_hand
from torchgrasp.ik.checks import GraspErrors
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.contact_first import assign, rank_in_group, solve_contact_first
from torchgrasp.ik.query import query_mixture
from torchgrasp.ik.ranking import centred_friction, score
from torchgrasp.ik.sdf import field_from_surface
from torchgrasp.posture_model.mixture import load_mixture
from torchgrasp.values import Certificate, Contacts, IKSeeds


def test_rank_in_group_against_brute_force(generator):
    badness = torch.randint(0, 40, (200,), generator=generator).double()  # with ties
    group = torch.randint(0, 30, (200,), generator=generator)
    place, seen = torch.zeros(200, dtype=torch.int64), {}
    for i in sorted(range(200), key=lambda i: (float(badness[i]), i)):
        place[i] = seen.get(int(group[i]), 0)
        seen[int(group[i])] = int(place[i]) + 1
    assert torch.equal(rank_in_group(badness, group), place)
    assert len(rank_in_group(badness[:0], group[:0])) == 0


def test_assign_gives_finger_i_its_contact(generator):
    points = torch.rand(4, 3, 3, generator=generator, dtype=torch.float64)
    flat = torch.rand(4, 3, generator=generator, dtype=torch.float64)
    permutation = torch.tensor([[2, 0, 1], [0, 1, 2]])
    guess = IKSeeds(
        torch.zeros(2, 4),
        torch.eye(4).expand(2, 4, 4),
        torch.tensor([3, 1]),
        permutation,
        torch.zeros(2),
        torch.zeros(2, 3),
    )
    taken = assign(Contacts(points, -points, std_m=flat), guess)
    torch.testing.assert_close(taken.points[0, 0], points[3, 2])
    torch.testing.assert_close(taken.normals[0, 2], -points[3, 1])
    torch.testing.assert_close(taken.std_m[1], flat[1])


def test_realised_grasps_are_checked_and_ranked():
    """Contacts on a ball that Barrett postures touch, disturbed: the executable ones come first, best first."""
    hand = load_hand("barrett")
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.035)
    field = field_from_surface(torch.tensor(mesh.vertices), torch.tensor(mesh.faces))
    turn = torch.linspace(0, 1.5, 6, dtype=torch.float64)
    flat = torch.full((6, 3), 0.001, dtype=torch.float64)
    angle = turn[:, None] + torch.tensor([0.0, 2.1, 4.2], dtype=torch.float64)
    normals = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)
    contacts = Contacts(0.035 * normals, normals, std_m=flat)
    ones = torch.ones(6, dtype=torch.float64)
    certificate = Certificate(torch.arange(6, dtype=torch.float64), ones, ones, ones > 0, ones[:, None].expand(6, 6))
    world, center = CollisionWorld(field, None), torch.zeros(3, dtype=torch.float64)
    guess = query_mixture(contacts, hand, load_mixture("barrett"))
    found = solve_contact_first(guess, hand, contacts, certificate, world, center)
    good = found.status == Status.OK
    assert good.sum() >= 3
    assert not (good[1:] & ~good[:-1]).any()
    for part in (found[good], found[~good]):
        assert (part.score.diff() <= 0).all()
    row = certificate.margin.tolist().index(float(found.certificate.margin[0]))
    torch.testing.assert_close(found.contacts.points[0], contacts.points[row, found.permutation[0]])
    tips = apply(found.obj_from_hand, hand.tip_centres(found.joints))[good]
    gap = torch.linalg.vector_norm(tips, dim=-1) - 0.035 - hand.tip_radius
    assert float(gap.abs().max()) < 2.1e-3
    assert len(solve_contact_first(guess[:0], hand, contacts, certificate, world, center)) == 0
    unknown = dataclasses.replace(contacts, std_m=None)
    with pytest.raises(BadArgument, match="std_m"):
        solve_contact_first(guess, hand, unknown, certificate, world, center)


def triple(height: float = 0.0, tilt: float = 0.0) -> Contacts:
    """Three contacts on a vertical cylinder at 120 degrees, normals tilted upward."""
    angle = torch.arange(3, dtype=torch.float64) * 2 * math.pi / 3
    radial = torch.stack([angle.cos(), angle.sin(), torch.zeros(3, dtype=torch.float64)], -1)
    up = torch.tensor([0.0, 0, 1], dtype=torch.float64)
    normals = torch.cos(torch.tensor(tilt)) * radial + torch.sin(torch.tensor(tilt)) * up
    return Contacts((0.03 * radial + height * up)[None], normals[None])


def test_centred_friction_is_the_tangent_of_the_tilt():
    torch.testing.assert_close(
        centred_friction(triple(tilt=0.0)), torch.zeros(1, dtype=torch.float64), atol=1e-6, rtol=0
    )
    torch.testing.assert_close(
        centred_friction(triple(tilt=0.3)), torch.tensor([0.3], dtype=torch.float64).tan(), atol=1e-6, rtol=0
    )


def test_central_untilted_grasps_rank_first():
    zeros = torch.zeros(1, 3, dtype=torch.float64)
    found = GraspErrors(zeros, zeros, torch.zeros(1, dtype=torch.float64), torch.zeros(1, dtype=torch.int64))
    center = torch.zeros(3, dtype=torch.float64)
    best = score(triple(), found, center)
    for worse in (triple(height=0.03), triple(tilt=0.5)):
        assert float(score(worse, found, center)) < float(best)
