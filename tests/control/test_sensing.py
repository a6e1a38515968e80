"""Poorer fingertips: what each kind tells, how late, and that the closing law relies on no more
than that.
"""

import dataclasses
import math

import pytest
import torch

from tests.point_fingers import (
    GAINS,
    NORMALS,
    PERIOD,
    TARGET,
    TOUCHING,
    observation,
    real,
    reference,
)
from torchgrasp import GraspController, TrialSpec
from torchgrasp.control import FingertipSensor, TipContact, feel_flags, feel_torques, no_contact
from torchgrasp.control.holding import MAX_FACTOR, ForceHold
from torchgrasp.control.sensing import TORQUE_NOISE, WAITING_FORCE, DriveFeel
from torchgrasp.control.uncertainty_closing import CLOSING, UncertaintyClosing
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.values.closing import NO_OPTIONS, ClosingOptions, SensorModel

WAIT_ALONE = dataclasses.replace(NO_OPTIONS, wait=True)
JACOBIAN = torch.eye(9).double().reshape(3, 3, 9)
FINGERS = reference().hand.finger_names


def having(**changes):
    return dataclasses.replace(reference(), sensor=SensorModel(**changes))


def touch(force) -> TipContact:
    push = real(force)
    return TipContact(push, -push[:, None] * NORMALS, TARGET, NORMALS)


def told(known, force, ticks=100, seed=None):
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    sensor = FingertipSensor(known, generator)
    return [sensor(touch(force), JACOBIAN, PERIOD) for _ in range(ticks)]


def test_sensor_delay_repeats_earlier_readings_and_noise_scales():
    fresh = told(having(), (1.0, 2.0, 3.0))
    for late in (1, 4):
        old = told(having(delay=late / 100), (1.0, 2.0, 3.0))
        for k in range(late, 100):
            assert torch.equal(old[k].reading, fresh[k - late].reading)
            assert torch.equal(old[k].contact, fresh[k - late].contact)
    assert (old[0].reading == 0).all()
    one, three = (
        torch.stack([t.reading for t in told(having(noise=n), (2.0, 2.0, 2.0), 100, 1)])
        for n in (1.0, 3.0)
    )
    clean = torch.stack([t.reading for t in told(having(), (2.0, 2.0, 2.0), 100)])
    assert torch.allclose(three - clean, 3 * (one - clean), atol=1e-12)
    readings = torch.stack(
        [t.reading for t in told(having(kind="torque"), (2.0, 2.0, 2.0), 700, 1)[50:]]
    )
    passed = math.sqrt(1 - math.exp(-0.4 * math.pi)) / math.sqrt(
        1 + math.exp(-0.4 * math.pi)
    )  # of an AR(1) low-pass
    assert float(readings.std()) == pytest.approx(TORQUE_NOISE * passed, rel=0.15)


def test_torque_sensor_measures_observable_forces_without_places_as_feel_torques_does():
    last = told(having(kind="torque"), (1.0, 2.0, 0.0))[-1]
    assert torch.allclose(last.reading, real([1.0, 2.0, 0.0]), rtol=1e-3)
    assert torch.allclose(last.forces, -last.reading[:, None] * NORMALS, atol=1e-9)
    assert last.contact.tolist() == [True, True, False]
    assert not torch.isfinite(last.points).any() and not torch.isfinite(last.normals).any()
    known = having(kind="torque")
    tactile = no_contact()
    torques = torch.einsum("fcj,fc->j", JACOBIAN, touch((1.0, 2.0, 0.5)).forces)
    for expected in told(known, (1.0, 2.0, 0.5), 20):
        tactile = feel_torques(tactile, known, JACOBIAN, torques, PERIOD)
        assert torch.allclose(tactile.reading, expected.reading) and torch.equal(
            tactile.contact, expected.contact
        )
    stretched = JACOBIAN.clone()
    stretched[0, 0] *= 1e-3  # the first finger is stretched out along its normal
    torques = 0.01 * torch.ones(9).double()
    tactile = no_contact()
    for _ in range(20):
        tactile = feel_torques(tactile, known, stretched, torques, PERIOD)
    assert abs(float(tactile.reading[0])) < 1.0  # by least squares it would be 10 N
    assert tactile.reading[1:].tolist() == pytest.approx([0.0, 0.01], rel=1e-3)
    assert abs(float(tactile.forces[1, 1]) - 0.01) < 1e-4


