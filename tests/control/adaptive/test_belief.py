"""Touches that revise the shape: what was expected changes nothing, a surprise moves the contacts in the air."""

import dataclasses

import pytest
import torch

from tests.point_fingers import GAINS, PERIOD, observation, real, reference
from torchgrasp import fit_shape
from torchgrasp.control.adaptive.belief import FARTHEST, Belief
from torchgrasp.control.closing import LawClosing
from torchgrasp.control.controller import GraspController
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.frames import rigid, rotation_from_vector
from torchgrasp.geometry.linalg import unit
from torchgrasp.values import PointCloud

EYE = torch.eye(4, dtype=torch.float64)
FIRST = torch.tensor([True, False, False])
BALL = 0.03 * unit(torch.randn(600, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
NORMALS = unit(real([[1, 0, 0.3], [1, 0, -0.3], [-1, 0, 0]]))


@pytest.fixture(scope="module")
def shape():
    """A ball of 30 mm, all seen but the side towards -x."""
    seen = BALL[BALL[:, 0] > -0.01]
    return fit_shape(PointCloud(seen, unit(seen), real([0.5, 0.0, 0.0])), seed=0)


def at(radius: float):
    """A reference with contacts on a ball about the origin."""
    return dataclasses.replace(reference(), normals=NORMALS, gains=dataclasses.replace(GAINS, target=radius * NORMALS))


def felt(point: torch.Tensor, normal: torch.Tensor):
    seen = observation(contact=FIRST, reading=(0.3, 0.0, 0.0))
    nothing = torch.full((2, 3), torch.nan, dtype=torch.float64)
    points, normals = torch.cat([point[None], nothing]), torch.cat([normal[None], nothing])
    return dataclasses.replace(seen, tactile=dataclasses.replace(seen.tactile, points=points, normals=normals))


def surface_point(shape, direction: torch.Tensor) -> torch.Tensor:
    """Bisect the estimated surface along a ray from the origin."""
    low, high = 0.0, 0.06
    for _ in range(40):
        middle = 0.5 * (low + high)
        inside = bool(shape.predict((middle * direction)[None]).distance < 0)
        low, high = (middle, high) if inside else (low, middle)
    return low * direction


def test_a_touch_where_it_was_expected_changes_nothing(shape):
    belief, planned = Belief(shape, EYE), at(0.03)
    point = surface_point(shape, NORMALS[0])
    assert belief.revise(felt(point, NORMALS[0]), planned) is planned and belief.shape is shape


def test_a_surprise_moves_the_contacts_in_the_air_onto_the_surface_as_it_is_now(shape):
    belief, planned = Belief(shape, EYE), at(0.03)
    point = surface_point(shape, NORMALS[0]) + 0.01 * NORMALS[0]
    inside = bool(shape.contains(point[None]))
    revised = belief.revise(felt(point, NORMALS[0]), planned)
    target, before = revised.gains.target, planned.gains.target
    assert inside and belief.shape is not shape
    assert float(belief.shape.predict(point[None]).distance.abs() * shape.scale) < 0.01
    assert torch.equal(target[0], before[0]) and torch.equal(revised.normals[0], planned.normals[0])
    for finger in (1, 2):
        step = target[finger] - before[finger]
        assert torch.linalg.cross(step, NORMALS[finger]).norm() < 1e-9 and step.norm() <= FARTHEST + 1e-9
        if step.norm() > 0:
            estimate = belief.shape.predict(target[finger][None])
            assert float(estimate.distance.abs() * shape.scale) < 2e-3
            assert torch.allclose(revised.normals[finger], estimate.normal[0])
    assert (target - before).norm() > 1e-4
    assert belief.revise(felt(point, NORMALS[0]), revised) is revised  # each finger's first touch is taken once


def test_the_answer_does_not_depend_on_the_hand_s_frame(shape):
    turn = rigid(rotation_from_vector(real([0.3, -0.5, 0.9])), real([0.1, 0.2, -0.1]))
    point = surface_point(shape, NORMALS[0]) + 0.01 * NORMALS[0]
    planned = at(0.03)
    first = Belief(shape, EYE).revise(felt(point, NORMALS[0]), planned).gains.target
    back = turn[:3, :3].T
    there = dataclasses.replace(planned.gains, target=(planned.gains.target - turn[:3, 3]) @ back.T)
    aside = dataclasses.replace(planned, normals=NORMALS @ back.T, gains=there)
    seen = felt(back @ (point - turn[:3, 3]), back @ NORMALS[0])
    second = Belief(shape, turn).revise(seen, aside).gains.target
    assert torch.allclose(second @ turn[:3, :3].T + turn[:3, 3], first, atol=1e-7)


def test_a_touch_out_of_the_ball_of_the_posterior_is_left_alone(shape):
    belief, planned = Belief(shape, EYE), at(0.03)
    assert belief.revise(felt(real([1.0, 0.0, 0.0]), NORMALS[0]), planned) is planned and belief.shape is shape


def test_the_closing_follows_the_belief_and_others_refuse_it(shape):
    planned = at(0.03)
    controller = GraspController(planned, belief=shape)
    controller.step(felt(surface_point(shape, NORMALS[0]) + 0.01 * NORMALS[0], NORMALS[0]), PERIOD)
    assert isinstance(controller.closing, LawClosing) and controller.closing.reference is not planned
    with pytest.raises(BadArgument, match="belief"):
        GraspController(planned, "position", belief=shape)
