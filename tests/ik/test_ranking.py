"""Ranking: order within groups, the geometric score, and which way each feature of the model of success counts."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch

from tests.make import near, real
from tests.pinch import pinch
from torchgrasp import ContactSpec, closure_probability, fit_shape
from torchgrasp.base import join
from torchgrasp.geometry.frames import apply, inverse, rigid, rotate, rotation_from_vector
from torchgrasp.geometry.linalg import unit
from torchgrasp.ik.ranking import (
    FEATURES,
    carrying_force,
    centred_friction,
    finger_levers,
    is_known,
    load_arm,
    rank_by_success,
    rank_in_group,
    success_features,
    success_log_odds,
)
from torchgrasp.plan.forces import least_friction_forces, tangential_ratio
from torchgrasp.values import Contacts, PointCloud, format_success

PADS = real([[0.1, 0.3, 0.2]])
GOOD = torch.tensor([[4.0, 0.3, -1.0, -0.2, 0.5]])
WORSE = {"log-odds of closure": -2.0, "log of the stiffest finger's lever over 70 mm, at most": -0.5}
RADIUS = 0.04


def test_rank_in_group_against_brute_force_and_centred_friction_is_the_tangent_of_the_tilt(generator):
    cost = torch.randint(0, 40, (200,), generator=generator).double()  # with ties
    group = torch.randint(0, 30, (200,), generator=generator)
    place, counts = torch.zeros(200, dtype=torch.int64), {}
    for i in sorted(range(200), key=lambda i: (float(cost[i]), i)):
        place[i] = counts.get(int(group[i]), 0)
        counts[int(group[i])] = int(place[i]) + 1
    assert torch.equal(rank_in_group(group, cost), place)
    assert len(rank_in_group(group[:0], cost[:0])) == 0
    near(centred_friction(triple(tilt=0.0)), torch.zeros(1, dtype=torch.float64), 1e-6)
    near(centred_friction(triple(tilt=0.3)), real([0.3]).tan(), 1e-6)


def triple(height: float = 0.0, tilt: float = 0.0) -> Contacts:
    """Three contacts on a vertical cylinder at 120 degrees, normals tilted upward."""
    angle = torch.arange(3, dtype=torch.float64) * 2 * math.pi / 3
    radial = torch.stack([angle.cos(), angle.sin(), torch.zeros(3, dtype=torch.float64)], -1)
    up = real([0.0, 0, 1])
    normals = torch.cos(torch.tensor(tilt)) * radial + torch.sin(torch.tensor(tilt)) * up
    return Contacts((0.03 * radial + height * up)[None], normals[None])


def test_the_arm_of_a_load_is_about_the_longest_side_of_the_best_three_in_any_frame_or_order(generator):
    points = torch.randn(20, 5, 3, generator=generator, dtype=torch.float64)
    center = real([0.5, 0.1, -0.3])
    threes = torch.stack([load_arm(points[:, list(k)], center) for k in itertools.combinations(range(5), 3)])
    assert torch.equal(load_arm(points, center), threes.amin(0))
    assert bool((load_arm(points, center) <= load_arm(points[:, :4], center)).all())
    points = 0.05 * torch.randn(30, 3, 3, generator=generator, dtype=torch.float64)
    center = real([0.01, -0.02, 0.015])
    found = load_arm(points, center)
    for row in range(10):
        p = points[row].numpy()
        first, second, third = max(((0, 1, 2), (1, 2, 0), (2, 0, 1)), key=lambda s: np.linalg.norm(p[s[0]] - p[s[1]]))
        side = p[second] - p[first]
        gaps = [np.linalg.norm(np.cross(side, x - p[first])) / np.linalg.norm(side) for x in (center.numpy(), p[third])]
        assert float(found[row]) == pytest.approx(gaps[0] / (gaps[1] + 0.01))
    turn = rotation_from_vector(real([0.3, -1.0, 2.0]))
    torch.testing.assert_close(load_arm(points[:, [2, 0, 1]] @ turn.T + 1.0, turn @ center + 1.0), found)
    assert load_arm(points[:0], center).shape == (0,)


@pytest.mark.parametrize("push", [0.0, 2.0])
def test_the_force_that_carries_a_load_is_the_least_with_which_no_contact_slides(push, generator):
    normals = triple().normals.expand(40, 3, 3)
    points = 0.06 * normals + 0.05 * torch.randn(40, 3, 3, generator=generator, dtype=torch.float64)
    load, center = real([0.5, 0.3, -2.0]), real([0.01, 0.0, -0.02])
    balanced = least_friction_forces(points, normals)
    found = carrying_force(Contacts(points, normals), balanced, center, 0.8, load, push)
    pushes = push * unit(torch.randn(4000 if push else 1, 3, generator=generator, dtype=torch.float64)).numpy()
    ratio = tangential_ratio(balanced, normals).amax(-1).nan_to_num(torch.inf)
    assert bool(torch.isinf(found[ratio > 0.81]).all()) and int((ratio < 0.75).sum()) > 5
    for p, n, f, s in zip(*(x[ratio < 0.75].numpy() for x in (points, normals, balanced, found)), strict=True):
        wrench = np.hstack([np.vstack([np.eye(3), np.cross(x, np.eye(3)).T]) for x in p - center.numpy()])
        loads = np.pad(load.numpy() + pushes, ((0, 0), (0, 3)))
        shared = -np.linalg.lstsq(wrench, loads.T, rcond=None)[0].T.reshape(-1, 3, 3)

        def slides(factor, f=f, n=n, shared=shared):
            """Whether a contact slides under one of the loads."""
            force = factor * f + shared
            press = -(force * n).sum(-1)
            return bool((np.linalg.norm(force + press[..., None] * n, axis=-1) > 0.8 * press).any())

        assert slides(0.97 * s) and not slides(1.03 * s)


@pytest.mark.parametrize("name", FEATURES)
@pytest.mark.parametrize("hand", ["allegro", "barrett"])
def test_every_feature_counts_the_way_it_should_and_an_unknown_hand_gets_the_least_chance(name, hand):
    changed = GOOD.clone()
    changed[0, FEATURES.index(name)] += WORSE.get(name, 0.5)
    assert float(success_log_odds(changed, hand) - success_log_odds(GOOD, hand)) < -0.1
    known = [success_log_odds(GOOD, hand) for hand in ("allegro", "barrett")]
    assert float(success_log_odds(GOOD, "mine")) == min(map(float, known))


def test_success_is_unknown_beyond_the_trials_and_ranks_after_known_success(ball):
    _, grasp = pinch("allegro")
    sure = dataclasses.replace(grasp.contacts, std_m=torch.full((1, 3), 0.003, dtype=torch.float64))
    unsure = dataclasses.replace(grasp.contacts, std_m=torch.full((1, 3), 0.026, dtype=torch.float64))
    grasps = join([dataclasses.replace(grasp, contacts=contacts) for contacts in (unsure, sure)])
    grasps = dataclasses.replace(grasps, score=torch.tensor([3.0, 1.0]).double(), status=torch.zeros(2).long())
    assert is_known(ball, grasps, 0.3).tolist() == is_known(ball, grasps, 2.0).tolist() == [False, True]
    assert not bool(is_known(ball, grasps, 0.2).any())
    large = dataclasses.replace(ball, scale=0.5)
    assert not bool(is_known(large, grasps, 0.6).any())
    ranked = rank_by_success(dataclasses.replace(grasps, known=is_known(ball, grasps, 0.6)), torch.tensor([3.0, 1.0]))
    assert ranked.score.tolist() == [1.0, 3.0]  # both keep their scores
    assert format_success(ranked) == "73%" and format_success(ranked[1]) == "unknown"


@pytest.fixture(scope="module")
def ball():
    """The posterior of a whole ball of 80 mm."""
    draw = torch.randn(600, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return fit_shape(PointCloud(RADIUS * unit(draw), unit(draw)))


def around(height=0.0):
    """Contacts around z at a height [m] on the ball."""
    angle = real([0.3, 2.4, 4.6])
    level = math.sqrt(RADIUS**2 - height**2) * torch.stack([angle.cos(), angle.sin(), 0 * angle], -1)
    points = level + real([0.0, 0.0, height])
    return Contacts(points[None], unit(points)[None])


def held(contacts, hand_from_obj=None):
    """The Allegro hand's pinch of other contacts, as if it reached them, in another frame of the object."""
    hand, grasp = pinch("allegro")
    pose = grasp.obj_from_hand if hand_from_obj is None else hand_from_obj @ grasp.obj_from_hand
    rows = grasp[torch.zeros(len(contacts), dtype=torch.int64)]
    return hand, dataclasses.replace(rows, contacts=contacts, obj_from_hand=pose.expand(len(contacts), 4, 4))


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_equal_springs_in_all_joints_yield_by_the_square_of_the_lever(name):
    hand, grasp = pinch(name)
    points = apply(inverse(grasp.obj_from_hand), grasp.contacts.points)[0]
    normals = rotate(inverse(grasp.obj_from_hand), grasp.contacts.normals)[0]
    levers, step = finger_levers(hand, grasp)[0], 1e-6
    rest = hand.link_poses(grasp.joints)[0, hand.tips.index]
    local = (rest[:, :3, :3].mT @ (points - rest[:, :3, 3])[..., None])[..., 0]

    def pushed(joints):
        """How far [m] the touching points of the tips are along the normals."""
        poses = hand.link_poses(joints[None])[0, hand.tips.index]
        return (((poses[:, :3, :3] @ local[..., None])[..., 0] + poses[:, :3, 3]) * normals).sum(-1)

    moves = torch.stack(
        [(pushed(grasp.joints[0] + d) - pushed(grasp.joints[0] - d)) / (2 * step) for d in step * torch.eye(hand.dof)],
        1,
    )
    stiffness = hand.actuated.coupling.T @ hand.actuated.coupling  # of unit springs in every joint of the URDF
    for finger, move in enumerate(moves):
        yielding = torch.linalg.solve(stiffness, move)  # least energy: stiffness @ yielding = torque of a unit force
        assert float(move @ yielding) == pytest.approx(float(levers[finger]) ** 2, rel=1e-6)


