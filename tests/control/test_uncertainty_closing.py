"""The closings: when fingers approach, wait, search, stop and press, and the paper's control law
(Eqs. 25-28).
"""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.point_fingers import (
    FREE,
    GAINS,
    NORMALS,
    PERIOD,
    TARGET,
    TOUCHING,
    close_on_block,
    observation,
    real,
    reference,
)
from torchgrasp import ClosingReference, GraspController, Plane
from torchgrasp.control.law import (
    MAX_SPEED,
    POSITION_FLOOR,
    POSITION_RATE,
    position_gain,
    surface_covariance,
)
from torchgrasp.control.paper.closings import STOP_FORCE, PaperClosing, PositionClosing
from torchgrasp.control.protocol import SETTLED
from torchgrasp.control.reference import next_target
from torchgrasp.control.sensing import WAITING_FORCE
from torchgrasp.control.uncertainty_closing import (
    CLOSING,
    UncertaintyClosing,
    rim_contacts,
    with_equal_gains,
)
from torchgrasp.values.closing import NO_OPTIONS, ClosingOptions

ONE = torch.tensor([True, False, False])
TWO = torch.tensor([True, True, False])
RIGID_ARM = ClosingOptions(palm_reach=0.0, stops=0)


def closing(options: ClosingOptions = ClosingOptions()) -> UncertaintyClosing:  # noqa: B008
    return UncertaintyClosing(reference(), options)


def uncertain(*std_mm: float, force: float = 1e-3) -> ClosingReference:
    """The reference of contacts with these deviations, alike in all else; the force loop [m/(s N)]
    is slow.
    """
    covariance = surface_covariance(NORMALS, 1e-3 * real(std_mm))
    gains = dataclasses.replace(
        GAINS,
        covariance=covariance,
        position_gain=position_gain(covariance),
        force_gain=torch.full((3, 3), force).double(),
        desired_force=-3.0 * NORMALS,
    )
    return dataclasses.replace(
        reference(), gains=gains, distance_variance=(1e-3 * real(std_mm)) ** 2
    )


def order(controller: GraspController) -> list[int]:
    """The fingers by their first touch, within the longest time of a closing."""
    forces = []
    for seen, _ in close_on_block(controller, 3.9):
        forces.append(seen.tactile.lagged[:, 0])
        if bool((forces[-1] > 0).all()):
            return (torch.stack(forces) > 0).double().argmax(0).argsort().tolist()
    raise AssertionError("a finger never touched")


def test_eq25_free_fingers_approach_their_contacts_at_one_pace_and_fixed_gains_are_certain():
    step = closing()(observation(), PERIOD).reshape(3, 3)
    assert ((step * NORMALS).sum(-1) < 0).all()
    assert step.norm(dim=-1).max() <= MAX_SPEED * PERIOD + 1e-12
    assert step[:, 1:].abs().max() < 1e-9
    near = dataclasses.replace(
        observation(0.2), tips=TARGET + 0.01 * NORMALS + real([[0.2], [0.1], [0.2]]) * NORMALS
    )
    speed = -(closing()(near, PERIOD).reshape(3, 3) * NORMALS).sum(-1)
    assert float(speed[1] / speed[0]) == pytest.approx(
        (0.1 + POSITION_FLOOR) / (0.2 + POSITION_FLOOR), rel=1e-3
    )
    assert float(speed[2]) == pytest.approx(float(speed[0]))
    gains = with_equal_gains(reference()).gains
    assert torch.allclose(gains.position_gain, real(POSITION_RATE))
    assert torch.allclose(gains.covariance, POSITION_FLOOR**2 * torch.eye(3).double())
    assert (gains.force_gain == gains.force_gain[:, :1]).all()
    assert torch.equal(gains.target, GAINS.target)


def test_paper_closing_touches_with_the_most_certain_finger_first():
    for std_mm, force in (((2.0, 5.0, 10.0), 1e-3), ((5.0, 10.0, 2.0), 0.02)):
        assert order(GraspController(uncertain(*std_mm, force=force), "paper"))[0] == int(
            np.argmin(std_mm)
        )


