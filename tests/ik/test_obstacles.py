"""Hands among neighbours: fields, motions and probabilities against closed forms and the neighbours' own meshes."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from torchgrasp import ContactSpec, certify, fit_shape, load_hand, load_object, plan_contacts
from torchgrasp.errors import BadArgument, Status
from torchgrasp.geometry.frames import apply
from torchgrasp.geometry.signed_distance import field_from_surface
from torchgrasp.ik import CollisionWorld, GraspProblem, Obstacles, PostureLibrary, nearest_postures, solve_joint
from torchgrasp.ik.motion import collision_probability, lift_clearance
from torchgrasp.scene import Occupancy
from torchgrasp.shape.surface import extract_surface

SPEC = ContactSpec(table=0.0)
BALL, SIZE = torch.tensor([-0.01, 0.09, 0.06], dtype=torch.float64), 0.04
"""Centre and radius [m] of the neighbour."""


def ball_occupancy(middle=BALL, radius=SIZE, likely=0.95):
    """Voxels of a ball, as likely full as said."""
    origin = torch.tensor([-0.3, -0.3, 0.0025], dtype=torch.float64)
    occupancy = Occupancy(origin, 0.005, torch.zeros(120, 120, 50, dtype=torch.float64))
    inside = (occupancy.centres - middle).norm(dim=-1) < radius
    return dataclasses.replace(occupancy, probability=likely * inside)


@pytest.fixture(scope="module")
def given():
    """Certified contacts on a jug, and all but the obstacles of a problem."""
    hand, shape = load_hand("allegro"), fit_shape(load_object("jug").view, seed=0, table=0.0)
    surface = extract_surface(shape)
    plan = plan_contacts(shape, SPEC, starts=14, seed=2)
    certificate = certify(plan.contacts, SPEC)
    good = (plan.status == Status.OK) & certificate.closed
    world = CollisionWorld(field_from_surface(surface.vertices, surface.faces), 0.0)
    problem = GraspProblem(hand, plan.contacts[good], certificate[good], world, surface.vertices.mean(0))
    return problem, PostureLibrary.of(hand, 600), shape, surface


def solve(given, obstacles=None, reachable=None):
    problem, library, shape, _ = given
    world = dataclasses.replace(problem.world, obstacles=obstacles)
    seeds = nearest_postures(library, problem.contacts, world, reachable=reachable)
    grasps = solve_joint(dataclasses.replace(problem, world=world, reachable=reachable), seeds, shape, SPEC)
    return grasps, grasps[grasps.status == Status.OK]


@pytest.fixture(scope="module")
def free(given):
    return solve(given)


@pytest.fixture(scope="module")
def among(given):
    return solve(given, Obstacles.of(ball_occupancy()))


def paths(hand, grasp):
    """Sphere centres (n, 3) and radii on a grasp's approach, closing and lift, by forward kinematics."""
    opened = apply(grasp.obj_from_hand, hand.sphere_centres(grasp.pregrasp))[0]
    closed = apply(grasp.obj_from_hand, hand.sphere_centres(grasp.joints))[0]
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    places = [opened - back * grasp.approach[0] for back in torch.linspace(0.1, 0, 30).tolist()]
    for share in np.linspace(0, 1, 9):
        joints = grasp.pregrasp + share * (grasp.joints - grasp.pregrasp)
        places.append(apply(grasp.obj_from_hand, hand.sphere_centres(joints))[0])
    places += [closed + height * up for height in torch.linspace(0, 0.1, 30).tolist()]
    return torch.stack(places), hand.collision_spheres.radius.double()


def test_grasps_beside_a_ball_keep_clear_of_it_all_the_way(given, free, among):
    hand = given[0].hand

    def room(grasps):
        spheres = (paths(hand, grasp) for grasp in grasps)
        return [float(((centres - BALL).norm(dim=-1) - SIZE - radius).min()) for centres, radius in spheres]

    unaware, aware = room(free[1]), room(among[1])
    assert len(aware) >= 3 and min(unaware) < -0.01
    assert min(aware) > -0.003  # half a voxel


