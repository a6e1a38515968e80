"""How a grasp carries a load: its arm, the force that carries it, and the greatest force of the
fingers.
"""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch

from tests.make import load_hand, near, real, spokes, touched_contacts
from tests.pinch import pinch
from tests.success.scenes import around, grasps_at
from torchgrasp.contacts.balance import least_friction_forces, tangential_ratio
from torchgrasp.geometry.frames import apply, inverse, rotate, rotation_from_vector
from torchgrasp.geometry.linalg import unit
from torchgrasp.success.loads import (
    carrying_force,
    greatest_force,
    lever_arm,
    log_odds_about,
    squeezing_forces,
    squeezing_strength,
)
from torchgrasp.values.planning import Contacts


def test_the_arm_of_a_load_is_about_the_longest_side_of_the_best_three_in_any_frame_or_order(
    generator,
):
    points = torch.randn(20, 5, 3, generator=generator, dtype=torch.float64)
    center = real([0.5, 0.1, -0.3])
    threes = torch.stack(
        [lever_arm(points[:, list(k)], center) for k in itertools.combinations(range(5), 3)]
    )
    assert torch.equal(lever_arm(points, center), threes.amin(0))
    assert bool((lever_arm(points, center) <= lever_arm(points[:, :4], center)).all())
    points = 0.05 * torch.randn(30, 3, 3, generator=generator, dtype=torch.float64)
    center = real([0.01, -0.02, 0.015])
    found = lever_arm(points, center)
    for row in range(10):
        p = points[row].numpy()
        first, second, third = max(
            ((0, 1, 2), (1, 2, 0), (2, 0, 1)), key=lambda s: np.linalg.norm(p[s[0]] - p[s[1]])
        )
        side = p[second] - p[first]
        gaps = [
            np.linalg.norm(np.cross(side, x - p[first])) / np.linalg.norm(side)
            for x in (center.numpy(), p[third])
        ]
        assert float(found[row]) == pytest.approx(gaps[0] / (gaps[1] + 0.01))
    turn = rotation_from_vector(real([0.3, -1.0, 2.0]))
    torch.testing.assert_close(
        lever_arm(points[:, [2, 0, 1]] @ turn.T + 1.0, turn @ center + 1.0), found
    )
    assert lever_arm(points[:0], center).shape == (0,)


@pytest.mark.parametrize("push", [0.0, 2.0])
def test_the_force_that_carries_a_load_is_the_least_with_which_no_contact_slides(push, generator):
    normals = spokes(0.0, 2 * math.pi / 3, 4 * math.pi / 3).expand(40, 3, 3)
    points = 0.06 * normals + 0.05 * torch.randn(40, 3, 3, generator=generator, dtype=torch.float64)
    load = real([0.5, 0.3, -2.0])
    center = real([0.01, 0.0, -0.02])
    balanced = least_friction_forces(points, normals)
    found = carrying_force(Contacts(points, normals), balanced, center, (0.8,), load, push)[0]
    pushes = (
        push
        * unit(
            torch.randn(4000 if push else 1, 3, generator=generator, dtype=torch.float64)
        ).numpy()
    )
    ratio = tangential_ratio(balanced, normals).amax(-1).nan_to_num(torch.inf)
    assert bool(torch.isinf(found[ratio > 0.81]).all()) and int((ratio < 0.75).sum()) > 5
    for p, n, f, s in zip(
        *(x[ratio < 0.75].numpy() for x in (points, normals, balanced, found)), strict=True
    ):
        wrench = np.hstack(
            [np.vstack([np.eye(3), np.cross(x, np.eye(3)).T]) for x in p - center.numpy()]
        )
        loads = np.pad(load.numpy() + pushes, ((0, 0), (0, 3)))
        shared = -np.linalg.lstsq(wrench, loads.T, rcond=None)[0].T.reshape(-1, 3, 3)

        def slides(factor, f=f, n=n, shared=shared):
            """Whether a contact slides under one of the loads."""
            force = factor * f + shared
            press = -(force * n).sum(-1)
            return bool((np.linalg.norm(force + press[..., None] * n, axis=-1) > 0.8 * press).any())

        assert slides(0.97 * s) and not slides(1.03 * s)