def test_waiting_finger_rests_and_yields_to_more_than_the_waiting_force():
    law = closing(RIGID_ARM)
    contact = ONE
    for reading in (WAITING_FORCE, 0.1, 0.0, -0.1):
        step = law(observation(0.02, (reading, 0, 0), contact), PERIOD).reshape(3, 3)
        assert step[0].abs().max() < 1e-12
        contact = FREE  # the finger rests although it no longer touches
    step = law(observation(0.02, (1.0, 0, 0)), PERIOD).reshape(3, 3)
    assert float((step[0] * NORMALS[0]).sum()) > 0
    last = law(observation(0.02, (0.0, CLOSING.touch, CLOSING.touch)), PERIOD).reshape(3, 3)
    assert float((last[0] * NORMALS[0]).sum()) < float(
        (step[0] * NORMALS[0]).sum()
    )  # all have touched: all press


@pytest.mark.parametrize(("wait", "sign"), [(True, 1), (False, -1)])
def test_finger_presses_at_once_without_waiting(wait, sign):
    seen = observation(
        0.0, (1.0, 0.0, 0.0), ONE
    )  # more than the waiting force, less than the desired force
    step = closing(ClosingOptions(wait=wait))(seen, PERIOD).reshape(3, 3)
    assert float(step[0] @ NORMALS[0]) * sign > 0


@pytest.mark.parametrize(("contact", "time"), [(TOUCHING, SETTLED), (ONE, CLOSING.patience)])
def test_closing_ends_when_all_touch_or_patience_is_over(contact, time):
    law = closing()
    ticks = 0
    while not law.done:
        law(observation(contact=contact), PERIOD)
        ticks += 1
    assert ticks * PERIOD == pytest.approx(time, abs=1.5 * PERIOD)
    untouched = closing()
    for _ in range(100):
        untouched(observation(), 2 * CLOSING.patience / 100)
    assert not untouched.done


def test_targets_stay_near_the_joints_but_late_fingers_search_and_press_harder():
    law = closing()
    stopping = PositionClosing(reference())
    for _ in range(150):
        targets = law(observation(0.5), PERIOD)
    assert targets.abs().max() == pytest.approx(CLOSING.lead)
    for _ in range(60):
        targets = stopping(observation(0.5), 0.5)
    assert targets.abs().max() == pytest.approx(1.0)
    seen = observation(-0.03, (0.3, 0.3, 0.0), TWO)
    law = closing()
    first = law(seen, PERIOD).reshape(3, 3)
    assert float(first[2] @ NORMALS[2]) < -0.5 * MAX_SPEED * PERIOD
    last = [law(seen, PERIOD) for _ in range(240)][-1]
    assert last.abs().max() > 1.5 * CLOSING.lead  # the joints do not follow, as if blocked


def searched(table: Plane | None) -> torch.Tensor:
    """The tips (3, 3) of fingers that search along x, beyond their contacts."""
    law = UncertaintyClosing(dataclasses.replace(reference(), table=table), RIGID_ARM)
    joints = torch.zeros(9).double()
    for _ in range(200):
        at = TARGET + 0.02 * NORMALS + joints.reshape(3, 3)
        joints = law(dataclasses.replace(observation(joints=joints), tips=at), PERIOD)
    return at


@pytest.mark.parametrize("edge", [False, True])
@pytest.mark.parametrize("up", [1.0, -1.0])
def test_searching_finger_stays_above_the_table_or_beyond_its_edge(up, edge):
    """The table or its edge is across x, 5 mm behind the contacts above it."""
    above = NORMALS[:, 0] == up
    side = Plane(real([up, 0, 0]), float(up * TARGET[above, 0].mean()) - 0.005)
    table = Plane(real([0, 0, 1]), 1.0, side) if edge else side
    low, free = (up * searched(t)[:, 0] for t in (table, None))
    height = low - side.offset - 0.01
    assert float(height[above].min()) >= 0 and float(height[above].max()) < 1e-3
    assert float(free[above].max()) < side.offset
    assert float(low[~above].min()) > float(-0.03 + 0.01)


def test_an_edge_far_from_the_fingers_changes_nothing():
    """To the last bit: where the table goes on, it is as without an edge; where it ended long ago,
    as if it were far below.
    """
    above = NORMALS[:, 0] == 1.0
    table = Plane(real([1, 0, 0]), float(TARGET[above, 0].mean()) - 0.005)
    there, here = (Plane(real([0, 1, 0]), offset) for offset in (1.0, -1.0))
    assert torch.equal(searched(dataclasses.replace(table, edge=there)), searched(table))
    deep = dataclasses.replace(table, offset=-10.0)
    assert torch.equal(searched(dataclasses.replace(table, edge=here)), searched(deep))


