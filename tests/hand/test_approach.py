"""The way to a pre-grasp against distances to solids in closed form."""

import pytest
import torch

from tests.pinch import HEIGHT, RADIUS, cylinder, pinch
from torchgrasp.frames import rigid, rotate, rotation_from_vector
from torchgrasp.hand.approach import DISTANCE, find_approach
from torchgrasp.hand.clear import Surroundings
from torchgrasp.hand.collide import DistanceField, field_from_mesh
from torchgrasp.hand.motion import Posture, Screws


def spheres_on_the_way(posture, hand, direction, places=81):
    """Centres (p, s, 3) of the hand's spheres from where the way starts to where it ends, and their radii."""
    cover = hand.collision_spheres
    centres = Screws.at(posture, hand).points(cover.link_index, cover.center)[0]
    back = torch.linspace(DISTANCE, 0.0, places, dtype=torch.float64)
    return centres - back[:, None, None] * direction[0], cover.radius


def cylinder_distance(points):
    """Signed distance to the cylinder of the tests."""
    across = points[..., :2].norm(dim=-1) - RADIUS
    along = (points[..., 2] - HEIGHT / 2).abs() - HEIGHT / 2
    outside = torch.stack([across, along], -1).clamp_min(0).norm(dim=-1)
    return outside + torch.maximum(across, along).clamp_max(0)


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_the_way_is_clear_of_the_object_and_the_table_as_said(name):
    hand, grasp = pinch(name)
    posture = Posture(grasp.pregrasp, grasp.obj_from_hand)
    direction, clearance = find_approach(posture, hand, Surroundings(field_from_mesh(cylinder()), 0.0))
    assert float(direction.norm()) == pytest.approx(1.0)
    centres, radius = spheres_on_the_way(posture, hand, direction)
    away = centres[: 81 - 10]  # the last eighth is the pre-grasp's own matter
    least = min(
        float((cylinder_distance(away) - radius).min()),
        float((away[..., 2] - radius).min()),
    )
    assert least > 0
    assert float(clearance) == pytest.approx(least, abs=4e-3)


def field_of(distance, center, half=0.4, spacing=0.01):
    """A field of a distance in closed form around a centre."""
    axis = torch.arange(-half, half, spacing, dtype=torch.float64)
    offsets = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return DistanceField(center - half, spacing, distance(offsets + center))


def test_a_wall_is_avoided_and_a_cage_leaves_no_way():
    hand, grasp = pinch("allegro")
    posture, center = Posture(grasp.pregrasp, grasp.obj_from_hand), grasp.obj_from_hand[0, :3, 3]
    free, _ = find_approach(posture, hand, Surroundings(field_from_mesh(cylinder()), None))

    def wall(points):
        """Distance to all that is more than 0.1 m behind the hand on that way."""
        return ((points - center) * free[0]).sum(-1) + 0.1

    other, clearance = find_approach(posture, hand, Surroundings(field_of(wall, center), None))
    before = (wall(spheres_on_the_way(posture, hand, free)[0]) - hand.collision_spheres.radius).min()
    after = (wall(spheres_on_the_way(posture, hand, other)[0]) - hand.collision_spheres.radius).min()
    assert float(after) > float(before) + 0.02
    assert float(clearance) == pytest.approx(float(after), abs=0.01)

    def cage(points):
        """Distance to all that is more than 0.15 m from the middle of the hand."""
        return 0.15 - (points - center).norm(dim=-1)

    _, none = find_approach(posture, hand, Surroundings(field_of(cage, center), None))
    assert float(none) < 0


def test_the_way_turns_with_hand_and_frame():
    hand, grasp = pinch("barrett")
    turned = rigid(rotation_from_vector(torch.tensor([0.3, -0.8, 0.5]).double()), torch.zeros(3).double())
    nothing = Surroundings(None, None)
    first, infinite = find_approach(Posture(grasp.pregrasp, grasp.obj_from_hand), hand, nothing)
    second, _ = find_approach(Posture(grasp.pregrasp, turned @ grasp.obj_from_hand), hand, nothing)
    assert torch.isinf(infinite).all()
    assert torch.allclose(second, rotate(turned[None], first[:, None])[:, 0], atol=1e-12)
