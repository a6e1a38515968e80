import dataclasses
import math

import numpy as np
import pytest
import torch
import trimesh
from scipy.ndimage import gaussian_filter

from torchgrasp.cloud.camera import INTRINSICS, look_at, partial_view, render_depth
from torchgrasp.cloud.sensor import (
    ACTIVE_STEREO,
    SENSORS,
    SensorNoise,
    add_noise,
    estimate_noise,
    median_depth,
)
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import inverse
from torchgrasp.geometry.plane import Plane

NAMES = ["active stereo", *SENSORS]
BRICK = trimesh.creation.box([0.1, 0.1, 0.1]).apply_translation([0.0, 0.0, 0.05])


def sensor(name: str) -> SensorNoise:
    return SENSORS.get(name, ACTIVE_STEREO)


def wall(z, noise: SensorNoise, seed: int = 0):
    """Return the errors [m] of the measured pixels of a wall that faces the camera at a depth [m]."""
    depth = torch.full((240, 320), float(z), dtype=torch.float64)
    seen = add_noise(depth, torch.ones_like(depth), torch.Generator().manual_seed(seed), noise)
    return (seen - depth)[seen > 0]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("z", [0.5, 1.2])
def test_a_wall_has_the_random_noise_of_the_sensor_and_its_steps(name, z):
    noise = dataclasses.replace(sensor(name), bias=0.0)
    step = noise.step * z * z / noise.base if noise.base else 0.0
    expected = math.hypot(float(noise.sigma(torch.tensor(z))), step / math.sqrt(12))
    assert float(wall(z, noise).std()) == pytest.approx(expected, rel=0.25)


def test_a_stereo_camera_without_steps_has_the_random_noise_alone():
    noise = dataclasses.replace(ACTIVE_STEREO, bias=0.0, step=0.0)
    assert float(wall(0.5, noise).std()) == pytest.approx(0.12 / 33.88 * 0.5**2, rel=0.05)


def test_the_noise_of_a_kinect_is_that_of_its_paper():
    noise = dataclasses.replace(SENSORS["kinect_v1"], bias=0.0)
    assert float(wall(2.0, noise).std()) == pytest.approx(1.425e-3 * 2.0**2, rel=0.1)


@pytest.mark.parametrize("name", NAMES)
def test_the_bias_is_smooth_and_of_its_size(name):
    noise = dataclasses.replace(
        sensor(name), disparity=0.0, fine=0.0, step=1e-6, floor=0.0, growth=0.0, lost=0.0, holes=0.0
    )
    errors = wall(0.8, noise).reshape(240, 320)
    assert float(errors.std()) == pytest.approx(noise.bias, rel=0.05)
    assert float((errors[:, 1:] - errors[:, :-1]).std()) < 0.15 * noise.bias


def test_neighbouring_pixels_of_a_grain_have_similar_noise():
    def likeness(grain):
        errors = wall(1.0, SensorNoise(growth=0.002, bias=0.0, lost=0.0, grain=grain)).reshape(
            240, 320
        )
        return float((errors[:, 1:] * errors[:, :-1]).mean() / errors.square().mean())

    assert abs(likeness(0.0)) < 0.05
    assert likeness(5.0) > 0.9


def test_the_second_camera_misses_a_strip_beside_a_nearer_surface():
    depth = torch.full((40, 200), 1.0, dtype=torch.float64)
    depth[:, 100:150] = 0.5
    exact = SensorNoise(
        base=30.0, step=1e-6, bias=0.0, flying=0.0, lost_rim=0.0, lost=0.0, shadow=True
    )
    seen = add_noise(depth, torch.ones_like(depth), torch.Generator(), exact)
    missing = torch.nonzero(seen[20] == 0)[:, 0]
    assert missing.tolist() == list(
        range(int(missing[0]), 100)
    )  # up to the nearer surface's left rim
    assert len(missing) == pytest.approx(30.0 * (1 / 0.5 - 1 / 1.0), abs=2)


EXACT = SensorNoise(30.0, bias=0.0, flying=0.0, lost_rim=0.0, lost=0.0, grazing=(89.0, 90.0))


def measure(depth, noise: SensorNoise, seed: int = 0):
    return add_noise(depth, torch.ones_like(depth), torch.Generator().manual_seed(seed), noise)


