"""Expectation-maximisation against scikit-learn and closed forms."""

import dataclasses

import numpy as np
import pytest
import torch
from sklearn.mixture import GaussianMixture

from tests.make import near, real
from torchgrasp.foundation.errors import BadArgument, IndefiniteCovariance
from torchgrasp.posture_model.em import (
    EM,
    Components,
    DataRows,
    EmRule,
    FitProgress,
    coefficients_from_components,
    components_from_sums,
    expectation,
    expectation_maximisation,
    features_from_data,
    maximisation,
    start_components,
)


def clustered(n: int = 6000, d: int = 5, m: int = 4) -> torch.Tensor:
    """Standardised draws of overlapping Gaussians."""
    rng = np.random.default_rng(3)
    turn = rng.normal(size=(m, d, d)) * 0.5
    which = rng.integers(m, size=n)
    x = rng.normal(size=(m, d))[which] * 2 + np.einsum(
        "nij,nj->ni", turn[which], rng.normal(size=(n, d))
    )
    return torch.from_numpy((x - x.mean(0)) / x.std(0))


def test_eq19_features_give_the_gaussian_density_and_eq20_one_component_the_sample_moments(
    generator,
):
    d = 4
    m = 3
    root = torch.randn(m, d, d, generator=generator, dtype=torch.float64)
    covariances = root @ root.transpose(1, 2) + 0.1 * torch.eye(d, dtype=torch.float64)
    means = torch.randn(m, d, generator=generator, dtype=torch.float64)
    weights = real([0.2, 0.3, 0.5])
    x = torch.randn(50, d, generator=generator, dtype=torch.float64)
    result = coefficients_from_components(
        Components(weights, means, covariances)
    ) @ features_from_data(x)
    for k in range(m):
        gaussian = torch.distributions.MultivariateNormal(means[k], covariances[k])
        torch.testing.assert_close(
            result[k], gaussian.log_prob(x) + weights[k].log(), rtol=1e-9, atol=1e-9
        )
    x = clustered()
    result = components_from_sums(features_from_data(x).sum(1)[None], len(x), 0.0)
    torch.testing.assert_close(result.weights, torch.ones(1, dtype=torch.float64))
    near(result.means[0], x.mean(0), 1e-12)
    torch.testing.assert_close(result.covariances[0], torch.cov(x.T, correction=0))


@pytest.mark.promise("N11")
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_eq20_em_equals_scikit_learn_from_the_same_start():
    x = clustered()
    m = 6
    steps = 15
    start = start_components(DataRows(x), m, seed=0, regularisation=1e-6)
    ours = expectation_maximisation(DataRows(x), start, EmRule(steps, 0.0, 1e-6))
    first = start.components
    theirs = GaussianMixture(
        m,
        weights_init=first.weights.numpy(),
        means_init=first.means.numpy(),
        precisions_init=torch.linalg.inv(first.covariances).numpy(),
        reg_covar=1e-6,
        tol=0.0,
        max_iter=steps,
    ).fit(x.numpy())
    np.testing.assert_allclose(ours.components.weights, theirs.weights_, atol=1e-6)
    np.testing.assert_allclose(ours.components.means, theirs.means_, atol=1e-6)
    np.testing.assert_allclose(ours.components.covariances, theirs.covariances_, atol=1e-6)
    np.testing.assert_allclose(float(ours.log_likelihood[-1]), theirs.score(x.numpy()), atol=1e-9)


@pytest.mark.promise("N11")
@pytest.mark.parametrize("m", [1, 3, 9])
def test_log_likelihood_never_decreases(m):
    x = clustered()
    fit = expectation_maximisation(
        DataRows(x),
        start_components(DataRows(x), m, 1, 1e-6),
        EmRule(60, 0.0, 1e-6),
    )
    assert float(fit.log_likelihood.diff().min()) >= -1e-9
    # The last entry belongs to the components that are returned.
    _, log_likelihood = expectation(DataRows(x), fit.components)
    torch.testing.assert_close(log_likelihood / len(x), fit.log_likelihood[-1])