def moved_by_joints(hand, grasp, step=1e-6):
    """How the touching points (f, 3, h) of the first grasp's tips move with the joints, by
    differences, in the hand.
    """
    points = apply(inverse(grasp.obj_from_hand), grasp.contacts.points)[0]
    rest = hand.link_poses(grasp.joints)[0, hand.tips.index]
    local = (rest[:, :3, :3].mT @ (points - rest[:, :3, 3])[..., None])[..., 0]

    def touching(joints):
        """The points of the tips that touch."""
        poses = hand.link_poses(joints[None])[0, hand.tips.index]
        return (poses[:, :3, :3] @ local[..., None])[..., 0] + poses[:, :3, 3]

    steps = step * torch.eye(hand.dof, dtype=torch.float64)
    return torch.stack(
        [touching(grasp.joints[0] + d) - touching(grasp.joints[0] - d) for d in steps], -1
    ) / (2 * step)


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_at_the_greatest_force_virtual_work_asks_one_drive_for_its_whole_torque_and_no_drive_for_more(
    name, generator
):
    hand, grasp = pinch(name)
    forces = torch.randn(1, 3, 3, generator=generator, dtype=torch.float64)
    work = torch.einsum(
        "fih,fi->h", moved_by_joints(hand, grasp), rotate(inverse(grasp.obj_from_hand), forces)[0]
    )
    used = float(greatest_force(hand, grasp, forces)) * work.abs()
    shares = [
        float(u) / hand.actuators[joint].effort
        for u, joint in zip(used, hand.joint_names, strict=True)
    ]
    assert max(shares) == pytest.approx(1.0, rel=1e-6)
    near(greatest_force(hand, grasp, 2 * forces), 0.5 * greatest_force(hand, grasp, forces), 1e-9)
    assert bool(greatest_force(hand, grasp, forces * torch.nan).isnan().all())


@pytest.mark.parametrize(("name", "fingers"), [("allegro", 3), ("allegro", 4), ("shadow", 5)])
def test_greatest_forces_of_any_number_of_fingers_do_not_depend_on_other_rows_or_the_dtype(
    name, fingers
):
    hand = load_hand(name, fingers)
    joints = torch.lerp(
        hand.lower, hand.upper, torch.linspace(0.2, 0.6, 5, dtype=torch.float64)[:, None]
    )
    _, rows = grasps_at(touched_contacts(hand, joints), name)
    rows = dataclasses.replace(rows, joints=joints)
    forces = -rows.contacts.normals
    small = hand.to(torch.float32)
    greatest = greatest_force(hand, rows, forces)
    assert greatest.shape == (5,)
    near(greatest_force(hand, rows[3:], forces[3:]), greatest[3:], 1e-9)
    found = greatest_force(small, rows.to(torch.float32), forces)
    torch.testing.assert_close(found.double(), greatest, rtol=1e-3, atol=1e-4)
    assert greatest_force(hand, rows[:0], forces[:0]).shape == (0,)


def test_log_odds_about_other_centres_fall_with_their_distance_from_the_contacts_and_are_the_scores_at_the_first():
    _, grasps = grasps_at(around(0.0, 0.004), score=[0.5, 2.0])
    middle = grasps.contacts.points[0].mean(0)
    aside = torch.stack([middle + real([x, 0.0, 0.0]) for x in (0.0, 0.01, 0.02, 0.04)])
    found = log_odds_about(grasps, aside, 0.9, (0.0, 0.0, -1.0))
    near(found[:, 0], grasps.score, 1e-12)
    assert bool((found.diff(dim=1) < 0).all())
    near(log_odds_about(grasps[1:], aside, 0.9, (0.0, 0.0, -1.0)), found[1:], 1e-9)
    rounded = log_odds_about(grasps.to(torch.float32), aside, 0.9, (0.0, 0.0, -1.0))
    near(rounded, found, 1e-2)


@pytest.mark.parametrize("count", [3, 4, 5])
def test_squeezing_forces_balance_and_push_everywhere_and_those_of_three_contacts_need_little_friction(
    count, generator
):
    points = torch.randn(60, count, 3, generator=generator, dtype=torch.float64)
    normals = unit(points + 0.4 * torch.randn(60, count, 3, generator=generator).double())
    contacts = Contacts(0.05 * points, normals)
    forces = squeezing_forces(contacts)
    found = torch.isfinite(forces).flatten(1).all(1)
    assert int(found.sum()) > 30
    forces = forces[found]
    points, normals = contacts.points[found], normals[found]
    zero = torch.zeros_like(forces[:, 0])
    near(forces.sum(1), zero, 1e-9)
    near(torch.linalg.cross(points, forces).sum(1), zero, 1e-9)
    push = -(forces * normals).sum(-1)
    assert float(push.min()) > 0
    near(push.amax(1), torch.ones_like(push[:, 0]), 1e-9)
    best = tangential_ratio(least_friction_forces(points, normals), normals).amax(1)
    needed = tangential_ratio(forces, normals).amax(1)
    if count == 3:  # of more contacts the short search finds a rough guess
        assert float((needed - best)[best < 0.6].median()) < 0.1


def test_contacts_that_cannot_be_squeezed_have_no_strength_and_others_what_the_drives_allow():
    hand, grasp = pinch("allegro")
    contacts = grasp.contacts
    forces = squeezing_forces(contacts)
    strength = squeezing_strength(hand, grasp, contacts, forces, 100.0)
    near(strength, greatest_force(hand, grasp, forces), 1e-9)
    assert float(squeezing_strength(hand, grasp, contacts, forces, 0.5)) == 0.5
    # all normals point up, so no forces that push balance
    upward = torch.zeros_like(contacts.normals)
    upward[..., 2] = 1.0
    flat = dataclasses.replace(contacts, normals=upward)
    assert bool(squeezing_forces(flat).isnan().all())
    assert float(squeezing_strength(hand, grasp, flat, squeezing_forces(flat), 100.0)) == 0.0
