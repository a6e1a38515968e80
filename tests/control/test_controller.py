"""GraspController and its holdings without a simulator: phases, ends in time, balanced forces,
refusals.
"""

import dataclasses

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
from torchgrasp import ClosingReference, Plane, TrialSpec, load_hand
from torchgrasp.control import no_contact, observe
from torchgrasp.control.controller import CLOSING_TIME, GraspController
from torchgrasp.control.finger_forces import desired_forces
from torchgrasp.control.holding import RAMP, ForceHold, GripHold, held_forces
from torchgrasp.control.protocol import POSE_TIME
from torchgrasp.control.recovery import PRESSING_TIME
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.linalg import fibonacci_sphere
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.values.closing import ClosingOptions

PRESSED = (2.0, 2.0, 4.0)
CLOSE = TARGET * real(
    [1.0, 1.0, 0.2]
)  # two contacts side by side: unequal forces need little friction


def run(controller, seen, seconds):
    return [controller.step(seen, PERIOD).joints for _ in range(round(seconds / PERIOD))]


def sphere_field(away: float) -> SignedDistanceField:
    """The distances [m] of a ball of 3 cm, `away` [m] from the contacts."""
    axis = torch.linspace(-0.05, 0.05, 11).double()
    nodes = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    corner = real([away - 0.05, -0.05, -0.05])
    return SignedDistanceField(corner, 0.01, nodes.norm(dim=-1) - 0.03)


def off(forces: torch.Tensor, proportions: torch.Tensor) -> float:
    """The distance of the normal forces' proportions from given ones."""
    push = -(forces * NORMALS).sum(-1)
    return float((push / push.max() - proportions).norm())


def test_desired_and_held_forces_balance_or_press_along_the_normals():
    torch.testing.assert_close(
        desired_forces(TARGET, NORMALS, 6.0).sum(0), torch.zeros(3, dtype=torch.float64)
    )
    alike = NORMALS[:1].expand(3, 3).contiguous()
    torch.testing.assert_close(desired_forces(TARGET, alike, 6.0), -6.0 * alike)
    forces, total = held_forces(reference(), observation(contact=TOUCHING))
    assert forces.sum(0).abs().max() < 1e-9
    assert torch.linalg.cross(TARGET, forces).sum(0).abs().max() < 1e-9
    assert total == pytest.approx(8.0, rel=0.02)
    assert float((-(forces * NORMALS).sum(-1)).max()) == pytest.approx(4.0)
    planned, total = held_forces(
        reference(), observation(contact=torch.tensor([True, True, False]))
    )
    assert torch.equal(planned, GAINS.desired_force)
    assert total == pytest.approx(8.0)


def test_desired_forces_approach_preferred_proportions_and_held_ones_keep_those_of_the_stability_model():
    preferred = real([0.8, 0.2, 1.0])
    even, led = (desired_forces(CLOSE, NORMALS, 4.0, x) for x in (None, preferred))
    assert led.sum(0).abs().max() < 1e-9
    assert off(led, preferred) < 0.5 * off(even, preferred)
    planned = real([3.2, 0.8, 4.0])
    seen = observation(contact=TOUCHING)
    seen = dataclasses.replace(seen, tactile=dataclasses.replace(seen.tactile, points=CLOSE))
    gains = dataclasses.replace(GAINS, desired_force=-planned[:, None] * NORMALS)
    even, led = (
        held_forces(
            dataclasses.replace(reference(), gains=dataclasses.replace(gains, force_source=x)), seen
        )[0]
        for x in ("analytic", "stability")
    )
    assert led.sum(0).abs().max() < 1e-9
    assert off(led, planned / 4.0) < 0.5 * off(even, planned / 4.0)


