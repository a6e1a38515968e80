"""Grip by the felt load: least forces beside SciPy, what is believed of friction, and a hand that
carries a block.

The oracle `least_sum` is SciPy's general optimiser: every force stays in its cone under pushes from
many sides.
"""

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch

from tests.point_fingers import (
    GAINS,
    NORMALS,
    PERIOD,
    TARGET,
    TOUCHING,
    observation,
    on_table,
    real,
    reference,
)
from torchgrasp import GraspController, Status
from torchgrasp.control.held_object import FRICTION, FrictionEstimate, LoadEstimate, likely_body
from torchgrasp.control.holding import PUSH, RAMP, GripHold, push_reserve
from torchgrasp.control.least_forces import LeastForces, _Barrier, balance, friction_ratios
from torchgrasp.control.recovery import PRESSING_TIME
from torchgrasp.control.tactile import TACTILE, Observation
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.linalg import GOLDEN_ANGLE, fibonacci_sphere
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.values.distribution import Distribution

POINTS = TARGET.numpy()
OUTWARD = NORMALS.numpy()
GRASP_MAP = balance(POINTS).wrench
FREE = np.zeros((3, 3, 1))
FLOOR = np.full(3, 0.1)
HEAVIEST = likely_body(reference())[1]


def solve(
    load: list[float], friction: float, floor=FLOOR, reserve: np.ndarray | float = 0.0
) -> np.ndarray:
    """Least forces, by as many calls as ticks of a tenth of a second."""
    solver = LeastForces(GAINS.desired_force.numpy().copy(), np.ones(1), 100.0)
    for _ in range(10):
        solver.solve(
            balance(POINTS), OUTWARD, FREE, np.array(load, float), friction, floor, reserve
        )
    return solver.forces


def shares(arm: np.ndarray) -> np.ndarray:
    """How much each finger's force changes by a push of 1 N along each axis at `arm` from the
    middle of the contacts.

    Springs of equal stiffness share it, so that the sum of squares is least.
    """
    pushes = np.stack([np.concatenate([axis, np.cross(arm, axis)]) for axis in np.eye(3)], 1)
    return np.linalg.lstsq(GRASP_MAP, pushes, rcond=None)[0].reshape(3, 3, 3)


def pushed_forces(forces: np.ndarray, push: float, arm: np.ndarray) -> np.ndarray:
    """The forces of all fingers under pushes from many sides."""
    sides = push * fibonacci_sphere(200, GOLDEN_ANGLE, 0.0).double().numpy()
    return forces + np.einsum("fij,sj->sfi", shares(arm), sides if push else np.zeros((1, 3)))


@functools.cache
def least_sum(load: tuple[float, ...], friction: float, push: float = 0.0) -> float:
    """The least normal sum with which all forces stay in their cones under the push, by SciPy, from
    several starts.
    """
    from scipy.optimize import minimize

    def normal(x: np.ndarray) -> np.ndarray:
        return -(x.reshape(-1, 3, 3) * OUTWARD).sum(-1)

    def slack(x: np.ndarray) -> np.ndarray:
        moved = pushed_forces(x.reshape(3, 3), push, np.zeros(3))
        across = moved + normal(moved)[..., None] * OUTWARD
        return (friction * normal(moved) - np.sqrt((across**2).sum(-1) + 1e-12)).ravel()

    held = {"type": "eq", "fun": lambda x: GRASP_MAP @ x - load}
    cones = {"type": "ineq", "fun": slack}
    floors = {"type": "ineq", "fun": lambda x: normal(x)[0] - FLOOR}
    starts = [k * GAINS.desired_force.numpy().ravel() for k in (1.0, 2.0, 4.0)]
    found = [
        minimize(lambda x: normal(x).sum(), x, constraints=[held, cones, floors], tol=1e-9)
        for x in starts
    ]
    return min(float(x.fun) for x in found if x.success)


@pytest.mark.parametrize("friction", [0.4, 0.8])
@pytest.mark.parametrize(
    "load", [[0, 1, 0, 0, 0, 0], [0.5, 2, 1, 0, 0, 0.02], [0, 3, 0, 0.01, 0, 0]]
)
def test_least_forces_carry_the_load_within_the_cones_at_nearly_the_least_sum(load, friction):
    forces = solve(load, friction)
    assert np.allclose(GRASP_MAP @ forces.ravel(), load, atol=1e-9)
    assert (friction_ratios(forces, OUTWARD) < friction).all()
    push = -(forces * OUTWARD).sum(-1)
    assert (push > FLOOR).all()
    least = least_sum(tuple(load), friction)
    assert 0.999 * least < push.sum() < 1.15 * least


