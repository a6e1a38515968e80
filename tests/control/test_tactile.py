"""The tactile fingertip: lag, noise, hysteresis, the rate of its samples, where it feels a contact, reproducibility."""

import itertools
import math

import pytest
import torch

from torchgrasp.control.tactile import (
    NOISE,
    SAMPLING_RATE,
    TipContact,
    low_pass,
    measure,
    no_contact,
)

NORMALS = torch.tensor([[1.0, 0, 0], [0, 0.6, 0.8], [0, 0, -1]], dtype=torch.float64)
RADIUS = torch.tensor([0.012, 0.012, 0.0], dtype=torch.float64)
CENTRES = torch.tensor([[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], dtype=torch.float64)
SLANT = torch.linalg.cross(NORMALS, torch.ones(3, dtype=torch.float64).expand(3, 3))  # friction, across the normals


def press(force, air=()):
    """Three tips that press with a force along their normals and half of it across, but those in the air."""
    push = torch.full((3,), float(force), dtype=torch.float64)
    nothing = torch.tensor([i in air for i in range(3)])[:, None]
    points = CENTRES - RADIUS[:, None] * NORMALS
    forces = push[:, None] * (0.5 * SLANT - NORMALS)
    return TipContact(push, forces, torch.where(nothing, torch.nan, points), torch.where(nothing, torch.nan, NORMALS))


def run(forces, period=0.01, seed=None, air=()):
    """Feed a sequence of forces to one sensor."""
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    touch, trace = no_contact(), []
    for force in forces:
        touch = measure(touch, press(force, air), NORMALS, RADIUS, period, generator)
        trace.append(touch)
    return trace


def test_step_response_is_a_first_order_lag_at_any_rate():
    for period in (0.01, 0.02):
        trace = run([1.0] * 25, period)
        for k, touch in enumerate(trace):
            expected = 1 - math.exp(-2 * math.pi * 20.0 * (k + 1) * period)
            assert abs(float(touch.reading[0]) - expected) < 1e-9
            assert torch.allclose(touch.forces, expected * press(1.0).forces)


def test_samples_come_at_the_sensor_s_rate_and_are_held_in_between():
    trace = run([1.0] * 100, period=0.0025)
    changes = [k for k in range(1, 100) if not torch.equal(trace[k].reading, trace[k - 1].reading)]
    assert {b - a for a, b in itertools.pairwise(changes)} == {4} and len(changes) > 20
    held = run([2.0] * 300, period=0.004, seed=1)
    fresh = sum(not torch.equal(a.reading, b.reading) for a, b in zip(held[1:], held, strict=False))
    assert fresh == pytest.approx(300 * 0.004 * SAMPLING_RATE, abs=1.5)


def test_without_noise_the_truth_is_felt():
    touch = run([3.0] * 200)[-1]
    truth = press(3.0)
    assert torch.allclose(touch.reading, truth.normal_force) and torch.allclose(touch.forces, truth.forces)
    assert torch.equal(touch.points, truth.points) and torch.equal(touch.normals, truth.normals)


def test_noise_has_the_papers_size_and_no_bias():
    trace = run([2.0] * 4000, seed=0)[100:]
    readings = torch.stack([t.reading for t in trace])
    assert abs(float(readings.std()) - NOISE) < 0.005
    assert abs(float(readings.mean()) - 2.0) < 0.01
    rest = torch.stack([t.forces for t in trace]) - press(2.0).forces
    along = (rest * NORMALS).sum(-1)
    assert torch.allclose(along, -(readings - 2.0), atol=1e-5)  # one noise along the normal, felt twice
    across = (rest - along[..., None] * NORMALS).norm(dim=-1)
    assert float(across.square().mean().sqrt()) == pytest.approx(2**0.5 * 0.3, rel=0.03)


def test_the_place_of_a_contact_is_noisy_along_the_tip_and_its_normal_with_it():
    trace = run([2.0] * 4000, seed=5)
    points, normals = (torch.stack([getattr(t, name) for t in trace]) for name in ("points", "normals"))
    off = points - press(2.0).points
    assert float(off[:, 0].square().sum(-1).mean().sqrt()) == pytest.approx(2**0.5 * 1.5e-3, rel=0.03)
    assert off.mean(0).norm(dim=-1).max() < 2e-4
    assert torch.allclose(normals.norm(dim=-1), torch.ones(()).double())
    round_tips = CENTRES[:2] - RADIUS[:2, None] * normals[:, :2]
    assert torch.allclose(points[:, :2], round_tips)  # the sensed contact lies on the round tip, where its normal says
    angle = torch.acos((normals * NORMALS).sum(-1).clamp(max=1.0)).square().mean(0).sqrt()
    radius = torch.tensor([0.012, 0.012, 0.012], dtype=torch.float64)
    assert torch.allclose(angle, 2**0.5 * 1.5e-3 / radius, rtol=0.05)


def test_where_nothing_touches_no_contact_is_felt():
    touch = run([0.0] * 50, seed=2, air=(1,))[-1]
    assert torch.isnan(touch.points[1]).all() and torch.isnan(touch.normals[1]).all()
    assert torch.isfinite(touch.points[[0, 2]]).all() and torch.isfinite(touch.forces).all()


def test_contact_has_hysteresis():
    trace = run([0.15] * 60 + [0.3] * 60 + [0.15] * 60 + [0.05] * 60)
    flags = [bool(t.contact[0]) for t in trace]
    assert not any(flags[:60])
    assert flags[119]
    assert all(flags[120:180])
    assert not flags[-1]


def test_noise_alone_is_no_contact():
    assert not any(bool(t.contact.any()) for t in run([0.0] * 3000, seed=3, air=(0, 1, 2)))


def test_same_seed_same_readings_and_no_global_state():
    before = torch.random.get_rng_state()
    first, second, other = (run([1.0] * 5, seed=s)[-1] for s in (7, 7, 8))
    assert torch.equal(first.reading, second.reading) and torch.equal(first.points, second.points)
    assert not torch.equal(first.reading, other.reading)
    assert torch.equal(before, torch.random.get_rng_state())


def test_low_pass_is_a_share():
    assert low_pass(1e9, 0.01) == 1.0
    assert 0 < low_pass(1e-3, 0.01) < 1e-4
