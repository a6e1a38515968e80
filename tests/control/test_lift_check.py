"""A lift that leaves the object behind is felt; a lift that holds it, be it light or carried by the
palm, is not.
"""

import dataclasses

import pytest
import torch

from tests.point_fingers import FREE, PERIOD, TOUCHING, observation, on_table
from torchgrasp.control import no_contact
from torchgrasp.control.recovery import LiftCheck
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.values.closing import SensorModel

ONE = torch.tensor([True, False, False])


def lift(contact, load=0.0, reference=None, noise=0.0, speed=0.1):
    """The check after each tick of a rise to 50 mm, in which the fingertips carry a load [N]."""
    reference = on_table() if reference is None else reference
    check = LiftCheck(reference)
    generator = torch.Generator().manual_seed(1)
    up = reference.table.normal
    lost = []
    for k in range(round(0.05 / speed / PERIOD)):
        drawn = noise * torch.randn(3, 3, generator=generator, dtype=torch.float64)
        seen = observation(0.0, (1.0, 1.0, 1.0), contact)
        tactile = dataclasses.replace(seen.tactile, forces=load / 3 * up + drawn)
        lost.append(
            check(dataclasses.replace(seen, tactile=tactile), (k + 1) * PERIOD * speed, PERIOD)
        )
    return lost


def test_an_object_that_stays_behind_is_lost_for_good_once_the_hand_has_risen_by_a_centimetre():
    lost = lift(FREE)
    first = lost.index(True)
    assert (first + 1) * PERIOD * 0.1 == pytest.approx(0.01, abs=0.1 * PERIOD) and all(lost[first:])
    assert LiftCheck(on_table())(observation(0.0, contact=FREE), 0.02, PERIOD)


@pytest.mark.parametrize("seconds", [0.5, 2.0])
def test_an_object_of_50_grams_in_noisy_fingertips_is_not_lost(seconds):
    assert not any(lift(ONE, load=0.05 * 9.81, noise=0.3 / 3**0.5, speed=0.05 / seconds))
    assert not any(lift(TOUCHING, noise=0.3))


def test_what_one_fingertip_and_the_palm_carry_is_not_lost_until_it_drops():
    reference = on_table()
    check = LiftCheck(on_table())
    seen = observation(0.0, contact=ONE)
    forces = torch.zeros(3, 3, dtype=torch.float64)
    for load, lost in ((1.0, False), (-0.5, True)):
        forces[0] = load * reference.table.normal
        there = dataclasses.replace(
            seen, tactile=dataclasses.replace(seen.tactile, forces=forces.clone())
        )
        for k in range(60):
            found = check(there, 0.0 if load > 0 and k < 20 else 0.03, PERIOD)
        assert found is lost


def slide(*speeds, height=0.02, noise=0.0):
    """When [s] an object is lost that the hand carries, and along which its fingertips slide at
    some speeds [m/s].
    """
    check = LiftCheck(on_table())
    generator = torch.Generator().manual_seed(2)
    seen = observation(0.0, (1.0, 1.0, 1.0), TOUCHING)
    up = on_table().table.normal
    for k in range(round(1.0 / PERIOD)):
        sliding = torch.tensor(speeds).double() + noise * torch.randn(
            3, generator=generator, dtype=torch.float64
        )
        tactile = dataclasses.replace(seen.tactile, forces=up.expand(3, 3).clone(), sliding=sliding)
        if check(dataclasses.replace(seen, tactile=tactile), height, PERIOD):
            return (k + 1) * PERIOD
    return None


def test_an_object_that_slides_along_two_fingertips_in_the_first_centimetres_will_be_lost():
    assert slide(0.004, 0.0, 0.003) == pytest.approx(0.5, abs=1.5 * PERIOD)
    assert slide(0.0, 0.02, 0.02) == pytest.approx(0.075, abs=1.5 * PERIOD)
    assert slide(0.02, 0.0, 0.0) is None  # the object has settled, or turns about the others
    assert slide(0.02, 0.02, 0.02, height=0.021) is None
    assert slide(0.0, 0.0, 0.0, noise=0.002) is None


def test_without_forces_or_table_the_touches_tell():
    binary = dataclasses.replace(on_table(), sensor=SensorModel("binary"))
    for reference in (binary, dataclasses.replace(on_table(), table=None)):
        for contact in (TOUCHING, ONE, FREE):
            check = LiftCheck(reference)
            assert check(observation(0.0, contact=contact), 0.03, PERIOD) is (
                int(contact.sum()) < 2
            )
    dead = dataclasses.replace(
        on_table(), sensor=SensorModel("binary", dead=(on_table().hand.finger_names[2],))
    )
    assert not LiftCheck(dead)(observation(0.0, contact=ONE), 0.03, PERIOD)


def test_a_height_above_the_base_a_far_jump_and_another_hand_are_refused():
    """The hand rises from the height 0."""
    check = LiftCheck(on_table())
    with pytest.raises(BadArgument, match=r"height: .*start of the lift"):
        check(observation(0.0, contact=TOUCHING), 0.65, PERIOD)
    with pytest.raises(BadArgument, match="height"):
        check(observation(0.0, contact=TOUCHING), 50.0, PERIOD)  # in millimetres
    for height in (0.0, 0.2, 0.4, 0.1):
        assert not check(observation(0.0, contact=TOUCHING), height, PERIOD)
    four = dataclasses.replace(observation(0.0), tactile=no_contact(fingers=4))
    with pytest.raises(BadArgument, match=r"observation: .*3 fingertips"):
        check(four, 0.1, PERIOD)


def test_a_broken_sensor_shows_neither_a_load_nor_a_slide():
    """Without the broken one, one fingertip touches, and no load is felt."""
    names = on_table().hand.finger_names
    dead = dataclasses.replace(on_table(), sensor=SensorModel(dead=names[1:]))
    seen = observation(0.0, contact=FREE)
    loud = dataclasses.replace(
        seen.tactile,
        forces=torch.tensor([[0.0] * 3, [0.0, 9.0, 0.0], [0.0] * 3]).double(),
        sliding=torch.tensor([0.0, 9.0, 9.0]).double(),
    )
    checks = [LiftCheck(dead), LiftCheck(dead)]
    for _ in range(50):
        silent, noisy = (
            check(dataclasses.replace(seen, tactile=tactile), 0.015, PERIOD)
            for check, tactile in zip(checks, (seen.tactile, loud), strict=True)
        )
        assert silent == noisy