@pytest.mark.parametrize("friction", [0.4, 0.8])
@pytest.mark.parametrize("arm", [(0.0, 0.0, 0.0), (0.01, -0.03, 0.02)])
def test_forces_with_a_reserve_stay_in_their_cones_under_a_push_from_any_side(friction, arm):
    load = (0.5, 2.0, 1.0, 0.0, 0.0, 0.02)
    reserve = PUSH * push_reserve(balance(POINTS), OUTWARD, np.array(arm), friction)
    forces = solve(list(load), friction, reserve=reserve)
    moved = pushed_forces(forces, PUSH, np.array(arm))
    assert np.allclose(GRASP_MAP @ forces.ravel(), load, atol=1e-9)
    assert all((friction_ratios(x, OUTWARD) < friction).all() for x in moved)
    assert arm[1] or (-(forces * OUTWARD).sum() < 1.3 * least_sum(load, friction, PUSH))


def test_the_likely_body_is_the_estimated_surface_or_a_ball_as_wide_as_the_contacts():
    grid = torch.cartesian_prod(*[torch.linspace(-0.1, 0.1, 51).double()] * 3).reshape(
        51, 51, 51, 3
    )
    ball = torch.linalg.vector_norm(grid - real([0.01, 0.02, 0.0]), dim=-1) - 0.06
    turned = torch.eye(4).double()
    volume = 4 / 3 * math.pi * 0.06**3
    turned[:3, 3] = real([0.0, 0.0, 0.05])
    ball[:, :, -1] = -0.2  # a sign that is wrong far from the surface
    field = SignedDistanceField(real([-0.1, -0.1, -0.1]), 0.004, ball)
    centre, weight = likely_body(
        dataclasses.replace(reference(), surface=field, obj_from_hand=turned)
    )
    np.testing.assert_allclose(centre, [0.01, 0.02, -0.05], atol=1e-3)
    assert weight == pytest.approx(9810 * volume, rel=0.05)
    known = reference()
    centre, weight = likely_body(known)
    np.testing.assert_allclose(centre, POINTS.mean(0))
    assert weight == pytest.approx(9.81 * 0.4)  # a ball of 130 g, if it were water
    wide = dataclasses.replace(
        known, gains=dataclasses.replace(known.gains, target=2 * known.gains.target)
    )
    assert likely_body(wide)[1] == pytest.approx(9810 * math.pi / 6 * (0.12**2 + 0.04**2) ** 1.5)


@pytest.mark.parametrize("fingertips", [3, 4, 5])
def test_balance_gives_grasp_map_inverse_and_null_space(fingertips):
    generator = np.random.default_rng(fingertips)
    points, forces = generator.normal(size=(2, fingertips, 3))
    found = balance(points)
    arms = points - points.mean(0)
    total = np.concatenate([forces.sum(0), np.cross(arms, forces).sum(0)])
    np.testing.assert_allclose(found.wrench @ forces.ravel(), total, atol=1e-12)
    np.testing.assert_allclose(found.inverse, np.linalg.pinv(found.wrench), atol=1e-12)
    np.testing.assert_allclose(found.wrench @ found.free, 0.0, atol=1e-12)
    np.testing.assert_allclose(found.free.T @ found.free, np.eye(3 * fingertips - 6), atol=1e-12)
    line = balance(np.arange(fingertips)[:, None] * np.array([0.0, 0.01, 0.02]))
    assert np.isfinite(line.inverse).all() and abs(line.inverse).max() < 1e3
    assert line.free.shape[1] == 3 * fingertips - 5  # nothing resists a torque about the line


