"""Hands among neighbours: fields, motions and probabilities against closed forms and the
neighbours' own meshes.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.make import near, real
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.geometry.frames import apply
from torchgrasp.geometry.plane import Plane
from torchgrasp.ik import Obstacles
from torchgrasp.ik.motion import collision_probability, lift_clearance
from torchgrasp.scene import Occupancy

BALL = real([-0.01, 0.09, 0.06])
SIZE = 0.04
"""Centre and radius [m] of the neighbour."""


def ball_occupancy(middle=BALL, radius=SIZE, likely=0.95):
    """Voxels of a ball, as likely full as said."""
    origin = real([-0.3, -0.3, 0.0025])
    occupancy = Occupancy(origin, 0.005, torch.zeros(120, 120, 50, dtype=torch.float64))
    inside = (occupancy.centres - middle).norm(dim=-1) < radius
    return dataclasses.replace(occupancy, probability=likely * inside)


@pytest.fixture(scope="module")
def jug(jugs):
    return jugs(3)


@pytest.fixture(scope="module")
def hand(jug):
    return jug.problem.hand


@pytest.fixture(scope="module")
def free(jug_grasps):
    """The executable grasps without obstacles."""
    return executable(jug_grasps(3))


def executable(grasps):
    return grasps.executable


def paths(hand, grasp, rise=0.0):
    """Sphere centres (n, 3) and radii on a grasp's approach, closing and lift, by forward
    kinematics.
    """
    opened = apply(grasp.obj_from_hand, hand.sphere_centres(grasp.pregrasp))[0] + real(
        [0.0, 0.0, rise]
    )
    closed = apply(grasp.obj_from_hand, hand.sphere_centres(grasp.joints))[0]
    up = real([0.0, 0.0, 1.0])
    places = [opened - back * grasp.approach[0] for back in torch.linspace(0.1, 0, 30).tolist()]
    for share in np.linspace(0, 1, 9):
        joints = grasp.pregrasp + share * (grasp.joints - grasp.pregrasp)
        down = real([0.0, 0.0, (1 - share) * rise])
        places.append(apply(grasp.obj_from_hand, hand.sphere_centres(joints))[0] + down)
    places += [closed + height * up for height in torch.linspace(0, 0.1, 30).tolist()]
    return torch.stack(places), hand.collision_spheres.radius.double()


def test_grasps_beside_a_ball_keep_clear_of_it_all_the_way(jug, hand, free):
    def room(grasps):
        spheres = (paths(hand, grasp) for grasp in grasps)
        return [
            float(((centres - BALL).norm(dim=-1) - SIZE - radius).min())
            for centres, radius in spheres
        ]

    unaware = room(free)
    aware = room(executable(jug.solve(Obstacles.of(ball_occupancy()))))
    assert len(aware) >= 3 and min(unaware) < -0.01
    assert min(aware) > -0.003  # half a voxel


def test_obstacles_far_away_none_or_that_may_be_touched_forbid_nothing(jug, jug_grasps):
    far = Obstacles.of(ball_occupancy(real([0.27, 0.27, 0.2]), 0.012))
    free = jug_grasps(3)
    again = jug.solve(far)
    for name in ("joints", "pregrasp", "approach", "obj_from_hand", "status"):
        near(getattr(free, name), getattr(again, name), 1e-6)
    assert Obstacles.of(ball_occupancy(likely=0.0)) is None
    with pytest.raises(BadArgument, match="full"):
        Obstacles.of(ball_occupancy(), full=0.0)
    wall = ball_occupancy(radius=1.0)  # everything is full
    assert len(executable(jug.solve(Obstacles.of(wall)))) == 0
    assert Status.NEIGHBOUR_COLLISION not in jug.solve(Obstacles.of(wall, hard=False)).status


def test_the_field_is_the_distance_to_the_region_and_tells_the_room_for_a_lift(generator, jug):
    obstacles = Obstacles.of(ball_occupancy())
    points = BALL + 0.08 * (2 * torch.rand(2000, 3, generator=generator, dtype=torch.float64) - 1)
    points[:, 2].clamp_(0.005, 0.24)
    true = (points - BALL).norm(dim=1) - SIZE
    assert (
        float((obstacles.field.query(points)[0] - true).abs().max()) < 0.006
    )  # a voxel's diagonal, and its faces
    vertices = jug.surface.vertices
    top = torch.tensor(
        [*vertices[vertices[:, 2].argmax()][:2].tolist(), float(vertices[:, 2].max()) + 0.02]
    ).double()
    assert lift_clearance(vertices, Obstacles.of(ball_occupancy(top, 0.02))) < -0.01
    beside = real([0.2, 0.2, 0.1])
    assert lift_clearance(vertices, Obstacles.of(ball_occupancy(beside, 0.03))) > 0.02


def test_probability_of_collision_is_that_of_what_is_swept(hand, free):
    likely, unlikely, none = (
        collision_probability(hand, free, Obstacles.of(ball_occupancy(likely=p)), None)
        for p in (0.95, 0.3, 0.11)
    )
    gaps = [
        (centres - BALL).norm(dim=-1) - radius - SIZE
        for centres, radius in (paths(hand, g) for g in free)
    ]
    met = torch.tensor([float(g.min()) < -0.006 for g in gaps])
    away = torch.tensor([float(g.min()) > 0.006 for g in gaps])
    assert bool(met.any())
    assert (
        bool((likely[met] >= 0.8).all())
        and bool((unlikely[met] < 0.5).all())
        and bool((none[met] < 0.25).all())
    )
    assert bool((likely[away] == 0).all())


def test_only_reachable_poses_are_grasps(jug, hand, free):
    """An arm that comes from one side and cannot reach around: half of the directions of approach."""
    side = real([0.0, -1.0, 0.0])
    asked = []

    def reachable(obj_from_hand):
        asked.append(len(obj_from_hand))
        return obj_from_hand[:, :3, :3] @ hand.approach.double() @ side > 0

    good = executable(jug.solve(reachable=reachable))
    assert len(good) >= 3 and asked
    assert bool(reachable(good.obj_from_hand).all())
    assert not bool(reachable(free.obj_from_hand).all())
    assert len(jug.solve(reachable=lambda poses: torch.zeros(len(poses), dtype=torch.bool))) == 0
    once = iter([True])
    assert (
        Status.OK
        not in jug.solve(
            reachable=lambda poses: torch.full((len(poses),), next(once, False))
        ).status
    )
    with pytest.raises(BadArgument, match="reachable"):
        jug.solve(reachable=lambda poses: math.inf)


def test_a_hand_that_begins_above_its_grasp_sweeps_from_there(hand, free, generator):
    radius = hand.collision_spheres.radius.double()
    sides = torch.nn.functional.normalize(
        torch.randn(60, 3, generator=generator, dtype=torch.float64), dim=1
    )
    for grasp in free[:3]:
        grasp = dataclasses.replace(
            grasp, approach=real([[0.0, 0.0, 1.0]])
        )  # not through the place above it
        opened = apply(grasp.obj_from_hand, hand.sphere_centres(grasp.pregrasp))[0]
        table = Plane.horizontal(
            float((opened[:, 2] - radius).min()) + 0.028
        )  # opened links would be in the table
        level = paths(hand, grasp)[0]
        above = paths(hand, grasp, 0.029)[0][29]
        skin = (above[:, None] + radius[:, None, None] * sides).reshape(-1, 3)
        room = (torch.cdist(skin, level.reshape(-1, 3)) - radius.repeat(len(level))).amin(1)
        ball = Obstacles.of(
            ball_occupancy(skin[room.argmax()], 0.004)
        )  # beside the way without a rise
        assert float(collision_probability(hand, grasp, ball, None)) == 0
        assert float(collision_probability(hand, grasp, ball, table)) > 0.8


def test_a_hand_is_lifted_along_the_normal_of_its_table(hand, free):
    grasp = dataclasses.replace(free[0], approach=real([[0.0, 0.0, 1.0]]))
    opened = apply(grasp.obj_from_hand, hand.sphere_centres(grasp.pregrasp))[0]
    closed = apply(grasp.obj_from_hand, hand.sphere_centres(grasp.joints))[0]
    outermost = torch.cat([opened, closed])[:, 0].max()
    beside = closed[closed[:, 0].argmax()].clone()
    beside[0] = outermost + 0.06
    ball = Obstacles.of(ball_occupancy(beside, 0.01))
    wall = Plane(real([1.0, 0.0, 0.0]), -1.0)
    assert float(collision_probability(hand, grasp, ball, Plane.horizontal(-1.0))) == 0
    assert float(collision_probability(hand, grasp, ball, wall)) > 0.8