def test_features_of_a_ball_by_hand(ball):
    contacts, center = around(0.01), real([0.0, 0.0, -0.02])
    hand, grasp = held(contacts)
    closure, least, arm, lever, _ = success_features(hand, ball, grasp, center, 0.5, seed=3)[0].tolist()
    cone = math.atan(0.5)
    closed = closure_probability(ball, contacts, ContactSpec(friction=0.5), n=600, seed=3).probability
    assert closure == pytest.approx(float(torch.logit(closed, eps=1e-3)))
    assert least * cone == pytest.approx(math.asin(0.25), abs=0.01)  # forces within the plane of the contacts
    p = contacts.points[0].numpy()
    gaps = [np.linalg.norm(np.cross(p[2] - p[1], x - p[1])) for x in (center.numpy(), p[0])]
    gaps = [gap / np.linalg.norm(p[2] - p[1]) for gap in gaps]
    assert arm == pytest.approx(math.log(gaps[0] / (gaps[1] + 0.01) + 0.1))
    assert lever == pytest.approx(math.log((min(float(finger_levers(hand, grasp).min()), 0.07) + 0.01) / 0.08))
    forces = least_friction_forces(contacts.points, contacts.normals, 1.0)
    carried = success_features(hand, ball, grasp, center, 0.8)[0, 4]
    assert carried == pytest.approx(math.log(carrying_force(contacts, forces, center, 0.4, real([0, 0, -1.0]))))