def test_forces_of_three_contacts_trade_friction_against_the_preferred_proportions():
    """All directions in the null space are tried: the friction needed, and 0.2 of the distance from
    the proportions.
    """
    preferred = real([0.8, 0.2, 1.0])
    sides = TARGET.roll(-1, 0) - TARGET
    sides = sides / sides.norm(dim=1, keepdim=True)
    w = fibonacci_sphere(200_000).double()
    tried = w[:, :, None] * sides - (w[:, :, None] * sides).roll(1, 1)

    def cost(forces: torch.Tensor) -> torch.Tensor:
        push = -(forces * NORMALS).sum(-1)
        across = (forces + push[..., None] * NORMALS).norm(dim=-1)
        far = (push / push.amax(-1, keepdim=True) - preferred).norm(dim=-1)
        return torch.where(push.amin(-1) > 0, (across / push).amax(-1) + 0.2 * far, torch.inf)

    found = cost(desired_forces(TARGET, NORMALS, 4.0, preferred))
    assert 0.05 < float(found) < 1.001 * float(cost(tried).min())


def test_force_hold_exerts_the_forces_and_regulates_their_sum():
    start = 0.01 * torch.ones(9).double()
    seen, weak = (observation(0.0, contact=TOUCHING, reading=x) for x in (PRESSED, (1.0, 1.0, 2.0)))
    hold = ForceHold(reference(), seen, start)
    assert (hold(seen, PERIOD) - start).abs().max() < 0.1
    last = [hold(seen, PERIOD) for _ in range(round(RAMP / PERIOD))][-1]
    forces, _ = held_forces(reference(), seen)
    assert torch.allclose(
        2.0 * last.reshape(3, 3), forces, atol=0.02
    )  # kp times the lead of sliding joints is force
    more = [hold(weak, PERIOD) for _ in range(300)]
    assert more[49].norm() > 1.1 * last.norm()
    assert more[-1].norm() == pytest.approx(1.5 * float(forces.norm()) / 2.0, rel=1e-6)


def test_open_loop_passes_its_three_poses():
    opened = dataclasses.replace(reference(), pregrasp=reference().joints - 0.01)
    controller = GraspController(opened, "open_loop")
    assert not controller.closed
    path = torch.stack(run(controller, observation(contact=TOUCHING), 2 * POSE_TIME + 0.2))
    assert torch.allclose(path[39], real(0.0), atol=1e-12) and torch.allclose(
        path[19], real(-0.005)
    )
    assert torch.allclose(path[79:], real(0.02)) and torch.allclose(path[59], real(0.01))
    assert controller.closed


@pytest.mark.parametrize(
    ("closing", "hold"), [("position", ForceHold), ("fixed", GripHold), ("uncertainty", GripHold)]
)
def test_controller_ends_the_closing_in_time_and_holds(closing, hold):
    controller = GraspController(reference(), closing)
    period = 0.02
    for _ in range(round(CLOSING_TIME / period)):
        controller.step(observation(0.05), period)
    assert controller.hold is None
    controller.step(observation(0.05), period)
    assert isinstance(controller.hold, hold) and not controller.closed
    for _ in range(round(PRESSING_TIME / period)):
        controller.step(observation(0.05), period)
    assert controller.closed


@pytest.mark.parametrize("holding", ["force", "grip", "position", "law"])
def test_controller_keeps_its_targets_in_the_tick_that_begins_the_holding(holding):
    controller = GraspController(reference(), holding=holding)
    seen = observation(contact=TOUCHING, reading=PRESSED)
    while controller.hold is None:
        before = controller.targets.joints
        targets = controller.step(seen, PERIOD)
    assert torch.equal(targets.joints, before) and controller.pressed == 0.0
    controller.step(seen, PERIOD)
    assert controller.pressed == PERIOD


def test_controller_starts_with_the_opened_hand_refuses_unknown_names_and_passes_nan():
    assert torch.equal(GraspController(reference()).targets.joints, reference().pregrasp)
    for names, match in ((("slow",), "slow"), (("fixed", "glue"), "glue")):
        with pytest.raises((BadArgument, TypeError), match=match):
            GraspController(reference(), *names)
    with pytest.raises(BadArgument, match="law"):
        GraspController(reference(), "position", "law")
    known = reference()
    lost = torch.full((9,), torch.nan).double()
    assert torch.isnan(known.expand(lost)).all() and torch.isnan(known.pick(lost)).all()
    assert torch.isnan(known.hand.actuated.couple(lost)).all()