def test_smoothing_blurs_a_surface_and_neither_a_plane_nor_what_is_behind_a_jump():
    noise = dataclasses.replace(EXACT, smoothing=3.0)
    row, column = torch.meshgrid(*(torch.arange(n).double() for n in (60, 120)), indexing="ij")
    roof = 0.6 + 1e-3 * (column - 60).abs()  # edges of 1 mm a pixel
    inner = slice(20, 40), slice(30, 90)
    expected = torch.from_numpy(gaussian_filter(roof.numpy(), 3.0))
    assert (measure(roof, noise) - expected)[inner].abs().max() < 3e-5
    # the edge is rounded by width * sqrt(2 / pi) of the blurred |x|
    assert float(measure(roof, noise)[30, 60] - 0.6) == pytest.approx(
        3e-3 * math.sqrt(2 / math.pi), rel=0.03
    )
    plane = 0.6 + 1e-3 * column + 5e-4 * row
    assert (measure(plane, noise) - plane)[inner].abs().max() < 1e-6
    two = torch.where(column < 60, 0.5, 0.8).double()
    torch.testing.assert_close(measure(two, noise), two)
    gone = torch.where(column < 60, 0.5, 0.0).double()
    torch.testing.assert_close(measure(gone, noise), gone)


def test_worn_rims_are_strips_that_differ_by_view_and_have_their_mean_width():
    row, column = torch.meshgrid(*(torch.arange(300).double() for _ in range(2)), indexing="ij")
    radius = 100.0
    disc = (row - 150) ** 2 + (column - 150) ** 2 < radius**2
    depth = torch.where(disc, 0.6, 0.0).double()
    worn = 5.0
    noise = dataclasses.replace(EXACT, worn=worn, hole_width=5.0)
    left = [int((measure(depth, noise, seed) > 0).sum()) for seed in range(40)]
    strips = torch.tensor([radius - math.sqrt(count / math.pi) for count in left])
    # a width below 0 takes nothing away, which adds a twelfth to the mean of a normal one
    assert float(strips.mean()) == pytest.approx(1.083 * worn, rel=0.3)
    assert float(strips.min()) < 0.4 * worn and 1.5 * worn < float(strips.max()) < 2.5 * worn
    whole = torch.full((40, 40), 0.6, dtype=torch.float64)
    torch.testing.assert_close(measure(whole, noise), whole)


def test_holes_are_patches_and_have_their_share():
    depth = torch.full((400, 400), 0.6, dtype=torch.float64)
    lost = measure(depth, dataclasses.replace(EXACT, holes=0.1, hole_width=4.0)) == 0
    assert float(lost.double().mean()) == pytest.approx(0.1, rel=0.25)
    beside = lost[:, 1:][lost[:, :-1]]
    assert beside.double().mean() > 0.7  # of independent pixels it is 0.1


def test_a_cropped_and_misplaced_view_is_cut_above_its_foot_and_moved_with_its_camera():
    pose = look_at(20.0, 30.0, target=BRICK)
    plain = partial_view(BRICK, pose, n=100000, noise=EXACT)
    cut = partial_view(BRICK, pose, n=100000, noise=dataclasses.replace(EXACT, crop=0.02))
    assert float(plain.points[:, 2].min()) < 0.001
    assert 0.02 < float(cut.points[:, 2].min()) < 0.021
    assert len(cut) == int((plain.points[:, 2] > 0.02).sum())
    moved = dataclasses.replace(EXACT, misplaced=0.003)
    shifts = []
    for seed in range(12):
        cloud = partial_view(BRICK, pose, n=100000, noise=moved, seed=seed)
        assert cloud.viewpoint is not None
        shifts.append(cloud.viewpoint.double() - pose[:3, 3])
        middle = cloud.points.double().mean(0) - plain.points.double().mean(0)
        torch.testing.assert_close(middle, shifts[-1], rtol=0.0, atol=1e-6)
    assert float(torch.stack(shifts).std()) == pytest.approx(0.003, rel=0.25)