def test_obstacles_far_away_and_none_change_nothing(given, free):
    far = Obstacles.of(ball_occupancy(torch.tensor([0.27, 0.27, 0.2], dtype=torch.float64), 0.012))
    again, _ = solve(given, far)
    for name in ("joints", "pregrasp", "approach", "obj_from_hand", "status"):
        torch.testing.assert_close(getattr(free[0], name), getattr(again, name), atol=1e-6, rtol=0)
    assert Obstacles.of(ball_occupancy(likely=0.0)) is None
    with pytest.raises(BadArgument, match="full"):
        Obstacles.of(ball_occupancy(), full=0.0)


def test_the_field_is_the_distance_to_the_region(generator):
    obstacles = Obstacles.of(ball_occupancy())
    points = BALL + 0.08 * (2 * torch.rand(2000, 3, generator=generator, dtype=torch.float64) - 1)
    points[:, 2].clamp_(0.005, 0.24)
    true = (points - BALL).norm(dim=1) - SIZE
    assert float((obstacles.field.query(points)[0] - true).abs().max()) < 0.006  # a voxel's diagonal, and its faces


def test_probability_of_collision_is_that_of_what_is_swept(given, free):
    hand, grasps = given[0].hand, free[1]
    likely, unlikely, none = (
        collision_probability(hand, grasps, Obstacles.of(ball_occupancy(likely=p))) for p in (0.95, 0.3, 0.11)
    )
    met = torch.tensor(
        [bool(((c - BALL).norm(dim=-1) < r + SIZE - 0.006).any()) for c, r in (paths(hand, g) for g in grasps)]
    )
    away = torch.tensor(
        [bool(((c - BALL).norm(dim=-1) > r + SIZE + 0.006).all()) for c, r in (paths(hand, g) for g in grasps)]
    )
    assert bool(met.any())
    assert bool((likely[met] >= 0.8).all()) and bool((unlikely[met] < 0.5).all()) and bool((none[met] < 0.25).all())
    assert bool((likely[away] == 0).all())


def test_obstacles_that_may_be_touched_forbid_nothing(given):
    wall = ball_occupancy(radius=1.0)  # everything is full
    assert len(solve(given, Obstacles.of(wall))[1]) == 0
    soft, _ = solve(given, Obstacles.of(wall, hard=False))
    assert Status.NEIGHBOUR_COLLISION not in soft.status


def test_a_thing_on_the_target_leaves_no_room_for_its_lift(given):
    vertices = given[3].vertices
    top = torch.tensor([*vertices[vertices[:, 2].argmax()][:2].tolist(), float(vertices[:, 2].max()) + 0.02]).double()
    assert lift_clearance(vertices, Obstacles.of(ball_occupancy(top, 0.02))) < -0.01
    beside = torch.tensor([0.2, 0.2, 0.1], dtype=torch.float64)
    assert lift_clearance(vertices, Obstacles.of(ball_occupancy(beside, 0.03))) > 0.02


def test_only_reachable_poses_are_grasps(given, free):
    """An arm that comes from one side and cannot reach around: half of the directions of approach."""
    hand, side = given[0].hand, torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    asked = []

    def reachable(obj_from_hand):
        asked.append(len(obj_from_hand))
        return obj_from_hand[:, :3, :3] @ hand.approach.double() @ side > 0

    _, good = solve(given, reachable=reachable)
    assert len(good) >= 3 and asked
    assert bool(reachable(good.obj_from_hand).all())
    assert not bool(reachable(free[1].obj_from_hand).all())
    nowhere, _ = solve(given, reachable=lambda poses: torch.zeros(len(poses), dtype=torch.bool))
    assert len(nowhere) == 0
    once = iter([True])
    fickle, _ = solve(given, reachable=lambda poses: torch.full((len(poses),), next(once, False)))
    assert Status.OK not in fickle.status
    with pytest.raises(BadArgument, match="reachable"):
        solve(given, reachable=lambda poses: math.inf)
