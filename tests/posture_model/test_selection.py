"""The criterion over the number of components, cross-validation, and the judgement on held-out
postures.
"""

import math

import numpy as np
import pytest
import torch
from paper.selection import bic_curve, cross_validate

from torchgrasp import fit_mixture
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.posture_model import DEFAULT_ENERGY, PAPER_ENERGY, HandSamples
from torchgrasp.posture_model.score import evaluate_mixture, growing_bic


def islands(n: int = 1500, m: int = 4) -> HandSamples:
    """Draws of m Gaussians far apart: the criterion's minimum is known."""
    rng = np.random.default_rng(2)
    centres = rng.normal(size=(m, 8)) * 6
    x = centres[rng.integers(m, size=n)] + rng.normal(size=(n, 8))
    return HandSamples(torch.from_numpy(x[:, :2]), torch.from_numpy(x[:, 2:]), ("a", "b"))


def test_bic_is_that_of_the_fit_and_finds_the_number_of_true_components():
    observed = []
    curve = bic_curve(islands(), (1, 2, 3, 4, 5, 6), tick=lambda: observed.append(1))
    assert len(observed) == 6 and curve.components.tolist() == [1, 2, 3, 4, 5, 6]
    assert int(curve.components[curve.bic.argmin()]) == 4
    assert str(curve).endswith("least at 4")
    assert str(bic_curve(islands(), (1, 2))).endswith("no minimum is seen")
    samples = islands()
    curve = bic_curve(samples, (2,), seed=3)
    log_likelihood = float(fit_mixture(samples, 2, seed=3).log_prob(samples.rows()).sum())
    parameters = 1 + 2 * (8 + 8 * 9 // 2)  # one weight, two means and covariances
    assert math.isclose(
        float(curve.bic[0]), -2 * log_likelihood + parameters * math.log(len(samples)), abs_tol=0.1
    )


def test_growing_fits_find_the_number_of_true_components_and_are_as_likely_as_new_fits():
    samples = islands()
    seen = []
    curve = growing_bic(samples, 6, observer=seen.append)
    assert seen == curve.components.tolist() == [1, 2, 3, 4, 5, 6]
    assert int(curve.components[curve.bic.argmin()]) == 4
    apart = bic_curve(samples, range(1, 7)).bic
    torch.testing.assert_close(
        curve.bic[:1], apart[:1], rtol=0, atol=0.1
    )  # one Gaussian has one fit
    torch.testing.assert_close(
        curve.bic[3:4], apart[3:4], rtol=0, atol=2.0
    )  # the true number has one good fit
    assert bool((curve.bic <= apart * 1.02).all())
    assert torch.equal(growing_bic(samples, 2).bic, curve.bic[:2])  # the fits use no random number
    with pytest.raises(BadArgument, match=r"components: expected .*got 200"):
        growing_bic(samples, 200)


def test_cross_validation_judges_each_posture_once_and_by_others():
    samples = islands(400)
    result = cross_validate(samples, (1, 4), folds=4, seed=1)
    assert result.log_likelihood.shape == result.error.shape == (2, 4)
    # One Gaussian by hand: the same division, the moments of three parts, the density on the
    # fourth.
    parts = torch.randperm(400, generator=torch.Generator().manual_seed(1)).tensor_split(4)
    x = samples.rows()
    for fold, held_out in enumerate(parts):
        rest = torch.cat([part for part in parts if part is not held_out])
        gaussian = torch.distributions.MultivariateNormal(
            x[rest].mean(0), torch.cov(x[rest].T, correction=0)
        )
        expected = float(gaussian.log_prob(x[held_out]).mean())
        assert math.isclose(float(result.log_likelihood[0, fold]), expected, abs_tol=1e-3)
    assert bool((result.log_likelihood[1] > result.log_likelihood[0]).all())
    assert bool((result.error[1] < result.error[0]).all())
    assert "4 folds" in str(result)


def test_a_judgement_is_what_it_says():
    samples = islands(600)
    mixture = fit_mixture(samples[:400], 4)
    held_out = samples[400:]
    result = evaluate_mixture(mixture, held_out)
    error = (mixture.joints(held_out.q) - held_out.joints).abs()
    torch.testing.assert_close(result.error, error.mean(0))
    torch.testing.assert_close(result.deviation, error.std(0))
    assert math.isclose(result.mean_error, float(error.mean()))
    modes = mixture.modes(held_out.q, 4)[0]
    pairs = zip(modes, held_out.joints, strict=True)
    off = [min(float((mode - joints).abs().mean()) for mode in found) for found, joints in pairs]
    assert math.isclose(result.nearest_mode, sum(off) / len(off), rel_tol=1e-9)
    accepted = [
        float((mixture.energy(held_out.q) < r).double().mean())
        for r in (PAPER_ENERGY, DEFAULT_ENERGY)
    ]
    assert [result.paper_coverage, result.default_coverage] == accepted
    assert result.meta()["acceptance_paper_coverage"] == f"{accepted[0]:.4f}"
    assert "within reach" in str(result) and "a " in str(result)


def test_bad_arguments():
    samples = islands(100)
    for folds in (1, 51):
        with pytest.raises(BadArgument, match=rf"folds: expected .*got {folds}"):
            cross_validate(samples, (1,), folds=folds)
    mixture = fit_mixture(samples, 1)
    with pytest.raises(BadArgument, match=r"samples: expected .*got 1 postures"):
        evaluate_mixture(mixture, samples[:1])
    other = HandSamples(samples.joints, samples.q, ("a", "c"))
    with pytest.raises(BadArgument, match=r"samples: expected .*got joints"):
        evaluate_mixture(mixture, other)