def test_a_camera_is_chosen_by_name_or_by_its_noise():
    ball = trimesh.creation.icosphere(radius=0.04)
    pose = look_at(0.0, 30.0)
    views = {
        name: partial_view(ball, pose, noise=noise).points
        for name, noise in [("True", True), *SENSORS.items()]
    }
    assert torch.equal(views["True"], partial_view(ball, pose, noise=ACTIVE_STEREO).points)
    for name in SENSORS:
        assert torch.equal(views[name], partial_view(ball, pose, noise=name).points)
    assert float((views["zivid"].norm(dim=-1) - 0.04).abs().median()) < 0.0005
    image = render_depth([ball], pose, noise="azure")[0]
    assert torch.equal(image, render_depth([ball], pose, noise=SENSORS["azure"])[0])


def test_an_unknown_camera_is_refused_by_name():
    ball = trimesh.creation.icosphere(radius=0.04)
    with pytest.raises(BadArgument, match="noise"):
        partial_view(ball, look_at(0.0, 30.0), noise="sony")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("name", SENSORS)
def test_the_noise_of_a_sensor_is_estimated_from_its_table(name):
    pose = look_at(20.0, 45.0, 0.7)
    noise = SENSORS[name]
    table = Plane.horizontal(0.0).moved(inverse(pose))
    depth, labels = render_depth([BRICK], pose, noise=name)
    found = estimate_noise(depth, INTRINSICS, table, labels == 0)
    z = torch.tensor(0.7)
    step = noise.step * 0.7**2 / noise.base if noise.base else 0.0
    true = torch.hypot(noise.sigma(z), torch.tensor(step / math.sqrt(12)))
    whole = math.hypot(float(true), noise.bias)  # patches of noise count as noise or as bias
    assert math.hypot(float(found.sigma(z)), found.bias) == pytest.approx(whole, rel=0.3)
    assert 0.4 * true < found.sigma(z) < 1.5 * true
    assert estimate_noise(depth, INTRINSICS, table, labels == 1) is None


SEEN = look_at(20.0, 45.0, 0.7)


def frames(count: int, pose):
    return [render_depth([BRICK], pose, noise="kinect_v1", seed=seed)[0] for seed in range(count)]


def test_the_median_of_frames_has_less_noise_and_fewer_holes():
    pose = look_at(20.0, 45.0, 0.7)
    seen = frames(5, pose)
    exact = render_depth([BRICK], pose, noise=False)[0]
    middle = median_depth(seen)

    def error(depth):
        return float((depth - exact)[(depth > 0) & (exact > 0)].abs().median())

    assert error(middle) < 0.6 * error(seen[0])
    assert int(((middle == 0) & (exact > 0)).sum()) < 0.7 * int(
        ((seen[0] == 0) & (exact > 0)).sum()
    )
    assert not bool(middle[exact == 0].any())


def test_the_median_keeps_counts_and_drops_what_most_frames_miss():
    images = [np.array([[700, 0, 500]], dtype=np.uint16), np.array([[702, 0, 0]], dtype=np.uint16)]
    images += [np.array([[701, 300, 0]], dtype=np.uint16)]
    middle = median_depth(images)
    assert middle.dtype == torch.uint16
    assert middle.tolist() == [[701, 0, 0]]


def test_frames_of_a_moved_camera_or_of_several_sizes_are_refused():
    still = frames(2, SEEN)
    assert len(median_depth(still)) == len(still[0])
    with pytest.raises(BadArgument, match=r"frames: .*stand still .*, got frame 3 differs"):
        median_depth([*still, frames(1, look_at(20.0, 45.0, 0.75))[0]])
    # 10 mm of the camera, or of the object alone
    aside = look_at(20.0, 45.0, 0.7)
    aside[0, 3] += 0.01
    for mesh, pose in ((BRICK, aside), (BRICK.copy().apply_translation([0.015, 0.0, 0.0]), SEEN)):
        other = render_depth([mesh], pose, noise="kinect_v1", seed=7)[0]
        for views in ([*still, other], [still[0], other]):
            with pytest.raises(BadArgument, match=r"differs by more than .*% of its (pix|patch)"):
                median_depth(views)
    with pytest.raises(BadArgument, match="one size"):
        median_depth([still[0], still[1][:100]])
    with pytest.raises(BadArgument, match="got none"):
        median_depth([])