def test_binary_sensor_reads_the_same_for_every_force():
    weak = told(having(kind="binary"), (1.0, 0.1, 0.0))[-1]
    strong = told(having(kind="binary"), (9.0, 0.1, 0.0))[-1]
    assert weak.contact.tolist() == [True, False, False]
    for name in ("reading", "forces", "contact", "average", "sliding"):
        assert torch.equal(getattr(weak, name), getattr(strong, name))
    assert torch.equal(feel_flags(weak, weak.contact).reading, real([WAITING_FORCE, 0.0, 0.0]))


def test_dead_sensor_is_silent_and_others_are_unchanged():
    quiet, all_of_them = (
        told(x, (2.0, 2.0, 2.0), seed=3)[-1] for x in (having(dead=FINGERS[1:2]), having())
    )
    assert (
        quiet.reading[1] == 0 and not quiet.contact[1] and not torch.isfinite(quiet.points[1]).any()
    )
    for k in (0, 2):
        assert quiet.reading[k] == all_of_them.reading[k] and torch.equal(
            quiet.normals[k], all_of_them.normals[k]
        )
    with pytest.raises(BadArgument, match="little_toe"):
        FingertipSensor(having(dead=("little_toe",)))


def closes(
    sensor: SensorModel, contact, off: float, ticks=12
) -> tuple[UncertaintyClosing, torch.Tensor]:
    """How far the last finger's target comes on while the others touch as given, its tip off its
    contact [m].
    """
    law = UncertaintyClosing(dataclasses.replace(reference(), sensor=sensor), WAIT_ALONE)
    seen = observation(off, (0.3, 0.3, 0.0), contact)
    targets = torch.stack([law(seen, PERIOD).reshape(3, 3)[2] for _ in range(ticks)])
    return law, -((targets - targets[0]) * NORMALS[2]).sum(-1)


DEAD = SensorModel(dead=FINGERS[2:])
TWO = torch.tensor([True, True, False])


def test_dead_finger_rests_at_its_contact_then_searches_and_counts_as_touching_far_beyond():
    alone = torch.tensor([True, False, False])
    for contact, off, comes_on in (
        (alone, 0.01, True),
        (alone, -0.001, False),
        (TWO, -0.001, True),
    ):
        law, steps = closes(DEAD, contact, off)
        assert (float(steps[-1]) > 1e-3) == comes_on and not law.done
        if not comes_on:
            assert torch.allclose(steps, steps[:1], atol=1e-9)
    deviation = float((NORMALS[2] @ GAINS.covariance[2] @ NORMALS[2]).sqrt())
    for off, done in ((-0.9 * 3.0 * deviation, False), (-1.1 * 3.0 * deviation, True)):
        assert closes(DEAD, TWO, off)[0].done == done
    assert not closes(SensorModel(), TWO, -1.1 * 3.0 * deviation)[
        0
    ].done  # one that could tell searches on


def test_dead_finger_stops_where_its_drives_push_which_measure_blocked_joints_but_not_motion():
    joints = torch.zeros(9).double()  # something keeps it where it is
    known = dataclasses.replace(reference(), kp=torch.full((9,), 100.0).double(), sensor=DEAD)
    law = UncertaintyClosing(known, WAIT_ALONE)
    seen = observation(-0.001, (0.3, 0.3, 0.0), TWO, joints)
    targets = torch.stack([law(seen, PERIOD).reshape(3, 3)[2] for _ in range(120)])
    ahead = -(targets * NORMALS[2]).sum(-1)
    assert law.done and bool(law.touched.all())
    assert (
        CLOSING.stalled < 100.0 * float(ahead[-1]) < 3 * CLOSING.stalled
    )  # it stands, the lag of the average later
    assert torch.allclose(ahead[-20:], ahead[-1:], atol=1e-9)
    known = reference()
    still = torch.zeros(9).double()
    drive = next(iter(known.hand.actuators.values()))
    pushed = DriveFeel(known)
    moving = DriveFeel(known)
    for k in range(200):
        felt = pushed(
            observation(joints=still), still - (0.5 * NORMALS / known.kp[0]).flatten(), PERIOD
        )
        at = still + 0.2 * PERIOD * (k + 1)  # at 0.2 rad/s a drive lags by d/k of it
        free = moving(observation(joints=at), at + drive.kd / known.kp * 0.2, PERIOD)
    assert torch.allclose(felt, real([0.5, 0.5, 0.5]), rtol=1e-3)
    assert float(free.abs().max()) < 1e-6


