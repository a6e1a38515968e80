"""The guarded approach: an open hand that comes down over a ball which is not where it was seen."""

import dataclasses

import pytest
import torch

from tests.control.test_localization import CENTER, RADIUS, ball_field
from tests.point_fingers import PERIOD, observation, on_table, real
from torchgrasp import ClosingReference, GraspController, load_hand
from torchgrasp.control import no_contact, observe
from torchgrasp.control.object_pose import SEARCH
from torchgrasp.control.recovery import APPROACH, GuardedApproach
from torchgrasp.control.uncertainty_closing import PALM_SPEED
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.values.closing import ClosingOptions, SensorModel

ALL = ClosingOptions()
DOWN = real([0.0, -1.0, 0.0])
LENGTH = 0.08
TIP = 0.01
OPEN = real([[0.052, 0, 0.02], [0.052, 0, -0.02], [-0.036, 0, 0]])
"""Tips of the opened hand [m]: 6 mm beside the ball in its place."""


def above(**changes):
    return on_table(**({"surface": ball_field(), "approach": DOWN} | changes))


def feel(hand, shift):
    """What the open hand feels of a ball displaced by `shift`: each tip that overlaps it touches
    its nearest point.
    """
    tips = OPEN + hand.palm - hand.left * hand.direction
    out = tips - (CENTER + shift)
    normals = out / out.norm(dim=-1, keepdim=True)
    contact = out.norm(dim=-1) < RADIUS + TIP
    seen = observation(contact=contact)
    touched = contact[:, None]
    points = OPEN - TIP * normals  # in the axes of the displaced hand
    tactile = dataclasses.replace(
        seen.tactile,
        points=torch.where(touched, points, torch.nan),
        normals=torch.where(touched, normals, torch.nan),
    )
    return dataclasses.replace(seen, tips=OPEN, tactile=tactile)


def come(hand, shift, ticks=3000):
    """Let the hand come; return `left` and `palm` of every tick."""
    lefts = [hand.left]
    palms = [hand.palm]
    for _ in range(ticks):
        if hand.done:
            return real(lefts), torch.stack(palms)
        hand(feel(hand, shift), PERIOD)
        lefts.append(hand.left)
        palms.append(hand.palm)
    raise AssertionError("the hand never arrived")


def test_guarded_approach_passes_an_object_in_its_place():
    hand = GuardedApproach(above(), ALL, LENGTH, [])
    lefts, palms = come(hand, real([0, 0, 0]))
    speeds = -lefts.diff() / PERIOD
    assert hand.stops == 0 and lefts[-1] == 0.0 and not palms.any()
    assert (speeds > 0).all() and speeds.max() <= APPROACH.speed * (1 + 1e-9)
    changes = speeds.diff().abs() / PERIOD
    assert changes[:-1].max() <= APPROACH.acceleration * 1.2  # braking is sampled
    assert speeds[-1] <= 0.02  # it arrives slowly


@pytest.mark.parametrize("shift", [(0.016, 0, 0), (-0.015, 0, 0.004), (0.012, 0, 0.014)])
def test_guarded_approach_moves_the_palm_to_the_touched_object(shift):
    shift = real(shift)
    hand = GuardedApproach(above(), ALL, LENGTH, [])
    _, palms = come(hand, shift)
    assert 1 <= hand.stops < ALL.stops
    assert (hand.displacement[:3] - shift).norm() < 0.005
    assert (hand.palm - shift).norm() < 0.005 and hand.palm[1] == 0.0
    assert not feel(hand, shift).tactile.contact.any()
    assert palms.diff(dim=0).norm(dim=-1).max() <= PALM_SPEED * PERIOD * (1 + 1e-9)


def test_guarded_approach_draws_back_before_its_palm_moves_within_its_reach():
    lefts, palms = come(GuardedApproach(above(), ALL, LENGTH, []), real([0.016, 0, 0]))
    stopped = int((lefts.diff() >= 0).int().argmax())
    first = int((palms.abs().sum(-1) > 0).int().argmax())
    feeling = 0.06 + (len(SEARCH.turns) + len(SEARCH.fine_turns) + 2) * PERIOD
    assert (
        lefts[stopped + 1 : stopped + 6].diff() >= APPROACH.speed * PERIOD * (1 - 1e-9)
    ).all()  # it draws back at once
    assert (first - stopped) * PERIOD >= feeling and (lefts[stopped : first + 1].diff() >= 0).all()
    assert lefts[first] >= float(lefts[stopped]) + 0.02 - 1e-9
    assert lefts.max() <= LENGTH
    hand = GuardedApproach(above(), ALL, LENGTH, [])
    for _ in range(500):
        hand(feel(hand, real([0.03, 0, 0])), 4 * PERIOD)
        assert hand.palm.norm() <= ALL.palm_reach * (1 + 1e-9)


