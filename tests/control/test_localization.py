"""Tactile localization: displacements of bodies whose distance field is known in closed form are
found again.
"""

import dataclasses
import functools
import math

import pytest
import torch

from tests.point_fingers import TARGET, observation, on_table, real
from torchgrasp import SensorModel
from torchgrasp.control.object_pose import SEARCH, Localization, Touches
from torchgrasp.geometry.frames import rigid, rotation_from_vector
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.signed_distance import SignedDistanceField

CENTER = TARGET.mean(0)
RADIUS = 0.03
HALF = real([0.03, 0.02, 0.045])
STILL = torch.zeros(3).double()


def ball(points):
    return (points - CENTER).norm(dim=-1) - RADIUS


def block(points):
    beyond = (points - CENTER).abs() - HALF
    return beyond.clamp_min(0).norm(dim=-1) + beyond.amax(-1).clamp_max(0)


@functools.cache
def ball_field() -> SignedDistanceField:
    """The field of the ball in the hand's frame."""
    return field(ball)


def field(distance, obj_from_hand=None) -> SignedDistanceField:
    """The field of a body given in the hand's frame, on a grid in that of the object."""
    pose = torch.eye(4).double() if obj_from_hand is None else obj_from_hand
    origin = pose[:3, 3] - 0.12
    nodes = origin + 0.003 * torch.cartesian_prod(*[torch.arange(81).double()] * 3)
    return SignedDistanceField(
        origin, 0.003, distance((nodes - pose[:3, 3]) @ pose[:3, :3]).reshape(81, 81, 81)
    )


def known(surface, obj_from_hand=None, **changes):
    """The reference of an object on a table whose normal is the hand's y axis."""
    pose = torch.eye(4).double() if obj_from_hand is None else obj_from_hand
    return on_table(surface=surface, obj_from_hand=pose, **changes)


def displaced(shift, turn=0.0):
    """Where points of an object go that moves along the table and turns about its normal; and
    directions.
    """
    rotation = rotation_from_vector(real([0, turn, 0]))
    return lambda x: (x - CENTER) @ rotation.T + CENTER + shift, lambda n: n @ rotation.T


def touching(points, normals, contact):
    """An observation of fingertips that touch."""
    seen = observation(contact=torch.tensor(contact))
    contact = torch.tensor(contact)[:, None]
    points = torch.where(contact, points, torch.nan)
    normals = torch.where(contact, normals, torch.nan)
    return dataclasses.replace(
        seen, tactile=dataclasses.replace(seen.tactile, points=points, normals=normals)
    )


def touch(reference, points, normals, contact=(True, True, True), tips=None) -> Touches:
    touches = Touches(reference)
    seen = touching(points, normals, contact)
    tips = points + reference.hand.tips.radius[:, None] * normals if tips is None else tips
    touches.add(dataclasses.replace(seen, tips=tips), torch.zeros(3).double())
    return touches


def locate(reference, *touches):
    search = Localization(reference, touches)
    while not search.done:
        search()
    return search.displacement


BALL_POINTS = unit(real([[1, 0.3, 0.5], [0.8, -0.2, -1], [-1, 0.1, 0.2]]))


@pytest.mark.parametrize(
    "shift", [(0.0, 0.0), (0.015, 0.0), (-0.012, 0.02), (0.021, -0.027), (-0.05, 0.04)]
)
def test_localization_finds_a_ball_from_three_touches(shift):
    wanted = real([shift[0], 0.0, shift[1]])
    there = known(ball_field())
    found = locate(there, touch(there, CENTER + RADIUS * BALL_POINTS + wanted, BALL_POINTS))
    assert (found[:3] - wanted).norm() < SEARCH.pitch / 2


