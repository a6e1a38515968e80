"""The closing law with each of its parts left out: without all of them it is the paper's, and the surest is first."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.point_fingers import GAINS, NORMALS, PERIOD, TARGET, TOUCHING, observation, real, reference
from torchgrasp.control import ClosingReference, GraspController, TipContact, measure, no_contact
from torchgrasp.control.law import MAX_SPEED, position_gain, surface_covariance
from torchgrasp.control.observation import Observation
from torchgrasp.control.paper.closings import PaperClosing, PositionClosing
from torchgrasp.control.uncertainty_closing import UncertaintyClosing
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.plane import Plane
from torchgrasp.specs import NO_OPTIONS, ClosingOptions, TrialSpec

SPRING = 2e3
"""Stiffness of the block [N/m]."""


def uncertain(*std_mm: float, force: float = 1e-3) -> ClosingReference:
    """The reference of contacts with these deviations, alike in all else; the force loop [m/(s N)] is slow."""
    covariance = surface_covariance(NORMALS, 1e-3 * real(std_mm))
    gains = dataclasses.replace(
        GAINS,
        covariance=covariance,
        position_gain=position_gain(covariance),
        force_gain=torch.full((3, 3), force).double(),
        desired_force=-3.0 * NORMALS,
    )
    return dataclasses.replace(reference(), gains=gains)


def press(controller: GraspController, seconds: float, start: float = 0.01) -> list[tuple[Observation, torch.Tensor]]:
    """Close on a block that stands where it was planned; the joints follow and slide the tips."""
    joints, tactile, path = torch.zeros(9).double(), no_contact(), []
    for _ in range(round(seconds / PERIOD)):
        points = TARGET + start * NORMALS + joints.reshape(3, 3)
        push = SPRING * -((points + controller.targets.palm - TARGET) * NORMALS).sum(-1).clamp_max(0.0)
        contact = TipContact(push, -push[:, None] * NORMALS, points, NORMALS)
        tactile = measure(tactile, contact, NORMALS, real([0.01] * 3), PERIOD)
        seen = dataclasses.replace(observation(joints=joints), tips=points + 0.01 * NORMALS, tactile=tactile)
        path.append((seen, controller.step(seen, PERIOD).joints))
        joints = controller.targets.joints
    return path


def order(controller: GraspController) -> list[int]:
    """The fingers by their first touch, within the longest time of a closing."""
    forces = torch.stack([seen.tactile.lagged[:, 0] for seen, _ in press(controller, 3.9)])
    assert (forces[-1] > 0).all()
    return (forces > 0).double().argmax(0).argsort().tolist()


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_fingers_that_search_in_vain_do_not_sink_below_the_table_but_move_freely_along_and_off_it(up):
    """The fingers search along x, beyond their contacts; the table is across x, 5 mm behind those above it."""
    above = NORMALS[:, 0] == up
    table = Plane(real([up, 0, 0]), float(up * TARGET[above, 0].mean()) - 0.005)
    low, free = (dataclasses.replace(reference(), table=t) for t in (table, None))
    tips = {}
    for name, known in (("low", low), ("free", free)):
        law, joints = UncertaintyClosing(known, ClosingOptions(palm_reach=0.0, stops=0)), torch.zeros(9).double()
        for _ in range(400):
            at = TARGET + 0.02 * NORMALS + joints.reshape(3, 3)
            joints = law(dataclasses.replace(observation(joints=joints), tips=at), PERIOD)
        tips[name] = at[:, 0] * up
    height = tips["low"] - table.offset - 0.01
    assert float(height[above].min()) >= 0 and float(height[above].max()) < 1e-3
    assert float(tips["free"][above].max()) < table.offset
    assert float(tips["low"][~above].min()) > float(-0.03 + 0.01)


@pytest.mark.parametrize("contact", [False, True])
def test_eq25_of_the_paper_by_matrices(contact):
    """One tick by NumPy, whether something is touched or not; three sliding joints a finger: J is the identity."""
    known, reading = uncertain(2, 4, 6, force=0.01), np.array([0.5, 0.0, 1.0])
    seen = observation(0.004, tuple(reading), TOUCHING if contact else ~TOUCHING)
    found = PaperClosing(known)(seen, PERIOD).reshape(3, 3).numpy()
    bracket = np.zeros((3, 3))
    for i, normal in enumerate(NORMALS.numpy()):
        error = -0.004 * normal
        sigma = (1e-3 * (2, 4, 6)[i]) ** 2 * np.outer(normal, normal) + 0.005**2 * np.eye(3)
        share = np.exp(-0.5 * error @ np.linalg.inv(sigma) @ error)
        force = (reading[i] - 3.0) * normal
        bracket[i] = (1 - share) * 4.0 * 0.005**2 / np.diag(sigma) * error + share * 0.01 * force
    fastest = np.linalg.norm(bracket, axis=-1).max()
    assert np.allclose(found, PERIOD * bracket * min(1.0, MAX_SPEED / fastest), rtol=1e-4)


@pytest.mark.parametrize("std_mm", [(1.0, 5.0, 10.0), (10.0, 5.0, 1.0), (5.0, 10.0, 1.0)])
def test_the_more_certain_finger_touches_first_as_the_paper_says(std_mm):
    certain_first = np.argsort(std_mm).tolist()
    assert order(GraspController(uncertain(*std_mm), "paper")) == certain_first


def test_a_fast_force_loop_turns_that_order_round():
    """Where the blend of an uncertain finger rises far from the contact, it is the force controller that closes it."""
    assert order(GraspController(uncertain(1, 5, 10, force=0.02), "paper"))[0] == 2


def test_without_waiting_a_finger_presses_at_once():
    one = torch.tensor([True, False, False])
    seen = observation(0.0, (1.0, 0.0, 0.0), one)
    for wait, sign in ((True, 1), (False, -1)):  # 1 N is more than the waiting force and less than the desired one
        step = UncertaintyClosing(reference(), ClosingOptions(wait=wait))(seen, PERIOD).reshape(3, 3)
        assert float(step[0] @ NORMALS[0]) * sign > 0


def test_without_the_switch_a_position_error_is_not_forgotten_at_a_touch():
    seen = observation(0.03, (2.0, 2.0, 4.0), TOUCHING)  # the forces are as desired, the contacts 30 mm early
    still = UncertaintyClosing(reference(), NO_OPTIONS)(seen, PERIOD)
    assert still.abs().max() < 1e-9
    going = PaperClosing(reference())(seen, PERIOD).reshape(3, 3)
    assert ((going * NORMALS).sum(-1) < -1e-4).all()


def test_the_papers_closing_ends_when_fingers_are_there_and_forces_are_steady():
    there = observation(0.0, contact=TOUCHING)
    far = observation(0.03, contact=TOUCHING)

    def ticks(*, seen: Observation, rising: float = 0.0) -> int:
        closing = PaperClosing(reference())
        for k in range(100):
            average = torch.full((3,), rising * k).double()
            closing(dataclasses.replace(seen, tactile=dataclasses.replace(seen.tactile, average=average)), PERIOD)
            if closing.done:
                return k
        return 100

    assert ticks(seen=there) < 20
    assert ticks(seen=far) == 100
    assert ticks(seen=there, rising=0.05) == 100
    assert ticks(seen=observation(0.0)) == 100


def test_the_law_may_go_on_as_the_holding_and_then_presses_as_desired():
    controller = GraspController(uncertain(2, 2, 2, force=0.005), holding="law")
    waiting = press(controller, 2.5)
    assert controller.hold is controller.closing
    reading = waiting[-1][0].tactile.reading
    assert torch.allclose(reading, real([3.0] * 3), rtol=0.05)


def test_the_papers_baseline_aims_at_the_contacts():
    controller = GraspController(reference(), "paper_position")
    assert isinstance(controller.closing, PositionClosing)
    assert torch.equal(controller.closing.aim, TARGET)
    controller.step(observation(0.5e-3), PERIOD)
    assert controller.closing.done


def test_parts_and_laws_of_closings_without_any_are_refused():
    for closing in ("paper", "position", "open_loop"):
        with pytest.raises(BadArgument, match="options"):
            GraspController(reference(), closing, options=ClosingOptions())
        with pytest.raises(BadArgument, match="options"):
            TrialSpec(closing=closing, options=ClosingOptions())
    with pytest.raises(BadArgument, match="law"):
        GraspController(reference(), "position", "law")