def test_a_finger_in_the_air_bears_no_load_and_presses_as_little_as_allowed():
    points = np.array([[0.0, -0.03, 0], [0, 0.03, 0], [0.02, 0.03, 0]])
    floor = np.array([0.2, 0.2, 0.7])
    normals = np.array([[0.0, -1, 0], [0, 1, 0], [0, 1, 0]])
    contacts = balance(points, np.array([True, True, False]))
    load = np.array([1.0, 0, 2, 0, 0, 0])
    load[3:] = np.cross(
        points[:2].mean(0) - points.mean(0), load[:3]
    )  # it acts between the two fingers
    solver = LeastForces(-normals.copy(), np.ones(1), 100.0)
    forces = -normals
    for _ in range(10):
        forces = solver.solve(contacts, normals, FREE, load, 0.5, floor)
    np.testing.assert_allclose(forces[:2].sum(0), load[:3], atol=1e-9)
    push = -(forces * normals).sum(-1)
    least = math.sqrt(5) / 2 / 0.5  # [N] of each of the two, which share the load
    assert push[:2] == pytest.approx([least] * 2, rel=0.05) and push[2] == pytest.approx(
        0.7, rel=0.1
    )


@pytest.mark.parametrize("digits", [4, 8, 16, 64])
def test_fingers_in_the_air_with_forces_on_the_border_of_their_cones_end_in_finite_forces(digits):
    """A hold that has lost its object comes there; the Hessian may then be singular."""
    normals = -np.eye(3)
    contacts = balance(0.03 * normals, np.zeros(3, dtype=bool))
    barrier = _Barrier(contacts, normals, np.zeros((6, 9)), np.zeros(6), 0.01, 0.0)
    barrier.squared = 1.0
    barrier.floor = np.full(3, 0.4)
    slide = 1 - digits * 2.0**-53  # of a normal force of 1, with friction 1
    step, decrement = barrier.newton(
        barrier.place(np.array([[1.0, slide, 0], [0, 1, slide], [slide, 0, 1]]))
    )
    assert np.isfinite(step).all() and math.isfinite(decrement)


def test_least_forces_keep_the_floors():
    floor = np.array([1.0, 1.0, 2.0])
    push = -(solve([0, 0, 0, 0, 0, 0], 0.5, floor) * OUTWARD).sum(-1)
    assert (push > floor).all() and push.sum() == pytest.approx(4.0, rel=0.15)


def test_friction_estimate_is_a_gaussian_posterior():
    estimate = FrictionEstimate(0.8)
    estimate.update(0.5, 4.0)
    noise = 0.4 * math.hypot(1.0, 0.5) / 4.0
    precision = FRICTION.std**-2 + noise**-2
    assert estimate.mean == pytest.approx(
        (FRICTION.mean * FRICTION.std**-2 + 0.5 * noise**-2) / precision
    )
    assert estimate.std == pytest.approx(precision**-0.5)


def test_friction_is_at_least_the_ratio_of_a_finger_that_sticks():
    estimate = FrictionEstimate(0.8)
    estimate.update(0.6, 20.0, slides=False)
    least = 0.6 - 0.4 * math.hypot(1.0, 0.6) / 20
    assert estimate.mean == 0.8 and estimate.least == pytest.approx(least)
    estimate.update(0.3, 20.0)  # a finger that spins
    assert estimate.mean == 0.8
    for _ in range(100):
        estimate.update(0.58, 20.0)
    assert estimate.mean == pytest.approx(0.58, abs=0.01)
    estimate.update(0.9, 20.0, slides=False)
    assert estimate.mean == estimate.least > 0.8


def test_the_prior_of_friction_is_that_of_the_plan_if_it_is_a_distribution():
    """The moments are those of the pieces: (0.35, 0.3^2 / 12) for a third, (1, 0) for the rest."""
    prior = Distribution(((0.2, 0.5), (1.0, 1.0)), (1.0, 2.0))
    estimate = FrictionEstimate(prior)
    mean = (0.35 + 2 * 1.0) / 3
    variance = (0.3**2 / 12 + (0.35 - mean) ** 2 + 2 * (1.0 - mean) ** 2) / 3
    assert estimate.mean == pytest.approx(mean) and estimate.std == pytest.approx(variance**0.5)
    assert FrictionEstimate(Distribution.of(0.3)).mean == FrictionEstimate(0.3).mean == 0.8