def test_options_of_closings_without_any_and_components_without_those_they_need_are_refused():
    for closing in ("paper", "position", "open_loop"):
        with pytest.raises(BadArgument, match="options"):
            GraspController(reference(), closing, options=ClosingOptions())
        with pytest.raises(BadArgument, match="options"):
            TrialSpec(closing=closing, options=ClosingOptions())
    for options in ({"pose_estimate": False}, {"palm_reach": 0.0}, {"attempts": 0}, {"stops": -1}):
        with pytest.raises(BadArgument):
            ClosingOptions(**options)


@pytest.mark.parametrize("holding", ["force", "grip", "position", "law"])
def test_a_robot_may_change_targets_and_reuse_the_memory_of_its_readings(holding):
    ours = GraspController(reference(), holding=holding)
    theirs = GraspController(reference(), holding=holding)
    memory = observation(contact=TOUCHING, reading=PRESSED)
    for k in range(200):
        joints = torch.full((9,), 1e-4 * k).double()
        seen = dataclasses.replace(observation(contact=TOUCHING, reading=PRESSED), joints=joints)
        memory.joints.copy_(joints)
        sent = theirs.step(memory, PERIOD)
        assert torch.equal(ours.step(seen, PERIOD).joints, sent.joints)
        sent.joints.mul_(180 / torch.pi)  # a driver in degrees
        sent.palm.add_(1.0)
    assert torch.equal(ours.targets.joints, theirs.targets.joints)


def test_parts_of_a_plan_that_do_not_fit_each_other_are_refused_by_name():
    known = on_table(planned_table=on_table().table)
    GraspController(known)
    up = known.table.normal
    tilted = Plane(real([0.0, 0.0, 1.0]), known.table.offset)
    wrong = {
        "table": [tilted, Plane(up, known.table.offset - 0.1), Plane(-up, 0.1)],
        "surface": [sphere_field(away=0.3)],
        "normals": [2.0 * NORMALS],
        "approach": [real([0.0, -100.0, 0.0])],
        "kp": [known.kp[:5], 0.0 * known.kp],
    }
    for name, values in wrong.items():
        for value in values:
            with pytest.raises(BadArgument, match=name):
                GraspController(dataclasses.replace(known, **{name: value}))


def test_a_largest_force_that_the_modes_do_not_keep_is_refused():
    fragile = dataclasses.replace(reference(), max_force=2.0)
    GraspController(dataclasses.replace(fragile, max_force=4.0), holding="law")
    for closing, holding in (("open_loop", "force"), ("paper", "force"), ("uncertainty", "law")):
        with pytest.raises(BadArgument, match="max_force"):
            GraspController(fragile, closing, holding)
    for closing, holding in (("uncertainty", "impedance"), ("position", "position")):
        with pytest.raises(BadArgument, match="max_force"):
            TrialSpec(closing=closing, holding=holding, max_force=2.0)


def test_measured_joints_in_degrees_are_refused_and_overshoot_is_not():
    hand = load_hand("barrett")
    middle = (hand.lower + hand.upper) / 2
    observe(hand, hand.upper + 0.1, no_contact())
    with pytest.raises(BadArgument, match="radians"):
        observe(hand, middle * 180 / torch.pi, no_contact())
    observe(hand, middle, no_contact())


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_a_table_in_the_frame_of_the_cloud_is_refused_also_where_the_plan_had_none(name):
    reference = ClosingReference.from_grasp(load_hand(name), load_shipped_grasp("jug", name))
    without = dataclasses.replace(reference, planned_table=None)
    GraspController(dataclasses.replace(without, table=reference.planned_table))
    with pytest.raises(BadArgument, match=r"reference\.table.*hand_from_obj"):
        GraspController(dataclasses.replace(without, table=Plane.horizontal(0.0)))