def test_dead_finger_in_the_air_does_not_move_the_object_estimate():
    moved = {}
    for name, known in (("dead", having(dead=FINGERS[2:])), ("alive", reference())):
        law = UncertaintyClosing(known, ClosingOptions())
        tips = (
            TARGET + 0.01 * NORMALS - 0.01 * NORMALS * real([[0.0], [0.0], [1.0]])
        )  # the last is beyond its contact
        law(dataclasses.replace(observation(), tips=tips), PERIOD)
        moved[name] = float(law.palm.norm())
    assert moved["dead"] == 0 and moved["alive"] > 0


def test_force_hold_regulates_by_sensed_forces_alone():
    start = torch.zeros(9).double()
    silent = observation(0.0, (0.0, 0.0, 0.0), TOUCHING)
    for known, factor in ((having(kind="binary"), 1.0), (reference(), MAX_FACTOR)):
        hold = ForceHold(known, silent, start)
        for _ in range(150):
            hold(silent, PERIOD)
        assert hold.factor == factor
    right = observation(0.0, (2.0, 2.0, 0.0), TOUCHING)
    hold = ForceHold(having(dead=FINGERS[2:]), right, start)
    for _ in range(150):
        hold(right, PERIOD)
    assert hold.factor == pytest.approx(1.0)


def test_holdings_keep_the_largest_force():
    fragile = dataclasses.replace(reference(), max_force=2.0)
    seen = observation(0.0, (0.0, 0.0, 0.0), TOUCHING)
    for holding in ("force", "grip"):
        controller = GraspController(fragile, holding=holding)
        for _ in range(200):
            targets = controller.step(seen, PERIOD)
        pressed = 2.0 * targets.joints.reshape(3, 3)  # kp times the lead of sliding joints is force
        assert float(-(pressed * NORMALS).sum(-1).min()) <= 2.0 + 0.02, holding
        assert float((pressed * NORMALS).sum(-1).abs().max()) <= 2.0 + 0.02, holding
    with pytest.raises(BadArgument, match="force"):
        TrialSpec(force=4.0, max_force=2.0)


@pytest.mark.parametrize(
    ("closing", "holding"), [("paper", "force"), ("position", "force"), ("uncertainty", "grip")]
)
def test_closings_refuse_sensors_that_measure_too_little(closing, holding):
    for sensor in (SensorModel("binary"), SensorModel(dead=FINGERS[:1])):
        with pytest.raises(BadArgument, match="sensor"):
            TrialSpec(closing=closing, holding=holding, sensor=sensor)
        with pytest.raises(BadArgument, match="sensor"):
            GraspController(dataclasses.replace(reference(), sensor=sensor), closing, holding)
    assert TrialSpec(closing="open_loop", sensor=SensorModel("binary")).sensor.kind == "binary"


@pytest.mark.parametrize(
    "changes",
    [{"noise": 1.0}, {"noise": 3.0}, {"kind": "torque"}, {"kind": "torque", "noise": 3.0}],
)
def test_sensor_noise_alone_is_no_touch(changes):
    levers = 0.05 * JACOBIAN  # a torque's noise is 0.2 N here, twice a tactile fingertip's
    sensor = FingertipSensor(having(**changes), torch.Generator().manual_seed(2))
    reports = [sensor(touch((0.0, 0.0, 0.0)), levers, PERIOD) for _ in range(300)]
    assert not torch.stack([t.contact for t in reports]).any()