@pytest.mark.parametrize("prior", [Distribution.between(0.2, 1.0), 0.8, 0.25])
@pytest.mark.parametrize("friction", [0.3, 0.5, 0.9])
def test_what_the_touches_leave_of_the_friction_contains_the_true_one(prior, friction):
    """Fingertips stick at any ratio below the coefficient, and slide at it; readings are noisy."""
    generator = np.random.default_rng(0)
    estimate = FrictionEstimate(prior)
    assert estimate.posterior == Distribution.of(prior)
    force = 10.0
    for _ in range(40):
        noise = 0.2 * 0.4 / force * generator.normal()
        estimate.update(friction * generator.uniform() + noise, force, slides=False)
    low = estimate.held
    assert 0.7 * friction < low < friction
    kept = Distribution.of(prior)
    if kept.share(low, math.inf):
        assert estimate.posterior == kept.given(low, math.inf)
    else:
        assert estimate.posterior == Distribution.of(low)
    for _ in range(40):
        noise = 0.2 * 0.4 / force * generator.normal()
        estimate.update(friction + noise, force)
    found = estimate.posterior
    # a number near the truth stays; all else is a short interval about the truth
    assert found.least - 0.05 <= friction <= found.most + 0.05
    assert found.most - found.least < 0.2


def strong_hold(max_force: float | None = None) -> GripHold:
    """A hold by strong drives, above a table whose normal is the hand's y axis."""
    strong = {
        name: drive._replace(effort=8.0) for name, drive in reference().hand.actuators.items()
    }
    hand = dataclasses.replace(reference().hand, actuators=strong)
    known = dataclasses.replace(on_table(max_force=max_force), hand=hand)
    return GripHold(known, observation(0.0, (2.0, 2.0, 4.0), TOUCHING), torch.zeros(9).double())


def loaded(thumb: float, ratio: float, speed: float) -> Observation:
    """What the fingertips feel of an object that pulls them down by `ratio` of their normal forces.

    The thumb presses with `thumb` [N], each other finger with the half. All slide at `speed` [m/s].
    """
    push = thumb * np.array([0.5, 0.5, 1.0])
    forces = push[:, None] * (ratio * np.array([0.0, 1.0, 0.0]) - OUTWARD)
    seen = observation(0.0, tuple(push), TOUCHING)
    tactile = dataclasses.replace(
        seen.tactile, forces=torch.from_numpy(forces), sliding=torch.full((3,), speed).double()
    )
    return dataclasses.replace(seen, tactile=tactile)


def estimates(friction: float, speed: float, ticks: int) -> list[float]:
    """The estimated friction at each tick after a load has begun to pull the fingertips along the
    surface with `friction` of their normal forces; until the ramp was over, they felt none.
    """
    hold = strong_hold()
    for _ in range(round(RAMP / PERIOD) + 1):
        hold(loaded(8.0, 0.0, 0.0), PERIOD)
    found = []
    for _ in range(ticks):
        hold(loaded(8.0, friction, speed), PERIOD)
        found.append(hold.friction.mean)
    return found


@functools.cache
def carried(
    weight: float, friction: float, max_force: float | None = None, seconds: float = 4.0
) -> tuple[GripHold, Observation, list[float]]:
    """Hold a block whose weight comes off its table in half a second, after another one, without
    noise.

    The joints follow at once: what the hand wants is what is felt. A finger slides where that
    exceeds its cone.
    """
    hold = strong_hold(max_force)
    seen = observation(0.0, (2.0, 2.0, 4.0), TOUCHING)
    sums = []
    for k in range(round(seconds / PERIOD)):
        hold(seen, PERIOD)
        lifted = min(max((k * PERIOD - 1.0) / 0.5, 0.0), 1.0) * weight
        bearing = np.zeros(6)
        bearing[1] = lifted
        short = GRASP_MAP @ hold.sent.ravel() - bearing
        forces = hold.sent - (np.linalg.pinv(GRASP_MAP) @ short).reshape(3, 3)
        push = -(forces * OUTWARD).sum(-1)
        slides = friction_ratios(forces, OUTWARD) > friction
        across = forces + push[:, None] * OUTWARD
        length = np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
        forces = np.where(
            slides[:, None],
            across * friction * push[:, None] / length - push[:, None] * OUTWARD,
            forces,
        )
        tactile = dataclasses.replace(
            seen.tactile,
            reading=torch.from_numpy(push),
            forces=torch.from_numpy(forces),
            sliding=torch.from_numpy(0.02 * slides),
        )
        seen = dataclasses.replace(seen, tactile=tactile)
        sums.append(float(push.sum()))
    return hold, seen, sums