def test_features_do_not_depend_on_the_frame_and_rows_do_not_on_each_other(ball):
    turn = rotation_from_vector(real([0.5, 1.0, -2.0]))
    moved_from_obj = rigid(turn, real([0.3, -0.1, 0.2]))
    center = real([0.0, 0.01, 0.0])
    both = Contacts(*(torch.cat([x, y]) for x, y in zip(tensors(around(0.01)), tensors(around(-0.02)), strict=True)))
    hand, grasps = held(both)
    here = success_features(hand, ball, grasps, center, 0.6)
    there = Contacts(apply(moved_from_obj, both.points), both.normals @ turn.T)
    moved, at = held(there, moved_from_obj)[1], apply(moved_from_obj, center[None])[0]
    down = tuple((-turn[:, 2]).tolist())
    again = success_features(hand, ball.moved(moved_from_obj), moved, at, 0.6, weight=down)
    near(again[:, 1:], here[:, 1:], 1e-3)
    near(torch.sigmoid(again[:, 0]), torch.sigmoid(here[:, 0]), 0.06)  # other draws
    near(success_features(hand, ball, grasps[1:], center, 0.6), here[1:], 1e-9)
    assert success_features(hand, ball, grasps[:0], center, 0.6).shape == (0, len(FEATURES))


def test_contacts_that_nothing_balances_have_finite_features(ball):
    one_side = around(0.01)
    alike = Contacts(one_side.points, one_side.normals[:, :1].expand(1, 3, 3).contiguous())
    hand, grasp = held(alike)
    features = success_features(hand, ball, grasp, torch.zeros(3, dtype=torch.float64), 0.5)
    assert bool(torch.isfinite(features).all())
    assert float(features[0, 1]) == pytest.approx(math.pi / 2 / math.atan(0.5))


def tensors(contacts):
    """Return points and normals."""
    return contacts.points, contacts.normals
