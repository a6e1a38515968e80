"""Features of grasps: each by hand on a ball, the frame that does not matter, and which way load
and friction count.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.make import directions, near, real
from tests.success.scenes import RADIUS, UNEVEN, around, ball_body, grasps_at, whole_ball
from torchgrasp.contacts.balance import least_friction_forces
from torchgrasp.foundation.base import join
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply, rigid, rotation_from_vector
from torchgrasp.geometry.plane import move
from torchgrasp.success.features import CAUSES, FEATURES, measure_grasps
from torchgrasp.success.loads import carrying_force, greatest_force
from torchgrasp.success.moved import touch_moved
from torchgrasp.success.task import Conditions, GraspTask
from torchgrasp.values.planning import Contacts

VERTICES = RADIUS * directions(3000, seed=1) * real([1.0, 0.8, 0.6]) + real([0.0, 0.004, -0.01])
EVEN = (0.0, 2 * math.pi / 3, 4 * math.pi / 3)


def measure(hand, grasps, shape=None, vertices=VERTICES, friction=0.6, lifted=True, **task):
    """The features of grasps of the ball by name."""
    asked = GraspTask(**task)
    conditions = Conditions.of(friction, asked.mass)
    body = ball_body(vertices, shape)
    [found] = measure_grasps(hand, body, grasps, conditions, asked, lifted)
    assert found.shape == (len(grasps), len(FEATURES)) and found.dtype == torch.float64
    return dict(zip(FEATURES, found.T, strict=True))


def surrounding(contacts):
    """Grasps of the ball, with the hand where its fingertips surround the ball."""
    hand, grasps = grasps_at(contacts)
    centre = hand.tip_centres(grasps.joints).mean(1)
    turn = torch.eye(3, dtype=torch.float64).expand(len(grasps), 3, 3)
    return hand, dataclasses.replace(grasps, obj_from_hand=rigid(turn, -centre))


def test_every_feature_has_one_cause_and_an_si_unit():
    assert len(set(FEATURES)) == len(FEATURES) == sum(map(len, CAUSES.values()))
    assert {unit for names in CAUSES.values() for unit in names.values()} <= {
        "m",
        "rad",
        "N",
        "kg",
        "1",
    }


def test_features_of_a_ball_by_hand():
    contacts = around(0.01)
    hand, grasp = grasps_at(contacts)
    found = {
        name: float(x)
        for name, x in measure(hand, grasp, mass=0.3, force=5.0, displaced=True).items()
    }
    p = contacts.points[0].numpy()
    v = VERTICES.numpy()
    center = v.mean(0)
    spread = np.linalg.eigvalsh(np.cov(v[:, :2].T, bias=True)) ** 0.5
    exact = {
        "offset": np.linalg.norm(p.mean(0) - center),
        "deviation": 0.003,
        "height": v[:, 2].max() - v[:, 2].min(),
        "breadth": spread[0],
        "friction": 0.6,
        "mass": 0.3,
        "force": 5.0,
        "lifted": 1.0,
        "displaced": 1.0,
        "open loop": 0.0,
    }
    for name, wanted in exact.items():
        assert found[name] == pytest.approx(wanted, rel=1e-6, abs=1e-9), name
    assert found["size"] == pytest.approx(RADIUS, abs=0.002)


def test_the_force_needed_is_that_of_three_springs_below_the_centre_of_mass():
    contacts = around(0.0, angles=EVEN)  # each carries a third of the weight by friction
    hand, grasp = grasps_at(contacts)
    still = VERTICES - VERTICES.mean(0)
    found = measure(hand, grasp, vertices=still, mass=0.3)
    needed = found["force needed"]  # at half the friction
    near(needed, real([0.3 * 9.81 / 3 / 0.3]), 0.04)
    forces = least_friction_forces(grasp.contacts.points, grasp.contacts.normals, strongest=1.0)
    gripped = torch.minimum(greatest_force(hand, grasp, forces), real([15.0]))  # at most
    near(found["force to spare"], torch.log(gripped / needed), 1e-9)
    pressed = measure(hand, grasp, vertices=still, mass=0.3, force=2.0)
    near(pressed["force to spare"], torch.log(2.0 / needed), 1e-9)


@pytest.mark.parametrize("lifted", [True, False])
def test_the_force_to_spare_where_the_body_is_moved_is_the_mean_over_the_displaced_contacts(lifted):
    hand, grasps = surrounding(around(0.01, -0.01))
    found = measure(hand, grasps, lifted=lifted, mass=0.2, force=4.0, friction=0.7)
    forces = least_friction_forces(grasps.contacts.points, grasps.contacts.normals, strongest=1.0)
    moved = touch_moved(hand, ball_body(VERTICES).field, grasps, forces)
    strength = torch.minimum(greatest_force(hand, grasps, forces), real([4.0]))
    down, pull = (real([0.0, 0.0, -0.2 * 9.81]), 0.0) if lifted else (torch.zeros(3).double(), 2.0)
    spare = {0.7: [], 0.35: []}
    for k, touched in enumerate(moved.touched):
        rows = slice(k * len(grasps), (k + 1) * len(grasps))
        contacts = moved.contacts[rows]
        for friction, mine in spare.items():
            needed = carrying_force(
                contacts, moved.forces[rows], VERTICES.mean(0), (friction,), down, pull
            )[0]
            mine.append(torch.log(strength / needed.clamp(1e-3, 1e3)).where(touched, -9.0))
    full, half = (torch.stack(x) for x in spare.values())
    near(found["carried if moved"], (full > 0).double().mean(0), 1e-9)
    near(found["force to spare if moved"], full.clamp(-2, 2).mean(0), 1e-9)
    near(found["force to spare if moved and slippery"], half.clamp(-2, 2).mean(0), 1e-9)
    assert 0.0 < float(found["carried if moved"].min()) <= 1.0


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_a_turn_about_the_vertical_and_a_shift_of_the_whole_scene_change_nothing(name):
    hand, grasps = grasps_at(around(0.01, -0.02, 0.0), name)
    pose = rigid(rotation_from_vector(real([0.0, 0.0, 1.1])), real([0.3, -0.1, 0.2]))
    here = measure(hand, grasps, mass=0.4)
    there = measure(
        hand, move(grasps, pose), whole_ball().moved(pose), apply(pose, VERTICES), mass=0.4
    )
    searched = {"force needed", "force to spare", *CAUSES["moved"]}
    for feature in FEATURES:
        wanted = here[feature]
        tolerance = 0.02 if feature in searched else 1e-5  # the search begins with fixed directions
        torch.testing.assert_close(
            there[feature], wanted, rtol=tolerance, atol=tolerance, msg=feature
        )


def test_grasps_do_not_depend_on_each_other_and_none_have_no_features():
    hand, grasps = grasps_at(around(0.01, -0.02, 0.0))
    every = measure(hand, grasps)
    last = measure(hand, grasps[1:])
    for feature in FEATURES:
        near(last[feature], every[feature][1:], 1e-9)
    assert [len(x) for x in measure(hand, grasps[:0]).values()] == [0] * len(FEATURES)


def test_the_force_needed_is_proportional_to_the_load_and_friction_lessens_it():
    heights = torch.linspace(-0.005, 0.005, 3).tolist()
    hand, grasps = surrounding(around(*heights))
    for lifted in (True, False):
        light, heavy = (measure(hand, grasps, lifted=lifted, mass=mass) for mass in (0.2, 0.4))
        near(heavy["force needed"], 2 * light["force needed"], 1e-6)
        near(heavy["force to spare"], light["force to spare"] - math.log(2), 1e-6)
        changed = {name for name in FEATURES if not torch.equal(light[name], heavy[name])}
        assert changed <= {"force needed", "force to spare", "mass", *CAUSES["moved"]}
        slippery, rough = (
            measure(hand, grasps, lifted=lifted, friction=friction) for friction in (0.45, 0.9)
        )
        assert bool((rough["force needed"] < 0.8 * slippery["force needed"]).all())
        for better, worse in ((light, heavy), (rough, slippery)):
            assert all(
                bool((better[name] >= worse[name]).all())
                for name in ("force to spare", *CAUSES["moved"])
            )
        near(
            rough["force to spare if moved and slippery"], slippery["force to spare if moved"], 1e-6
        )
    pulled, hung = (
        measure(hand, grasps, lifted=lifted)["force needed"] for lifted in (False, True)
    )
    assert bool(
        (pulled > hung).all()
    )  # a pull may have the direction of the weight, and is stronger by 2 %


def test_the_tilt_is_the_deviation_of_the_normals_of_drawn_surfaces():
    shape = dataclasses.replace(whole_ball(), std_factor=1.7)
    contacts = around(0.01)
    hand, grasp = grasps_at(contacts)
    slopes = shape.sample(contacts.points[0], 20_000, seed=1)[..., 1:].numpy()
    largest = 0.0
    for slope in slopes.swapaxes(0, 1):
        mean = slope.mean(0)
        across = np.linalg.svd(mean[None])[2][1:]  # two directions in the surface
        largest = max(
            largest,
            np.linalg.eigvalsh(np.cov(slope @ across.T, rowvar=False))[-1] ** 0.5
            / np.linalg.norm(mean),
        )
    found = measure(hand, grasp, shape)
    assert float(found["tilt"]) == pytest.approx(1.7 * largest, rel=0.03)


@pytest.mark.parametrize(("name", "fingers"), [("allegro", 4), ("shadow", 5)])
def test_hands_of_more_fingers_have_finite_features(name, fingers):
    hand, grasps = grasps_at(around(0.01, -0.01, angles=UNEVEN[:fingers]), name)
    found = measure(hand, grasps)
    assert all(bool(x.isfinite().all()) for x in found.values())
    near(
        found["offset"],
        torch.linalg.vector_norm(grasps.contacts.points.mean(1) - VERTICES.mean(0), dim=-1),
        1e-9,
    )


def test_contacts_that_nothing_balances_have_finite_features_and_no_force_to_spare():
    one_side = around(0.01)
    alike = dataclasses.replace(
        one_side, normals=one_side.normals[:, :1].expand(1, 3, 3).contiguous()
    )
    both = join([one_side, alike])
    found = measure(*grasps_at(both))
    assert all(bool(x.isfinite().all()) for x in found.values())
    assert float(found["force to spare"][1]) == pytest.approx(math.log(1e-3 / 1e3))
    assert float(found["force to spare"][0]) > -2.0
    assert float(found["force needed"][1]) == 1000.0
    assert float(found["carried if moved"][1]) == 0.0


def test_grasps_in_float32_have_the_features_of_those_in_float64():
    hand, grasps = grasps_at(around(0.01, -0.02))
    exact = measure(hand, grasps)
    rounded = measure(hand.to(torch.float32), grasps.to(torch.float32))
    for feature in FEATURES:
        torch.testing.assert_close(
            rounded[feature], exact[feature], rtol=1e-3, atol=1e-4, msg=feature
        )


def test_contacts_without_deviation_are_refused():
    hand, grasp = grasps_at(around(0.01))
    bare = dataclasses.replace(
        grasp, contacts=Contacts(grasp.contacts.points, grasp.contacts.normals)
    )
    with pytest.raises(BadArgument, match="std_m"):
        measure(hand, bare)