def test_localization_finds_the_link_that_touches_on_the_side_of_earlier_touches():
    # the nearer of two spheres of 10 mm touches a ball of 30 mm: the centres are 40 mm apart, on
    # the line between them
    there = known(ball_field())
    gap = RADIUS + 0.01
    links = torch.cat([CENTER + real([[0.09, 0, 0], [0.3, 0, 0.3]]), real([[0.01], [0.01]])], -1)
    far = CENTER + 0.3 * torch.eye(3).double()
    nothing = (False, False, False)
    touches = Touches(there, links, kept=True)
    touches.add(dataclasses.replace(observation(contact=torch.tensor(nothing)), tips=far), STILL)
    found = locate(there, touches)
    wanted = (
        real([0.05, 0, 0]) * 0.03**2 / (0.03**2 + 0.004**2)
    )  # of Gaussians: the prior draws a little
    assert (found[:3] - wanted).norm() < 3e-3
    for side in (1, -1):
        place = real([0.09, 0, 0]) + gap * unit(real([-1.0, 0, side]))
        earlier = touch(there, CENTER + RADIUS * BALL_POINTS + place, BALL_POINTS)
        found = locate(there, earlier, touches)
        assert (
            found[:3] - place
        ).norm() < 6e-3  # without the earlier touches it would be off by 30 mm
        assert (locate(there, earlier)[:3] - place).norm() < SEARCH.pitch / 2


def test_localization_believes_the_last_of_touches_that_contradict_each_other():
    there = known(ball_field())
    places = (real([0.02, 0, 0.01]), real([-0.02, 0, 0.02]))
    one, other = (
        touch(there, CENTER + RADIUS * BALL_POINTS + place, BALL_POINTS) for place in places
    )
    assert (locate(there, other, one)[:3] - places[0]).norm() < 4e-3
    assert (locate(there, one, other)[:3] - places[1]).norm() < 4e-3


def test_localization_after_closing_on_nothing_keeps_away_from_where_the_palm_was():
    there = known(ball_field())
    far = CENTER + 0.3 * torch.eye(3).double()
    felt = []
    places = []
    for _ in range(4):
        places.append(locate(there, *felt)[:3])
        felt.append(Touches(there))
        nothing = observation(contact=torch.zeros(3, dtype=torch.bool))
        felt[-1].add(dataclasses.replace(nothing, tips=far - places[-1]), places[-1])
    gaps = torch.stack(places)[:, None] - torch.stack(places)
    assert places[0].norm() == 0.0 and all(0.02 < x.norm() < 0.06 for x in places[1:])
    assert (gaps.norm(dim=-1) + torch.eye(4)).min() > 0.02
    assert felt[-1].nothing and not touch(there, far, BALL_POINTS, (True, False, False)).nothing


def test_kept_touches_are_what_a_fingertip_felt_before_it_lost_the_object():
    there = known(ball_field())
    points = CENTER + RADIUS * BALL_POINTS
    gone = observation(contact=torch.zeros(3, dtype=torch.bool))
    for kept in (False, True):
        touches = Touches(there, kept=kept)
        for seen in (*[touching(points, BALL_POINTS, (True, False, True))] * 2, gone):
            touches.add(seen, torch.zeros(3).double())
        assert touches.felt.tolist() == [kept, False, kept]
        assert torch.allclose(touches.means()[0][0], points[0], rtol=0, atol=1e-12)


def test_localization_by_one_touch_uses_its_normal():
    # the normal of one contact tells on which side of the ball it is: a plane would tell nothing
    # along itself
    wanted = real([0.02, 0.0, 0.012])
    normal = unit(real([[0.6, 0.0, -0.8]] * 3))
    there = known(ball_field())
    tips = CENTER + real([[0, 0, 0], [0, 0.2, 0], [0, -0.2, 0]])  # the others are far off
    touches = touch(there, CENTER + RADIUS * normal + wanted, normal, (True, False, False), tips)
    along = torch.linalg.cross(normal[0], real([0, 1, 0]))
    known_by = {0: 0.004, 1: 0.3 * RADIUS}  # across the surface, and along it
    shares = [0.03**2 / (0.03**2 + known_by[k] ** 2) for k in (0, 1)]  # of Gaussians
    found = locate(there, touches)[:3]
    for axis, share in zip((normal[0], along), shares, strict=True):
        assert abs(float(found @ axis) - share * float(wanted @ axis)) < 2e-3


