"""The tactile fingertip: lag, noise, hysteresis, sampling rate, place of the contact,
reproducibility.
"""

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
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.linalg import unit

NORMALS = torch.tensor([[1.0, 0, 0], [0, 0.6, 0.8], [0, 0, -1]], dtype=torch.float64)
RADIUS = torch.tensor([0.012, 0.012, 0.0], dtype=torch.float64)
POINTS = 0.1 * torch.eye(3, dtype=torch.float64) - RADIUS[:, None] * NORMALS
SLANT = torch.linalg.cross(
    NORMALS, torch.ones(3, 3, dtype=torch.float64)
)  # friction, across the normals


def press(force, air=(), batch=()):
    """Tips that press with a force along their normals and half of it across; tips in the air have
    no place.
    """
    push = torch.full((*batch, 3), float(force), dtype=torch.float64)
    nothing = torch.tensor([i in air for i in range(3)])[:, None]
    points, normals = (
        torch.where(nothing, torch.nan, x).expand(*batch, 3, 3) for x in (POINTS, NORMALS)
    )
    return TipContact(push, push[..., None] * (0.5 * SLANT - NORMALS), points, normals)


def run(forces, period=0.01, seed=None, air=(), batch=()):
    """Feed a sequence of forces to sensors."""
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    touch = no_contact(*batch)
    trace = []
    for force in forces:
        touch = measure(touch, press(force, air, batch), NORMALS, RADIUS, period, generator)
        trace.append(touch)
    return trace


@pytest.mark.parametrize("period", [0.01, 0.02])
def test_measure_lags_by_a_first_order_filter_at_any_rate(period):
    assert low_pass(1e9, period) == 1.0 and 0 < low_pass(1e-3, period) < 2e-4
    for k, touch in enumerate(run([1.0] * 25, period)):
        expected = 1 - math.exp(-2 * math.pi * 20.0 * (k + 1) * period)
        assert abs(float(touch.reading[0]) - expected) < 1e-9
        assert torch.allclose(touch.forces, expected * press(1.0).forces)


def test_measure_samples_at_the_sensors_rate_and_holds_the_samples():
    trace = run([1.0] * 60, period=0.0025)
    changes = [k for k in range(1, 60) if not torch.equal(trace[k].reading, trace[k - 1].reading)]
    assert {b - a for a, b in itertools.pairwise(changes)} == {4} and len(changes) > 10
    held = run([2.0] * 100, period=0.004, seed=1)
    fresh = sum(not torch.equal(a.reading, b.reading) for a, b in zip(held[1:], held, strict=False))
    assert fresh == pytest.approx(100 * 0.004 * SAMPLING_RATE, abs=1.5)


def test_measure_without_noise_reads_the_truth_and_no_place_of_a_tip_in_the_air():
    touch = run([3.0] * 50)[-1]
    truth = press(3.0)
    assert torch.allclose(touch.reading, truth.normal_force) and torch.allclose(
        touch.forces, truth.forces
    )
    assert torch.equal(touch.points, truth.points) and torch.equal(touch.normals, truth.normals)
    touch = run([0.0] * 50, seed=2, air=(1,))[-1]
    assert torch.isnan(touch.points[1]).all() and torch.isnan(touch.normals[1]).all()
    assert torch.isfinite(touch.points[[0, 2]]).all() and torch.isfinite(touch.forces).all()


def test_measure_noise_of_forces_has_the_papers_size_and_no_bias():
    last = run([2.0] * 25, seed=0, batch=(4000,))[-1]
    assert abs(float(last.reading.std()) - NOISE) < 0.005
    assert abs(float(last.reading.mean()) - 2.0) < 0.01
    rest = last.forces - press(2.0).forces
    along = (rest * NORMALS).sum(-1)
    assert torch.allclose(
        along, -(last.reading - 2.0), atol=1e-5
    )  # both readings have the same noise
    assert float(last.sliding.std()) == pytest.approx(2e-3, rel=0.03)  # [m/s]; nothing slides
    across = (rest - along[..., None] * NORMALS).norm(dim=-1)
    assert float(across.square().mean().sqrt()) == pytest.approx(2**0.5 * 0.3, rel=0.03)


def test_measure_noise_of_a_place_is_along_the_tip_and_turns_its_normal():
    last = run([2.0] * 2, seed=5, batch=(4000,))[-1]
    off = last.points - POINTS
    assert float(off[:, 0].square().sum(-1).mean().sqrt()) == pytest.approx(
        2**0.5 * 1.5e-3, rel=0.03
    )
    assert off.mean(0).norm(dim=-1).max() < 2e-4
    centres = POINTS + RADIUS[:, None] * NORMALS
    round_tips = centres[:2] - RADIUS[:2, None] * last.normals[:, :2]
    assert torch.allclose(
        last.points[:, :2], round_tips
    )  # the sensed contact lies on the round tip
    angle = (
        torch.acos((unit(last.normals) * NORMALS).sum(-1).clamp(max=1.0)).square().mean(0).sqrt()
    )
    assert torch.allclose(angle, torch.full((3,), 2**0.5 * 1.5e-3 / 0.012).double(), rtol=0.05)


def test_contact_flag_has_hysteresis_and_measure_repeats_itself_by_seed():
    flags = [bool(t.contact[0]) for t in run([0.15] * 60 + [0.3] * 60 + [0.15] * 60 + [0.05] * 60)]
    assert not any(flags[:60]) and all(flags[119:180]) and not flags[-1]
    assert not any(
        bool(t.contact.any()) for t in run([0.0] * 60, seed=3, air=(0, 1, 2), batch=(50,))
    )
    before = torch.random.get_rng_state()
    first, second, other = (run([1.0] * 5, seed=s)[-1] for s in (7, 7, 8))
    assert torch.equal(first.reading, second.reading) and torch.equal(first.points, second.points)
    assert not torch.equal(first.reading, other.reading)
    assert torch.equal(before, torch.random.get_rng_state())


def test_measure_refuses_contacts_of_another_number_of_fingertips():
    with pytest.raises(BadArgument, match="expected 4, as the tactile state, got 3 fingertips"):
        measure(no_contact(fingers=4), press(1.0), NORMALS, RADIUS, period=0.01)
