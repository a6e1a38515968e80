"""The tactile fingertip: lag, noise, hysteresis, reproducibility."""

import math

import torch

from torchgrasp.close.sensor import CUTOFF, NOISE, low_pass, sense, untouched


def run(forces, period=0.01, seed=None):
    """Feed a sequence of forces to one sensor."""
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    touch, trace = untouched(), []
    for force in forces:
        touch = sense(touch, torch.full((3,), float(force), dtype=torch.float64), period, generator)
        trace.append(touch)
    return trace


def test_step_response_is_a_first_order_lag_at_any_rate():
    for period in (0.01, 0.004):
        trace = run([1.0] * 25, period)
        for k, touch in enumerate(trace):
            expected = 1 - math.exp(-2 * math.pi * CUTOFF * (k + 1) * period)
            assert abs(float(touch.reading[0]) - expected) < 1e-9


def test_noise_has_the_papers_size_and_no_bias():
    readings = torch.stack([t.reading for t in run([2.0] * 4000, seed=0)[100:]])
    assert abs(float(readings.std()) - NOISE) < 0.005
    assert abs(float(readings.mean()) - 2.0) < 0.01


def test_contact_has_hysteresis():
    trace = run([0.15] * 60 + [0.3] * 60 + [0.15] * 60 + [0.05] * 60)
    flags = [bool(t.contact[0]) for t in trace]
    assert not any(flags[:60])
    assert flags[119]
    assert all(flags[120:180])
    assert not flags[-1]


def test_noise_alone_is_no_contact():
    assert not any(bool(t.contact.any()) for t in run([0.0] * 3000, seed=3))


def test_same_seed_same_readings_and_no_global_state():
    before = torch.random.get_rng_state()
    first, second, other = (run([1.0] * 5, seed=s)[-1].reading for s in (7, 7, 8))
    assert torch.equal(first, second)
    assert not torch.equal(first, other)
    assert torch.equal(before, torch.random.get_rng_state())


def test_low_pass_is_a_share():
    assert low_pass(1e9, 0.01) == 1.0
    assert 0 < low_pass(1e-3, 0.01) < 1e-4