def test_fingers_slide_along_the_table_to_the_rim_of_a_low_object():
    """Tips of 10 mm on the table touch a sharp rim 5 mm high with normals of slope 1/2; walls are
    met as before.
    """
    slope = torch.tensor([0.5, 0.5, 0.5]).double()
    normals = torch.stack([(1 - slope**2).sqrt() * NORMALS[:, 0], 0 * slope, slope], -1)
    rim = TARGET * real([1.0, 1.0, 0.0]) + real([0.0, 0.0, 0.005])
    gains = dataclasses.replace(
        GAINS, target=rim, covariance=surface_covariance(normals, real([0.004] * 3))
    )
    low = dataclasses.replace(
        reference(), normals=normals, gains=gains, table=Plane(real([0, 0, 1]), 0.0)
    )
    law = UncertaintyClosing(low, RIGID_ARM)
    joints = torch.zeros(9).double()
    paths = []
    assert law.low.all() and not rim_contacts(dataclasses.replace(low, table=None)).any()
    assert not rim_contacts(dataclasses.replace(low, normals=NORMALS)).any()
    ending = (Plane(real([1, 0, 0]), x) for x in (1.0, 0.0, -1.0))  # where the table ends along x
    rims = [
        rim_contacts(dataclasses.replace(low, table=dataclasses.replace(low.table, edge=edge)))
        for edge in ending
    ]
    assert rims[0].all() and torch.equal(rims[1], NORMALS[:, 0] < 0) and not rims[2].any()
    for _ in range(150):
        paths.append(
            rim + 0.01 * normals + real([0, 0, 0.006]) + 0.012 * NORMALS + joints.reshape(3, 3)
        )
        joints = law(dataclasses.replace(observation(joints=joints), tips=paths[-1]), PERIOD)
    height = torch.stack(paths)[..., 2] - 0.01
    left = ((torch.stack(paths) - rim) * NORMALS).sum(-1)
    touch = 0.01 * math.sqrt(
        0.75
    )  # horizontal distance [m] of a tip's centre from the rim that it touches
    assert float(height.min()) > 0 and float(left.min()) < touch
    assert (
        float(height[left < touch + 0.003].max()) < 0.0005
    )  # so low even where the rim is met 3 mm early


def test_a_raised_palm_goes_down_as_coupled_fingers_close_upwards():
    """Each finger has one joint, with which its tip goes inwards and up by 0.6: only the palm keeps
    it at the table.
    """
    slope = torch.tensor([0.5, 0.5, 0.5]).double()
    coupling = torch.zeros(9, 3).double()
    for i in range(3):
        coupling[3 * i, i] = -NORMALS[i, 0]
        coupling[3 * i + 2, i] = 0.6
    normals = torch.stack([(1 - slope**2).sqrt() * NORMALS[:, 0], 0 * slope, slope], -1)
    rim = TARGET * real([1.0, 1.0, 0.0]) + real([0.0, 0.0, 0.005])
    gains = dataclasses.replace(
        GAINS, target=rim, covariance=surface_covariance(normals, real([0.004] * 3))
    )
    low = dataclasses.replace(
        reference(coupling), normals=normals, gains=gains, table=Plane(real([0, 0, 1]), 0.0)
    )
    rise = real([0, 0, 0.006])
    start = rim + 0.01 * normals + 0.01 * NORMALS - real([0, 0, 0.006])
    assert not low.rise.any()  # its links are far away
    raised = dataclasses.replace(low)
    vars(raised)["rise"] = rise
    law = UncertaintyClosing(raised, RIGID_ARM)
    joints = torch.zeros(9).double()
    paths = [start + rise]
    while float(((paths[-1] - rim) * NORMALS).sum(-1).max()) > 0.01 * math.sqrt(
        0.75
    ):  # until all tips touch
        joints = law(
            dataclasses.replace(observation(joints=joints), tips=paths[-1] - law.palm), PERIOD
        )
        paths.append(start + law.palm + joints.reshape(3, 3))
    height = torch.stack(paths)[..., 2] - 0.01
    assert (
        float(height.min()) > -1e-3
        and float(height.amin(1).max()) < 1e-3
        and float(height.max()) < 3e-3
    )
    assert float(law.palm[2]) < 0.003 and torch.equal(law.palm[:2], torch.zeros(2).double())
    law = UncertaintyClosing(raised, RIGID_ARM).press()
    law(dataclasses.replace(observation(), tips=start), PERIOD)
    assert torch.equal(law.palm, rise)


