"""Features of grasps: each by hand on a ball, the frame that does not matter, and which way load and friction count."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from tests.make import directions, near, real
from tests.success.scenes import RADIUS, UNEVEN, around, grasps_at, whole_ball
from torchgrasp.base import join
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.frames import apply, rigid, rotation_from_vector
from torchgrasp.geometry.plane import move
from torchgrasp.success.features import CAUSES, FEATURES, measure_grasps
from torchgrasp.success.task import GraspTask
from torchgrasp.values import Contacts

VERTICES = RADIUS * directions(3000, seed=1) * real([1.0, 0.8, 0.6]) + real([0.0, 0.004, -0.01])
EVEN = (0.0, 2 * math.pi / 3, 4 * math.pi / 3)


def measure(hand, grasps, shape=None, vertices=VERTICES, friction=0.6, lifted=True, **task):
    """The features of grasps of the ball by name."""
    shape = whole_ball() if shape is None else shape
    found = measure_grasps(hand, shape, vertices, grasps, friction, GraspTask(**task), lifted)
    assert found.shape == (len(grasps), len(FEATURES)) and found.dtype == torch.float64
    return dict(zip(FEATURES, found.T, strict=True))


def test_every_feature_has_one_cause_and_an_si_unit():
    assert len(set(FEATURES)) == len(FEATURES) == sum(map(len, CAUSES.values()))
    assert {unit for names in CAUSES.values() for unit in names.values()} <= {"m", "rad", "N", "kg", "1"}


def test_features_of_a_ball_by_hand():
    contacts = around(0.01)
    hand, grasp = grasps_at(contacts)
    found = {name: float(x) for name, x in measure(hand, grasp, mass=0.3, force=5.0, displaced=True).items()}
    p, n, v = contacts.points[0].numpy(), contacts.normals[0].numpy(), VERTICES.numpy()
    center, cloud = v.mean(0), whole_ball().cloud.points.numpy()
    offset, sides = p.mean(0) - center, [np.linalg.norm(p[i] - p[i - 1]) for i in range(3)]
    q, low, high = (x.numpy() for x in (grasp.joints[0], hand.lower, hand.upper))
    spread = np.linalg.eigvalsh(np.cov(v[:, :2].T, bias=True)) ** 0.5
    gaps = cKDTree(cloud).query(p)[0]
    exact = {
        "offset": np.linalg.norm(offset),
        "offset across": np.hypot(*offset[:2]),
        "normals apart": np.linalg.norm(n.mean(0)),
        "certificate margin": 0.01,
        "deviation": 0.003,
        "mean deviation": 0.002,
        "from seen": gaps.max(),
        "mean from seen": gaps.mean(),
        "height of lowest": p[:, 2].min() - v[:, 2].min(),
        "below top": v[:, 2].max() - p[:, 2].max(),
        "span": max(sides),
        "shortest side": min(sides),
        "steepest normal": 0.25,
        "limit margin": (np.minimum(q - low, high - q) / (high - low)).min(),
        "pad angle": 0.3,
        "clearance": 0.005,
        "approach up": float(hand.approach[2]),
        "height": v[:, 2].max() - v[:, 2].min(),
        "width": spread[1],
        "breadth": spread[0],
        "walls": 1.0,
        "fingers": 3.0,
        "tip radius": float(hand.tips.radius.mean()),
        "friction": 0.6,
        "mass": 0.3,
        "force": 5.0,
        "lifted": 1.0,
        "displaced": 1.0,
        "open loop": 0.0,
    }
    for name, wanted in exact.items():
        assert found[name] == pytest.approx(wanted, rel=1e-6, abs=1e-9), name
    about = {  # of a ball of 40 mm; the search for forces has steps of a percent
        "angle needed": (math.asin(0.25), 0.01),
        "angle to spare": (math.atan(0.6) - math.asin(0.25), 0.01),
        "bend": (math.atan(4 / 40), 0.02),
        "mean bend": (math.atan(4 / 40), 0.02),
        "wide bend": (math.atan(8 / 40), 0.02),
        "size": (RADIUS, 0.002),
        "seen share": (np.mean(cKDTree(cloud).query(v[::4])[0] < 0.006), 0.04),
    }
    for name, (wanted, tolerance) in about.items():
        assert found[name] == pytest.approx(wanted, abs=tolerance), name


def test_the_force_needed_is_that_of_three_springs_below_the_centre_of_mass():
    contacts = around(0.0, angles=EVEN)  # each carries a third of the weight by friction
    hand, grasp = grasps_at(contacts)
    still = VERTICES - VERTICES.mean(0)
    found = measure(hand, grasp, vertices=still, mass=0.3)
    near(found["force needed"], real([0.3 * 9.81 / 3 / 0.6]), 0.02)
    near(found["force needed at half friction"], real([0.3 * 9.81 / 3 / 0.3]), 0.04)
    near(found["arm"], real([0.02 / (0.06 + 0.01)]), 1e-6)  # the centre is 20 mm beside a side, of a height of 60 mm
    gripped = torch.minimum(found["greatest force"], real([15.0]))  # as strong as the load asks for, at most
    near(found["force to spare"], gripped / found["force needed at half friction"], 1e-9)
    pressed = measure(hand, grasp, vertices=still, mass=0.3, force=2.0)
    near(pressed["force to spare"], 2.0 / pressed["force needed at half friction"], 1e-9)


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_a_turn_about_the_vertical_and_a_shift_of_the_whole_scene_change_nothing(name):
    hand, grasps = grasps_at(around(0.01, -0.02, 0.0), name)
    pose = rigid(rotation_from_vector(real([0.0, 0.0, 1.1])), real([0.3, -0.1, 0.2]))
    here = measure(hand, grasps, mass=0.4)
    there = measure(hand, move(grasps, pose), whole_ball().moved(pose), apply(pose, VERTICES), mass=0.4)
    searched = {"force needed", "force needed at half friction", "force to spare", "greatest force"} | {
        "angle needed", "angle to spare", "angle to spare over tilt"
    }  # fmt: skip
    for feature in FEATURES:
        wanted = here[feature]
        tolerance = 0.02 if feature in searched else 1e-5  # the search begins with fixed directions
        torch.testing.assert_close(there[feature], wanted, rtol=tolerance, atol=tolerance, msg=feature)


def test_grasps_do_not_depend_on_each_other_and_none_have_no_features():
    hand, grasps = grasps_at(around(0.01, -0.02, 0.0))
    every, last = measure(hand, grasps), measure(hand, grasps[1:])
    for feature in FEATURES:
        near(last[feature], every[feature][1:], 1e-9)
    assert [len(x) for x in measure(hand, grasps[:0]).values()] == [0] * len(FEATURES)


def test_the_force_needed_is_proportional_to_the_load_and_friction_lessens_it():
    heights = torch.linspace(-0.005, 0.005, 7).tolist()
    hand, grasps = grasps_at(around(*heights))
    for lifted in (True, False):
        light, heavy = (measure(hand, grasps, lifted=lifted, mass=mass) for mass in (0.2, 0.4))
        near(heavy["force needed"], 2 * light["force needed"], 1e-6)
        near(heavy["force to spare"], light["force to spare"] / 2, 1e-6)
        changed = {name for name in FEATURES if not torch.equal(light[name], heavy[name])}
        assert changed == {"force needed", "force needed at half friction", "force to spare", "mass"}
        slippery, rough = (measure(hand, grasps, lifted=lifted, friction=friction) for friction in (0.45, 0.9))
        assert bool((rough["force needed"] < 0.8 * slippery["force needed"]).all())
        assert bool((rough["force to spare"] > slippery["force to spare"]).all())
        near(rough["force needed at half friction"], slippery["force needed"], 1e-6)
        near(rough["angle to spare"] - slippery["angle to spare"], real([math.atan(0.9) - math.atan(0.45)] * 7), 1e-9)
        assert torch.equal(rough["angle needed"], slippery["angle needed"])
    pulled, hung = (measure(hand, grasps, lifted=lifted)["force needed"] for lifted in (False, True))
    assert bool((pulled > hung).all())  # a pull may have the direction of the weight, and is stronger by 2 %


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
            largest, np.linalg.eigvalsh(np.cov(slope @ across.T, rowvar=False))[-1] ** 0.5 / np.linalg.norm(mean)
        )
    found = measure(hand, grasp, shape)
    assert float(found["tilt"]) == pytest.approx(1.7 * largest, rel=0.03)
    near(found["angle to spare over tilt"], found["angle to spare"] / found["tilt"], 1e-9)


def test_the_closing_angle_is_the_cosine_of_the_worst_finger_and_is_a_number_where_a_finger_does_not_open():
    hand, grasp = grasps_at(around(0.01))
    found = float(measure(hand, grasp)["closing angle"])
    way = (hand.tip_centres(grasp.joints) - hand.tip_centres(grasp.pregrasp))[0].numpy()
    cosines = [-w @ n / np.linalg.norm(w) for w, n in zip(way, grasp.contacts.normals[0].numpy(), strict=True)]
    assert found == pytest.approx(min(cosines), abs=1e-6)
    still = grasps_at(around(0.01), opens=1.0)[1]
    assert bool(measure(hand, still)["closing angle"].isfinite().all())


@pytest.mark.parametrize(("name", "fingers"), [("allegro", 4), ("shadow", 5)])
def test_hands_of_more_fingers_have_finite_features(name, fingers):
    hand, grasps = grasps_at(around(0.01, -0.01, angles=UNEVEN[:fingers]), name)
    found = measure(hand, grasps)
    assert all(bool(x.isfinite().all()) for x in found.values())
    assert found["fingers"].tolist() == [fingers] * 2
    near(found["offset"], torch.linalg.vector_norm(grasps.contacts.points.mean(1) - VERTICES.mean(0), dim=-1), 1e-9)


def test_contacts_that_nothing_balances_have_finite_features_and_no_force_to_spare():
    one_side = around(0.01)
    alike = dataclasses.replace(one_side, normals=one_side.normals[:, :1].expand(1, 3, 3).contiguous())
    both = join([one_side, alike])
    found = measure(*grasps_at(both))
    assert all(bool(x.isfinite().all()) for x in found.values())
    assert float(found["angle needed"][1]) == pytest.approx(math.pi / 2)
    assert float(found["force to spare"][1]) == 0.0 < float(found["force to spare"][0])
    assert float(found["force needed"][1]) == 1000.0


def test_grasps_in_float32_have_the_features_of_those_in_float64():
    hand, grasps = grasps_at(around(0.01, -0.02))
    exact, rounded = measure(hand, grasps), measure(hand.to(torch.float32), grasps.to(torch.float32))
    for feature in FEATURES:
        torch.testing.assert_close(rounded[feature], exact[feature], rtol=1e-3, atol=1e-4, msg=feature)


def test_contacts_without_deviation_are_refused():
    hand, grasp = grasps_at(around(0.01))
    bare = dataclasses.replace(grasp, contacts=Contacts(grasp.contacts.points, grasp.contacts.normals))
    with pytest.raises(BadArgument, match="std_m"):
        measure(hand, bare)