def test_start_finds_separate_clusters_by_the_seed_and_names_fewer_rows_than_components(generator):
    x = clustered()
    first, second = (start_components(DataRows(x), 5, 7, 1e-6) for _ in range(2))
    assert torch.equal(first.components.means, second.components.means)
    assert not torch.equal(
        first.components.means, start_components(DataRows(x), 5, 8, 1e-6).components.means
    )
    centres = real([[-2.0, 0], [2, 0], [0, 3]])
    x = (
        centres[:, None] + 0.05 * torch.randn(3, 200, 2, generator=generator, dtype=torch.float64)
    ).flatten(0, 1)
    start = start_components(DataRows(x), 3, 0, 0.0).components
    torch.testing.assert_close(start.weights, torch.full((3,), 1 / 3, dtype=torch.float64))
    assert float(torch.cdist(centres, start.means).amin(1).max()) < 0.02
    rows = real([[0.0, 1.0], [1.0, 0.0]]).repeat(50, 1)
    with pytest.raises(BadArgument, match=r"components: expected at most 2, .*got 3"):
        start_components(DataRows(rows), 3, 0, 1e-6)


def test_an_indefinite_start_and_data_that_span_no_covariance_are_errors():
    x = clustered()
    start = start_components(DataRows(x), 3, 0, 1e-6)
    flat = start.components.covariances * torch.tensor([1.0, 1, 0])[:, None, None]
    components = Components(start.components.weights, start.components.means, flat)
    begun = FitProgress(components, start.reseeded, start.log_likelihood)
    with pytest.raises(IndefiniteCovariance, match="fewer components"):
        expectation_maximisation(DataRows(x), begun, EmRule(5, 0.0, 0.0))
    x = torch.cat([x, x[:, :1]], 1)  # a column twice
    with pytest.raises(IndefiniteCovariance, match="collapsed 1 times"):
        start_components(DataRows(x), 3, 0, 0.0)


def test_a_collapsed_component_is_placed_anew_and_the_fit_recovers():
    x = clustered()
    start = start_components(DataRows(x), 3, 0, 1e-6)
    # A component so far away that no row belongs to it: it takes half of the heaviest one.
    means = start.components.means.index_fill(0, torch.tensor([1]), 50.0)
    lost = FitProgress(
        dataclasses.replace(start.components, means=means), start.reseeded, start.log_likelihood
    )
    steps: list[FitProgress] = []
    fit = expectation_maximisation(
        DataRows(x), lost, EmRule(200, 1e-6, 1e-6), observer=steps.append
    )
    assert fit.reseeded.tolist() == [0, 1, 0]
    assert [step.jumped for step in steps[:2]] == [True, False]
    assert fit.converged
    assert float(fit.components.weights.min()) > 0.05
    assert float(fit.log_likelihood[1:].diff().min()) >= -1e-9
    usual = expectation_maximisation(DataRows(x), start, EmRule(200, 1e-6, 1e-6))
    assert abs(float(fit.log_likelihood[-1] - usual.log_likelihood[-1])) < 0.05


@pytest.mark.promise("I11")
def test_a_component_is_placed_anew_three_times_and_no_more():
    x = clustered()
    components = start_components(DataRows(x), 3, 0, 1e-6).components
    sums, _ = expectation(DataRows(x), components)
    sums[2] = 0.0
    for before in range(EM.most_reseeds):
        result, reseeded = maximisation(sums, len(x), 0.0, torch.tensor([0, 0, before]))
        assert reseeded.tolist() == [0, 0, before + 1]
        heaviest = int(components_from_sums(sums, len(x), 0.0).weights.argmax())
        torch.testing.assert_close(result.weights[2], result.weights[heaviest])
        # half of the heaviest each, to either side: its mean is kept
        middle = (result.means[2] + result.means[heaviest]) / 2
        torch.testing.assert_close(middle, sums[heaviest, 1:6] / sums[heaviest, 0])
        # apart by one standard deviation along the longest axis
        spread, axes = torch.linalg.eigh(
            components_from_sums(sums, len(x), 0.0).covariances[heaviest]
        )
        apart = (result.means[2] - result.means[heaviest]).abs()
        torch.testing.assert_close(apart, spread[-1].sqrt() * axes[:, -1].abs())
    with pytest.raises(IndefiniteCovariance, match=r"component 2, of 0\.0 rows, collapsed 4 times"):
        maximisation(sums, len(x), 0.0, torch.tensor([0, 0, EM.most_reseeds]))
