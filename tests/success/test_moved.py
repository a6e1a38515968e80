"""Contacts of displaced objects: on a ball by geometry, and their forces by balance."""

import dataclasses

import pytest
import torch

from tests.make import near, real
from tests.success.scenes import RADIUS, UNEVEN, around, grasps_at
from torchgrasp.contacts.balance import (
    forces_near,
    internal_forces,
    least_friction_forces,
    tangential_ratio,
)
from torchgrasp.geometry.frames import apply, rigid, rotation_from_vector
from torchgrasp.geometry.plane import move
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.success.moved import touch_moved, trace


def ball_field(radius=RADIUS, spacing=0.002):
    """The exact distances from a ball about the origin, on a grid."""
    line = torch.arange(-0.1, 0.1001, spacing, dtype=torch.float64)
    nodes = (
        torch.cartesian_prod(line, line, line).norm(dim=1).reshape(len(line), len(line), len(line))
    )
    return SignedDistanceField(torch.full((3,), -0.1, dtype=torch.float64), spacing, nodes - radius)


def test_a_ball_on_its_way_stops_where_the_distance_of_the_centres_is_the_sum_of_both_radii(
    generator,
):
    way = torch.nn.functional.normalize(
        torch.randn(4, 50, 3, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    beside = 0.03 * torch.randn(4, 50, 3, 3, generator=generator, dtype=torch.float64)
    start = beside - 0.09 * way
    tips = real([0.012, 0.008, 0.0])
    points, normals, found = trace(ball_field(), start, way, tips)
    along = (start * way).sum(-1)  # |start + t way| = RADIUS + tip
    root = along**2 - (start**2).sum(-1) + (RADIUS + tips) ** 2
    travelled = -along - root.clamp_min(0).sqrt()
    touching = (
        (root > 1e-4) & (travelled > 0.002) & (travelled < 0.115)
    )  # grazing balls may stop beside
    assert int(touching.sum()) > 200 and bool(found[touching].all())
    centre = start + travelled[..., None] * way
    assert (
        float((normals - centre / centre.norm(dim=-1, keepdim=True))[touching].abs().max()) < 0.05
    )
    assert float((points - RADIUS * normals)[touching].abs().max()) < 1.5e-3
    past = root < -4e-4  # by 4 mm or more
    assert int(past.sum()) > 20 and not bool(found[past].any())


@pytest.mark.parametrize("fingers", [3, 4, 5])
def test_forces_near_others_balance_push_and_need_less_friction_than_the_weights_they_begin_with(
    fingers, generator
):
    _, grasps = grasps_at(around(0.01, -0.01, 0.0, angles=UNEVEN[:fingers]), "shadow")
    points = grasps.contacts.points
    normals = grasps.contacts.normals
    forces = least_friction_forces(points, normals, strongest=1.0)
    pairs = internal_forces(points)
    weights = (torch.linalg.pinv(pairs.flatten(2).mT) @ forces.flatten(1)[..., None])[..., 0]
    near(torch.einsum("bp,bpfi->bfi", weights, pairs), forces, 1e-9)
    shaken = points + 0.004 * torch.randn(points.shape, generator=generator, dtype=torch.float64)
    found = forces_near(shaken, normals, weights)
    assert float(found.sum(1).abs().max()) < 1e-9
    assert float(torch.linalg.cross(shaken, found).sum(1).abs().max()) < 1e-9
    assert bool((-(found * normals).sum(-1) > 0).all())
    same = torch.einsum("bp,bpfi->bfi", weights, internal_forces(shaken))
    needed = [tangential_ratio(x, normals).amax(-1) for x in (same, found)]
    assert bool((needed[1] <= needed[0] + 0.02).all())  # evenness counts a little, too
    best = tangential_ratio(least_friction_forces(shaken, normals), normals).amax(-1)
    assert bool((needed[1] < best + 0.1).all())


def test_forces_near_nothing_that_pushes_are_nan():
    _, grasps = grasps_at(around(0.01))
    alike = grasps.contacts.normals[:, :1].expand(1, 3, 3).contiguous()
    assert bool(
        forces_near(grasps.contacts.points, alike, torch.ones(1, 3, dtype=torch.float64))
        .isnan()
        .all()
    )


def test_a_moved_ball_is_touched_on_its_surface_in_the_axes_of_the_hand():
    hand, grasps = grasps_at(around(0.01, -0.01))
    field = ball_field()
    # The fingers of these grasps do not reach their contacts: they are moved so that their tips
    # surround the ball.
    tips = hand.tip_centres(grasps.joints)
    grasps = dataclasses.replace(
        grasps, obj_from_hand=rigid(torch.eye(3).double().expand(2, 3, 3), -tips.mean(1))
    )
    forces = least_friction_forces(grasps.contacts.points, grasps.contacts.normals, strongest=1.0)
    found = touch_moved(hand, field, grasps, forces)
    count = len(found.touched)
    assert found.touched.shape == (count, 2) and found.contacts.points.shape == (2 * count, 3, 3)
    on = found.touched.flatten()
    assert bool(on.any())
    assert float((found.contacts.points[on].norm(dim=-1) - RADIUS).abs().max()) < 1e-3
    assert float(found.forces[on].sum(1).abs().max()) < 1e-9
    near(
        -(found.forces[on] * found.contacts.normals[on]).sum(-1).amax(-1),
        torch.ones(int(on.sum())).double(),
        1e-9,
    )
    turn = rotation_from_vector(real([0.0, 0.0, 0.7]))  # a ball is the same from all sides
    pose = rigid(turn, torch.zeros(3, dtype=torch.float64))
    turned = touch_moved(hand, field, move(grasps, pose), forces @ turn.T)
    assert (
        float((turned.contacts.points[on] - apply(pose, found.contacts.points[on])).abs().max())
        < 2e-3
    )
    assert bool(torch.equal(turned.touched, found.touched))


def test_fingers_that_pass_by_the_object_touch_nothing():
    hand, grasps = grasps_at(around(0.01))
    away = rigid(torch.eye(3, dtype=torch.float64), real([1.0, 0.0, 0.0]))[None]
    forces = least_friction_forces(grasps.contacts.points, grasps.contacts.normals, strongest=1.0)
    far = dataclasses.replace(grasps, obj_from_hand=away)
    assert not bool(touch_moved(hand, ball_field(), far, forces).touched.any())