def test_fingers_go_down_by_themselves_where_one_tip_keeps_the_raised_palm_up():
    slope = torch.full((3,), 0.5).double()
    normals = torch.stack([(1 - slope**2).sqrt() * NORMALS[:, 0], 0 * slope, slope], -1)
    rim = TARGET * real([1.0, 1.0, 0.0]) + real([0.0, 0.0, 0.005])
    gains = dataclasses.replace(
        GAINS, target=rim, covariance=surface_covariance(normals, real([0.004] * 3))
    )
    low = dataclasses.replace(
        reference(), normals=normals, gains=gains, table=Plane(real([0, 0, 1]), 0.0)
    )
    raised = dataclasses.replace(low)
    vars(raised)["rise"] = real([0, 0, 0.006])
    law = UncertaintyClosing(raised, RIGID_ARM)
    # tips at the table where the palm is down, the first of them where it is raised
    start = rim + 0.01 * normals + 0.01 * NORMALS
    start[:, 2] = real([0.004, 0.01, 0.01])
    joints = torch.zeros(9).double()
    for _ in range(100):
        tips = start + joints.reshape(3, 3)
        joints = law(dataclasses.replace(observation(joints=joints), tips=tips), PERIOD)
    height = (start + joints.reshape(3, 3) + law.palm)[:, 2] - 0.01
    assert float(law.palm[2]) > 0.004  # the first tip holds it
    assert float(height.max()) < 0.002


def test_joints_that_would_be_too_fast_slow_down_together():
    velocity = real([[2.0, 1.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.0]])
    free, slow = (
        next_target(
            reference(), torch.zeros(9).double(), velocity, observation(), 10.0, PERIOD, *fastest
        )
        for fastest in ((), (0.8,))
    )
    assert float(slow.abs().max()) == pytest.approx(0.8 * PERIOD)
    assert torch.allclose(slow * float(free.abs().max() / slow.abs().max()), free)


def test_touching_finger_is_force_controlled_and_held_with_the_desired_forces():
    seen = observation(
        0.03, (2.0, 2.0, 4.0), TOUCHING
    )  # the forces are as desired, the contacts 30 mm early
    assert UncertaintyClosing(reference(), NO_OPTIONS)(seen, PERIOD).abs().max() < 1e-9
    going = PaperClosing(reference())(seen, PERIOD).reshape(3, 3)
    assert ((going * NORMALS).sum(-1) < -1e-4).all()
    controller = GraspController(uncertain(2, 2, 2, force=0.005), holding="law")
    *_, (last, _) = close_on_block(controller, 2.5)
    assert controller.hold is controller.closing
    assert torch.allclose(last.tactile.reading, real([3.0] * 3), rtol=0.05)


def test_position_closing_stops_each_finger_for_good():
    law = PositionClosing(reference())
    first = law(observation(0.02, (STOP_FORCE, 0.0, 0.0)), PERIOD).reshape(3, 3)
    assert first[0].abs().max() == 0
    assert (first[1:].abs().amax(-1) > 0).all()
    assert law(observation(0.02), PERIOD).reshape(3, 3)[0].abs().max() == 0
    law(observation(), PERIOD)  # nothing is felt at the planned contacts: it continues
    assert not law.done
    law(observation(0.0015 - 0.02), PERIOD)  # a fingertip stops within 1 mm of its aim
    assert not law.done
    law(observation(0.0005 - 0.02), PERIOD)
    assert law.done


def test_paper_position_closing_aims_at_the_contacts_and_stops_at_the_papers_force():
    law = PositionClosing(reference())
    step = (
        law(observation(0.02, (0.45, 0.55, 0.0)), PERIOD).reshape(3, 3).abs().amax(-1)
    )  # Sec. 6.5: 0.5 N
    assert (step > 0).tolist() == [True, False, True]
    controller = GraspController(reference(), "paper_position")
    assert isinstance(controller.closing, PositionClosing)
    assert torch.equal(controller.closing.aim, TARGET)
    controller.step(observation(0.5e-3), PERIOD)
    assert controller.closing.done