@pytest.mark.parametrize("turn", [-0.2, 0.1])
def test_localization_finds_a_turned_block(turn):
    points = CENTER + real([[0.03, 0.005, 0.03], [0.03, -0.005, -0.03], [-0.012, 0.0, 0.045]])
    normals = real([[1, 0, 0], [1, 0, 0], [0, 0, 1]])
    wanted = real([0.008, 0.0, -0.014])
    there = known(field(block))
    (place, direct) = displaced(wanted, turn)
    found = locate(there, touch(there, place(points), direct(normals)))
    assert (found[:3] - wanted).norm() < 3e-3 and abs(float(found[4]) - turn) <= SEARCH.fine_turns[
        -1
    ]


def test_localization_depends_on_no_frame_and_its_error_is_small_under_noise():
    pose = rigid(rotation_from_vector(real([0.4, -1.0, 2.0])), real([0.5, -0.2, 0.1]))
    wanted = real([0.01, 0.0, -0.017])
    one = known(ball_field())
    other = known(field(ball, pose), pose)
    found = [
        locate(x, touch(x, CENTER + RADIUS * BALL_POINTS + wanted, BALL_POINTS))
        for x in (one, other)
    ]
    assert (found[0] - found[1]).norm() < SEARCH.pitch / 2
    generator = torch.Generator().manual_seed(0)
    there = known(ball_field())
    wanted = real([0.01, 0.0, 0.014])
    errors = []
    for _ in range(20):
        drawn = torch.randn(2, 3, 3, generator=generator, dtype=torch.float64)
        normals = unit(BALL_POINTS + 0.1 * drawn[0])
        points = CENTER + RADIUS * BALL_POINTS + wanted + 1.5e-3 * drawn[1]
        errors.append(float((locate(there, touch(there, points, normals))[:3] - wanted).norm()))
    assert sorted(errors)[10] < 3e-3 and max(errors) < 7e-3


def test_localization_keeps_fingertips_in_the_air_outside():
    # a touch at the side of a slab tells nothing along it; the tip in the air does
    there = known(field(block))
    point = CENTER + real([[0.03, 0, 0]] * 3)
    normal = real([[1, 0, 0]] * 3)
    tips = torch.stack([point[0], CENTER + real([0, 0, 0.048]), CENTER + real([0, 0.2, 0])])
    free = locate(
        there, touch(there, point, normal, (True, False, False), tips + real([0, 0, 0.05]))
    )
    stopped = locate(there, touch(there, point, normal, (True, False, False), tips))
    assert abs(float(free[2])) < 2e-3
    assert stopped[2] <= -0.008 + 0.004  # a tip of 10 mm, 3 mm from the end of the slab


def test_localization_ignores_dead_fingers():
    there = known(ball_field())
    name = there.hand.finger_names[2]
    dead = dataclasses.replace(there, sensor=SensorModel(dead=(name,)))
    wanted = real([0.012, 0.0, -0.01])
    points = CENTER + RADIUS * BALL_POINTS + wanted
    tips = (
        points + real([[0], [0], [2e-3]]) * BALL_POINTS
    )  # so near that the last one would have to touch
    found = locate(dead, touch(dead, points, BALL_POINTS, (True, True, False), tips))
    assert (found[:3] - wanted).norm() < 4e-3
    refused = locate(there, touch(there, points, BALL_POINTS, (True, True, False), tips))
    assert (refused[:3] - wanted).norm() > (found[:3] - wanted).norm()


def test_localization_tries_one_turn_a_call_and_finds_no_displacement_without_touches():
    there = known(ball_field())
    assert locate(there).norm() == 0.0
    search = Localization(there, [touch(there, CENTER + RADIUS * BALL_POINTS, BALL_POINTS)])
    for k in range(len(SEARCH.turns) + len(SEARCH.fine_turns)):
        assert not search.done and search.step == k
        search()
    assert search.done and math.isfinite(search.cost)
