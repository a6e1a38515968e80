"""Candidates become grasps whose status names the first thing that is wrong."""

import dataclasses

import pytest
import torch

from tests.make import touched_contacts
from torchgrasp.errors import Status
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.hand.load import load_hand
from torchgrasp.ik.candidates import GraspCandidates, GraspProblem, check_candidates
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.configuration import Configuration
from torchgrasp.values import Certificate


@pytest.fixture(scope="module")
def touching():
    """The Allegro hand half closed, in free space: a problem, and a candidate that solves it."""
    hand = load_hand("allegro")
    joints = (hand.lower + 0.45 * (hand.upper - hand.lower))[None]
    one, std = torch.ones(1, dtype=torch.float64), torch.full((1, 3), 0.001, dtype=torch.float64)
    contacts = dataclasses.replace(touched_contacts(hand, joints), std_m=std)
    certificate = Certificate(one, one, one, one > 0, one[:, None].expand(1, 6))
    problem = GraspProblem(hand, contacts, certificate, CollisionWorld(), contacts.points[0].mean(0))
    pose, status = torch.eye(4, dtype=torch.float64)[None], torch.zeros(1, dtype=torch.int64)
    configuration = Configuration(joints, pose)
    return problem, GraspCandidates(configuration, contacts, certificate, torch.arange(3)[None], status)


def test_a_candidate_in_free_space_passes(touching):
    problem, candidate = touching
    grasp = check_candidates(problem, candidate)
    assert grasp.status.tolist() == [Status.OK]
    assert not torch.equal(grasp.pregrasp, grasp.joints)
    torch.testing.assert_close(grasp.approach[0], problem.hand.approach.double())


def test_failed_contacts_keep_their_status_and_unproven_ones_are_not_closed(touching):
    problem, candidate = touching
    late = dataclasses.replace(candidate, status=torch.full_like(candidate.status, Status.TOO_CLOSE))
    open_ = dataclasses.replace(candidate.certificate, closed=~candidate.certificate.closed)
    assert check_candidates(problem, late).status.tolist() == [Status.TOO_CLOSE]
    assert check_candidates(problem, dataclasses.replace(late, certificate=open_)).status.tolist() == [Status.TOO_CLOSE]
    unproven = check_candidates(problem, dataclasses.replace(candidate, certificate=open_))
    assert unproven.status.tolist() == [Status.NOT_CLOSED]
    assert torch.equal(unproven.pregrasp, unproven.joints)  # nobody will open it


def distance_field(center, half, spacing, distance):
    """A field of a distance in closed form around a centre."""
    axis = torch.arange(-half, half, spacing, dtype=torch.float64)
    offsets = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return SignedDistanceField(center - half, spacing, distance(offsets))


def test_a_hand_that_cannot_open_says_so(touching):
    """A small ball 1 mm deep in the thumb's tip is touched; frozen joints cannot leave it."""
    problem, candidate = touching
    hand, joints = problem.hand, candidate.configuration.joints
    tip, normal = hand.tip_centres(joints)[0, 2], hand.fingertips(joints)[1][0, 2]
    middle = tip + (hand.tips.radius[2] + 0.004 - 0.001) * normal
    ball = distance_field(middle, 0.02, 0.0005, lambda offset: offset.norm(dim=-1) - 0.004)
    touched = dataclasses.replace(problem, world=CollisionWorld(ball))
    assert check_candidates(touched, candidate).status.tolist() == [Status.OK]
    actuated = dataclasses.replace(hand.actuated, lower=joints[0], upper=joints[0])
    rigid = dataclasses.replace(hand, actuated=actuated)
    frozen = dataclasses.replace(touched, hand=rigid)
    assert check_candidates(frozen, candidate).status.tolist() == [Status.PREGRASP]


def test_a_hand_in_a_cage_has_no_approach(touching):
    problem, candidate = touching
    middle = problem.hand.sphere_centres(candidate.configuration.joints)[0].mean(0)
    cage = distance_field(middle, 0.4, 0.01, lambda offset: 0.17 - offset.norm(dim=-1))
    caged = dataclasses.replace(problem, world=CollisionWorld(cage))
    assert check_candidates(caged, candidate).status.tolist() == [Status.NO_APPROACH]
