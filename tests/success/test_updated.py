"""The next grasp is planned with what the last lift has shown of friction and mass."""

import dataclasses

import pytest

from tests.evaluation.test_causes import record
from torchgrasp import ContactSpec, GraspTask, Status
from torchgrasp.values.distribution import Distribution

FELT = Distribution.between(0.2, 0.3)  # mass [kg] by a felt load


def lifted(status=Status.OK, **shown):
    """The record of a lift that has shown friction or mass."""
    return dataclasses.replace(record(status=status), **shown)


@pytest.mark.parametrize(
    ("mass", "left"),
    [
        (Distribution.between(0.1, 1.0), FELT),
        (Distribution(((0.1, 0.25), (0.5, 0.5))), Distribution.between(0.2, 0.25)),
        (0.25, 0.25),  # the load agrees with the number
        (0.5, FELT),  # it does not
        (Distribution.between(0.4, 1.0), FELT),
    ],
)
def test_a_felt_load_leaves_the_masses_that_agree_with_it(mass, left):
    task = GraspTask(mass=mass, force=3.0)
    assert task.updated(lifted(mass=FELT)) == GraspTask(mass=left, force=3.0)
    for result in (lifted(), lifted(Status.DROPPED, mass=FELT)):
        assert task.updated(result) == task


def test_a_load_that_is_too_heavy_leaves_the_greater_masses():
    heavy = lifted(Status.TOO_HEAVY, mass=Distribution.between(0.6, 10.0))
    known = GraspTask(mass=Distribution.between(0.1, 1.0)).updated(heavy)
    assert known.mass == Distribution.between(0.6, 1.0)


def test_friction_is_what_the_touches_have_left():
    left = Distribution.between(0.3, 0.45)
    spec = ContactSpec(friction=Distribution.between(0.2, 1.0), edges=12)
    found = spec.updated(lifted(friction=left))
    assert found == dataclasses.replace(spec, friction=left)
    assert found.planned_friction == pytest.approx(0.375 * spec.friction_margin)
    assert spec.updated(lifted()) == spec
    one = spec.updated(lifted(friction=Distribution.of(0.8)))
    assert one.friction == 0.8 and isinstance(one.friction, float)
