"""Refinement: Jacobians against finite differences, postures recovered, limits and clearances kept."""

import dataclasses

import pytest
import torch

from tests.make import near, real, touched_contacts
from torchgrasp import Contacts, Plane, load_hand
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.geometry.frames import apply, rigid, rotate, rotation_from_vector
from torchgrasp.geometry.signed_distance import field_from_surface
from torchgrasp.ik.candidates import is_clear, measure_errors
from torchgrasp.ik.clearance import MILLIMETRE, CollisionWorld, clearance_rows, link_clearance
from torchgrasp.ik.configuration import Configuration, SpatialJacobian, differentiate
from torchgrasp.ik.motion import find_approach
from torchgrasp.ik.refine import grasp_residuals, open_hand, refine, tip_rows, tip_targets


@pytest.fixture(scope="module", params=["allegro", "barrett"])
def hand(request):
    return load_hand(request.param)


@pytest.fixture(scope="module")
def ball():
    """A ball of radius 30 mm at the origin."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.03)
    return field_from_surface(torch.tensor(mesh.vertices), torch.tensor(mesh.faces))


def random_postures(hand, n: int, seed: int = 0) -> Configuration:
    rng = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return torch.rand(*shape, generator=rng, dtype=torch.float64)

    joints = hand.lower + (hand.upper - hand.lower) * rand(n, hand.dof)
    turn = rotation_from_vector(rand(n, 3) * 4 - 2)
    return Configuration(joints, rigid(turn, rand(n, 3) * 0.1 - 0.05))


def touched(hand, posture: Configuration) -> Contacts:
    """Contacts that this very configuration touches."""
    return touched_contacts(hand, posture.joints, posture.obj_from_hand)


def far(ball_field) -> CollisionWorld:
    return CollisionWorld(ball_field, None)


def test_jacobian_against_finite_differences(hand, ball):
    posture = random_postures(hand, 6)
    lower = hand.lower + 0.05
    upper = hand.upper - 0.05
    posture = Configuration(
        posture.joints.clamp(lower, upper), posture.obj_from_hand
    )  # steps must not meet the limits
    contacts = touched(hand, random_postures(hand, 6, seed=1))
    world = CollisionWorld(ball, -0.02)

    def rows(at):
        spatial = SpatialJacobian.at(hand, at)
        target = tip_targets(hand, contacts)
        tips = tip_rows(spatial, target, contacts.normals)
        links = clearance_rows(spatial, world, tips_touch=True)
        return differentiate(spatial, [tips]), differentiate(spatial, links)

    tips, links = rows(posture)
    h = 1e-6
    for k in range(6 + hand.dof):
        step = torch.zeros(6, 6 + hand.dof, dtype=torch.float64)
        step[:, k] = h
        plus = rows(posture.integrate(hand, step))
        minus = rows(posture.integrate(hand, -step))
        difference = (plus[0][0] - minus[0][0]) / (2 * h)
        torch.testing.assert_close(tips[1][..., k], difference, rtol=1e-5, atol=2e-3)
        # hinges come sorted by depth, so that only the sum of squares compares row by row
        slope = (2 * links[0] * links[1][..., k]).sum(1)
        difference = ((plus[1][0] ** 2).sum(1) - (minus[1][0] ** 2).sum(1)) / (2 * h)
        torch.testing.assert_close(slope, difference, rtol=2e-3, atol=1.0)


def test_disturbed_postures_come_back(hand, ball):
    """From 5 mm, 10 degrees and 0.15 rad away the tips return to their contacts."""
    rng = torch.Generator().manual_seed(5)
    truth = random_postures(hand, 200)
    free = hand.self_clearance(truth.joints) > 2 * MILLIMETRE
    truth = Configuration(truth.joints[free], truth.obj_from_hand[free])
    truth = Configuration(
        truth.joints, rigid(truth.obj_from_hand[:, :3, :3], truth.obj_from_hand[:, :3, 3] + 1.0)
    )
    contacts = touched(hand, truth)  # a metre away from the ball: reach alone is tested
    g = len(truth.joints)
    scale = torch.cat(
        [torch.full((3,), 0.005), torch.full((3,), 0.17), torch.full((hand.dof,), 0.15)]
    ).double()
    start = truth.integrate(
        hand, torch.randn(g, 6 + hand.dof, generator=rng, dtype=torch.float64) * scale
    )
    refined = refine(hand, start, contacts, far(ball))
    error = measure_errors(hand, refined, contacts, far(ball)).tip_error.amax(1)
    assert float((error < MILLIMETRE).double().mean()) > 0.95
    assert bool((refined.joints >= hand.lower).all())
    assert bool((refined.joints <= hand.upper).all())
    target = tip_targets(hand, contacts)
    after, before = (
        grasp_residuals(hand, x, target, contacts.normals, far(ball), tips_touch=True)[0]
        .square()
        .sum(1)
        for x in (refined, start)
    )
    assert bool((after <= before).all())


def test_errors_name_what_is_wrong(hand, ball):
    posture = random_postures(hand, 60)
    free = hand.self_clearance(posture.joints) > 0
    posture = Configuration(posture.joints[free], posture.obj_from_hand[free])
    away = real([0.0, 0, 1.0])
    posture = Configuration(
        posture.joints,
        rigid(posture.obj_from_hand[:, :3, :3], posture.obj_from_hand[:, :3, 3] + away),
    )
    contacts = touched(hand, posture)
    same = measure_errors(hand, posture, contacts, CollisionWorld(ball, None))
    assert (same.status == Status.OK).all()

    shifted = Contacts(contacts.points + 0.003, contacts.normals)
    assert (measure_errors(hand, posture, shifted, far(ball)).status == Status.TIP_ERROR).all()

    inside_out = Contacts(
        contacts.points - 2 * hand.tips.radius[:, None] * -contacts.normals, -contacts.normals
    )
    assert (
        measure_errors(hand, posture, inside_out, far(ball)).status == Status.NORMAL_ANGLE
    ).all()

    below = measure_errors(hand, posture, contacts, CollisionWorld(ball, 2.0))
    assert (below.status == Status.TABLE_COLLISION).all()

    outside = Configuration(posture.joints.clone(), posture.obj_from_hand)
    outside.joints[:, 0] = hand.upper[0] + 0.1
    limits = measure_errors(hand, outside, touched(hand, outside), far(ball))
    assert (limits.status == Status.JOINT_LIMITS).all()

    onto = Configuration(
        posture.joints,
        rigid(posture.obj_from_hand[:, :3, :3], torch.zeros_like(away).expand(len(free[free]), 3)),
    )
    hit = measure_errors(hand, onto, touched(hand, onto), CollisionWorld(ball, None))
    inside = hit.clearance < 0
    assert inside.any()
    assert (hit.status[inside] == Status.OBJECT_COLLISION).all()

    crossed = random_postures(hand, 60).joints
    crossed = crossed[hand.self_clearance(crossed) < 0]
    n = min(len(crossed), len(posture.joints))
    assert n > 3
    few = Configuration(posture.joints[:n], posture.obj_from_hand[:n])
    bent = crossed[:n]
    itself = Configuration(bent, few.obj_from_hand)
    status = measure_errors(hand, itself, touched(hand, itself), far(ball)).status
    assert (status == Status.SELF_COLLISION).all()
    assert is_clear(hand, few, far(ball)).all() and not is_clear(hand, itself, far(ball)).any()
    assert (
        not is_clear(hand, few, CollisionWorld(ball, 2.0)).any()
        and not is_clear(hand, onto[inside], far(ball)).any()
    )

    nowhere = dataclasses.replace(contacts, points=contacts.points * float("nan"))
    assert (measure_errors(hand, posture, nowhere, far(ball)).status == Status.TIP_ERROR).all()


def test_the_opened_hand_is_farther_and_clear(hand, ball):
    """Tips around the ball open to more than they touch, at the same pose."""
    posture = random_postures(hand, 40)
    contacts = dataclasses.replace(
        touched(hand, posture), std_m=torch.zeros_like(posture.joints[:, :3])
    )
    away = CollisionWorld(ball, None)
    opened = open_hand(hand, posture, contacts, away)
    before = hand.tip_centres(posture.joints)
    after = hand.tip_centres(opened)
    outward = -hand.fingertips(posture.joints)[1]
    travel = ((after - before) * outward).sum(-1)
    assert float(travel.median()) > 0.005
    assert bool((opened >= hand.lower).all())
    assert bool((opened <= hand.upper).all())


def test_a_tilted_table_is_a_level_one_seen_from_another_frame(hand, ball):
    """Residuals, openings, approaches and clearances turn with everything; a height is a level
    plane.
    """
    posture = random_postures(hand, 6)
    contacts = touched(hand, posture)
    contacts = dataclasses.replace(contacts, std_m=torch.full_like(contacts.points[..., 0], 0.004))
    turn = rigid(
        rotation_from_vector(torch.tensor([0.4, -0.9, 0.3]).double()),
        torch.tensor([0.2, 0.1, -0.3]).double(),
    )
    moved = Configuration(posture.joints, turn @ posture.obj_from_hand)
    turned = Contacts(
        apply(turn, contacts.points), rotate(turn, contacts.normals), std_m=contacts.std_m
    )
    level = CollisionWorld(table=-0.05)
    tilted = CollisionWorld(table=Plane.horizontal(-0.05).moved(turn))

    here, there = (SpatialJacobian.at(hand, p) for p in (posture, moved))
    for tips_touch in (True, False):
        a, b = (
            differentiate(at, clearance_rows(at, world, tips_touch))
            for at, world in ((here, level), (there, tilted))
        )
        torch.testing.assert_close(a, b, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(
        link_clearance(here, level, True)[2], link_clearance(there, tilted, True)[2]
    )
    near(open_hand(hand, posture, contacts, level), open_hand(hand, moved, turned, tilted), 1e-6)
    (direction, room), (other, same) = (
        find_approach(hand, p, w) for p, w in ((posture, level), (moved, tilted))
    )
    torch.testing.assert_close(rotate(turn, direction[:, None])[:, 0], other)
    torch.testing.assert_close(room, same)
    plane = CollisionWorld(table=Plane.horizontal(-0.05))
    rows = (differentiate(here, clearance_rows(here, world, True)) for world in (level, plane))
    assert all(map(torch.equal, *rows))
    with pytest.raises(BadArgument, match="table"):
        CollisionWorld(ball, float("nan"))