@pytest.mark.parametrize("placed", [True, False])
def test_guarded_approach_arrives_though_every_finger_touches_all_the_way(placed):
    hand = GuardedApproach(above(), ALL, LENGTH, [])
    seen = observation(contact=torch.ones(3, dtype=torch.bool))
    if not placed:
        nowhere = torch.full((3, 3), torch.nan).double()
        seen = dataclasses.replace(
            seen, tactile=dataclasses.replace(seen.tactile, points=nowhere, normals=nowhere)
        )
    for _ in range(3000):
        if hand.done:
            break
        hand(seen, PERIOD)
    assert hand.done
    assert hand.stops == ALL.stops if placed else not hand.palm.any()


def test_guarded_approach_feels_a_link_by_the_drives_of_its_joints():
    hand = load_hand("allegro")
    grasp = load_shipped_grasp("jug", "allegro")
    plan = dataclasses.replace(
        ClosingReference.from_grasp(hand, grasp), table=above().table, surface=ball_field()
    )
    coming = GuardedApproach(plan, ALL, LENGTH, [])
    joints = plan.pregrasp
    still = observe(hand, joints, no_contact())
    for _ in range(30):
        coming(still, PERIOD)
    assert 0.0 < coming.left < LENGTH - 0.02 and coming.stops == 0 and not coming.feeling
    joint = hand.tree.joint_names.index(hand.joint_names[5])
    for torque, stops in ((0.02, False), (0.04, True)):
        pushed = still.joints.clone()
        pushed[joint] += torque / float(plan.kp[joint])
        coming(dataclasses.replace(still, joints=pushed), PERIOD)
        assert coming.feeling is stops
    spheres = hand.collision_spheres
    moved = hand.tree.moves[spheres.link_index, joint] > 0
    assert 0 < len(coming.felt[0].links) == int(moved.sum()) < len(moved)
    there = hand.sphere_centres(plan.pick(pushed))[moved] - coming.left * plan.approach
    assert torch.allclose(coming.felt[0].links[:, :3], there, rtol=0, atol=1e-9)


def approach(controller, shift):
    """Step a controller until its hand has arrived; return what it commanded."""
    commanded = [controller.targets]
    while controller.approaching:
        commanded.append(controller.step(feel(controller.guard, shift), PERIOD))
    return commanded


def test_controller_closes_where_the_approach_found_the_object():
    shift = real([0.016, 0, 0])
    controller = GraspController(above(), approach=LENGTH)
    commanded = approach(controller, shift)
    assert commanded[0].left == LENGTH and commanded[-1].left == 0.0 and controller.stops >= 1
    opened = controller.reference.expand(controller.reference.pregrasp)
    assert all(torch.equal(x.joints, opened) for x in commanded)
    assert torch.equal(controller.closing.palm, commanded[-1].palm)
    assert (controller.closing.displacement[:3] - shift).norm() < 0.005
    after = controller.step(observation(0.02), PERIOD)
    assert after.left == 0.0 and (after.palm - shift).norm() < 0.005


@pytest.mark.parametrize(
    ("closing", "options", "missing"),
    [
        ("uncertainty", ClosingOptions(stops=0), {}),
        ("position", None, {}),
        ("open_loop", None, {}),
        ("uncertainty", None, {"table": None}),
        ("uncertainty", None, {"surface": None}),
        ("uncertainty", None, {"approach": None}),
        ("uncertainty", None, {"sensor": SensorModel("binary")}),
    ],
)
def test_controller_refuses_an_approach_that_it_cannot_guard(closing, options, missing):
    held = above(**missing)
    with pytest.raises(BadArgument, match="approach"):
        GraspController(held, closing, options=options, approach=LENGTH)
    assert not GraspController(held, closing, options=options).approaching


def test_controller_refuses_a_bad_length_of_approach():
    for length in ("0.1", float("nan"), -0.1, 1.1, None):
        with pytest.raises(BadArgument, match="approach"):
            GraspController(above(), approach=length)


def test_controller_comes_down_once_more_after_it_closed_on_nothing():
    options = ClosingOptions(attempts=3)
    nothing = observation(0.02)
    lefts = []
    palms = []
    controller = GraspController(above(), options=options, approach=LENGTH)
    while not controller.closed:
        targets = controller.step(nothing, PERIOD)
        lefts.append(targets.left)
        palms.append(targets.palm)
    assert controller.attempts == 3
    left = real(lefts)
    palm = torch.stack(palms)
    ups = ((left[1:] > 0) & (left[:-1] == 0)).nonzero()[:, 0]
    assert len(ups) == 2  # it draws back before its palm moves to another place
    assert (left.diff().abs() <= APPROACH.speed * PERIOD * (1 + 1e-9)).all()
    places = [palm[int(k)] for k in (*ups, -1)]
    assert all((one - other).norm() > 0.015 for k, one in enumerate(places) for other in places[:k])


def test_reference_has_the_approach_in_the_hands_axes():
    grasp = load_shipped_grasp("jug", "allegro")
    found = ClosingReference.from_grasp(load_hand("allegro"), grasp).approach
    back = grasp.obj_from_hand[0, :3, :3].double() @ found
    assert torch.allclose(back, grasp.approach[0].double(), atol=1e-6)
    still = dataclasses.replace(grasp, approach=torch.zeros_like(grasp.approach))
    assert ClosingReference.from_grasp(load_hand("allegro"), still).approach is None
