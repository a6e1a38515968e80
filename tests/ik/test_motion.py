"""The path to a pre-grasp against distances to solids in closed form."""

import math

import pytest
import torch

from tests.make import distance_field, field_of_mesh
from tests.pinch import HEIGHT, RADIUS, cylinder, pinch
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply, rigid, rotation_from_vector
from torchgrasp.geometry.linalg import unit
from torchgrasp.ik.clearance import CollisionWorld
from torchgrasp.ik.configuration import Configuration, SpatialJacobian
from torchgrasp.ik.motion import (
    APPROACH_DISTANCE,
    FINE_STEPS,
    approach_directions,
    find_approach,
    opened_pose,
)


def spheres_on_path(posture, hand, direction, places=81):
    """Centres (p, s, 3) of the hand's spheres along the path, and their radii."""
    cover = hand.collision_spheres
    centres = SpatialJacobian.at(hand, posture).points(cover.link_index, cover.center)[0]
    back = torch.linspace(APPROACH_DISTANCE, 0.0, places, dtype=torch.float64)
    return centres - back[:, None, None] * direction[0], cover.radius


def cylinder_distance(points):
    """Signed distance to the cylinder of the tests."""
    across = points[..., :2].norm(dim=-1) - RADIUS
    along = (points[..., 2] - HEIGHT / 2).abs() - HEIGHT / 2
    outside = torch.stack([across, along], -1).clamp_min(0).norm(dim=-1)
    return outside + torch.maximum(across, along).clamp_max(0)


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_the_path_is_as_clear_of_the_object_and_the_table_as_said(name):
    hand, grasp = pinch(name)
    posture = Configuration(grasp.pregrasp, grasp.obj_from_hand)
    direction, clearance = find_approach(
        hand, posture, CollisionWorld(field_of_mesh(cylinder()), 0.0)
    )
    assert float(direction.norm()) == pytest.approx(1.0)
    centres, radius = spheres_on_path(posture, hand, direction)
    away = centres[: 81 - 5]  # the last sixteenth is the pre-grasp's own matter
    least = min(
        float((cylinder_distance(away) - radius).min()), float((away[..., 2] - radius).min())
    )
    assert least > 0
    assert float(clearance) == pytest.approx(least, abs=5e-4)


def test_a_wall_is_avoided_and_a_cage_leaves_no_path():
    hand, grasp = pinch("allegro")
    posture = Configuration(grasp.pregrasp, grasp.obj_from_hand)
    center = grasp.obj_from_hand[0, :3, 3]
    free, _ = find_approach(hand, posture, CollisionWorld(field_of_mesh(cylinder()), None))

    def wall(points):
        """Distance to all that is more than 0.1 m behind the hand on that path."""
        return ((points - center) * free[0]).sum(-1) + 0.1

    other, clearance = find_approach(
        hand, posture, CollisionWorld(distance_field(wall, center, 0.4, 0.01), None)
    )
    before = (wall(spheres_on_path(posture, hand, free)[0]) - hand.collision_spheres.radius).min()
    after = (
        wall(spheres_on_path(posture, hand, other)[0][:-5]) - hand.collision_spheres.radius
    ).min()
    assert float(after) > float(before) + 0.02
    assert float(clearance) == pytest.approx(float(after), abs=1e-12)

    def cage(points):
        """Distance to all that is more than 0.15 m from the middle of the hand."""
        return 0.15 - (points - center).norm(dim=-1)

    _, none = find_approach(
        hand, posture, CollisionWorld(distance_field(cage, center, 0.4, 0.01), None)
    )
    assert float(none) < 0


def wall_of(normal, origin):
    """Distance to all that lies behind a plane."""
    return lambda points: ((points - origin) * normal).sum(-1)


def test_the_path_turns_with_hand_and_frame():
    """A wall behind the hand that leans by 40 degrees leaves most room on the path that is tilted
    towards it.
    """
    hand, grasp = pinch("barrett")
    posture = Configuration(grasp.pregrasp, grasp.obj_from_hand)
    axis, side = torch.eye(3).double()[[2, 0]]
    tilted = math.sqrt(0.5) * (axis + side)
    leaning = math.cos(math.radians(40)) * axis - math.sin(math.radians(40)) * side
    assert torch.equal(hand.approach.double(), axis)
    motion = rigid(
        rotation_from_vector(torch.tensor([0.3, -0.8, 0.5]).double()),
        torch.tensor([0.2, 0.1, -0.3]),
    )
    clearances = []
    for turn in (torch.eye(4).double(), motion.double()):
        turned = Configuration(posture.joints, turn @ posture.obj_from_hand)
        rotation = turned.obj_from_hand[0, :3, :3]
        middle = apply(turned.obj_from_hand[0], 0.1 * axis[None])[0]
        wall = wall_of(rotation @ leaning, middle - 0.25 * (rotation @ leaning))
        field = distance_field(wall, middle, 0.35, 0.005)
        direction, clearance = find_approach(hand, turned, CollisionWorld(field, None))
        assert torch.allclose(direction[0], rotation @ tilted, atol=1e-12)
        centres, radius = spheres_on_path(turned, hand, direction)
        # between the nodes of a plane's distance nothing is lost
        assert float(clearance) == pytest.approx(float((wall(centres) - radius).min()), abs=1e-12)
        clearances.append(float(clearance))
    assert clearances[0] == pytest.approx(clearances[1], abs=1e-12)


def test_what_is_called_free_is_free_where_the_nearest_node_errs(generator):
    """Nodes 3 cm apart rank the paths badly; one that is free is chosen all the same, and its
    clearance is exact.
    """
    hand, grasp = pinch("allegro")
    posture = Configuration(grasp.pregrasp, grasp.obj_from_hand)
    centres = SpatialJacobian.at(hand, posture).points(
        hand.collision_spheres.link_index, hand.collision_spheres.center
    )
    middle = centres[0].mean(0)
    radius = hand.collision_spheres.radius
    erred = 0
    for _ in range(8):
        normal = unit(torch.randn(3, generator=generator, dtype=torch.float64))
        directions = approach_directions(hand, posture, None)[0]
        paths = [
            spheres_on_path(posture, hand, d[None], FINE_STEPS + 1)[0][:-1] for d in directions
        ]
        room = torch.stack([(wall_of(normal, middle)(path) - radius).min() for path in paths])
        field = distance_field(
            wall_of(normal, middle + (room.max() - 1e-3) * normal), middle, 0.42, 0.03
        )
        by_node = torch.stack(
            [(field.nearest_node(path) - radius).min() for path in paths]
        ).argmax()
        erred += int(room[by_node] < room.max() - 1e-3)
        direction, clearance = find_approach(hand, posture, CollisionWorld(field, None))
        which = (directions - direction).norm(dim=1).argmin()
        assert float(clearance) == pytest.approx(float(room[which] - room.max() + 1e-3), abs=1e-12)
        assert float(clearance) >= 0
    assert erred > 0


def test_a_pose_that_is_no_pose_is_not_opened():
    """Transposed, or of another scale, it would come back as it is."""
    hand, grasp = pinch("barrett")
    pose = grasp.obj_from_hand
    assert torch.equal(opened_pose(hand, grasp.pregrasp, pose, None), pose)
    for wrong in (pose.mT.contiguous(), 1000 * pose):
        with pytest.raises(BadArgument, match="obj_from_hand: expected a rigid transform"):
            opened_pose(hand, grasp.pregrasp, wrong, grasp.table)
