"""Candidates become grasps whose status names the first thing that is wrong."""

import dataclasses

import pytest
import torch

from tests.make import distance_field, touched_contacts
from torchgrasp import Certificate, Plane, Status, load_hand
from torchgrasp.ik.candidates import GraspCandidates, GraspProblem, check_candidates
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.motion import opened_pose


@pytest.fixture(scope="module")
def touching():
    """The Allegro hand half closed, in free space: a problem, and a candidate that solves it."""
    hand = load_hand("allegro")
    joints = (hand.lower + 0.45 * (hand.upper - hand.lower))[None]
    one = torch.ones(1, dtype=torch.float64)
    std = torch.full((1, 3), 0.001, dtype=torch.float64)
    contacts = dataclasses.replace(touched_contacts(hand, joints), std_m=std)
    certificate = Certificate(one, one, one, one > 0, one[:, None].expand(1, 6))
    problem = GraspProblem(
        hand, contacts, certificate, CollisionWorld(), contacts.points[0].mean(0)
    )
    pose = torch.eye(4, dtype=torch.float64)[None]
    status = torch.zeros(1, dtype=torch.int64)
    configuration = Configuration(joints, pose)
    return problem, GraspCandidates(
        configuration, contacts, certificate, torch.arange(3)[None], status
    )


def test_a_candidate_in_free_space_passes_and_failed_or_unproven_ones_keep_a_status(touching):
    problem, candidate = touching
    grasp = check_candidates(problem, candidate)
    assert grasp.status.tolist() == [Status.OK]
    assert not torch.equal(grasp.pregrasp, grasp.joints)
    torch.testing.assert_close(grasp.approach[0], problem.hand.approach.double())
    late = dataclasses.replace(
        candidate, status=torch.full_like(candidate.status, Status.TOO_CLOSE)
    )
    open_ = dataclasses.replace(candidate.certificate, closed=~candidate.certificate.closed)
    assert check_candidates(problem, late).status.tolist() == [Status.TOO_CLOSE]
    assert check_candidates(
        problem, dataclasses.replace(late, certificate=open_)
    ).status.tolist() == [Status.TOO_CLOSE]
    unproven = check_candidates(problem, dataclasses.replace(candidate, certificate=open_))
    assert unproven.status.tolist() == [Status.NOT_CLOSED]
    assert torch.equal(unproven.pregrasp, unproven.joints)  # nobody will open it


def test_a_hand_that_cannot_open_or_is_in_a_cage_says_so(touching):
    """A small ball 1 mm deep in the thumb's tip is touched; frozen joints cannot leave it."""
    problem, candidate = touching
    hand = problem.hand
    joints = candidate.configuration.joints
    tip = hand.tip_centres(joints)[0, 2]
    normal = hand.fingertips(joints)[1][0, 2]
    middle = tip + (hand.tips.radius[2] + 0.004 - 0.001) * normal
    ball = distance_field(lambda x: (x - middle).norm(dim=-1) - 0.004, middle, 0.02, 0.0005)
    touched = dataclasses.replace(problem, world=CollisionWorld(ball))
    assert check_candidates(touched, candidate).status.tolist() == [Status.OK]
    actuated = dataclasses.replace(hand.actuated, lower=joints[0], upper=joints[0])
    rigid = dataclasses.replace(hand, actuated=actuated)
    frozen = dataclasses.replace(touched, hand=rigid)
    assert check_candidates(frozen, candidate).status.tolist() == [Status.PREGRASP]
    middle = problem.hand.sphere_centres(candidate.configuration.joints)[0].mean(0)
    cage = distance_field(lambda x: 0.17 - (x - middle).norm(dim=-1), middle, 0.4, 0.01)
    caged = dataclasses.replace(problem, world=CollisionWorld(cage))
    assert check_candidates(caged, candidate).status.tolist() == [Status.NO_APPROACH]


def test_an_opened_hand_rises_until_it_clears_the_table_by_a_millimetre():
    """The opened Barrett hand points down; its lowest sphere is 5 mm in, 5 mm over and 40 mm in the
    table: too much.
    """
    hand = load_hand("barrett")
    joints = torch.tensor([[0.3, 0.5, 0.5, 0.5]], dtype=torch.float64).expand(3, -1)
    pose = (
        torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
        .expand(3, -1, -1)
        .clone()
    )
    height = -hand.sphere_centres(joints)[..., 2] - hand.collision_spheres.radius
    pose[:, 2, 3] = torch.tensor([0.015, 0.025, -0.02], dtype=torch.float64) - height.amin(1)
    moved = (opened_pose(hand, joints, pose, Plane.horizontal(0.02)) - pose)[:, :3, 3]
    expected = torch.tensor([[0, 0, 0.006], [0, 0, 0], [0, 0, 0]], dtype=torch.float64)
    torch.testing.assert_close(moved, expected, atol=1e-9, rtol=0)
    assert torch.equal(opened_pose(hand, joints, pose, None), pose)