def test_grip_carries_heavy_and_slippery_blocks_harder_and_fragile_ones_within_their_force():
    short = functools.partial(carried, seconds=3.0)
    closed = round(PRESSING_TIME / PERIOD)  # the tick in which the hand counts as closed
    for weight in (0.5, 1.5):
        hold, _, sums = short(weight, 0.8)
        needed, heaviest = (
            least_sum((0, x, 0, 0, 0, 0), 0.8, y) for x, y in ((weight, PUSH), (0, PUSH + HEAVIEST))
        )
        assert hold.status is Status.OK
        assert needed < sums[-1] < 1.2 * needed
        assert heaviest < sums[closed] < 1.2 * heaviest  # on the table
    assert short(1.0, 0.8)[0].weight == pytest.approx(1.0, rel=0.05)
    slippery, _, hard = short(4.0, 0.35)
    sticky, _, soft = short(4.0, 2.0)
    assert slippery.friction.mean < 0.7 and sticky.friction.mean == 0.8
    assert hard[-1] > 1.2 * soft[-1]
    hold, seen, sums = short(1.0, 0.8, max_force=2.0)
    assert hold.status is Status.OK and hold.weight == pytest.approx(1.0, rel=0.05)
    assert max(sums) < 1.05 * 4.0  # the thumb presses with 2 N, the others with the half
    assert float(seen.tactile.reading.max()) < 2.0


def test_grip_reports_a_load_as_too_heavy_only_if_a_finger_slides():
    hold, _, _ = carried(40.0, 0.8)  # beyond the torques
    assert hold.status is Status.TOO_HEAVY and hold.weight > 5.0
    weight = 5.0
    most = 2.0
    believed = (
        FrictionEstimate(0.8).mean * 2 * most
    )  # the thumb presses with 2 N, the others with the half
    assert believed < weight
    assert carried(weight, 3.0, max_force=most)[0].status is Status.OK
    assert carried(weight, 0.8, max_force=most)[0].status is Status.TOO_HEAVY


@pytest.mark.parametrize("friction", [0.4, 0.6])
def test_a_slip_shows_the_friction_once_the_filtered_forces_have_followed_it(friction):
    """The filters still hold the smaller forces of before, which would show less friction."""
    found = estimates(friction, 0.02, 8)
    assert min(found) > 0.85 * friction
    assert found[-1] == pytest.approx(friction, rel=0.1)


def test_a_speed_within_the_noise_of_the_sensor_is_no_slide_and_a_slow_slide_is_one():
    assert set(estimates(0.5, 2.5 * TACTILE.slide, 10)) == {0.8}
    assert estimates(0.5, 6.0 * TACTILE.slide, 10)[-1] == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(("slip", "status"), [(0.15, Status.OK), (0.5, Status.TOO_HEAVY)])
def test_a_load_is_too_heavy_if_the_fingers_slide_on_and_not_for_a_moment(slip, status):
    """They slide at the largest force that is allowed, and stop each time for as long."""
    hold = strong_hold(max_force=2.0)
    ticks = round(slip / PERIOD)
    for k in range(50 + 2 * ticks):
        slides = k >= 50 and (k - 50) // ticks % 2 == 0
        hold(loaded(2.0, 1.3, 0.02 * slides), PERIOD)
    assert hold.strained and hold.status is status


@pytest.mark.parametrize("max_force", [1.0, 3.0])
def test_a_fragile_object_on_its_table_is_pressed_with_most_of_what_it_bears_and_never_with_all(
    max_force,
):
    """It may be too heavy for such a force, and that is no reason to press with all of it."""
    sums = carried(1.0, 0.8, max_force, seconds=1.0)[2]
    assert max(sums) < 0.9 * 2 * max_force  # the thumb presses with the half of the sum
    assert sums[-1] > 0.7 * 2 * max_force


@pytest.mark.parametrize("known", [0.8, Distribution.between(0.2, 3.0)])
def test_a_finger_behind_an_edge_shows_no_friction_beyond_the_largest(known):
    """Its force may have any direction; soft silicone reaches 1.5, and the plan may know more."""
    estimate = FrictionEstimate(known)
    largest = max(Distribution.of(known).most, 1.5)
    for _ in range(5):
        estimate.update(5.0, 4.0, slides=False)
        estimate.update(5.0, 40.0, slides=False)
    assert 1.0 < estimate.mean <= largest
    assert estimate.held < largest and estimate.posterior.most <= largest


