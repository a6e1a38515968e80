"""Fitting the mixture: its report, its invariance under units, its refusals."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from torchgrasp.foundation.errors import BadArgument
from torchgrasp.posture_model.sample import HandSamples
from torchgrasp.posture_model.training import MIXTURES, fit_mixture


def banana(n: int = 4000, unit: float = 1.0) -> HandSamples:
    """Two joints and a code that depends on them, smoothly and with little noise; lengths in `unit`
    metres.
    """
    rng = np.random.default_rng(4)
    joints = rng.uniform(-1, 1, size=(n, 2))
    a, b = joints.T
    lengths = np.stack([0.05 + 0.02 * a, 0.05 + 0.02 * a * b, 0.06 - 0.01 * b**2], -1) / unit
    cosines = np.stack([np.cos(a), np.cos(a + b), np.sin(b)], -1) + 0.02 * rng.normal(size=(n, 3))
    lengths = lengths + 1e-3 / unit * rng.normal(size=(n, 3))
    q = torch.from_numpy(np.concatenate([lengths, cosines], -1))
    return HandSamples(torch.from_numpy(joints), q, ("a", "b"), {"hand": "toy", "seed": "4"})


def test_eq20_fit_reports_what_it_did_and_the_bic_of_one_gaussian_in_closed_form():
    samples = banana()
    mixture = fit_mixture(samples, 8)
    assert mixture.names == ("a", "b", "L1", "L2", "L3", "N1", "N2", "N3")
    assert mixture.meta["hand"] == "toy"
    assert mixture.meta["samples"] == "4000"
    assert mixture.meta["converged"] == "true"
    assert mixture.regularisation == 1e-6
    mean = float(mixture.log_prob(samples.rows()).mean())
    assert math.isclose(float(mixture.meta["log_likelihood"]), mean, abs_tol=1e-5)
    # The mixture has the mean of its data: a property of every step of EM.
    torch.testing.assert_close(
        mixture.weights @ mixture.means, samples.rows().mean(0), rtol=1e-6, atol=1e-6
    )
    samples = banana(500)
    mixture = fit_mixture(samples, 1, regularisation=0.0)
    covariance = torch.cov(samples.rows().T, correction=0)
    log_likelihood = -0.5 * 500 * (8 * math.log(2 * math.pi) + float(torch.logdet(covariance)) + 8)
    bic = -2 * log_likelihood + (8 + 36) * math.log(500)
    assert math.isclose(float(mixture.meta["bic"]), bic, abs_tol=0.06)
    torch.testing.assert_close(mixture.covariances[0], covariance)


def test_eq23_more_components_predict_better_and_units_do_not_matter():
    train = banana()
    test = banana(1000)
    errors = [
        float((fit_mixture(train, m).joints(test.q) - test.joints).abs().mean()) for m in (1, 4, 16)
    ]
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.1
    metres = fit_mixture(banana(), 5)
    millimetres = fit_mixture(banana(unit=1e-3), 5)
    unit = torch.tensor([1.0, 1, 1e3, 1e3, 1e3, 1, 1, 1], dtype=torch.float64)
    torch.testing.assert_close(metres.weights, millimetres.weights, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(metres.means * unit, millimetres.means, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(
        metres.covariances * unit[:, None] * unit, millimetres.covariances, rtol=1e-5, atol=1e-9
    )


def test_same_seed_same_mixture_and_the_likeliest_of_several_starts_goes_on():
    samples = banana(1500)
    first = fit_mixture(samples, 4, seed=2)
    second = fit_mixture(samples, 4, seed=2)
    assert torch.equal(first.covariances, second.covariances)
    alone = [
        fit_mixture(samples, 6, seed=seed, iterations=MIXTURES.trial_steps, tolerance=0.0)
        for seed in (2, 3, 4)
    ]
    best = max(alone, key=lambda mixture: float(mixture.meta["log_likelihood"]))
    together = fit_mixture(
        samples, 6, seed=2, iterations=MIXTURES.trial_steps, tolerance=0.0, starts=3
    )
    assert len({mixture.meta["log_likelihood"] for mixture in alone}) == 3
    assert torch.equal(together.covariances, best.covariances)
    # The steps of the trial count, and more follow.
    assert together.meta["iterations"] == str(MIXTURES.trial_steps)
    assert fit_mixture(samples, 6, iterations=1).meta["iterations"] == "1"
    assert (
        fit_mixture(samples, 6, seed=2, iterations=30, tolerance=0.0, starts=3).meta["iterations"]
        == "30"
    )


def test_bad_arguments():
    samples = banana(100)
    for components in (0, 50):
        with pytest.raises(BadArgument, match=rf"components: expected .*got {components}"):
            fit_mixture(samples, components)
    with pytest.raises(BadArgument, match=r"samples: expected .*got 3 samples"):
        fit_mixture(samples[:3], 1)
    with pytest.raises(BadArgument, match=r"regularisation: expected .*got nan"):
        fit_mixture(samples, 1, regularisation=float("nan"))
    stiff = dataclasses.replace(
        samples, joints=samples.joints.index_fill(1, torch.tensor([0]), 0.5)
    )
    with pytest.raises(BadArgument, match=r"got no variation in a$"):
        fit_mixture(stiff, 2)
    with pytest.raises(BadArgument, match=r"q: expected .*got nan"):
        dataclasses.replace(samples, q=samples.q * float("nan"))
    samples.q[0, 0] = float("nan")  # a value that is spoilt later
    with pytest.raises(BadArgument, match=r"samples\.q: expected .*got nan"):
        fit_mixture(samples, 2)
