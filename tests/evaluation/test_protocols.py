"""Where the hand and the object really stand: within the errors asked for, uniform, and the same
for the same seed.
"""

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from scipy import stats

from tests.make import near, real
from tests.pinch import cylinder, pinch
from torchgrasp.app.cli.evaluate import Evaluate
from torchgrasp.evaluation.protocols import (
    PROTOCOLS,
    PoseNoise,
    PullSpec,
    apply_error,
    draw_error,
    draw_hand_errors,
    draw_object_poses,
    draw_push,
    draw_slide,
    draw_trial,
    error_from_object_pose,
    find_protocol,
    seed_of,
)
from torchgrasp.evaluation.trial import GraspTrial, TrialDriver, Truth, check_truth
from torchgrasp.foundation.errors import BadArgument, NoEffect
from torchgrasp.geometry.frames import apply, inverse, rigid, rotation_angle, rotation_from_vector
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.values.distribution import Distribution
from torchgrasp.values.specs import TrialSpec


def test_motions_in_degrees_and_millimetres_are_refused():
    """With 15 for 15 degrees, no rotation would fail a pull: an object turns by at most pi."""
    for angle in (0.0, math.radians(15), math.pi, math.inf):
        assert PullSpec(10.0, 2.0, 0.05, angle).angle == angle
    for angle in (15.0, 3.2, 180.0):
        with pytest.raises(BadArgument, match=r"angle: expected radians in \[0, pi\]"):
            PullSpec(10.0, 2.0, 0.05, angle)
    for distance in (5.0, 50.0):  # in centimetres, in millimetres
        with pytest.raises(BadArgument, match=r"distance: expected a number in \[0, 0\.5\]"):
            PullSpec(10.0, 2.0, distance, math.inf)
        with pytest.raises(BadArgument, match=r"translation: expected a number in \[0, 0\.5\]"):
            PoseNoise(distance)
    for angle in (1.0, 3.0, 5.0):
        with pytest.raises(BadArgument, match=r"rotation: expected .* rad, not in degrees"):
            PoseNoise(0.005, angle)
    assert PoseNoise(0.005, math.radians(45)).rotation == math.pi / 4


def test_a_pull_lasts_as_long_as_it_says():
    """The motion is checked every 0.2 s: a shorter pull would pass without any pull."""
    for seconds, checks in ((0.2, 1), (0.6, 3), (1.4, 7), (2.0, 10), (60.0, 300)):
        assert PullSpec(10.0, seconds, 0.05, 0.3).checks == checks
    for seconds in (0.0, 0.05, 0.1, 0.15, 61.0):
        with pytest.raises(BadArgument, match=r"seconds: expected a number in \[0\.2, 60\]"):
            PullSpec(10.0, seconds, 0.05, 0.3)
    for seconds in (0.25, 0.3, 0.5, 1.99):
        with pytest.raises(BadArgument, match=r"seconds: expected a multiple of 0\.2 s"):
            PullSpec(10.0, seconds, 0.05, 0.3)


def test_errors_of_the_pose_stay_within_the_protocol_s():
    noise = PoseNoise(0.005, math.radians(5))
    errors = draw_hand_errors(noise, 600, seed=1)
    assert errors.shape == (600, 4, 4)
    assert 0.0048 < float(errors[..., :3, 3].abs().max()) <= 0.005
    angle = rotation_angle(errors[..., :3, :3])
    assert math.radians(5) < float(angle.max()) <= math.radians(5) * 3**0.5
    assert torch.equal(errors, draw_hand_errors(noise, 600, seed=1))
    still = draw_hand_errors(PoseNoise(), 2, seed=0)
    assert torch.equal(still, torch.eye(4, dtype=torch.float64).expand(2, 4, 4))


def test_every_object_view_row_and_draw_has_an_error_of_its_own_that_others_do_not_change():
    names = [
        (o, v, r, d)
        for o in ("tin", "cup")
        for v in ("view0", "view1")
        for r in range(3)
        for d in range(3)
    ]
    seeds = {seed_of(seed, *name) for seed in (0, 1) for name in names}
    assert len(seeds) == 2 * len(names) and all(0 <= seed < 2**63 for seed in seeds)
    assert seed_of(0, "a", "b") != seed_of(0, "ab") and seed_of(0, "1") != seed_of(0, 1)
    mesh = cylinder()
    (_, grasp) = pinch("allegro")
    for name in ("paper", "pose-noise"):
        errors = torch.stack(
            [draw_error(PROTOCOLS[name], grasp, mesh, seed_of(0, *row)) for row in names]
        )
        assert len(errors[:, :3, 3].unique(dim=0)) == len(names)
        assert torch.equal(
            draw_error(PROTOCOLS[name], grasp, mesh, seed_of(0, *names[-1])), errors[-1]
        )


