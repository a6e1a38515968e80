"""A second look: motions of bodies whose distance field is known in closed form are found again,
and followed.
"""

import dataclasses

import pytest
import torch

from tests.control.test_guarded_approach import LENGTH, above, feel
from tests.control.test_localization import CENTER, HALF, RADIUS, ball_field, block, field
from tests.pinch import QUICK, cylinder, pinch
from tests.point_fingers import PERIOD, real
from torchgrasp import GraspController, Plane, PointCloud
from torchgrasp.cloud.camera import look_at
from torchgrasp.control.relook import relocate
from torchgrasp.evaluation import GraspTrial, Truth
from torchgrasp.evaluation.lift import lift_grasp
from torchgrasp.evaluation.views import _camera_of
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply, inverse, rigid, rotation_from_vector
from torchgrasp.geometry.linalg import unit
from torchgrasp.geometry.signed_distance import field_from_surface

TABLE = Plane(real([0, 1, 0]), -0.1)
UP = real([0, 1, 0])


def turned(shift, turn):
    """A motion along the table, and about the vertical through the body's centre."""
    rotation = rotation_from_vector(turn * UP)
    return rigid(rotation, CENTER + real([shift[0], 0, shift[1]]) - rotation @ CENTER)


def seen_block(n=400, seed=0):
    """Points on the three faces of the block that an eye above its first corner sees."""
    generator = torch.Generator().manual_seed(seed)
    inside = 2 * torch.rand(n, 3, generator=generator, dtype=torch.float64) - 1
    face = torch.arange(n) % 3
    return CENTER + HALF * torch.where(torch.arange(3) == face[:, None], 1.0, inside)


@pytest.mark.parametrize(
    "pose", [None, rigid(rotation_from_vector(real([0.4, -1.0, 2.0])), real([0.5, -0.2, 0.1]))]
)
@pytest.mark.parametrize(
    ("shift", "turn"), [((0, 0), 0), ((0.08, -0.08), 0.52), ((-0.02, 0.075), -0.4)]
)
def test_relocate_finds_the_motion_of_a_block_in_any_frame(shift, turn, pose):
    pose = torch.eye(4).double() if pose is None else pose
    motion = turned(shift, turn)
    cloud = PointCloud(apply(pose @ motion, seen_block()))
    found = inverse(pose) @ relocate(field(block, pose), cloud, TABLE.moved(pose)) @ pose
    corners = CENTER + HALF * torch.cartesian_prod(*[real([-1, 1])] * 3)
    assert (apply(found, corners) - apply(motion, corners)).norm(dim=-1).max() < 1e-3
    assert (found[:3, :3] @ UP - UP).norm() < 1e-12 and abs(float(found[1, 3])) < 1e-12


def test_relocate_is_robust_against_noise_and_outliers():
    generator = torch.Generator().manual_seed(0)
    motion = turned((0.05, 0.03), 0.2)
    points = apply(motion, seen_block())
    points = points + 0.002 * torch.randn(points.shape, generator=generator, dtype=torch.float64)
    points[:40] += real([0.03, 0.02, 0.0])  # a tenth of the points is of something else
    found = relocate(field(block), PointCloud(points), TABLE)
    assert (apply(found, CENTER[None]) - apply(motion, CENTER[None])).norm() < 2e-3


def seen_ball(shift):
    """The side of the ball that an eye high above x sees."""
    out = unit(torch.randn(400, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64))
    return PointCloud(CENTER + shift + RADIUS * out[out @ unit(real([0.5, 1, 0])) > 0.2])


def test_controller_moves_the_path_of_its_palm_to_the_object_before_the_approach():
    shift = real([0.05, 0, 0.03])
    controller = GraspController(above(), approach=LENGTH)
    controller.relook(seen_ball(shift))
    assert (controller.targets.palm - shift).norm() < 1e-3 and controller.targets.left == LENGTH
    while controller.approaching:
        here = feel(controller.guard, shift - controller.path)
        assert (controller.step(here, PERIOD).palm - shift).norm() < 1e-3
    assert controller.stops == 0
    assert (controller.step(here, PERIOD).palm - shift).norm() < 1e-3
    # touches are compared with the surface where it is now
    point = apply(controller.reference.obj_from_hand, (CENTER + RADIUS * UP)[None])
    assert abs(float(ball_field().query(point)[0])) < 2e-3


def test_controller_refuses_a_view_without_an_approach_or_after_its_start():
    controller = GraspController(above(), approach=LENGTH)
    controller.step(feel(controller.guard, real([0, 0, 0])), PERIOD)
    for late in (controller, GraspController(above())):
        with pytest.raises(BadArgument, match="cloud"):
            late.relook(seen_ball(real([0, 0, 0])))


def test_the_camera_of_a_view_is_at_its_viewpoint_and_looks_at_its_points():
    cloud = PointCloud(seen_block(), viewpoint=CENTER + real([0.2, -0.3, 0.4]))
    pose = _camera_of(cloud)
    assert torch.allclose(pose[:3, 3], cloud.viewpoint, rtol=0, atol=1e-12)
    middle = apply(inverse(pose), cloud.points.mean(0)[None])[0]
    assert torch.allclose(middle[:2], real([0, 0]), rtol=0, atol=1e-12) and middle[2] > 0


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_a_camera_beside_the_hand_finds_an_object_six_centimetres_away():
    pytest.importorskip("sapien")
    surface = field_from_surface(
        torch.tensor(cylinder().vertices), torch.tensor(cylinder().faces), 0.004
    )
    hand, grasp = pinch("allegro")
    camera = look_at(-120.0, 40.0, 0.5, cylinder())
    away = (-0.045, 0.04)
    spec = dataclasses.replace(QUICK, noise=False)
    found = lift_grasp(
        GraspTrial(hand, grasp, Truth(cylinder(away), camera=camera), surface=surface), spec
    )
    assert (found.held, found.stops, found.attempts) == (
        True,
        0,
        1,
    ) and found.before_lift.distance < 0.005


@pytest.mark.parametrize(
    "wrong",
    [
        1000 * seen_ball(real([0, 0, 0])).points,  # in millimetres
        seen_ball(real([0.6, 0, 0])).points,  # too far away to be found
        apply(
            rigid(rotation_from_vector(real([1.0, 2.0, 0.5])), real([0.2, 0.3, 0.1])),
            seen_ball(real([0, 0, 0])).points,
        ),  # in the camera's frame
    ],
)
def test_a_view_in_another_frame_or_unit_moves_nothing(wrong):
    controller = GraspController(above(), approach=LENGTH)
    before = controller.targets.palm
    with pytest.raises(BadArgument, match=r"cloud.*planned cloud"):
        controller.relook(PointCloud(wrong))
    assert torch.equal(controller.targets.palm, before)
    controller.relook(seen_ball(real([0.05, 0, 0.03])))