@pytest.mark.parametrize("sideways", [slice(0, 1), slice(0, 3)])
@pytest.mark.parametrize("max_force", [None, 2.0])
def test_a_grip_whose_planned_forces_are_along_the_surface_keeps_the_largest_force(
    sideways, max_force
):
    """A finger in the air keeps the planned forces; the sensed normals of the others may be across
    them.
    """
    normals = NORMALS.clone()
    points = TARGET.clone()
    normals[sideways] = real([0, 1, 0])
    points[2] = torch.nan
    seen = observation(0.0, (2.0, 2.0, 4.0), TOUCHING)
    tactile = dataclasses.replace(seen.tactile, normals=normals, points=points)
    known = dataclasses.replace(reference(), max_force=max_force)
    seen = dataclasses.replace(seen, tactile=tactile)
    hold = GripHold(known, seen, torch.zeros(9).double())
    for _ in range(60):
        assert torch.isfinite(hold(seen, PERIOD)).all()
        push = -(hold.sent * hold.normals).sum(-1)
        assert max_force is None or push.max() < (1 + 1e-9) * max_force


@pytest.mark.parametrize("weight", [1.5, 4.0])
def test_the_felt_load_shows_the_mass(weight):
    hold = carried(weight, 0.8)[0]
    assert hold.mass is not None and hold.mass.share(weight / 9.81, weight / 9.81) == 0.0
    assert hold.mass.least < weight / 9.81 < hold.mass.most < 1.3 * weight / 9.81
    assert carried(0.2, 0.8)[0].mass is None  # it may still stand on the table


def test_a_load_that_is_too_heavy_bounds_the_mass_below():
    hold = carried(9.0, 0.4, 4.0)[0]
    assert hold.status is Status.TOO_HEAVY and hold.mass.least < 9.0 / 9.81 < hold.mass.most
    assert hold.mass.least > 0.1


@pytest.mark.parametrize("weight", [2.0, 20.0])
def test_the_interval_of_the_mass_holds_it_in_nineteen_of_twenty_lifts(weight):
    """Single readings have noise of 0.5 N; motion and oblique contacts change a whole lift's load
    by a twentieth.
    """
    generator = np.random.default_rng(0)
    found = 0
    for _ in range(400):
        estimate = LoadEstimate(np.array([0.0, 0.0, 1.0]), PUSH)
        estimate.steady = True
        load = weight * (1 + 0.05 * generator.normal())
        for noise in 0.5 * generator.normal(size=10):
            estimate.update(np.array([0.0, 0.0, load + noise, 0.0, 0.0, 0.0]), 0.02)
        assert estimate.mass is not None
        found += estimate.mass.least < weight / 9.81 < estimate.mass.most
    assert 0.92 < found / 400 < 0.98


@pytest.mark.parametrize("told", [True, False])
def test_a_hand_that_turns_with_its_object_carries_the_same_load_if_it_is_told_where_up_is(told):
    """The wrist turns by 90 degrees about the hand's x axis, in a second."""
    weight = 6.0
    hold = strong_hold()
    seen = observation(0.0, (8.0, 8.0, 16.0), TOUCHING)
    ups = []
    for k in range(600):
        angle = math.pi / 2 * min(max((k - 300) * PERIOD, 0.0), 1.0)
        ups.append(real([0.0, math.cos(angle), math.sin(angle)]))
        forces = GAINS.desired_force.numpy() * 4.0
        push = -(forces * OUTWARD).sum(-1)
        forces = forces + weight * ups[-1].numpy() * (push / push.sum())[:, None]
        tactile = dataclasses.replace(seen.tactile, forces=torch.from_numpy(forces))
        hold(dataclasses.replace(seen, tactile=tactile, up=ups[-1] if told else None), PERIOD)
    assert (hold.weight == pytest.approx(weight, rel=0.02)) == told
    assert told == (hold.mass is not None and hold.mass.least < weight / 9.81 < hold.mass.most)


def test_up_is_a_unit_vector():
    gravity = dataclasses.replace(observation(), up=real([0.0, 0.0, 9.81]))
    with pytest.raises(BadArgument, match="up: "):
        GraspController(reference()).step(gravity, PERIOD)