def test_an_object_is_moved_on_its_table_and_turned_about_the_vertical() -> None:
    pivot = real([0.3, -0.2, 0.5])
    places = draw_object_poses(PoseNoise(0.005, 0.1), pivot, 2000, seed=1)
    moved = (places[:, :3, :3] @ pivot) + places[:, :3, 3] - pivot
    assert moved[:, :2].abs().max() <= 0.005
    assert moved[:, 2].abs().max() < 1e-15
    angle = torch.atan2(places[:, 1, 0], places[:, 0, 0])
    assert angle.abs().max() <= 0.1
    assert torch.equal(places[:, 2, :3], real([[0.0, 0.0, 1.0]]).expand(2000, 3))
    # uniform: standard deviation a / sqrt(3), known to 2 % from 2000 draws
    assert float(angle.std()) == pytest.approx(0.1 / math.sqrt(3), rel=0.05)
    assert float(moved[:, 0].std()) == pytest.approx(0.005 / math.sqrt(3), rel=0.05)


def test_errors_of_any_dtype_and_device_move_the_hand_as_the_object_would_move(generator) -> None:
    turn = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    shift = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    obj_from_hand, place = rigid(rotation_from_vector(turn), shift)
    points = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    seen = apply(inverse(obj_from_hand), apply(place, points))
    true_pose = apply_error(obj_from_hand, error_from_object_pose(obj_from_hand, place))
    torch.testing.assert_close(apply(inverse(true_pose), points), seen)
    turn, shift = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    planned = rigid(rotation_from_vector(turn), shift)
    error = torch.eye(4, dtype=torch.float64)
    error[0, 3] = 0.25
    devices = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    for device in devices:
        for dtype in (torch.float32, torch.float64):
            pose = apply_error(planned.to(device), error.to(device, dtype))
            assert pose.dtype is torch.float64 and pose.device.type == "cpu"
            near(pose, planned @ error, 1e-15)
    assert torch.equal(apply_error(planned.float(), None), planned.float().double())
    with pytest.raises(BadArgument, match=r"error: expected .*got"):
        apply_error(planned, torch.full((4, 4), math.nan))


def test_pushes_have_their_size_in_every_direction_and_slides_stay_on_the_table():
    pushes = torch.tensor([draw_push(2.5, seed_of(0, k)) for k in range(600)], dtype=torch.float64)
    near(pushes.norm(dim=-1), torch.full((600,), 2.5, dtype=torch.float64), 1e-12)
    assert pushes.mean(0).norm() < 2.5 * 3 / math.sqrt(600)
    assert draw_push(2.5, 1) == draw_push(2.5, 1)
    slides = torch.stack([draw_slide(PoseNoise(0.03, 0.2), seed_of(0, k)) for k in range(300)])
    assert bool((slides[:, 2] == 0).all()) and 0.028 < float(slides.abs().max()) <= 0.03


def test_settings_of_lifts_and_pulls_do_not_mix():
    lift = find_protocol("table-lift")
    pull = find_protocol("dexgraspbench")
    assert (
        lift.trial.table_friction == 0.2
        and lift.trial.friction == 0.8
        and lift.criterion == "risen"
    )
    for bad in ({"push": 1.0}, {"criterion": "risen"}, {"displaced": "approach"}):
        with pytest.raises(BadArgument, match="pull"):
            dataclasses.replace(pull, **bad)
    with pytest.raises(BadArgument, match="rotation"):
        dataclasses.replace(lift, displaced="approach", noise=PoseNoise(0.0, 0.1))
    with pytest.raises(BadArgument, match="table_friction"):
        lift.with_trial(table_friction=0.9)
    with pytest.raises(BadArgument, match="push"):
        lift.with_trial(push=(0.0, 0.0, math.inf))


def test_the_command_line_changes_only_what_was_asked_for_and_displaces_no_object_of_a_pull():
    def disturbed(name, **options):
        asked = Evaluate(objects=Path("objects"), hand="allegro", out=Path("out"), **options)
        return asked.disturbed(find_protocol(name))

    assert all(disturbed(name) == find_protocol(name) for name in PROTOCOLS)
    assert disturbed("pose-noise", draws=1).noise == dataclasses.replace(
        find_protocol("pose-noise").noise, draws=1
    )
    moved = disturbed("table-lift", displaced=0.03, during=True, push=2.5, draws=5)
    assert (moved.noise, moved.displaced, moved.push) == (PoseNoise(0.03, 0.0, 5), "approach", 2.5)
    with pytest.raises(BadArgument, match="--displaced"):
        disturbed("dexgraspbench", displaced=0.03)
    with pytest.raises(BadArgument, match="--during"):
        disturbed("table-lift", during=True)
    with pytest.raises(BadArgument, match=r"^--displaced: expected a number in \[0, 0\.5\], got 3"):
        disturbed("table-lift", displaced=3.0)


