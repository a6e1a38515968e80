import dataclasses
import math

import pytest
import torch
import trimesh

from torchgrasp.cloud.camera import look_at, partial_view, render_depth
from torchgrasp.cloud.sensor import ACTIVE_STEREO, SENSORS, SensorNoise, add_noise
from torchgrasp.errors import BadArgument

NAMES = ["active stereo", *SENSORS]


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


def test_the_noise_of_a_kinect_is_that_of_its_paper():
    noise = dataclasses.replace(SENSORS["kinect_v1"], bias=0.0)
    assert float(wall(2.0, noise).std()) == pytest.approx(1.425e-3 * 2.0**2, rel=0.1)


@pytest.mark.parametrize("name", NAMES)
def test_the_bias_is_smooth_and_of_its_size(name):
    noise = dataclasses.replace(sensor(name), disparity=0.0, step=1e-6, floor=0.0, growth=0.0, lost=0.0)
    errors = wall(0.8, noise).reshape(240, 320)
    assert float(errors.std()) == pytest.approx(noise.bias, rel=0.05)
    assert float((errors[:, 1:] - errors[:, :-1]).std()) < 0.15 * noise.bias


def test_neighbouring_pixels_of_a_grain_have_similar_noise():
    def likeness(grain):
        errors = wall(1.0, SensorNoise(growth=0.002, bias=0.0, lost=0.0, grain=grain)).reshape(240, 320)
        return float((errors[:, 1:] * errors[:, :-1]).mean() / errors.square().mean())

    assert abs(likeness(0.0)) < 0.05
    assert likeness(5.0) > 0.9


def test_the_second_camera_misses_a_strip_beside_a_nearer_surface():
    depth = torch.full((40, 200), 1.0, dtype=torch.float64)
    depth[:, 100:150] = 0.5
    exact = SensorNoise(base=30.0, step=1e-6, bias=0.0, flying=0.0, lost_rim=0.0, lost=0.0, shadow=True)
    seen = add_noise(depth, torch.ones_like(depth), torch.Generator(), exact)
    missing = torch.nonzero(seen[20] == 0)[:, 0]
    assert missing.tolist() == list(range(int(missing[0]), 100))  # up to the nearer surface's left rim
    assert len(missing) == pytest.approx(30.0 * (1 / 0.5 - 1 / 1.0), abs=2)


def test_a_camera_is_chosen_by_name_or_by_its_noise():
    ball, pose = trimesh.creation.icosphere(radius=0.04), look_at(0.0, 30.0)
    views = {name: partial_view(ball, pose, noise=noise).points for name, noise in [("True", True), *SENSORS.items()]}
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