def test_each_trial_draws_friction_and_mass_from_their_distributions():
    friction = Distribution.between(0.3, 0.8)
    mass = Distribution.parse("0.1|0.4@3")
    spec = TrialSpec(friction=friction, mass=mass)
    drawn = [draw_trial(spec, seed) for seed in range(400)]
    assert drawn == [draw_trial(spec, seed) for seed in range(400)]
    # the oracle: scipy's test of the law, and the share of a fair draw
    assert stats.kstest([x.friction for x in drawn], stats.uniform(0.3, 0.5).cdf).pvalue > 1e-3
    assert {x.mass for x in drawn} == {0.1, 0.4}
    heavy = sum(x.mass == 0.4 for x in drawn)
    assert stats.binomtest(heavy, 400, 0.75).pvalue > 1e-3
    assert stats.spearmanr([x.friction for x in drawn], [x.mass for x in drawn]).pvalue > 1e-3
    assert draw_trial(TrialSpec(friction=0.5, mass=0.2), 3) == TrialSpec(friction=0.5, mass=0.2)


def test_a_protocol_plans_for_the_distributions_that_its_trials_draw_from():
    test = find_protocol("dexgraspbench").with_trial(mass=Distribution.between(0.1, 0.4))
    assert test.task.mass == Distribution.between(0.1, 0.4)
    assert find_protocol("multidex").task.mass == 0.1 * 0.5 / 10.0
    with pytest.raises(BadArgument, match="at most friction"):
        TrialSpec(friction=Distribution.between(0.3, 0.8), table_friction=0.4)


def test_truths_in_millimetres_or_under_their_table_are_refused():
    """A failed trial would be the grasp's fault."""
    hand, grasp = pinch("allegro")
    mesh = cylinder()
    with pytest.raises(BadArgument, match=r"slide: expected at most .* m, in metres, got .* 30 m"):
        Truth(mesh, slide=real([30.0, 0.0, 0.0]))
    aside = torch.eye(4).double()
    aside[0, 3] = 5.0
    with pytest.raises(BadArgument, match=r"error: expected at most 2 m, in metres"):
        Truth(mesh, error=aside)
    above = Truth(mesh, table=Plane.horizontal(0.5))
    with pytest.raises(BadArgument, match=r"table: expected the true table below the object"):
        check_truth(GraspTrial(hand, grasp, above))
    check_truth(GraspTrial(hand, grasp, Truth(mesh, table=Plane.horizontal(0.0))))


def test_what_a_trial_would_ignore_is_refused_or_told(monkeypatch):
    monkeypatch.setattr(TrialDriver, "_scene_spec", lambda *given: None)  # the scene is not built
    hand, grasp = pinch("allegro")
    mesh = cylinder()
    still = Truth(mesh, [mesh])
    slides = dataclasses.replace(still, slide=real([0.01, 0.0, 0.0]))
    TrialDriver(GraspTrial(hand, grasp, slides), TrialSpec())
    with pytest.raises(BadArgument, match=r"slide: .*approach"):
        TrialDriver(GraspTrial(hand, grasp, slides), TrialSpec(approach=0.0))
    rises = dataclasses.replace(still, slide=real([0.01, 0.0, 0.03]))
    with pytest.raises(BadArgument, match=r"slide: expected one along the table.* got .* 30 mm"):
        TrialDriver(GraspTrial(hand, grasp, rises), TrialSpec())
    told = Plane.horizontal(0.0)
    with pytest.raises(BadArgument, match="told: "):
        TrialDriver(GraspTrial(hand, grasp, still, told=told), TrialSpec(table=False))
    ball = SignedDistanceField(real([0.0, 0.0, 0.0]), 0.1, torch.ones(2, 2, 2).double())
    with pytest.warns(NoEffect, match="surface"):
        TrialDriver(GraspTrial(hand, grasp, still, surface=ball), TrialSpec(closing="open_loop"))
    for holding in ("grip", "impedance"):
        with pytest.raises(BadArgument, match=r"holding: .*squeeze"):
            TrialSpec(closing="open_loop", holding=holding)


def test_a_control_period_is_a_whole_number_of_timesteps():
    with pytest.raises(BadArgument, match=r"control_rate: .*250 or 166\.667 Hz, got 200 Hz"):
        TrialSpec(control_rate=200.0)
    for rate in (100.0, 1 / 0.006, 500.0, 50.0):
        TrialSpec(control_rate=rate)
    TrialSpec(control_rate=200.0, timestep=1 / 1000)
